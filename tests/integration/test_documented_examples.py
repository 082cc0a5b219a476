"""The examples of the documentation do what the documentation says."""

from __future__ import annotations

import re
import textwrap
from datetime import datetime, timedelta, timezone
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import Refused
from demandops.detect import rule_file
from demandops.detect.detector import Detector
from demandops.detect.event_engine import Observation
from demandops.model.demand.demand import Demand
from demandops.repo import new_repo
from demandops.repo.history import commit_message

from tests.kit.config import brokers, configuration, edited
from tests.kit.goals import EXPERIMENT, put
from tests.kit.memory import MemoryRepo

DOCS = Path(__file__).parents[2] / "docs"
NOW = datetime(2026, 5, 4, 12, 0, tzinfo=timezone.utc)
APPDEF, NODES = "appdefs/object-detection-fusion/appdef.yaml", "inventory/nodes.yaml"
POLICY, VERSIONS = "policy/access-domains.yaml", "registry/versions.yaml"
_DOMAINS = "apiVersion: demandops/v1\nkind: AccessDomains\n"
_LISTED = "apiVersion: demandops/v1\nkind: Versions"
_NO_NODE = "no-node: applications[0].place: no node fits: "
_EDGE = "nodes:\n- {id: edge, type: edge, cluster: c-its,"


def blocks(name: str) -> list[str]:
    """Return the indented code blocks of a document, without the indent."""
    found = re.findall(r"(?:^ {4}.*\n|^\n(?= {4}))+", (DOCS / name).read_text(), re.M)
    return [textwrap.dedent(text) for text in found]


def block(name: str, start: str) -> str:
    (found,) = [text.strip() for text in blocks(name) if text.lstrip().startswith(start)]
    return found


def data(name: str, start: str) -> Any:
    return yaml.safe_load(block(name, start))


def demand() -> dict[str, Any]:
    goal: dict[str, Any] = data("demand.md", "apiVersion: demandops/v1\nkind: Dem")
    return goal


def with_nodes(listed: list[dict[str, Any]]) -> dict[str, str]:
    """Return the inventory of nodes in which these replace, extend or join those of the same id."""
    inventory = yaml.safe_load(configuration()[NODES])
    nodes = {node["id"]: node for node in inventory["nodes"]}
    nodes |= {node["id"]: nodes.get(node["id"], {}) | node for node in listed}
    return {NODES: yaml.safe_dump(inventory | {"nodes": [*nodes.values()]})}


def refusal(repo: MemoryRepo, goal: object) -> str:
    with pytest.raises(Refused) as refused:
        repo.decide(goal)
    return refused.value.text_with_codes()


def test_the_demand_of_the_documentation_runs_with_a_derived_connection() -> None:
    repo = MemoryRepo()
    decision = repo.send(demand())
    services = {entry["service"] for entry in repo.books()["services"].values()}
    assert services == {"object-detection", "object-fusion"}
    assert list(repo.books()["connections"]) == [
        "derived/vehicle00/edge/vehicles/vehicle00/drivers/lidar/pointcloud",
        "derived/vehicle00/edge/vehicles/vehicle00/ego_data",
    ]
    assert (decision.lease_s, decision.warnings) == (600, ())
    goal = yaml.safe_load(EXPERIMENT[0].read_text())
    assert len(MemoryRepo().send(goal).changes.claims) == 3


def test_the_placement_of_the_documentation_is_told_as_it_says() -> None:
    listed = data("placement.md", f"{_EDGE} capabilities")["nodes"]
    repo = MemoryRepo(with_nodes(listed) | brokers(*sorted(node["id"] for node in listed)))
    goal = yaml.safe_load((DOCS.parent / "examples" / "placement" / "demand.yaml").read_text())
    start = "application 'object_detection_fusion' is placed on 'edge-north', "
    assert repo.send(goal).placed == (block("placement.md", start + "the nearest"),)
    goal["positions"][0]["y"] = 0
    again = repo.send(goal)
    assert again.outcome == "unchanged"
    assert again.placed == (block("placement.md", start + "where"),)
    goal["positions"][0]["y"] = 1800
    goal["applications"][0]["place"]["capabilities"].append("fpga")
    assert refusal(repo, goal) == block("placement.md", f"{_NO_NODE}'edge-north' lacks the c")


def test_the_capacity_of_the_documentation_is_kept() -> None:
    example = data("placement.md", f"{_EDGE} capacity")
    definition = yaml.safe_load(configuration()[APPDEF])
    for name, more in example["services"].items():
        definition["services"][name] |= more
    repo = MemoryRepo(with_nodes(example["nodes"]) | {APPDEF: yaml.safe_dump(definition)})
    goal = demand()
    repo.send(goal)
    goal["demand"], goal["applications"][0]["id"] = "second", "edge/second"
    assert refusal(repo, goal) == block("placement.md", "capacity:")


def test_the_policy_of_the_documentation_refuses_as_it_says() -> None:
    repo = MemoryRepo({POLICY: block("policy.md", _DOMAINS.strip())})
    assert repo.decide(demand()).outcome == "booked"
    for requester, node, start in (
        ("vehicle01", "cloud", "not-allowed: requesters[0]: rule 'vehicles'"),
        ("truck7", "edge", "not-allowed: requesters[0]: no rule of"),
    ):
        # its inputs are at its node, so it needs no connection that could be refused too
        inputs = {"ego_data": [{"topic": "/vehicles/vehicle01/ego_data", "source": node}]}
        (application,) = demand()["applications"]
        apps = [application | {"node": node, "inputs": inputs}]
        goal = demand() | {"requesters": [requester], "applications": apps}
        assert refusal(repo, goal) == block("policy.md", start)


