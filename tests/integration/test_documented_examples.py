"""The examples of the documentation do what the documentation says."""

from __future__ import annotations

import re
import textwrap
from datetime import datetime, timedelta, timezone
from itertools import combinations
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
import yaml
from click.testing import CliRunner
from demandops.base.errors import Refused
from demandops.cli.main import cli
from demandops.decide.decision import decide
from demandops.decide.state import State, rendered_files
from demandops.detect import rule_file
from demandops.detect.detector import Detector
from demandops.detect.observations import Observation
from demandops.model.config.load import load
from demandops.model.demand.demand_request import Expire
from demandops.repo import new_repo
from demandops.repo.history import commit_message
from demandops.repo.pull_request.rendered_charts import manifest_faults
from demandops.views.bookkeeping import as_data, bookkeeping

from tests.kit.config import brokers, configuration, edited, state_of
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

DOCS = Path(__file__).parents[2] / "docs"
NOW = datetime(2026, 5, 4, 12, 0, tzinfo=timezone.utc)


def blocks(name: str) -> list[str]:
    """Return the indented code blocks of a document, without the indent."""
    text = (DOCS / name).read_text()
    return [
        textwrap.dedent(found) for found in re.findall(r"(?:^ {4}.*\n|^\n(?= {4}))+", text, re.M)
    ]


def block(name: str, start: str) -> str:
    (found,) = [text for text in blocks(name) if text.lstrip().startswith(start)]
    return found


def state(**files: str) -> State:
    return state_of(load(configuration(files)))


def demand() -> dict[str, Any]:
    goal: dict[str, Any] = yaml.safe_load(block("demand.md", "apiVersion: demandops/v1\nkind: Dem"))
    return goal


def decided(on: State, goal: object) -> Any:
    return decide(on, goal, NOW, lambda path: None)


def test_the_demand_of_the_documentation_runs_with_a_derived_connection() -> None:
    decision = decided(state(), demand())
    books = as_data(bookkeeping(decision.state), "")
    assert {entry["service"] for entry in books["services"].values()} == {
        "object-detection",
        "object-fusion",
    }
    assert list(books["connections"]) == ["derived/vehicle00/edge"]
    assert decision.lease_s == 600
    assert decision.warnings == ()


_NO_NODE = "no-node: applications[0].place: no node fits: "
_EDGE = "nodes:\n- {id: edge, type: edge, cluster: c-its,"


def test_the_placement_of_the_documentation_is_told_as_it_says() -> None:
    def said(start: str) -> str:
        return block("placement.md", start).strip()

    nodes = yaml.safe_load(configuration()["inventory/nodes.yaml"])
    listed = yaml.safe_load(block("placement.md", f"{_EDGE} capabilities"))["nodes"]
    new = {node["id"] for node in listed}
    nodes["nodes"] = [one for one in nodes["nodes"] if one["id"] not in new] + listed
    repo = MemoryRepo({"inventory/nodes.yaml": yaml.safe_dump(nodes)} | brokers(*sorted(new)))
    goal = yaml.safe_load(block("placement.md", "apiVersion: demandops/v1\nkind: Dem"))
    start = "application 'object_detection_fusion' is placed on 'edge-north', "
    assert repo.send(goal).placed == (said(start + "the nearest"),)
    goal["positions"][0]["y"] = 0
    again = repo.send(goal)
    assert (again.outcome, again.placed) == ("unchanged", (said(start + "where"),))
    goal["positions"][0]["y"] = 1800
    goal["applications"][0]["place"]["capabilities"].append("fpga")
    with pytest.raises(Refused) as refused:
        repo.decide(goal)
    assert refused.value.text_with_codes() == said(f"{_NO_NODE}'edge-north' lacks the c")


def test_a_service_of_the_documentation_gets_the_node_that_it_says() -> None:
    inventory = yaml.safe_load(configuration()["inventory/nodes.yaml"])
    for node in inventory["nodes"]:
        node["capabilities"] = ["gpu"] if node["id"] == "cloud" else []
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    definition = yaml.safe_load(configuration()[appdef])
    for name, more in yaml.safe_load(block("placement.md", "services:"))["services"].items():
        definition["services"][name] |= more
    files = {"inventory/nodes.yaml": yaml.safe_dump(inventory), appdef: yaml.safe_dump(definition)}
    decision = MemoryRepo(files).send(demand())
    assert decision.placed == (block("placement.md", "service 'object-fusion'").strip(),)


