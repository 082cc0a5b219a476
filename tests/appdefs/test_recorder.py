"""Further types of applications: folders of YAML and templates, demanded like the first.

``recorder`` and ``monitor`` share a driver that runs where the sensor is. The reference's message
has no parameters, so what merges them is tested below the wire, by ledger and plan.
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
import yaml
from demandops.demand.application import Application, InputTopic
from demandops.demand.demand_request import Demanded, Join, place_in
from demandops.errors import Refused
from demandops.ledger.apply import apply
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.planner import plan
from demandops.plan.release import ServiceRelease
from demandops.plan.release_keys import all_keys

from tests.kit.cli import Run
from tests.kit.config import FAST, skeleton
from tests.kit.goals import BODY, CLOUD, STATION_CLOUD, application, connection, goal
from tests.kit.memory import NOW, MemoryRepo
from tests.kit.repo import GitRepo

HERE = Path(__file__).parent
RECORDER, MONITOR = 2, 3
UNCARRIED = (
    "application 'edge/record': no connection carries driver.points /vehicle00/driver/points of "
    "'vehicle00' to 'edge'"
)


def additions() -> dict[str, str]:
    """Return what a platform engineer adds to a state repo: the folders and two registry lists."""
    found = {
        f"appdefs/{path.relative_to(HERE).as_posix()}": path.read_text()
        for name in ("recorder", "monitor")
        for path in sorted((HERE / name).rglob("*"))
        if path.is_file()
    }
    folder = "appdefs/recorder/charts/recorder"
    charts = f"  recorder:\n    folder: {folder}\n    version: 0.1.0\n"
    images = "".join(
        f"  {name}:\n    repository: ghcr.io/example/{name}\n    tag: v1\n"
        for name in ("driver", "recorder")
    )
    return found | {
        "registry/charts.yaml": skeleton()["registry/charts.yaml"] + charts,
        "registry/images.yaml": skeleton()["registry/images.yaml"] + images,
    }


@pytest.fixture
def books() -> MemoryRepo:
    return MemoryRepo(additions())


def record(id: str = "edge/record", **more: Any) -> dict[str, Any]:
    return application(id, type=RECORDER, **more)


def monitor(id: str = "cloud/monitor", **more: Any) -> dict[str, Any]:
    return application(id, type=MONITOR, **{"node": "cloud", **more})


def test_it_is_demanded_with_yaml_alone(demandops: Run, state: GitRepo, tmp_path: Path) -> None:
    state.commit(dict(additions()), "Add the recorder\n")
    file = tmp_path / "record.yaml"
    file.write_text(
        """
        id: night shift
        apps:
        - header: {id: edge/record, node_id: edge}
          type: 2
          object_detection_fusion_app:
            requester_ids: [vehicle00]
            pointcloud_topics:
            - topic_name: /vehicles/vehicle00/drivers/lidar/pointcloud
              source_node_id: vehicle00
        """
    )
    (row,) = demandops("request", file, "--state-repo", state.path, "--output", "json").json()
    assert (row["outcome"], row["warnings"]) == ("booked", [UNCARRIED])
    ran = demandops("bookkeeping", "--state-repo", state.path, "--output", "json")
    found = ran.json()["services"]
    assert found == {
        "drv-vehicle00-vehicle00": {
            "applications": ["edge/record"],
            "service": "driver",
            "node": "vehicle00",
            "source": "vehicle00",
            "source_topic": CLOUD[0],
            "inputs": {"point_cloud": [CLOUD[0]]},
            "requesters": ["vehicle00"],
        },
        next(name for name in found if name.startswith("rec-")): {
            "applications": ["edge/record"],
            "service": "recorder",
            "node": "edge",
            "source": None,
            "source_topic": None,
            "inputs": {"clouds": ["/vehicle00/driver/points"]},
            "requesters": ["vehicle00"],
        },
    }
    assert demandops("verify", "--state-repo", state.path).code == 0


def test_no_python_of_the_generator_knows_it() -> None:
    generator = HERE.parents[1] / "generator"
    for path in generator.rglob("*.py"):
        text = path.read_text().lower()
        assert "recorder" not in text, path
        assert "object-fusion" not in text, path


def test_a_service_for_each_topic_runs_where_its_source_is(books: MemoryRepo) -> None:
    books.send(goal([record(clouds=[CLOUD, STATION_CLOUD])]))
    releases = books.objects("HelmRelease")
    assert releases.keys() >= {"drv-vehicle00-vehicle00", "drv-station00-station00"}
    values = releases["drv-vehicle00-vehicle00"]["spec"]["values"]
    assert values == {
        "replicas": 1,
        "image": "ghcr.io/example/driver:v1",
        "nodeSelector": {"node_id": "vehicle00"},
        "topics": [CLOUD[0]],
        "output": "/vehicle00/driver/points",
        "rate": 1,
    }
    assert "clusters/c-its/perception/vehicle00/drv-vehicle00-vehicle00.yaml" in books.rendered()


def test_what_runs_at_its_source_needs_a_connection_for_what_it_makes_of_its_input(
    books: MemoryRepo,
) -> None:
    assert books.send(goal([record()])).warnings == (UNCARRIED,)


def test_a_demand_of_our_own_gets_the_connection_that_brings_what_is_made_at_the_source(
    books: MemoryRepo,
) -> None:
    topic = {"topic": CLOUD[0], "source": "vehicle00"}
    application = {
        "id": "edge/record",
        "type": "recorder",
        "node": "edge",
        "inputs": {"point_cloud": [topic]},
        "parameters": {"rate": 10},
    }
    demand = {"kind": "Demand", "demand": "d", "requesters": ["vehicle00"]}
    assert books.send(demand | {"applications": [application]}).warnings == ()
    assert books.books()["connections"] == {
        "derived/vehicle00/edge": {
            "source": "vehicle00",
            "target": "edge",
            "topics": ["/vehicle00/driver/points"],
            "requesters": ["vehicle00"],
        }
    }
    books.send(demand | {"applications": [application | {"node": "cloud"}]})
    assert list(books.books()["connections"]) == ["derived/vehicle00/cloud"]
    assert books.send(demand | {"operation": "release"}).outcome == "released"
    assert books.books() | {"commit": ""} == {"services": {}, "connections": {}, "commit": ""}


def test_two_applications_of_different_kinds_share_a_driver(books: MemoryRepo) -> None:
    books.send(goal([record(who=["vehicle00"])], id="1"))
    before = books.rendered()
    decision = books.send(goal([monitor(who=["operator"])], id="2"))
    drivers = {n: e for n, e in books.books()["services"].items() if e["service"] == "driver"}
    assert drivers == {
        "drv-vehicle00-vehicle00": {
            "applications": ["cloud/monitor", "edge/record"],
            "service": "driver",
            "node": "vehicle00",
            "source": "vehicle00",
            "source_topic": CLOUD[0],
            "inputs": {"point_cloud": [CLOUD[0]]},
            "requesters": ["operator", "vehicle00"],
        }
    }
    assert all(books.rendered()[path] == text for path, text in before.items())
    assert [release.name[:4] for release in decision.releases] == ["mon-"]


def test_a_shared_driver_stops_with_the_last_who_needs_it(books: MemoryRepo) -> None:
    for demanded in (record(), monitor()):
        books.send(goal([demanded], id=demanded["header"]["id"]))
    down = goal([record()], id="edge/record", shutdown=True)
    books.send(down)
    assert "drv-vehicle00-vehicle00" in books.objects("HelmRelease")
    assert books.books()["services"]["drv-vehicle00-vehicle00"]["applications"] == ["cloud/monitor"]
    books.send(goal([monitor()], id="cloud/monitor", shutdown=True))
    assert books.rendered() == {}


def test_a_driver_does_not_depend_on_which_of_its_users_came_first() -> None:
    ends = []
    for order in ((record(), monitor()), (monitor(), record())):
        books = MemoryRepo(additions())
        for demanded in order:
            books.send(goal([demanded], id=demanded["header"]["id"]))
        ends.append(books.rendered())
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("topics", "replicas"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (6, 3), (7, 3), (20, 3)]
)
def test_replicas_follow_the_topics_within_bounds(
    books: MemoryRepo, topics: int, replicas: int
) -> None:
    clouds = [(f"/points_{number}", "vehicle00") for number in range(topics)]
    books.send(goal([record(clouds=clouds)]))
    (values,) = (
        release["spec"]["values"]
        for name, release in books.objects("HelmRelease").items()
        if name.startswith("rec-")
    )
    assert values["replicas"] == replicas
    assert len(values["topics"]) == topics


def test_replicas_go_down_again_when_topics_are_released(books: MemoryRepo) -> None:
    clouds = [(f"/points_{number}", "vehicle00") for number in range(5)]
    books.send(goal([record(clouds=clouds)]))
    decision = books.send(goal([record(clouds=clouds[1:])], shutdown=True))
    (change,) = (release for release in decision.releases if release.name.startswith("rec-"))
    assert change.details[-2:] == ("- replicas 3", "+ replicas 1")


def test_a_list_of_the_message_that_it_does_not_take_is_refused(books: MemoryRepo) -> None:
    assert books.faults(goal([record(ego=[("/ego", "vehicle00")])])) == [
        f"{BODY}.ego_data_topics: recorder has no such input; known: point_cloud"
    ]


def test_another_kind_for_a_claimed_application_is_refused(books: MemoryRepo) -> None:
    books.send(goal([record("edge/x")]))
    assert books.faults(goal([application("edge/x", who=["vehicle01"])])) == [
        "apps[0].type: 'object-detection-fusion' contradicts an existing claim: 'edge/x' is held "
        "by vehicle00 as 'recorder'; use another application id"
    ]


def test_an_unknown_type_is_told_with_all_that_are_known(books: MemoryRepo) -> None:
    assert books.faults(goal([application(type=9)])) == [
        "apps[0].type: 9 is not a known application type; known: 3 (monitor), "
        "1 (object-detection-fusion), 2 (recorder)"
    ]


def test_all_three_kinds_run_side_by_side(books: MemoryRepo) -> None:
    books.send(goal([application(), record(), monitor()], [connection()]))
    kinds = sorted(entry["service"] for entry in books.books()["services"].values())
    assert kinds == ["driver", "monitor", "object-detection", "object-fusion", "recorder"]
    for path, text in books.rendered().items():
        assert list(yaml.load_all(text, Loader=FAST)), path


class TestParameters:
    """Each demand's value, merged as the appdef says; what cannot be merged is refused."""

    @staticmethod
    def book(
        ledger: Ledger, who: str, appdef: str = "recorder", minute: int = 0, **parameters: object
    ) -> Ledger:
        app = Application(
            f"edge/{appdef}",
            appdef,
            "edge",
            {"point_cloud": (InputTopic(*CLOUD),)},
            MappingProxyType(parameters),
        )
        request = Join(who, (Demanded(app, (who,), place_in("applications[0]")),))
        return apply(ledger, request, NOW + timedelta(minutes=minute))[0]

    @staticmethod
    def planned(books: MemoryRepo, ledger: Ledger, service: str = "recorder") -> dict[str, object]:
        world = World(books.config, ledger)
        for key in all_keys(world):
            release = plan(world, key)
            if isinstance(release, ServiceRelease) and key.service == service:  # type: ignore[union-attr]
                return dict(release.parameters)
        raise AssertionError(f"no {service} is planned")

    def test_nobody_says_anything(self, books: MemoryRepo) -> None:
        assert self.planned(books, self.book(Ledger(), "a")) == {
            "labels": [],
            "rate": 1,
            "quality": None,
            "title": "untitled",
            "format": "mcap",
        }

    @pytest.mark.parametrize(
        ("name", "given", "merged"),
        [
            ("labels", [["b", "a"], ["c", "b"]], ["a", "b", "c"]),
            ("labels", ["b", ["a"]], ["a", "b"]),
            ("labels", [[], []], []),
            ("rate", [10, 20], 20),
            ("rate", [2.5, 2], 2.5),
            ("rate", [-3, -2], -2),
            ("quality", [10, 20], 10),
            ("quality", [0, 0.5], 0),
            ("title", ["first", "second"], "second"),
            ("format", ["bag", "bag"], "bag"),
        ],
    )
    def test_two_values_become_one(
        self, books: MemoryRepo, name: str, given: list[object], merged: object
    ) -> None:
        ledger = Ledger()
        for minute, value in enumerate(given):
            ledger = self.book(ledger, f"who{minute}", minute=minute, **{name: value})
        assert self.planned(books, ledger)[name] == merged

    @pytest.mark.parametrize("name", ["labels", "rate", "quality", "format"])
    def test_the_order_of_demands_does_not_matter(self, books: MemoryRepo, name: str) -> None:
        values = {
            "labels": [["a"], ["b"]],
            "rate": [1, 2],
            "quality": [1, 2],
            "format": ["bag"] * 2,
        }
        ends = []
        for order in ((0, 1), (1, 0)):
            ledger = Ledger()
            for index in order:
                ledger = self.book(ledger, f"who{index}", **{name: values[name][index]})
            ends.append(self.planned(books, ledger)[name])
        assert ends[0] == ends[1]

    def test_who_says_nothing_does_not_count_as_saying_the_default(self, books: MemoryRepo) -> None:
        ledger = self.book(self.book(Ledger(), "a"), "b", rate=0.5, format="bag")
        assert self.planned(books, ledger)["rate"] == 0.5
        assert self.planned(books, ledger)["format"] == "bag"

    def test_what_was_released_no_longer_counts(self, books: MemoryRepo) -> None:
        ledger = self.book(self.book(Ledger(), "a", rate=5), "b", rate=9)
        (claim,) = (claim for claim in ledger if claim.requesters == ("b",))
        assert self.planned(books, ledger.replace(claim.key, None))["rate"] == 5

    def test_values_that_nobody_said_how_to_merge_must_agree(self, books: MemoryRepo) -> None:
        ledger = self.book(
            self.book(Ledger(), "vehicle00", format="mcap"), "vehicle01", format="bag"
        )
        with pytest.raises(Refused) as refused:
            self.planned(books, ledger)
        (found,) = refused.value.faults
        assert found.code == "conflict"
        values = {'"mcap" for vehicle00', '"bag" for vehicle01'}
        start, _, rest = found.message.partition("demands contradict each other: ")
        shown, _, remedy = rest.partition("; ")
        assert (start, set(shown.split(" and "))) == ("", values)
        assert remedy == "agree, or have the application definition say how to merge them"

    def test_a_text_where_a_number_is_merged_is_refused(self, books: MemoryRepo) -> None:
        ledger = self.book(self.book(Ledger(), "a", rate=5), "b", rate="fast")
        with pytest.raises(Refused) as refused:
            self.planned(books, ledger)
        assert [(found.field, found.message) for found in refused.value.faults] == [
            (
                "parameters.rate",
                "'fast' is not a number, but the application definition takes the max",
            )
        ]

    def test_parameters_are_in_the_values(self, books: MemoryRepo) -> None:
        ledger = self.book(Ledger(), "a", rate=7, title="{{ x }}\n: 'y'", labels=["yes", "1e3"])
        from demandops.decision import State, rendered_files

        files = rendered_files(State(books.config, ledger, books.state.engine))
        (text,) = (text for path, text in files.items() if "/rec-" in path)
        values = yaml.safe_load(text)["spec"]["values"]
        assert values["rate"] == 7
        assert values["title"] == "{{ x }}\n: 'y'"
        assert values["labels"] == ["1e3", "yes"]
        assert "quality" not in values

    @pytest.mark.parametrize(("recorder", "monitor"), [(10, 20), (20, 10)])
    def test_a_shared_driver_merges_over_all_kinds_of_its_applications(
        self, books: MemoryRepo, recorder: int, monitor: int
    ) -> None:
        ledger = self.book(Ledger(), "a", "recorder", rate=recorder)
        ledger = self.book(ledger, "b", "monitor", rate=monitor)
        assert self.planned(books, ledger, "driver")["rate"] == 20

    def test_a_shared_driver_does_not_fall_back_to_the_default_of_one_kind(
        self, books: MemoryRepo
    ) -> None:
        ledger = self.book(Ledger(), "a", "monitor", rate=20)
        ledger = self.book(ledger, "b", "recorder")
        assert self.planned(books, ledger, "driver")["rate"] == 20
