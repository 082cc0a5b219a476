"""Leases on a real repository: a commit releases a demand when its lease ends without a renewal.

The leases have no slack. No test measures time: each wait ends with the expected event.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from demandops.base import settings
from demandops.model.ledger.claim import Claim
from demandops.serve.agenda import LIMIT_LOCAL
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.clock import Clock
from tests.kit.repo import GitRepo

DOMAINS = "policy/access-domains.yaml"
POLICY = """\
apiVersion: demandops/v1
kind: AccessDomains
domains:
- {name: perception, namespace: perception, nodes: ["*"], leases: {slack: 0s}%s}
"""


def _with_policy(repo: Path, more: str = "") -> Path:
    GitRepo(repo).commit({DOMAINS: POLICY % more}, "Short leases\n")
    return repo


@pytest.fixture(scope="session")
def bare_template(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo whose leases have no slack."""
    folder = tmp_path_factory.mktemp("leased") / "state.git"
    return _with_policy(Path(shutil.copytree(bare_template, folder)))


def put(demand: str, lease: Any = 60, who: str = "vehicle00", **more: Any) -> rig.Goal:
    """Return a demand for an application; the generator derives the connection that it needs."""
    return goals.put(demand, who, "station00", **({} if lease is None else {"lease": lease}) | more)


def renew(demand: str, *who: str) -> rig.Goal:
    who = who or ("vehicle00", "station00")
    return {"kind": "Demand", "operation": "renew", "demand": demand, "requesters": [*who]}


def held(generator: Generator, demand: str) -> tuple[Claim, ...]:
    return generator.snapshot.state.ledger.claims_with("demand", demand)


def wait_until_gone(generator: Generator, demand: str) -> None:
    rig.wait_until(lambda: not held(generator, demand), f"'{demand}' is released")


def expiries(repo: Path) -> list[rig.Commit]:
    return [c for c in rig.commits(repo) if c.one("Operation") == "expire"]


def test_a_lease_that_ends_is_one_commit_in_the_requesters_names(
    clock: Clock, url: str, bare: Path
) -> None:
    with rig.running(url, runtime=clock) as generator:
        rig.book(generator, put("short"), put("stays", None))
        end = max(c.lease.expires_at for c in held(generator, "short") if c.lease)
        clock.pass_(60)
        wait_until_gone(generator, "short")
        assert held(generator, "stays")
    (commit,) = expiries(bare)
    assert commit.summary == "Expire edge/short, derived/vehicle00/edge/ego"
    assert commit.all("Demand-Id") == ["short"]
    assert commit.all("Requester") == ["station00", "vehicle00"]
    assert commit.all("Application") == ["edge/short"]
    assert commit.all("Connection") == ["derived/vehicle00/edge/ego"]
    assert len(commit.all("Operation-Id")) == 1
    form = "--format=%an <%ae>%n%ct%n%b"
    author, made, body = rig.git(bare, "log", "-1", form, commit.id).split("\n", 2)
    assert author == "station00, vehicle00 (requesters) <short@requester.demandops.invalid>"
    assert int(made) >= int(end.timestamp()), "the lease was ended too early"
    assert f"ended at {end:%Y-%m-%d %H:%M:%S} UTC" in body.replace("\n", " ")
    assert list(rig.books(bare)["connections"]) == ["derived/vehicle00/edge/ego"]
    rig.assert_sound(bare)


def test_a_renewal_that_waits_counts_before_the_end_that_came_meanwhile(
    clock: Clock, bare: Path
) -> None:
    with rig.running(bare, runtime=clock) as generator:
        rig.book(generator, put("d", 60))
    # by the record, the lease ended 40 s ago; the renewal came before, while no generator ran
    received = (clock.now() + timedelta(seconds=50)).isoformat()
    # so many others before it that it is not in the first batch
    others = {f"op-{number}": renew("nothing") for number in range(LIMIT_LOCAL)}
    rig.leave_in_journal(
        settings.data_home(str(bare)),
        *(
            rig.journaled(operation, goal, received, rig.tip(bare))
            for operation, goal in (others | {"op-renew": renew("d")}).items()
        ),
    )
    clock.pass_(100)
    with rig.running(bare, runtime=clock) as generator:
        rig.wait_until(lambda: "op-renew" in rig.operations(bare), "the renewal is taken up")
        assert held(generator, "d")
    assert expiries(bare) == []


