"""A running generator follows what people merge, even if no demand comes.

The generator uses the state repo by its path, by a file URL or by smart HTTP. No test
measures time: each wait ends with the expected event. Tests repair every file that they break, and
every commit verifies.
"""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import QueueFull
from demandops.repo.load import last_valid_config
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.git_over_http import Server
from tests.kit.repo import read as file_of
from tests.kit.rig import Person, Stages, goal, leave

NODES, CLUSTERS = "inventory/nodes.yaml", "inventory/clusters.yaml"
BROKERS, CHARTS = "inventory/brokers.yaml", "registry/charts.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
SOON_S = 0.1


@pytest.fixture
def place(request: pytest.FixtureRequest, bare: Path) -> str:
    """The address of the state repo: its path, its file URL or its URL at the Git server."""
    if request.param == "embedded":
        return str(bare)
    return bare.as_uri() if request.param == "file-url" else request.getfixturevalue("http")


def claim_of(bare: Path, who: str) -> str:
    return next(path for path in rig.claims(bare, who) if "applications" in path)


def edited(bare: Path, path: str, old: str, new: str) -> dict[str, str | None]:
    text = file_of(bare, path)
    assert old in text
    return {path: text.replace(old, new, 1)}


def newest(bare: Path) -> rig.Commit:
    return rig.commits(bare)[-1]


def followed(bare: Path, made: str) -> rig.Commit:
    """Wait until the generator has followed a person's commit; return the generator's commit."""
    rig.wait_until(lambda: newest(bare).id != made, "the generator follows")
    (commit,) = [c for c in rig.commits(bare, f"{made}..main") if c.one("Operation") == "follow"]
    assert commit.one("Follows") == made
    return commit


def problems(bare: Path) -> list[dict[str, str]]:
    text = rig.git(bare, "show", f"main:{last_valid_config.PATH}", check=False)
    data = yaml.safe_load(text) if "problems:" in text else {"problems": []}
    return list(data["problems"])


# ---- honoured ----


def _move_node(bare: Path) -> dict[str, str | None]:
    before, _, rest = file_of(bare, NODES).partition("  - id: vehicle01\n")
    moved = rest.replace("cluster: c-its", "cluster: garage", 1)
    clusters = file_of(bare, CLUSTERS) + "  - name: garage\n"
    return {NODES: f"{before}  - id: vehicle01\n{moved}", CLUSTERS: clusters}


def _move_broker(bare: Path) -> dict[str, str | None]:
    return edited(bare, BROKERS, "service-mqtt-broker-edge", "elsewhere")


def _bump_chart(bare: Path) -> dict[str, str | None]:
    metadata = "appdefs/object-detection-fusion/charts/object-fusion/Chart.yaml"
    version = yaml.safe_load(file_of(bare, metadata))["version"]
    before, name, rest = file_of(bare, CHARTS).partition("object-fusion")
    registry = before + name + rest.replace(f"{version}", "9.8.7", 1)
    changed = edited(bare, metadata, f"version: {version}", "version: 9.8.7")
    return changed | {CHARTS: registry}


CHANGES: dict[str, Any] = {
    "deleted-claim": (
        "embedded",
        lambda bare: dict.fromkeys(rig.claims(bare, "user1")),
        lambda text: "user1" not in text,
    ),
    "edited-claim": (
        "file-url",
        lambda bare: edited(bare, claim_of(bare, "user1"), "/vehicle01/ego_data", "/another"),
        lambda text: "/vehicles/another" in text,
    ),
    "moved-node": ("http", _move_node, lambda text: "garage" in text),
    "bumped-chart": ("file-url", _bump_chart, lambda text: "9.8.7" in text),
}
"""Maps a change to the kind of address that it is tested with, a function that returns the changed
files, and a check of the result, which does not depend on the address."""


def _everything(bare: Path) -> str:
    """Return all files below clusters/ and ledger/ as one text, each line with its path."""
    return rig.git(bare, "grep", "", "main", "--", "clusters", "ledger")


@pytest.mark.parametrize(
    ("place", "change"), [(CHANGES[name][0], name) for name in CHANGES], indirect=["place"]
)
def test_a_change_is_honoured_without_any_demand(
    place: str, bare: Path, person: Person, change: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="demandops")
    _, make, holds = CHANGES[change]
    with rig.running(place, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1), goal(2))
        made = person.change(make(bare), f"A {change}")
        commit = followed(bare, made)
        assert commit.one("Caused-By") == f"{made} Petra Platform <petra@example.org>"
        assert holds(_everything(bare))
        by_petra = rig.git(bare, "log", "--author=<petra@example.org>", "--format=%H", "main")
        assert by_petra.splitlines() == [commit.id, made]
        committer = rig.git(bare, "log", "-1", "--format=%cn", commit.id)
        assert committer == "DemandOps generator"
        rig.book(generator, goal(3))
        assert holds(_everything(bare)), "the change must hold after a further demand"
    assert caplog.text.count(f"after commit {made[:12]}") == 1
    rig.assert_sound(bare)


