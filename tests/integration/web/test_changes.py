"""The page after changes by demands and by people, and while the state repo is away."""

from __future__ import annotations

import copy
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from demandops.cli.main import run
from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.views.kinds import rows_of
from demandops.web import page_views
from demandops.web.follower import Follower
from demandops.web.page_views import LISTS
from demandops.web.server import Site
from starlette.testclient import TestClient

from tests.integration.web.conftest import DENY, VIEWS, Shown, causes
from tests.integration.web.html import Page
from tests.kit import goals
from tests.kit.config import override
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GitRepo, Person, away
from tests.kit.rig import book, running, wait_until

LINK = {"id": "vehicle02/cloud", "type": "mqtt", "source": "vehicle02", "target": "cloud"}
LINK |= {"topics": [{"source": "/t"}]}
DETECTION = "od-edge-vehicle00"


def overridden(generator: Generator) -> None:
    """Wait until the generator follows a person's override."""
    generator.fetch_now()
    wait_until(lambda: generator.snapshot.state.config.overrides, "it applies")


def typed(page: Page, state: GitRepo) -> None:
    """Run the command that a page shows, in earnest."""
    (command,) = [e.text for e in page.all("pre") if e.text.strip().startswith("demandops ")]
    _, *args = shlex.split(command.removesuffix(" --dry-run"))
    assert (
        command.endswith(" --dry-run") and run([*args, "-y", "--state-repo", str(state.path)]) == 0
    )


def test_a_denied_connection_is_told_everywhere(shown: Shown, person: Person) -> None:
    def figures(**asked: str) -> list[str]:
        return shown.look("/", **asked).texts("li")[:7]

    assert figures() == [
        "9 releases 9 unknown",
        "3 connections 3 unknown",
        "2 demands 2 unknown",
        "3 requesters 3 unknown",
        "4 of 7 nodes used",
        "0 waiting",
        "2 changes in the last hour 2 booked, 0 released in the last day",
    ]
    book(shown.generator, goals.experiment(1) | {"shutdown": True})
    person.override(roadworks=DENY)
    person.change({"README.md": "hello"}, "Greet")
    overridden(shown.generator)
    page = shown.look("/")
    assert page.texts("h1") == ["1 of 1 application is not ready"]
    (cause,) = causes(shown.follower.newest)
    assert (cause.kind, cause.told) == ("suspended", "The road is closed")
    assert cause.who == "traffic-control, who owns the override"
    assert cause.command == "demandops override end roadworks"
    assert cause.requesters == ("station00", "vehicle01")
    changed = shown.follower.newest.last_change("overrides/roadworks.yaml")
    assert changed and cause.since == changed.time
    assert "vehicle01/edge is booked, but overrides/roadworks.yaml denies it" in page.text
    assert "1 override: 1 in force" in page.text
    assert "vehicle01/edge" not in shown.look("/connections").text
    for path in VIEWS:
        shown.look(path)
    told = figures(q="vehicle01")
    assert told[1:3] == ["1 connection 1 unknown", "1 demand 1 unknown"]
    assert "1 booked, 0 released in the last day" in told[-1]
    assert "1 booked, 1 released" not in told[-1] and "1 released in the last day" in figures()[-1]
    page = shown.look("/release", name=DETECTION)
    assert "It is gone since" in page.text and "stopped" in page.texts("td")
    assert len(shown.look("/timeline", lane="demands").texts("tr")[1:]) == 3
    assert "A person's change" in shown.look("/timeline", lane="overrides").text
    assert "Greet" in shown.look("/timeline", lane="people").text
    assert len(shown.look("/timeline", q="who:vehicle01").texts("tr")[1:]) == 1


def test_an_application_that_others_demand_too_runs_on_without_a_suspended_requester(
    shown: Shown, person: Person
) -> None:
    person.override(workshop=override({"requesters": ["vehicle00"]}, deny=True))
    overridden(shown.generator)
    assert shown.look("/").texts("h1") == ["1 thing needs attention"]
    (cause,) = causes(shown.follower.newest)
    assert (cause.kind, cause.applications) == ("suspended", ())
    page = shown.look("/thing", kind="requester", name="vehicle00")
    assert "kind=override&name=workshop" in page.link("workshop")


def test_an_override_that_no_generator_carried_out_yet_is_told(bare: Path, state: GitRepo) -> None:
    with running(bare) as generator:
        book(generator, *map(goals.experiment, (1, 2)))
    state.commit({"overrides/roadworks.yaml": DENY})
    follower = Follower(Reader.of(str(bare)), {}, 0)
    client = TestClient(Site(follower, ("127.0.0.1",)).application, base_url="http://127.0.0.1")
    overrides, first = client.get("/overrides"), client.get("/")
    follower.close()
    assert "not rendered yet" in overrides.text
    assert "wait for a generator to carry out a person&#39;s commit" in first.text