def test_who_could_not_renew_while_no_generator_ran_can_after_the_start(
    clock: Clock, bare: Path
) -> None:
    with rig.running(bare, runtime=clock) as generator:
        rig.book(generator, put("alive", 600), put("gone"))
    clock.pass_(3600)
    with rig.running(bare, runtime=clock) as generator:
        rig.book(generator, renew("alive"))
        clock.pass_(60)
        wait_until_gone(generator, "gone")
        assert held(generator, "alive")
    assert [commit.all("Demand-Id") for commit in expiries(bare)] == [["gone"]]


def test_a_generator_that_starts_holds_up_no_end_at_another(
    clock: Clock, url: str, bare: Path
) -> None:
    with rig.running(url, runtime=clock) as generator:
        rig.book(generator, put("d"))
        clock.pass_(50)
        with rig.running(url, runtime=clock):
            clock.pass_(11)
            wait_until_gone(generator, "d")
    assert len(expiries(bare)) == 1


def test_an_end_that_waits_while_the_clock_is_set_back_does_not_come(
    clock: Clock, url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="demandops")
    with rig.running(url, runtime=clock) as generator:
        rig.book(generator, put("d"))
        with rig.away(bare):
            clock.pass_(61)
            rig.wait_until(
                lambda: "trying again" in caplog.text, "the generator tries to end the lease"
            )
            clock.set_by(-3600)
        rig.book(generator, put("other"))
    assert expiries(bare) == []
    assert re.search(r"is back after \d+ s", caplog.text)


def test_a_lease_that_another_generator_renewed_does_not_expire(
    clock: Clock, url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="demandops")
    with rig.running(url, runtime=clock) as first, rig.running(url, runtime=clock) as second:
        rig.book(first, put("d"))
        rig.book(second, put("d", "1h"))
        assert held(first, "d")[0].lease != held(second, "d")[0].lease
        clock.pass_(60)
        rig.wait_until(
            lambda: held(first, "d")[0].lease == held(second, "d")[0].lease,
            "the first generator has seen the renewal",
        )
    assert "another writer was first" in caplog.text
    assert expiries(bare) == []
    assert rig.claims(bare, "edge/d")
    rig.assert_sound(bare)


def test_odd_goals_are_refusals_and_no_faults_of_the_generator(
    bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The goals go through the journal and real commits, because odd text could break either."""
    hostile = [
        put("d", lease=True),
        put("d", lease=1.5),
        put("d", lease=10**5000),
        put("d", lease="9" * 5000 + "s"),
        put("../../etc/passwd"),
        put("d\nOperation: expire"),
        put("d" * 1025),
        put("d", requesters=[]),
        put("d", requesters=[""]),
        put("d", colour={"deep": json.loads("[" * 900 + "]" * 900)}),
        put("d", operation="destroy"),
        put("d", applications=[None, 7, "x", []]),
        put("d", applications={"id": "x"}),
        put("d", operation="release"),
    ]
    with rig.running(bare) as generator:
        tip = rig.tip(bare)
        codes = [rig.outcome(generator.submit(goal)) for goal in hostile]
        assert rig.tip(bare) == tip and not {"booked", "released"} & {*codes}
        names = ["d" * 1024, "<a@b> (c), d", "ü" * 200, "a: b", "-rf", "#1", "🚗/🚕", "%s\\n$(x)"]
        rig.book(generator, *(put(name, None, who=name) for name in names))
    assert "internal error" not in caplog.text
    made = rig.commits(bare)[-len(names) :]
    assert [(commit.one("Demand-Id"), {*commit.all("Requester")}) for commit in made] == [
        (name, {name, "station00"}) for name in (n.replace("#1", r'"\x231"') for n in names)
    ]
    release = {"kind": "Demand", "operation": "release"}
    with rig.running(bare) as generator:
        assert {claim.demand for claim in generator.snapshot.state.ledger} == {*names}
        rig.book(
            generator, *(release | {"demand": n, "requesters": [n, "station00"]} for n in names)
        )
    assert rig.claims(bare) == []
    rig.assert_sound(bare, verify_last=3)