# ---- broken ----


def _claim_on_no_node(bare: Path) -> dict[str, str | None]:
    return edited(bare, claim_of(bare, "user1"), "node: edge\n", "node: nowhere\n")


def _node_on_no_cluster(bare: Path) -> dict[str, str | None]:
    return edited(bare, NODES, "cluster: c-its", "cluster: c-itz")


BREAKS: dict[str, Any] = {
    "claim-that-does-not-parse": (
        "embedded",
        lambda bare: {claim_of(bare, "user1"): "requesters: nobody\n"},
        "ledger/applications/",
    ),
    "claim-on-an-unknown-node": ("file-url", _claim_on_no_node, "ledger/applications/"),
    "node-in-use-gone": ("file-url", rig.without_vehicle01, NODES),
    "appdef-in-use-gone": ("embedded", lambda bare: {APPDEF: None}, APPDEF),
}


@pytest.mark.parametrize(
    ("address", "change"), [(BREAKS[name][0], name) for name in BREAKS], indirect=["address"]
)
def test_a_broken_change_is_reported_with_its_commit_until_it_is_mended(
    address: str, bare: Path, person: Person, change: str, caplog: pytest.LogCaptureFixture
) -> None:
    _, make, where = BREAKS[change]
    with rig.running(address, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1), goal(2))
        broken = make(bare)
        mended = {path: file_of(bare, path) for path in broken}
        standing = rig.git(bare, "rev-parse", "main:clusters")
        made = person.change(broken, "A merge gone wrong")
        followed(bare, made)
        told = problems(bare)
        assert told and all(problem["since"] == made for problem in told)
        assert {problem["author"] for problem in told} == {"Petra Platform <petra@example.org>"}
        assert all(problem["file"].startswith(where) for problem in told), told
        rig.wait_until(lambda: generator.snapshot.problems, "diagnostics show the change")
        assert rig.git(bare, "rev-parse", "main:clusters") == standing
        report = rig.git(bare, "rev-parse", f"main:{last_valid_config.PATH}")
        rig.book(generator, goal(3), goal(6), leave(3))
        assert rig.git(bare, "rev-parse", f"main:{last_valid_config.PATH}") == report, (
            "a demand must not change the report"
        )
        assert [c.one("Operation") for c in rig.commits(bare)][-3:] == ["join", "join", "shutdown"]
        logged = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
        assert len(logged) == len(set(logged)) == len(told)
        followed(bare, person.change(mended, "Mend it"))
        assert problems(bare) == []
        rig.wait_until(lambda: not generator.snapshot.problems, "diagnostics show the change")
    assert rig.books(bare) == rig.books_after([goal(1), goal(2), goal(6)])
    rig.assert_sound(bare)


def test_a_problem_that_stands_at_a_restart_is_reported_no_second_time(
    url: str, bare: Path, person: Person
) -> None:
    with rig.running(url, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1), goal(2))
        followed(bare, person.change(_claim_on_no_node(bare), "Nowhere"))
        rig.book(generator, goal(6))  # for the application of goal 1
    tip = rig.tip(bare)
    with rig.running(url, fetch_interval=SOON_S) as generator:
        rig.wait_until(lambda: generator.snapshot.problems, "the generator sees the problem again")
        assert rig.tip(bare) == tip
        assert rig.book(generator, leave(6))[0].outcome == "released"
    rig.assert_sound(bare)