def test_an_invalid_file_names_who_wrote_it_and_too_many_causes_are_counted(
    shown: Shown, person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    person.change({"registry/images.yaml": "images: [\n", "registry/charts.yaml": "charts: [\n"})
    person.change({"overrides/wrong.yaml": "kind: nothing\n"})
    shown.generator.fetch_now()
    wait_until(lambda: len(shown.generator.snapshot.problems) > 2, "the generator reports it")
    page = shown.look("/")
    of_commits = causes(shown.follower.newest)
    assert len(shown.follower.newest.problems) > len(of_commits) == 2
    assert "\noverrides/wrong.yaml:1: kind: is 'nothing'" in "".join(c.told for c in of_commits)
    for cause in of_commits:
        assert cause.kind == "invalid"
        assert cause.who == "Petra Platform <petra@example.org>, whose commit made it invalid"
        assert cause.command.startswith("git show ")
    assert "stays in effect" in page.text and "git revert --no-edit -m 1 " in page.text
    assert "more causes" not in page.text
    monkeypatch.setattr(page_views, "_MOST_CAUSES", 1)
    page = shown.look("/")
    assert len(page.texts("h3")) == 1 and "and 1 more causes; filter to see them" in page.text
    assert page.texts("h1") == ["2 things need attention"]


def test_a_lease_is_listed_and_the_consequence_of_its_release_is_what_follows(
    shown: Shown, state: GitRepo
) -> None:
    book(
        shown.generator,
        goals.put("mine", "vehicle02", applications=[], connections=[LINK], lease="10m"),
    )
    (row,) = shown.look("/leases").texts("tr")[1:]
    assert re.match(r"mine in [0-9m]+s? vehicle02 10m vehicle02/cloud", row)
    page = shown.look("/demand", id="mine")
    told = {e.text.strip() for e in page.all("a") if "li" in e.inside and "main" in e.inside}
    before = set(state.manifests())
    typed(page, state)
    shown.generator.fetch_now()
    wait_until(lambda: str(shown.generator.snapshot.commit) == state.tip, "the generator knows")
    gone = {Path(path).stem for path in before - set(state.manifests())}
    assert gone == told and len(gone) == 2


@pytest.mark.parametrize(
    ("release", "told"),
    [
        (DETECTION, "object-detection on edge for vehicle00 is needed, but {} denies it"),
        ("mqtt-vehicle00-edge-source-d3ca91c2df6c", "vehicle00/edge is booked, but {} denies it"),
    ],
)
def test_the_command_that_stops_a_release_stops_it(
    shown: Shown, state: GitRepo, release: str, told: str
) -> None:
    page = shown.look("/release", name=release)
    (promise,) = [text for text in page.texts("p") if "That stops it" in text]
    before = set(state.manifests())
    typed(page, state)
    overridden(shown.generator)
    assert shown.look("/release", name=release).texts("h1") != [f"Release {release} unknown"]
    (name,) = state.files("overrides/suspend-")
    assert told.format(name) in shown.look("/").text
    assert release in shown.look("/thing", kind="override", name=Path(name).stem).text
    gone = {Path(path).stem for path in before - set(state.manifests())}
    assert release in gone
    named = {word for word in re.split(r"[ ,.]+", promise) if word.startswith(("od-", "mqtt-"))}
    assert named == gone - {release}


def test_the_command_serves_the_page_until_it_is_stopped(bare: Path) -> None:
    command = [sys.executable, "-m", "demandops.cli.main", "web"]
    process = subprocess.Popen(
        [*command, "--state-repo", str(bare), "--listen", "127.0.0.1:0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:  # noqa: S310 - the page
        assert b"Nothing is demanded" in answer.read()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, "", "stopped\n")


def test_views_derived_step_by_step_equal_views_derived_from_scratch(
    shown: Shown, person: Person
) -> None:
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    scaling = "{max: 4, per: {sources: 1}, dividesWork: true}"
    text = person.read(appdef).replace("prefix: of\n", f"prefix: of\n    scaling: {scaling}\n")
    person.change({appdef: text}, "Scale")
    wait_until(lambda: shown.follower.newest.config.files[appdef] == text, "it is shown")
    joins = [*map(goals.experiment, range(1, 9))]
    another = copy.deepcopy(joins[0]) | {"connections": []}
    another["apps"][0]["object_detection_fusion_app"]["requester_ids"] = ["station01"]
    for goal in (joins[2], another, another | {"shutdown": True}, *joins[3:]):
        book(shown.generator, goal)
        for name in LISTS:
            shown.look(f"/{name}")
        now = shown.follower.newest
        anew = replace(now, derived={})
        assert now.running == anew.running
        for name in LISTS:
            assert sorted(map(str, rows_of(now, name))) == sorted(map(str, rows_of(anew, name)))


def test_what_is_gone_has_a_list_of_its_own(shown: Shown) -> None:
    made = goals.put("mine", "vehicle02", applications=[], connections=[LINK])
    over = {"kind": "Demand", "operation": "release", "demand": "mine", "requesters": ["vehicle02"]}
    book(shown.generator, made, over)
    assert "mine" not in shown.look("/demands").text
    page = shown.look("/demands", gone="1")
    (row,) = page.texts("tr")[1:]
    assert re.match(r"mine gone [0-9ms]+ ago by .*, release in [0-9a-f]{10} vehicle02", row)
    assert "gone=1" in shown.look("/connections").link("Those that are gone")
    for name in LISTS:
        shown.look(f"/{name}", gone="1")


def test_a_state_repo_that_is_away_is_told_and_followed_again(shown: Shown, bare: Path) -> None:
    with away(bare):
        wait_until(
            lambda: shown.follower.newest.unread, "the page knows that the state repo is away"
        )
        page = shown.look("/", status=200)
        assert "The state repo cannot be read" in page.text
        assert "may be out of date" in shown.look("/demands").texts("aside")[0]
        assert shown.client.get("/health").status_code == 503
    wait_until(lambda: not shown.follower.newest.unread, "the page follows again")
    assert shown.client.get("/health").status_code == 200


def test_a_server_that_takes_no_commit_of_the_node_is_told(
    shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shown.follower, "_push_denied", lambda: "ERROR: the key is read-only")
    shown.follower.wake()
    wait_until(lambda: shown.follower.newest.push_denied, "the page knows")
    told = shown.look("/", status=200).text
    assert "takes no commit of this generator" in told
    assert "the key is read-only" in told
