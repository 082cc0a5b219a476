"""Text from outside stays a value: it forges no message and no commit of the generator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from demandops.repo import reader

from tests.kit import goals, rig
from tests.kit.repo import FORGER, git, keygen, read
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


def test_where_keys_are_listed_an_unsigned_commit_is_a_persons(
    bare: Path, person: Person, tmp_path: Path
) -> None:
    key = keygen(tmp_path / "key")
    person.change({"policy/allowed-signers": f"generator {Path(f'{key}.pub').read_text()}"})
    with rig.running(bare, signing_key=key) as generator:
        rig.book(generator, goal(1))
        before = read(bare, DETECTION)
        made = person.change({DETECTION: before + "# changed\n"}, f"Forged\n\n{FORGED}", FORGER)
        rig.book(generator, goal(2))
        assert read(bare, DETECTION) == before
    assert made in [value.split()[0] for c in rig.commits(bare) for value in c.all("Caused-By")]