def test_a_report_that_a_person_removes_or_edits_is_put_right(bare: Path, person: Person) -> None:
    with rig.running(bare, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        made = person.change(_node_on_no_cluster(bare), "A merge gone wrong")
        followed(bare, made)
        report = file_of(bare, last_valid_config.PATH)
        followed(bare, person.change({last_valid_config.PATH: None}, "No reports, please"))
        assert file_of(bare, last_valid_config.PATH) == report
        followed(
            bare, person.change({last_valid_config.PATH: "problems: [{file: x}, 3]\n"}, "Mine")
        )
        assert file_of(bare, last_valid_config.PATH) == report
    rig.assert_sound(bare)


def test_several_peoples_commits_are_all_named_and_a_readme_is_not(
    url: str, bare: Path, person: Person
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        first = person.change(_move_broker(bare), "Elsewhere")
        person.change({"README.md": "Ours\n"}, "Say whose it is")
        second = person.edit(BROKERS, "elsewhere", "somewhere")
        rig.book(generator, goal(2))
    (commit,) = [c for c in rig.commits(bare) if c.one("Operation") == "follow"]
    named = [value.split()[0] for key, value in commit.trailers if key == "Caused-By"]
    assert named == [first, second]


def test_off_means_off(url: str, bare: Path, person: Person, tmp_path: Path) -> None:
    with (
        rig.running(url) as off,
        rig.running(url, fetch_interval=SOON_S, data=tmp_path / "other") as on,
    ):
        rig.book(off, goal(1))
        known = str(off.snapshot.commit)
        commit = followed(bare, person.change(_move_broker(bare)))
        rig.wait_until(lambda: str(on.snapshot.commit) == commit.id, "the other generator follows")
        assert str(off.snapshot.commit) == known
        off.fetch_now()  # as after a webhook's call
        rig.wait_until(lambda: str(off.snapshot.commit) == commit.id, "the generator follows now")


# ---- the remote is slow, or away ----


def test_a_fetch_that_hangs_delays_no_demand(http: str, server: Server, bare: Path) -> None:
    with rig.running(http, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        hang = server.faults.hang = threading.Event()
        rig.wait_until(lambda: generator._repository._process, "a fetch is under way and hangs")  # type: ignore[attr-defined]
        talking = generator._repository._process  # type: ignore[attr-defined]
        stages = Stages()
        ticket = generator.submit(goal(2), listener=stages)
        rig.wait_until(
            lambda: "committed" in stages.names, "the demand is committed although the fetch hangs"
        )
        assert talking.poll() is not None, "the fetch must be ended for the demand"
        assert not generator.remote_status.unreachable
        server.faults.hang = None
        hang.set()
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


def test_stopping_does_not_wait_for_a_look_that_hangs(http: str, server: Server) -> None:
    generator = Generator(http, fetch_interval=SOON_S)
    hang = server.faults.hang = threading.Event()
    try:
        rig.wait_until(lambda: generator._repository._process, "a fetch is under way and hangs")  # type: ignore[attr-defined]
        assert generator.stop(timeout=2 * rig.PATIENCE_S).result(rig.PATIENCE_S) is True
    finally:
        server.faults.hang = None
        hang.set()


def test_a_goal_is_told_why_it_waits_and_can_be_taken_back_meanwhile(
    http: str, server: Server, bare: Path
) -> None:
    with rig.running(http, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        server.faults.away = True
        rig.wait_until(
            lambda: generator.remote_status.unreachable, "the remote is known to be away"
        )
        stages = Stages()
        stays = generator.submit(goal(2), "op-2")
        goes = generator.submit(goal(3), "op-3", stages)
        rig.wait_until(lambda: stages.told, "the requester is told")
        ((stage, text),) = stages.told
        assert stage == "away" and http in text and "503" in text
        assert generator.withdraw("op-3") is True
        assert rig.outcome(goes) == "Withdrawn"
        assert not stays.future.done()
        assert generator.snapshot.state.ledger.claims_of_requester("user1"), (
            "the known state must stay readable"
        )
        server.faults.away = False
        assert rig.outcome(stays) == "booked"
    assert rig.operations(bare)[-1] == "op-2"


def test_a_full_queue_says_that_the_remote_is_away(http: str, server: Server) -> None:
    with rig.running(http, fetch_interval=SOON_S, queue_limit=3) as generator:
        server.faults.away = True
        rig.wait_until(
            lambda: generator.remote_status.unreachable, "the remote is known to be away"
        )
        tickets = [generator.submit(goal(number)) for number in range(500)]
        # the worker may take demands from the queue into its batch, so the last may find room
        rig.wait_until(lambda: any(one.future.done() for one in tickets), "a demand is refused")
        refused = next(one for one in tickets if one.future.done())
        with pytest.raises(QueueFull, match=r"503"):
            rig.receipt(refused)
        server.faults.away = False


# ---- what the command line reports ----


def test_views_go_on_while_something_is_not_valid_and_say_so(
    bare: Path, person: Person, demandops: Run
) -> None:
    with rig.running(bare, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        made = person.change(_node_on_no_cluster(bare), "A merge gone wrong")
        followed(bare, made)
    status = demandops("status", "--state-repo", bare)
    problem = status.out.splitlines()[1].strip()
    assert problem.startswith(f"{NODES}:") and f"(since {made[:10]} by Petra" in problem
    assert "of-edge-fusion-1" in status.out
    assert (status.code, "problems in files: 1" in status.err) == (1, True)
    (told,) = demandops("status", "--state-repo", bare, "--output", "json").json()["faults"]
    assert (told["file"], told["field"], told["since"]) == (NODES, "nodes[0].cluster", made)
    books = demandops("bookkeeping", "--state-repo", bare)
    assert (books.code, "edge/fusion-1" in books.out) == (0, True)
    assert books.err.startswith(f"warning: {problem}; ")
