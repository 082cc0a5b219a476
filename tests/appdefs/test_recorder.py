"""Further types of applications need only folders of YAML and templates, and no code.

``recorder`` and ``monitor`` share a driver that runs on the node of the sensor.
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.kit.cli import Run
from tests.kit.config import skeleton
from tests.kit.goals import BODY, CLOUD, STATION_CLOUD, application, connection, goal
from tests.kit.memory import NOW, MemoryRepo
from tests.kit.plain_yaml import FAST
from tests.kit.repo import GitRepo
from tests.scenarios.running import configuration

HERE = Path(__file__).parent
RECORDER, MONITOR = 2, 3
UNCARRIED = (
    "application 'edge/record': no connection carries /vehicle00/driver/points (driver.points) of "
    "'vehicle00' to 'edge'"
)


ADDITIONS = {
    path: text
    for path, text in configuration(["recorder", "monitor"]).items()
    if path not in skeleton() or path.startswith("registry/")
}
"""The files that a platform engineer adds to a state repo: the appdefs and two registry files."""


@pytest.fixture
def books() -> MemoryRepo:
    return MemoryRepo(ADDITIONS)


def record(id: str = "edge/record", **more: Any) -> dict[str, Any]:
    return application(id, type=RECORDER, **more)


def monitor(id: str = "cloud/monitor", **more: Any) -> dict[str, Any]:
    return application(id, type=MONITOR, **{"node": "cloud", **more})


def test_it_is_demanded_with_yaml_alone(demandops: Run, state: GitRepo, tmp_path: Path) -> None:
    state.commit(ADDITIONS, "Add the recorder\n")
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
    assert "rate = 1 " in demandops("bookkeeping", "--state-repo", state.path).out
    told = ("applications", "service", "node", "source", "source_topic", "inputs", "requesters")
    assert {name: {key: entry[key] for key in told} for name, entry in found.items()} == {
        "drv-vehicle00-vehicle00": {
            "applications": ["edge/record"],
            "service": "driver",
            "node": "vehicle00",
            "source": "vehicle00",
            "source_topic": CLOUD[0],
            "inputs": {"cloud": {CLOUD[0]: ["vehicle00"]}},
            "requesters": ["vehicle00"],
        },
        next(name for name in found if name.startswith("rec-")): {
            "applications": ["edge/record"],
            "service": "recorder",
            "node": "edge",
            "source": None,
            "source_topic": None,
            "inputs": {"clouds": {"/vehicle00/driver/points": ["vehicle00"]}},
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
            "type": "mqtt",
            "source": "vehicle00",
            "target": "edge",
            "topics": {"/vehicle00/driver/points": ["vehicle00"]},
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
            "version": "0.1.0",
            "application_version": None,
            "versions_asked": {},
            "parameters": {"rate": 1},
            "applications": ["cloud/monitor", "edge/record"],
            "service": "driver",
            "node": "vehicle00",
            "source": "vehicle00",
            "source_topic": CLOUD[0],
            "inputs": {"cloud": {CLOUD[0]: ["operator", "vehicle00"]}},
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
        books = MemoryRepo(ADDITIONS)
        for demanded in order:
            books.send(goal([demanded], id=demanded["header"]["id"]))
        ends.append(books.rendered())
    assert ends[0] == ends[1]


def test_a_topic_list_that_is_no_input_of_the_recorder_is_refused(books: MemoryRepo) -> None:
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
    """The appdef says how parameters of several demands merge; without a rule, they must agree."""

    @staticmethod
    def demand(who: str, appdef: str = "recorder", **parameters: object) -> dict[str, Any]:
        app = {
            "id": f"edge/{appdef}",
            "type": appdef,
            "node": "edge",
            "inputs": {"point_cloud": [{"topic": CLOUD[0], "source": CLOUD[1]}]},
            "parameters": parameters,
        }
        return {"kind": "Demand", "demand": who, "requesters": [who], "applications": [app]}

    @staticmethod
    def values(books: MemoryRepo, prefix: str = "rec-") -> dict[str, Any]:
        """Return the Helm values of the only release whose name starts with a prefix."""
        releases = books.objects("HelmRelease").items()
        (found,) = (one["spec"]["values"] for name, one in releases if name.startswith(prefix))
        return dict(found)

    @pytest.mark.parametrize(
        ("name", "given", "merged"),
        [
            ("labels", [["b", "a"], ["c", "b"]], ["a", "b", "c"]),
            ("labels", ["b", ["a"]], ["a", "b"]),
            ("labels", [[], []], []),
            ("labels", [["yes", "1e3"], None], ["1e3", "yes"]),
            ("rate", [10, 20], 20),
            ("rate", [2.5, 2], 2.5),
            ("rate", [-3, -2], -2),
            ("rate", [0.5, None], 0.5),  # the default of 1 does not count
            ("rate", [None, None], 1),
            ("quality", [10, 20], 10),
            ("quality", [0, 0.5], 0),
            ("title", ["first", "second"], "second"),
            ("title", ["{{ x }}\n: 'y'", None], "{{ x }}\n: 'y'"),
            ("format", ["bag", "bag"], "bag"),
            ("format", ["bag", None], "bag"),
        ],
    )
    def test_two_values_become_one(
        self, books: MemoryRepo, name: str, given: list[object], merged: object
    ) -> None:
        turned = books.copy()
        for repo, step in ((books, 1), (turned, -1)):
            for minute, value in enumerate(given[::step]):
                parameters = {} if value is None else {name: value}
                demand = self.demand(f"who{minute}", **parameters)
                repo.send(demand, NOW + timedelta(minutes=minute))
        assert self.values(books)[name] == merged
        if name != "title":  # of several titles, the last one counts
            assert self.values(turned)[name] == merged

    def test_values_without_a_rule_for_merging_must_agree(self, books: MemoryRepo) -> None:
        books.send(self.demand("vehicle00", format="mcap"))
        (found,) = books.faults(self.demand("vehicle01", format="bag"))
        assert found == (
            'parameters.format: demands contradict each other: "mcap" for vehicle00 and "bag" for '
            "vehicle01; demand the same value, or ask that the application definition say how to "
            "merge the values"
        )

    def test_a_contradiction_names_different_values(self, books: MemoryRepo) -> None:
        for number in range(3):
            books.send(self.demand(f"vehicle0{number}", format="mcap"))
        (found,) = books.faults(self.demand("vehicle03", format="bag"))
        assert '"mcap" for vehicle00 and "bag" for vehicle03; demand' in found

    def test_a_value_that_cannot_be_compared_is_refused(self, books: MemoryRepo) -> None:
        books.send(self.demand("vehicle00", rate=1))
        assert books.faults(self.demand("vehicle01", rate=True)) == [
            "parameters.rate: true for vehicle01 is not a number, but the application definition "
            "merges the values by max; give a number"
        ]

    @pytest.mark.parametrize(
        ("recorder", "monitor"), [({"rate": 10}, 20), ({"rate": 20}, 10), ({}, 20)]
    )
    def test_a_shared_driver_merges_over_all_kinds_of_its_applications(
        self, books: MemoryRepo, recorder: dict[str, int], monitor: int
    ) -> None:
        """The driver gets the largest rate that a recorder or a monitor demands."""
        books.send(self.demand("a", "recorder", **recorder))
        books.send(self.demand("b", "monitor", rate=monitor))
        assert self.values(books, "drv-")["rate"] == 20