def test_the_policy_of_the_documentation_lets_data_cross_by_its_rules_only() -> None:
    policy = (DOCS.parent / "examples" / "policy" / "two-domains.yaml").read_text()
    goal = demand() | {"requesters": ["vehicle00"]}
    assert MemoryRepo({POLICY: policy}).decide(goal).outcome == "booked"
    closed = policy.replace("peers: [city]", "nodes: ['*']")
    said = refusal(MemoryRepo({POLICY: closed}), goal)
    told = block("policy.md", "not-allowed: requesters[0]: access domain 'fleet'")
    assert said.replace("rule 'everybody' of ", "") == told


def test_the_node_in_several_domains_of_the_documentation() -> None:
    policy = (DOCS.parent / "examples" / "policy" / "node-in-two-domains.yaml").read_text()
    edge = data("policy.md", "nodes:\n  - id: edge")["nodes"]
    repo = MemoryRepo(with_nodes(edge) | {POLICY: policy})

    def folders(who: str, node: str = "edge") -> set[str]:
        releases = repo.decide(put(who, who, node=node, connect="none")).releases
        return {one.file.split("/")[2] for one in releases}

    assert folders("traffic-control") == {"city"}
    assert folders("vehicle01") == {"fleet"}
    assert folders("vehicle00", "edge@fleet") == {"fleet"}
    assert folders("vehicle00", "edge@city") == {"city"}
    unclear = put("vehicle00", "vehicle00", node="edge", connect="none")
    assert refusal(repo, unclear) == block("policy.md", "several-access-domains:")


def two_versions() -> list[dict[str, Any]]:
    folder = DOCS.parent / "examples" / "versions"
    return [
        yaml.safe_load((folder / f"{who}00.yaml").read_text()) for who in ("station", "vehicle")
    ]


def test_the_versions_of_the_documentation_are_an_update_and_back() -> None:
    source = "{oci: 'oci://charts.example/object-fusion', version: 0.2.0}"
    charts = f"{new_repo.files()['registry/charts.yaml']}    channels: {{next: {source}}}\n"
    repo = MemoryRepo(
        {VERSIONS: block("versions.md", _LISTED), "registry/charts.yaml": charts}
        | edited(APPDEF, "inputs:\n", "versions: update\ninputs:\n"),
        now=NOW,
    )
    first, second = two_versions()
    repo.send(first)
    (application,) = second["applications"]
    upgrade = second | {"applications": [application | {"version": "2.0.0"}]}
    assert repo.decide(upgrade).approval == (block("versions.md", "application definition"),)
    end = Demand("expire", demand=second["demand"], is_complete=True)
    said = [text.strip() for text in blocks("versions.md") if text.lstrip().startswith("Desired")]
    for goal, text in zip((second, end), said, strict=True):
        decision = repo.send(goal, repo.now + timedelta(minutes=20 if goal is end else 0))
        assert decision.approval == ()
        assert f"\n{text}\n" in commit_message.of_decision(decision, "op", NOW)


def test_the_instance_of_its_own_of_the_documentation() -> None:
    listed = re.sub(r"    charts: \{object-fusion: 0.2.0\}\n", "", block("versions.md", _LISTED))
    listed = listed.replace("charts: {object-fusion: 0.2.0}", "charts: {}")
    separate = edited(APPDEF, "inputs:\n", "versions: separate\ninputs:\n")
    repo = MemoryRepo({VERSIONS: listed} | separate)
    first, second = two_versions()
    repo.send(first)
    decision = repo.send(second)
    said = block("versions.md", "application 'edge/object_detection_fusion' in version")
    note, _, desired = said.partition("\n\n")
    assert note in decision.warnings
    assert f"\n{desired}\n" in commit_message.of_decision(decision, "op", NOW)
    names = {one.name: one for one in repo.state.plans.values()}
    (release,) = (one for name, one in names.items() if name.startswith("od-edge-station00-1"))
    assert f"`{release.outputs['object_list']}`" in (DOCS / "versions.md").read_text()


def test_the_rules_of_the_documentation_form_demands_that_are_booked() -> None:
    (near,) = (text for text in blocks("detector.md") if "kind: DetectorRules" in text)
    more = (DOCS.parent / "examples" / "detector" / "rules.yaml").read_text()
    start = datetime(2026, 5, 4, 4, 29, 30, tzinfo=timezone.utc).timestamp()  # a Monday
    cars = [f"vehicle0{number}" for number in range(3)]
    crossing = [
        (tick, car, (1000.0 * at * (tick > 1), 10.0), float(at))
        for tick in range(64)
        for at, car in enumerate(cars)
    ]
    formed = set[str]()
    for text, steps in (
        (near, [(1, "vehicle00", (-5352, -3280), 10)]),
        (more, crossing),
        (more.replace("start: 5", "start: 3"), crossing[:3]),
    ):
        detector = Detector(rule_file.read(text, "rules.yaml"), start)
        for after, entity, position, speed in steps:
            values = {"twist.twist.linear.x": speed}
            seen = Observation("vehicles", entity, start + after, position, values)
            for event, want in detector.step([seen], start + after):
                if want.goal is not None:
                    assert MemoryRepo().decide(want.goal.document).outcome == "booked"
                    formed.add(" ".join((event.rule, *event.subjects)))
    assert formed >= {
        *(f"platoon {one} {other}" for one, other in combinations(cars, 2)),
        *("rush-hour", "slow vehicle00", "slow vehicle01"),
    }
    assert [name for name in formed if name.startswith("crowded")]
