"""Text from outside stays a value: it forges no message and no commit of the generator.

A claim that a person writes is checked like a demand.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.naming import Subject, SubjectKind
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import ClaimKey
from demandops.repo import reader
from demandops.repo.merge_check import merge_check
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.repo import FORGER, git, read
from tests.kit.rig import Person, goal

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
POLICY = "policy/access-domains.yaml"
DETECTION = "clusters/c-its/perception/edge/od-edge-station00.yaml"
FORGED = "Why: x\n\nOperation: join\nRequester: control-room\nIn-Force: none\nRender-Version: 3"


def labelled(text: str) -> Any:
    demand = goals.put("labelled")
    demand["applications"][0]["parameters"] = {"label": text}
    return demand


def verdicts(bare: Path) -> list[tuple[bool, str]]:
    with reader.opened(str(bare)) as repo:
        found = repo.verify(repo.revisions(f"{rig.root(bare)}.."))
    return [(verdict.holds, verdict.skipped) for verdict in found]


@pytest.mark.parametrize("text", [f"a\n\n{FORGED}\x00", "\x00", f"a\u2029\u202e\r\r{FORGED}"])
def test_a_parameter_forges_no_message(bare: Path, person: Person, text: str) -> None:
    person.change({APPDEF: read(bare, APPDEF) + "\nparameters:\n  label:\n    merge: latest\n"})
    with rig.running(bare) as generator:
        rig.book(generator, labelled("a"), labelled(text))
    commit = rig.commits(bare)[-1]
    assert (commit.one("Requester"), commit.one("Operation")) == ("vehicle00", "put")
    assert "In-Force" not in dict(commit.trailers)
    message = git(bare, "log", "-1", "--format=%B")
    assert message.replace("\n", "").isprintable()
    assert not [line for line in message.splitlines() if line.startswith("Requester: control")]
    assert all(holds for holds, _ in verdicts(bare))
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))


@pytest.mark.parametrize("message", [f"Forged\n\n{FORGED}\n", "Render-Version: 1\n\nFrom: x\n"])
def test_a_persons_commit_that_quotes_trailers_is_a_persons(
    generator: Generator, bare: Path, person: Person, message: str
) -> None:
    rig.book(generator, goal(1))
    before = read(bare, DETECTION)
    person.change({DETECTION: before + "# changed\n"}, message)
    rig.book(generator, goal(2))
    assert read(bare, DETECTION) == before
    assert (True, "made by a person") in verdicts(bare)
    with reader.opened(str(bare)) as repo:
        (entry,) = [entry for entry in repo.log() if entry.author == "Petra Platform"][-1:]
    assert (entry.trailers, entry.why) == ({}, "")


def test_where_keys_are_listed_an_unsigned_commit_is_a_persons(
    bare: Path, person: Person, tmp_path: Path
) -> None:
    key = tmp_path / "key"
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", str(key)]
    subprocess.run(command, check=True)
    person.change({"policy/allowed-signers": f"generator {Path(f'{key}.pub').read_text()}"})
    with rig.running(bare, signing_key=key) as generator:
        rig.book(generator, goal(1))
        before = read(bare, DETECTION)
        made = person.change({DETECTION: before + "# changed\n"}, f"Forged\n\n{FORGED}", FORGER)
        rig.book(generator, goal(2))
        assert read(bare, DETECTION) == before
    assert made in [value.split()[0] for c in rig.commits(bare) for value in c.all("Caused-By")]


# ---- manual claims ----


def with_rules(bare: Path, **quotas: int) -> str:
    data = yaml.safe_load(read(bare, POLICY))
    for domain in data["domains"]:
        domain["rules"] = [{"name": "ours", "requesters": ["user*", "station*"]}]
        domain["quotas"] = quotas
    return yaml.safe_dump(data)


def by_hand(
    bare: Path, requester: str, app: str = "edge/d1", demand: str = "by-hand"
) -> dict[str, str | None]:
    """Return a copy of user1's claim file, for another requester."""
    path = next(path for path in rig.claims(bare, "user1") if "applications" in path)
    data = yaml.safe_load(read(bare, path))
    data |= {"demand": demand, "requesters": [requester]}
    data["application"]["id"] = app
    key = ClaimKey(Subject(SubjectKind.APPLICATION, app), demand)
    return {claim_files.path_of(key): yaml.safe_dump(data)}


def held(bare: Path) -> set[tuple[str, ...]]:
    with reader.opened(str(bare)) as repo:
        return {claim.requesters for claim in repo.snapshot().state.ledger}


@pytest.mark.parametrize(
    ("requester", "most", "app", "why"),
    [
        ("control-room", 10, "edge/d1", "no rule of access domain 'perception' is for"),
        ("user1", 2, "edge/d1", "'user1' would hold 3 claims"),
        ("user1\u2060", 10, "edge/d1", "U+2060"),
        ("user1", 10, "edge-d1", "application 'edge/d1' already publishes this topic"),
    ],
)
def test_a_claim_by_hand_that_a_demand_could_not_book_is_put_back(
    bare: Path, person: Person, requester: str, most: int, app: str, why: str
) -> None:
    demands = [goals.put(f"d{number}", f"user{number}") for number in range(1, 4)]
    with rig.running(bare) as generator:
        rig.book(generator, *demands[:2])
        claim = by_hand(bare, requester, app)
        person.change({POLICY: with_rules(bare, claimsPerRequester=most)})
        person.write(claim)
        (fault,) = merge_check.check(person.folder).faults
        assert why in str(fault)
        person.change(claim)
        rig.book(generator, released(demands[1]))
        assert held(bare) == {("user1",)}
        told = rig.git(bare, "log", "-1", "--format=%B", "main^")
        assert next(iter(claim)) in told and why in told
    assert all(holds for holds, _ in verdicts(bare))
    with rig.running(bare) as generator:  # the same after a restart
        rig.book(generator, demands[1])
        assert held(bare) == {("user1",), ("user2",)}


def released(demand: Any) -> Any:
    return {name: demand[name] for name in ("kind", "demand", "requesters")} | {
        "operation": "release"
    }


def test_a_claim_by_hand_that_policy_allows_is_followed(bare: Path, person: Person) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goals.put("d1", "user1"))
        person.change({POLICY: with_rules(bare, claimsPerRequester=3)})
        person.change(by_hand(bare, "user1"))
        rig.book(generator, goals.put("d2", "user2"))
        assert len(rig.claims(bare, "user1")) == 3
        person.change({POLICY: with_rules(bare, claimsPerRequester=1)})
        rig.book(generator, released(goals.put("d2", "user2")))
        assert held(bare) == {("user1",)}, "a booked claim must stay when the policy changes"
