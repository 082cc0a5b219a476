"""The exact commit messages that `git log` shows."""

from __future__ import annotations

import subprocess
from typing import Any

import pygit2
import pytest
from demandops.base.errors import fault
from demandops.base.naming import id_problem
from demandops.decide.changeset import ReleaseChange
from demandops.decide.decision import Decision
from demandops.model.demand.demand_request import Decommission
from demandops.repo.history import commit_log, commit_message
from demandops.repo.history.commit_log import compose

from tests.kit import goals
from tests.kit.repo import git, write_tree
from tests.unit.decide.test_waiting import put, release, waiting_repo

CONNECTION = goals.connection(
    "station00/edge", ends=("station00", "edge"), topics=[goals.STATION_CLOUD[0]], broker=""
)


def test_a_join_says_what_starts_for_whom_and_what_is_missing(desk: Any) -> None:
    text = commit_message.of_decision(desk.join("vehicle00", "station00"), "op-1", desk.now)
    assert text == (
        "Join edge/fusion\n"
        "\n"
        "Why: request 'intersection', received 2026-03-01 12:00:07 UTC, asks for 1 application in "
        "the name of vehicle00, station00.\n"
        "\n"
        "Desired state:\n"
        "  + od-edge-station00 (object-detection on edge for station00)\n"
        "  + of-edge-fusion-c9b035cdedb8 (object-fusion on edge for edge/fusion)\n"
        "\n"
        "Warnings:\n"
        "  application 'edge/fusion': no connection carries "
        "/stations/station00/pointcloud (point_cloud) of 'station00' to 'edge'\n"
        "\n"
        "Operation: join\n"
        "Operation-Id: op-1\n"
        "Demand-Id: 9f1703487a827065fafb\n"
        "Requester: vehicle00\n"
        "Requester: station00\n"
        "Application: edge/fusion\n"
        "Request-Id: intersection\n"
        "Render-Version: 2\n"
    )


def test_a_demand_that_waits_has_no_releases_that_run() -> None:
    repo, texts = waiting_repo(), list[str]()
    for number in range(4):
        taken = repo.take(put(f"d{number}", 4))
    gone = Decommission("solo", kinds=frozenset({"requester"}))
    for goal in (put("d4", 4, requesters=["solo"]), gone, release("d3")):
        assert isinstance(taken, Decision)
        texts.append(commit_message.of_decision(taken, "op", repo.now))
        taken = repo.take(goal)
    assert isinstance(taken, Decision)
    texts.append(commit_message.of_decision(taken, "op", repo.now))
    assert [text.partition("\n")[0] for text in texts] == [
        "Let d3 wait",
        "Let d4 wait",
        "Decommission solo",
        "Release d3",
    ]
    assert all("\n\nDesired state: unchanged.\n\n" in text for text in texts)
    assert "'solo' was decommissioned on 2026-01-31 12:00:00 UTC; its demands waited" in texts[2]


def test_a_further_requester_changes_nothing_that_runs(desk: Any) -> None:
    desk.join("vehicle00")
    desk.send({"id": "link", "connections": [CONNECTION]})
    text = commit_message.of_decision(desk.join("vehicle01"), "op-2", desk.now)
    assert text == (
        "Join edge/fusion\n"
        "\n"
        "Why: request 'intersection', received 2026-03-01 12:00:07 UTC, asks for 1 application in "
        "the name of vehicle01.\n"
        "\n"
        "Desired state: unchanged; the releases run already, or still run for other requesters.\n"
        "\n"
        "Operation: join\n"
        "Operation-Id: op-2\n"
        "Demand-Id: 5a9efb7eac4d9f70597d\n"
        "Requester: vehicle01\n"
        "Application: edge/fusion\n"
        "Request-Id: intersection\n"
        "Render-Version: 2\n"
    )


def test_a_further_topic_says_what_of_a_release_changes(desk: Any) -> None:
    desk.join("vehicle00")
    lines = commit_message.of_decision(
        desk.join("vehicle00", cloud="/stations/station00/rear"), "op-2", desk.now
    ).split("\n")
    start = lines.index("Desired state:")
    assert lines[start : lines.index("", start)] == [
        "Desired state:",
        "  + od-edge-station00-stations-station00-rea-88c9acf629c3 (object-detection on edge for "
        "station00)",
        "  ~ of-edge-fusion-c9b035cdedb8 (object-fusion on edge for edge/fusion)",
        "      + object_list /station00_stations_station00_rear_1e54632c63c0_local_objectlist",
    ]


def test_a_release_says_what_stops_and_what_was_not_held(desk: Any) -> None:
    desk.join("vehicle00")
    app = goals.application("edge/fusion", clouds=[])
    goal = goals.goal([app], [CONNECTION], id="intersection", shutdown=True)
    text = commit_message.of_decision(desk.send(goal), "op-3", desk.now)
    assert text == (
        "Release edge/fusion\n"
        "\n"
        "Why: request 'intersection', received 2026-03-01 12:00:07 UTC, gives up 1 application in "
        "the name of vehicle00.\n"
        "\n"
        "Desired state:\n"
        "  - od-edge-station00 (object-detection on edge for station00)\n"
        "  - of-edge-fusion-c9b035cdedb8 (object-fusion on edge for edge/fusion)\n"
        "\n"
        "Listed in the request, but not held by the requester:\n"
        "  connection 'station00/edge' for vehicle00\n"
        "\n"
        "Operation: shutdown\n"
        "Operation-Id: op-3\n"
        "Demand-Id: 4175c26d59874079147c\n"
        "Requester: vehicle00\n"
        "Application: edge/fusion\n"
        "Request-Id: intersection\n"
        "Render-Version: 2\n"
    )


