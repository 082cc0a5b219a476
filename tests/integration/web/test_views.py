"""The page's views of a real state repo."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from demandops.cluster.health import Health
from demandops.cluster.rollouts import OldBootstrap, Orphan, ReleaseStatus
from demandops.model.config.inventory import Position
from demandops.model.demand.goals import read_goal
from demandops.model.ledger.records import WaitingDemand
from demandops.views.kinds import rows_of
from demandops.views.rows import Filter, page_of
from demandops.views.source import Source
from demandops.web import fleet_map, time_line
from demandops.web.follower import Follower
from demandops.web.page_views import thing
from rpds import HashTrieMap

from tests.integration.web.conftest import Shown, causes
from tests.integration.web.html import Page
from tests.kit import plain_yaml
from tests.kit.goals import put
from tests.kit.repo import GitRepo

PAGES = plain_yaml.beside(__file__)
DETECTION = "od-edge-vehicle00"
IMAGE = "docker.io/rwthika/robotkube-object-detection:2025-04"


def with_health(follower: Follower, **named: Health) -> Source:
    statuses = {name: ReleaseStatus(Health("healthy"), "abc") for name in follower.newest.releases}
    for name, health in named.items():
        statuses[name.replace("_", "-")] = ReleaseStatus(health, "abc", "2026-05-04T12:00:00Z")
    return replace(follower.newest, statuses=statuses, watched=frozenset({"c-its"}))


def changed(follower: Follower, **fields: Any) -> Source:
    """Return the newest source with other fields of its state."""
    shown = follower.newest
    snapshot = replace(shown.snapshot, state=replace(shown.state, **fields))
    return replace(shown, snapshot=snapshot, problems=(), derived={})


@pytest.mark.parametrize(
    ("reason", "who"),
    [
        ("ImagePullBackOff: manifest unknown", f"the publisher of image {IMAGE}"),
        ("pod not scheduled: 0/3 nodes: Insufficient cpu", "the operator of node edge in cluster"),
        ("back-off: CrashLoopBackOff", "the maintainer of appdefs/object-detection-fusion"),
    ],
)
def test_a_failing_release_names_who_can_mend_it(still: Shown, reason: str, who: str) -> None:
    health = Health("reconciled", reason, "HelmRelease perception/od-edge-vehicle00", failing=True)
    now = with_health(still.follower, od_edge_vehicle00=health)
    (cause,) = causes(now)
    assert cause.who.startswith(who)
    assert cause.command == "kubectl -n perception describe helmrelease od-edge-vehicle00"
    assert cause.told == f"HelmRelease perception/od-edge-vehicle00: {reason}"
    assert cause.applications == ("edge/object_detection_fusion",)
    assert cause.requesters == ("station00", "vehicle00")
    assert f"{cause.since:%Y-%m-%d %H:%M}" == "2026-05-04 12:00"
    assert causes(now, "vehicle00") and not causes(now, "requester=vehicle01")


def test_releases_with_one_reason_are_one_cause(still: Shown) -> None:
    away = Health("waiting", "cannot be read: it is away", "cluster c-its")
    names = [name.replace("-", "_") for name in still.follower.newest.releases]
    now = with_health(still.follower, **dict.fromkeys(names, away))
    (cause,) = causes(now)
    assert cause.kind == "waiting" and len(cause.releases) == len(names)
    assert cause.who == "the operator of cluster c-its"
    assert cause.why == "cannot be seen, because cluster c-its cannot be read"


def test_what_is_not_known_is_not_called_ready(
    still: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = still.follower.newest
    # the follower's thread may set its own newest source at any time
    monkeypatch.setattr(Follower, "newest", property(lambda self: source))
    unknown = ["Nothing in the state repo keeps an application from being ready"]
    page = still.look("/")
    assert page.texts("h1") == unknown and "does not watch the clusters" in page.text
    source = with_health(still.follower)
    assert still.look("/").texts("h1") == ["Everything is ready"]
    assert still.look("/", q="vehicle00").texts("h1") == ["Everything that matches is ready"]
    source = replace(source, watched=frozenset({"other"}))
    page = still.look("/")
    assert page.texts("h1") == unknown and "Whether pods run on c-its is unknown" in page.text


@pytest.mark.parametrize("case", PAGES)
def test_a_page_shows(still: Shown, case: str) -> None:
    wanted = PAGES[case]
    page = still.look(wanted["path"], wanted.get("status", 200), **wanted.get("asks", {}))
    assert page.texts("h1")[0].startswith(wanted.get("h1", ""))
    (body,) = page.texts("body")
    assert [text for text in wanted.get("has", ()) if text not in body] == []
    assert [text for text in wanted.get("lacks", ()) if text in body] == []
    rows = [text.split()[0] for text in page.texts("tr")[1:]]
    assert wanted.get("rows", rows) == rows


def test_an_old_bootstrap_file_and_an_object_of_no_release_are_causes(still: Shown) -> None:
    old = OldBootstrap("c-its", "bootstrap/c-its.yaml", ("perception",), "git show …")
    left = Orphan("c-its", "Deployment", "perception", "mqtt-gone")
    now = replace(still.follower.newest, old_bootstraps=(old,), orphans=(left,))
    told = {cause.what: cause for cause in causes(now)}
    assert told.keys() == {"bootstrap/c-its.yaml", "Deployment perception/mqtt-gone"}
    assert told["bootstrap/c-its.yaml"].command == old.command
    assert told["Deployment perception/mqtt-gone"].command == left.command


def test_the_last_page_has_the_rest() -> None:
    assert page_of(range(5), 9, 2) == (range(4, 5), 3, 3)
    assert page_of(range(4), 2, 2) == (range(2, 4), 2, 2)
    assert page_of((), 0, 2) == ((), 1, 1)


def test_a_release_is_explained(still: Shown) -> None:
    page = still.look("/release", name=DETECTION)
    assert "station00, vehicle00" in page.text
    file = f"clusters/c-its/perception/edge/{DETECTION}.yaml"
    rendered = GitRepo(still.bare).files("clusters/")[file]
    difference, whole = [e.text for e in page.all("pre") if "kind: HelmRelease" in e.text]
    assert whole == rendered
    assert difference.splitlines()[1:] == [f"+{line}" for line in rendered.splitlines()]
    assert "started" in page.texts("td")
    assert "With it, the release starts." in page.text
    changed = still.look("/release", name="of-edge-object-detection-fusion-cf7e0180a8bb")
    assert "With it, the release reconfigures." in changed.text


def test_a_filter_lights_what_a_demand_holds(still: Shown) -> None:
    now = still.follower.newest
    demand = next(one.demand for one in now.state.ledger if "vehicle01" in one.requesters)
    wide, _ = fleet_map.picture(now, Filter(f"demand={demand}"), "")["drawings"]
    lit = [card for card in wide.cards if card.is_lit]
    assert {card.label for card in lit} == {"edge", "station00", "vehicle01"}
    on_edge = {mark.text: mark.is_lit for card in lit for mark in card.marks}
    assert on_edge["object-detection · station00"] and on_edge["mqtt vehicle01/edge"]
    assert not on_edge["object-detection · vehicle00"]
    # a line to each that matches, and none to the other vehicles of the edge
    found, _ = fleet_map.picture(now, Filter("vehicle01"), "")["drawings"]
    assert not [line.title for line in found.lines if "vehicle00" in line.title.split(":")[0]]


def fleet_of(follower: Follower, vehicles: int, edges: int = 1) -> Source:
    """Return the newest source with more nodes, which demand nothing."""
    config = follower.newest.config
    model, more = config.nodes["vehicle00"], dict(config.nodes)
    for type, count in (("edge", edges), ("vehicle", vehicles)):
        for number in range(count):
            id = f"far-{type}{number}"
            more[id] = model.model_copy(update={"id": id, "type": type})
    return changed(follower, config=replace(config, nodes=more))


def test_nodes_are_drawn_where_they_are_and_cover_no_other(still: Shown) -> None:
    newest, nodes = still.follower.newest, {}
    for number, node in enumerate(newest.config.nodes.values()):
        place = {"x": 10.0 * (number % 3), "y": float(number)}
        nodes[node.id] = node.model_copy(update={"position": Position.model_validate(place)})
    source = changed(still.follower, config=replace(newest.config, nodes=nodes))
    drawn = fleet_map.picture(source, Filter(""), "")
    assert (drawn["layout"], drawn["layouts"]) == ("place", ("cluster", "place"))
    for layout in drawn["layouts"]:
        for drawing in fleet_map.picture(source, Filter(""), layout)["drawings"]:
            assert all(0 <= card.x <= drawing.width - card.width for card in drawing.cards)
            assert not [pair for pair in combinations(drawing.cards, 2) if cover(*pair)]
    cards = {card.label: card for card in drawn["drawings"][0].cards}
    first, second, third, *_, last = (cards[id] for id in nodes)
    assert first.x < second.x < third.x and last.y < first.y


def cover(one: fleet_map.Card, other: fleet_map.Card) -> bool:
    beside = one.x + one.width <= other.x or other.x + other.width <= one.x
    return not (beside or one.y + one.height <= other.y or other.y + other.height <= one.y)


def test_many_nodes_are_drawn_as_stacks_that_a_filter_opens(still: Shown) -> None:
    source = fleet_of(still.follower, 1000)
    for drawing in fleet_map.picture(source, Filter(""), "")["drawings"]:
        assert sum(len(card.nodes) for card in drawing.cards) == len(source.config.nodes)
        (stack,) = [card for card in drawing.cards if len(card.nodes) >= 1000]
        assert stack.label.endswith(" vehicles")
    # a stack's own filter chooses its nodes, and a filter that finds few draws each of them
    for query, count in ((stack.query, len(stack.nodes)), ("node=far-vehicle7", 1)):
        found = fleet_map.picture(source, Filter(query), "")
        assert found["lit"] == count
    (lit,) = [card for card in found["drawings"][0].cards if card.is_lit]
    assert lit.label == "far-vehicle7" and len(found["drawings"][0].cards) < 20


@pytest.mark.parametrize("query", ["", "edge", "vehicle01"])
@pytest.mark.parametrize(("vehicles", "edges"), [(0, 0), (25, 20), (200, 20)])
def test_no_line_runs_behind_a_card(still: Shown, vehicles: int, edges: int, query: str) -> None:
    source = fleet_of(still.follower, vehicles, edges)
    for drawing in fleet_map.picture(source, Filter(query), "cluster")["drawings"]:
        assert drawing.lines
        for line in drawing.lines:
            for x, y in points(line.path):
                assert 0 <= x <= drawing.width and 0 <= y <= drawing.height
                assert not [
                    card.label
                    for card in drawing.cards
                    if card.x < x < card.x + card.width and card.y < y < card.y + card.height
                ]


def points(path: str) -> list[tuple[float, float]]:
    """Return points on a path of the commands M, V and C, close to each other."""
    here, found = (0.0, 0.0), list[tuple[float, float]]()
    for command, text in re.findall(r"([MVC])([^MVC]*)", path):
        numbers = [float(number) for number in text.split()]
        if command == "V":
            numbers = [here[0], here[1], here[0], numbers[0], here[0], numbers[0]]
        ends = list(zip(numbers[::2], numbers[1::2], strict=True))
        if command != "M":
            for step in range(33):
                t = step / 32
                weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
                at = zip(*(here, *ends), strict=True)
                x, y = (sum(w * v for w, v in zip(weights, values, strict=True)) for values in at)
                found.append((x, y))
        here = ends[-1]
    return found


def test_a_demand_that_waits_for_room_is_listed(still: Shown) -> None:
    newest = still.follower.newest
    since = newest.now - timedelta(minutes=5)
    waiting = WaitingDemand(read_goal(put("later", "vehicle02")), since)
    ledger = replace(newest.state.ledger, waiting=HashTrieMap({"later": waiting}))
    now = changed(still.follower, ledger=ledger)
    (cause,) = causes(now, "vehicle02")
    assert (cause.kind, cause.what, cause.since) == ("waiting", "later", since)
    assert cause.why == "waits for room on a node"
    rows = [row for row in rows_of(now, "demands") if Filter("demand=later").matches(row)]
    assert [row.item["state"] for row in rows] == ["waiting"]
    assert thing(now, "later", "demand", ())["word"] == "waiting"


def test_a_span_of_the_time_line_lists_only_its_events(shown: Shown) -> None:
    def commits(page: Page) -> list[str]:
        return [text.split()[-1] for text in page.texts("tr")[1:]]

    everything = shown.look("/timeline", span="all")
    assert len(commits(everything)) == 3 and "Create the state repo" in everything.text  # long ago
    page = shown.look("/timeline", span="15min")
    assert commits(page) == commits(everything)[:2]
    assert "2 events in the last 15min" in page.text
    dots = [title for title in page.texts("title") if " UTC, " in title]
    more = [int(count) for title in dots for count in re.findall(r"and (\d+) more", title)]
    assert len(dots) + sum(more) == 2  # the drawing has the same events as the list
    assert len(commits(shown.look("/timeline", span="7d", q="who:vehicle01"))) == 1


def test_the_time_line_fills_the_drawing(still: Shown) -> None:
    follower = still.follower
    events = follower.history
    strip = time_line.strip(events, events[0].time, "all", None)
    template = (Path(time_line.__file__).parent / "pages" / "timeline.html.j2").read_text()
    width = int(re.findall(r'x2="(\d+)"', template)[0])
    assert max(dot["x"] for dot in strip["dots"]) > 0.9 * width