def test_the_properties_of_the_documentation_are_compared() -> None:
    nodes = yaml.safe_load(configuration()["inventory/nodes.yaml"])
    listed = yaml.safe_load(block("placement.md", f"{_EDGE} properties"))["nodes"]
    others = [one for one in nodes["nodes"] if one["id"] == "vehicle00"]
    asked, of_service = (
        yaml.safe_load(block("placement.md", f"place: {start}"))
        for start in ("{role: edge, prop", "{prop")
    )
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    definition = yaml.safe_load(configuration()[appdef])
    definition["services"]["object-fusion"] |= of_service
    files = {"inventory/nodes.yaml": yaml.safe_dump(nodes | {"nodes": others + listed})}
    repo = MemoryRepo(files | {appdef: yaml.safe_dump(definition)} | brokers("edge", "edge-north"))
    goal = demand()
    (app,) = goal["applications"]
    del app["node"]
    decision = repo.decide(goal | {"applications": [app | asked]})
    told = [text.partition(",")[0].partition(" is ")[2] for text in decision.placed]
    assert told == ["placed on 'edge'"] * 2
    said = block("placement.md", f"{_NO_NODE}'edge' lacks the p")
    wrong = ("memoryGiB>=64", "memoryGib>=8", "ros>=8")
    apps = [
        app | {"id": f"app{number}", "place": {"role": "edge", "properties": [text]}}
        for number, text in enumerate(wrong)
    ]
    with pytest.raises(Refused) as refused:
        repo.decide(goal | {"applications": apps})
    assert refused.value.text_with_codes() == said.strip()


def test_the_named_node_of_a_service_of_the_documentation() -> None:
    goal = demand()
    goal["applications"] = yaml.safe_load(block("placement.md", "applications:\n"))["applications"]
    books = as_data(bookkeeping(decided(state(), goal).state), "")
    on = {entry["service"]: entry["node"] for entry in books["services"].values()}
    assert on == {"object-detection": "edge", "object-fusion": "cloud"}


def test_the_capacity_of_the_documentation_is_kept() -> None:
    example = yaml.safe_load(block("placement.md", f"{_EDGE} capacity"))
    (node,) = example["nodes"]
    inventory = yaml.safe_load(configuration()["inventory/nodes.yaml"])
    inventory["nodes"] = [node if one["id"] == "edge" else one for one in inventory["nodes"]]
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    definition = yaml.safe_load(configuration()[appdef])
    for name, more in example["services"].items():
        definition["services"][name] |= more
    repo = MemoryRepo(
        {"inventory/nodes.yaml": yaml.safe_dump(inventory), appdef: yaml.safe_dump(definition)}
    )
    goal = demand()
    repo.send(goal)
    goal["demand"], goal["applications"][0]["id"] = "second", "edge/second"
    with pytest.raises(Refused) as refused:
        repo.decide(goal)
    assert refused.value.text_with_codes() == block("placement.md", "capacity:").strip()


def test_the_deployment_request_of_the_documentation_runs() -> None:
    goal = yaml.safe_load(block("demand.md", "id: station00/collective-perception"))
    decision = decided(state(), goal)
    assert decision.outcome == "booked"
    assert len(decision.changes.claims) == 2


def test_the_application_definition_of_the_documentation_runs() -> None:
    definitions = [yaml.safe_load(text) for text in blocks("appdef.md") if "kind: " in text]
    files: dict[str, Any] = {"registry/charts.yaml": {"charts": {}}}
    files["registry/images.yaml"] = {"images": {}}
    for one in definitions:
        folder = f"appdefs/{one['name']}"
        kind = "appdef" if one["kind"] == "ApplicationDefinition" else "service"
        files[f"{folder}/{kind}.yaml"] = one
        for service in one.get("services", {"": one}).values():
            files[f"{folder}/{service['values']}"] = {"any": 1}
            name, source = service["chart"], {"http": "https://charts.example", "version": "1.0.0"}
            files["registry/charts.yaml"]["charts"][name] = source
            for image in service["images"]:
                entry = {"repository": f"registry.example/{image}", "tag": "1"}
                files["registry/images.yaml"]["images"][image] = entry
    for path in ("registry/charts.yaml", "registry/images.yaml"):
        section = next(iter(files[path]))
        whole = yaml.safe_load(new_repo.files("flux")[path])
        whole[section] |= files[path][section]
        files[path] = whole
    on = state(**{path: yaml.safe_dump(data) for path, data in files.items()})
    (app,) = (goal := demand())["applications"]
    clouds = {"point_cloud": app["inputs"]["point_cloud"]}
    goal["applications"] = [{**app, "type": "recorder", "inputs": clouds}]
    services = as_data(bookkeeping(decided(on, goal).state), "")["services"]
    assert {entry["service"]: entry["node"] for entry in services.values()} == {
        "lidar-driver": "vehicle00",
        "filter": "vehicle00",
        "recorder": "edge",
    }