def test_a_follow_commit_lists_the_changes_and_the_faults_that_were_not_applied() -> None:
    releases = [ReleaseChange("of-edge", "object-fusion on edge", "", "change", ("- replicas 1",))]
    problems = [fault("nodes[0].id", "appears twice; remove one").within("inventory/nodes.yaml")]
    assert commit_message.of_follow(releases, "c" * 40, "b" * 40, problems) == (
        "Update of-edge after commit cccccccccccc\n"
        "\n"
        "Why: commits up to cccccccccccc changed configuration, ledger or generated files.\n"
        "\n"
        "Desired state:\n"
        "  ~ of-edge (object-fusion on edge)\n"
        "      - replicas 1\n"
        "\n"
        "Not applied, because not valid:\n"
        "  inventory/nodes.yaml: nodes[0].id: appears twice; remove one\n"
        "\n"
        "Operation: follow\n"
        f"Follows: {'c' * 40}\n"
        f"Since: {'b' * 40}\n"
        "Render-Version: 2\n"
    )


def test_a_subject_line_stays_short_however_long_the_ids(desk: Any) -> None:
    decision = desk.join("vehicle00", application="edge/" + "fusion" * 40)
    subject = commit_message.of_decision(decision, "op-1", desk.now).split("\n")[0]
    assert subject == "Join edge/" + ("fusion" * 40)[:79] + "…"
    assert len(subject) == 90


# ---- authors ----

NASTY = [
    *("<script>", "Ada <ada@example.org>", ">", "<>", ".", ". . .", ",", ";:,.", "'", '"', "\\"),
    *("\\\\", '"\\\'"', "-", "--author=x", "#1", "日本 電気", "Ωμέγα", "🚗🚙", "e\u0301", "\u00e9"),
    *("x" * 300, "ü" * 300, "🚗" * 300, "a, b", "key: value"),
    *("Requester: somebody else", "(cherry picked from commit 12ab)", "---", "diff --git a/x b/x"),
    *("%H", "$(touch /tmp/x)", "{{ 7 * 7 }}", "station00/a b", "vehicle_00", "Signed-off-by"),
    *("a  b", "%(trailers)"),
]


def test_commits_in_the_name_of_nasty_requesters_are_sound_and_read_back_exactly(
    desk: Any, repo: pygit2.Repository
) -> None:
    tree = write_tree(repo, None, {"f": "x"})
    failed, parents = [], list[pygit2.Oid]()
    commits = []
    for name in NASTY:
        assert id_problem(name) == "", name
        decision = desk.join(name)
        text = commit_message.of_decision(decision, "op-1", desk.now)
        try:
            who = commit_message.author(decision, desk.now)
            committer = commit_message.generator_signature(desk.now)
            commit = repo.create_commit(None, who, committer, text, tree, parents)
        except Exception as error:
            failed.append(f"{name!r}: {error!r}")
            continue
        parents = [commit]
        commits.append(name)
        assert who.email.endswith("@requester.demandops.invalid")
        assert who.name.strip()
        assert len(who.name) <= 200
        assert commit_log.entry_of(repo[commit].peel(pygit2.Commit)).trailers["Requester"] == [name]
    repo.references.create("refs/heads/main", parents[0])
    command = ["git", "-C", repo.path, "fsck", "--strict", "--no-dangling", "--no-progress"]
    fsck = subprocess.run(command, capture_output=True, text=True, check=False)
    form = "--format=%(trailers:key=Requester,valueonly)%x1e"
    read_back = git(repo.path, "log", "--reverse", form).split("\n\x1e\n")
    lines = [compose([], [("Requester", name)]).strip() for name in commits]
    assert [f"Requester: {name}".removesuffix("\n\x1e") for name in read_back] == lines
    assert (fsck.returncode, fsck.stdout, fsck.stderr) == (0, "", "")
    assert failed == []


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (("vehicle00", "station00"), "vehicle00, station00 (requesters)"),
        (("Ada <ada@example.org>",), "Ada (ada@example.org) (requester)"),
        (("x" * 300,), "x" * 187 + "… (requester)"),
        ((".",), "(requester)"),
        (("\\",), "(requester)"),
        (("'quoted'",), "quoted' (requester)"),
    ],
)
def test_the_author_is_the_requesters_as_listed_and_never_a_person(
    desk: Any, names: tuple[str, ...], wanted: str
) -> None:
    decision = desk.join(*names)
    who = commit_message.author(decision, desk.now)
    assert who.name == wanted
    demand = decision.changes.claims[0].key.demand
    assert who.email == f"{demand}@requester.demandops.invalid"
    assert (who.time, who.offset) == (int(desk.now.timestamp()), 0)