@pytest.mark.parametrize(
    ("requester", "node", "start"),
    [
        ("vehicle01", "cloud", "not-allowed: requesters[0]: rule 'vehicles'"),
        ("truck7", "edge", "not-allowed: requesters[0]: no rule of"),
    ],
)
def test_the_policy_of_the_documentation_refuses_as_it_says(
    requester: str, node: str, start: str
) -> None:
    policy = block("policy.md", "apiVersion: demandops/v1\nkind: AccessDomains")
    on = state(**{"policy/access-domains.yaml": policy})
    goal = demand() | {"requesters": [requester]}
    (application,) = goal["applications"]
    # its inputs are at its node, so it needs no connection that could be refused too
    inputs = {"ego_data": [{"topic": "/vehicles/vehicle01/ego_data", "source": node}]}
    goal["applications"] = [application | {"node": node, "inputs": inputs}]
    with pytest.raises(Refused) as refused:
        decided(on, goal)
    said = refused.value.text_with_codes()
    assert said == block("policy.md", start).strip()
    assert decided(on, demand()).outcome == "booked"


def test_the_policy_of_the_documentation_lets_data_cross_by_its_rules_only() -> None:
    (policy,) = (text for text in blocks("policy.md") if "name: everybody" in text)
    head = "apiVersion: demandops/v1\nkind: AccessDomains\n"
    closed = policy.replace("peers: [city]", "nodes: ['*']")
    file = "policy/access-domains.yaml"
    goal = demand() | {"requesters": ["vehicle00"]}
    assert decided(state(**{file: f"{head}{policy.lstrip()}"}), goal).outcome == "booked"
    with pytest.raises(Refused) as refused:
        decided(state(**{file: f"{head}{closed.lstrip()}"}), goal)
    said = refused.value.text_with_codes().replace("rule 'everybody' of ", "")
    assert said == block("policy.md", "not-allowed: requesters[0]: access domain 'fleet'").strip()


def test_the_policy_of_the_documentation_closes_the_namespace() -> None:
    policy = block("policy.md", "apiVersion: demandops/v1\nkind: AccessDomains")
    on = state(**{"policy/access-domains.yaml": policy})
    path = "bootstrap/c-its.yaml"
    _, manifests = rendered_files(on)[path].split("\n---\n", 1)
    assert not [*manifest_faults({path: manifests})]
    kinds = [item["kind"] for item in yaml.safe_load_all(manifests)]
    assert kinds.count("NetworkPolicy") == 1
    assert "NetworkPolicy" not in rendered_files(state())[path]


def test_the_versions_of_the_documentation_are_an_update_and_back() -> None:
    listed = block("versions.md", "apiVersion: demandops/v1\nkind: Versions")
    source = "{oci: 'oci://charts.example/object-fusion', version: 0.2.0}"
    charts = f"{new_repo.files()['registry/charts.yaml']}    channels: {{next: {source}}}\n"
    definition = "appdefs/object-detection-fusion/appdef.yaml"
    repo = MemoryRepo(
        {"registry/versions.yaml": listed, "registry/charts.yaml": charts}
        | edited(definition, "inputs:\n", "versions: update\ninputs:\n"),
        now=NOW,
    )
    first, second = map(
        yaml.safe_load,
        (block("versions.md", f"kind: Demand\ndemand: {who}00") for who in ("station", "vehicle")),
    )
    repo.send(first)
    (application,) = second["applications"]
    upgrade = second | {"applications": [application | {"version": "2.0.0"}]}
    reason = block("versions.md", "application definition").strip()
    assert repo.decide(upgrade).approval == (reason,)
    end = Expire(id=second["demand"], demand=second["demand"])
    said = [text.strip() for text in blocks("versions.md") if text.lstrip().startswith("Desired")]
    for goal, text in zip((second, end), said, strict=True):
        decision = repo.send(goal, repo.now + timedelta(minutes=20 if goal is end else 0))
        assert decision.approval == ()
        assert f"\n{text}\n" in commit_message.of_decision(decision, "op", NOW)


def test_the_node_in_several_domains_of_the_documentation() -> None:
    (policy,) = (text for text in blocks("policy.md") if "name: guests" in text)
    (edge,) = yaml.safe_load(block("policy.md", "nodes:\n  - id: edge"))["nodes"]
    nodes = yaml.safe_load(configuration()["inventory/nodes.yaml"])
    nodes["nodes"] = [one | edge if one["id"] == "edge" else one for one in nodes["nodes"]]
    head = "apiVersion: demandops/v1\nkind: AccessDomains\n"
    repo = MemoryRepo(
        {"inventory/nodes.yaml": yaml.safe_dump(nodes), "policy/access-domains.yaml": head + policy}
    )

    def folders(who: str, node: str = "edge") -> set[str]:
        releases = repo.decide(put(who, who, node=node, connect="none")).releases
        return {one.file.split("/")[2] for one in releases}

    assert folders("traffic-control") == {"city"}
    assert folders("vehicle01") == {"fleet"}
    with pytest.raises(Refused) as refused:
        folders("vehicle00")
    assert refused.value.text_with_codes() == block("policy.md", "several-access-domains:").strip()
    assert folders("vehicle00", "edge@fleet") == {"fleet"}
    assert folders("vehicle00", "edge@city") == {"city"}


def test_the_instance_of_its_own_of_the_documentation() -> None:
    listed = block("versions.md", "apiVersion: demandops/v1\nkind: Versions")
    listed = listed.replace("    charts: {object-fusion: 0.2.0}\n", "")
    repo = MemoryRepo(
        {"registry/versions.yaml": listed.replace("charts: {object-fusion: 0.2.0}", "charts: {}")}
        | edited(
            "appdefs/object-detection-fusion/appdef.yaml",
            "inputs:\n",
            "versions: separate\ninputs:\n",
        )
    )
    for who in ("station", "vehicle"):
        decision = repo.send(yaml.safe_load(block("versions.md", f"kind: Demand\ndemand: {who}00")))
    said = block("versions.md", "application 'edge/object_detection_fusion' in version")
    note, _, desired = said.strip().partition("\n\n")
    assert note in decision.warnings
    assert f"\n{desired}\n" in commit_message.of_decision(decision, "op", NOW)
    page = (DOCS / "versions.md").read_text()
    (release,) = (
        one for one in repo.state.plans.values() if one.name.startswith("od-edge-station00-1")
    )
    assert f"`{release.outputs['object_list']}`" in page


def test_the_rules_of_the_documentation_form_demands_that_are_booked() -> None:
    near, more = (text for text in blocks("detector.md") if "kind: DetectorRules" in text)
    start = datetime(2026, 5, 4, 4, 29, 30, tzinfo=timezone.utc).timestamp()  # a Monday

    def wanted(text: str, *steps: tuple[float, str, tuple[float, float], float]) -> list[Any]:
        detector = Detector(rule_file.read(text, "rules.yaml"), start)
        told = []
        for after, entity, position, speed in steps:
            values = {"twist.twist.linear.x": speed}
            seen = Observation("vehicles", entity, start + after, position, values)
            told += [(event, want.goal) for event, want in detector.step([seen], start + after)]
        return told

    ((_, perception),) = wanted(near, (1, "vehicle00", (-5352, -3280), 10))
    cars = [f"vehicle0{number}" for number in range(3)]
    steps = [
        (tick, car, (1000.0 * at * (tick > 1), 10.0), float(at))
        for tick in range(64)
        for at, car in enumerate(cars)
    ]
    told = wanted(more, *steps)
    counted = wanted(more.replace("start: 5", "start: 3"), *steps[:3])
    kinds = [(event.rule, *event.subjects) for event, goal in told if goal is not None]
    assert kinds == [
        *(("platoon", one, other) for one, other in combinations(cars, 2)),
        ("rush-hour",),
        *(("slow", car) for car in cars[:2]),
    ]
    assert [goal.data["request"] for event, goal in counted if event.rule == "crowded"] == [
        "3 vehicles at the crossing"
    ]
    for goal in (perception, *(goal for _, goal in (*told, *counted) if goal is not None)):
        assert decided(state(), goal.document).outcome == "booked"


def test_each_schema_accepts_the_file_of_init_and_refuses_an_unknown_field() -> None:
    runner, files = CliRunner(), new_repo.files()
    listed = dict(
        line.split(maxsplit=1) for line in runner.invoke(cli, ["schema"]).output.splitlines()
    )
    checked = 0
    for name, what in listed.items():
        schema = yaml.safe_load(runner.invoke(cli, ["schema", name]).output)
        validator = jsonschema_rs.validator_for(schema)
        path = what.partition(",")[0].replace("<name>", "object-detection-fusion")
        if path in files:
            data = yaml.safe_load(files[path])
            assert validator.is_valid(data), name
            assert not validator.is_valid(data | {"misspelt": 1}), name
            checked += 1
    assert checked == 9
    schema = yaml.safe_load(runner.invoke(cli, ["schema", "demand"]).output)
    assert jsonschema_rs.validator_for(schema).is_valid(demand())


def test_schemas_are_written_to_a_folder(tmp_path: Path) -> None:
    ran = CliRunner().invoke(cli, ["schema", "--write", str(tmp_path / "schemas")])
    assert ran.output == f"17 schemas in {tmp_path / 'schemas'}\n"
    assert len(list((tmp_path / "schemas").glob("*.json"))) == 17
