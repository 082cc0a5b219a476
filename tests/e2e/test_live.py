"""An application that `demandops new` laid down gets and loses vehicles while its pod runs on."""

from __future__ import annotations

import json
import shutil
from typing import Any

import yaml

from tests.e2e.common.expected import VEHICLES
from tests.e2e.common.world import World, demandops
from tests.kit.repo import git

ROUNDS, CHANGES = 10, 5
OPTIONS = (
    *("--input", "wave=std_msgs/msg/String", "--image", "registry.example/listening:1"),
    *("--service", "ear=listening/ear"),
)


def scaffold(world: World) -> dict[str, str]:
    """Return the files of a new application, as a person gets them in a clone."""
    clone = world.folder / "author"
    git(world.folder, "clone", "--quiet", world.url, str(clone))
    demandops(world.folder, "new", "application", "listening", *OPTIONS, "-C", str(clone))
    new = git(clone, "ls-files", "--others").splitlines()
    files = {path: (clone / path).read_text() for path in new}
    shutil.rmtree(clone)
    return files


def joins(vehicle: str) -> dict[str, Any]:
    inputs = {"wave": [{"topic": f"/{vehicle}/wave", "source": vehicle}]}
    listening = {"id": "edge/ears", "type": "listening", "node": "edge", "inputs": inputs}
    return {"demand": f"{vehicle}-ears", "requesters": [vehicle], "applications": [listening]}


def leaves(vehicle: str) -> dict[str, Any]:
    return {"operation": "release", "demand": f"{vehicle}-ears", "requesters": [vehicle]}


def test_a_scaffolded_application_follows_50_changes_without_a_restart(world: World) -> None:
    domain, there = world.domain, ["station00"]
    world.push(scaffold(world), "Add the application listening")

    def demand(*goals: dict[str, Any]) -> str:
        """Book the goals one after the other, and wait until the cluster has all of them."""
        paths = [world.folder / f"goal-{number}.yaml" for number in range(len(goals))]
        for path, goal in zip(paths, goals, strict=True):
            path.write_text(json.dumps({"apiVersion": "demandops/v1", "kind": "Demand", **goal}))
        said = world.demandops("demand", *map(str, paths))
        domain.follow(world.tip())
        return said

    assert "starts ear-edge-ears" in demand(joins("station00"))
    (name,) = (each for each in domain.releases() if each.startswith("ear-"))

    def inputs() -> list[str]:
        text = domain.get("ConfigMap", f"{name}-params")["data"]["params.yml"]
        parameters = yaml.safe_load(text)[name.replace("-", "_")]["ros__parameters"]
        assert parameters["result_topic"] == "/edge_ears_ear"
        return list(parameters["wave_topics"])

    def lives() -> tuple[object, ...]:
        (pod,) = domain.find("Pod", name)
        names = {each["name"] for each in pod["spec"]["containers"]}
        assert names == {"listening", "parameter-sync"}
        counts = (each["restartCount"] for each in pod["status"]["containerStatuses"])
        return (*domain.identity(name), *counts)

    domain.wait("its pod", lambda: ("ear-edge-ears", "edge") in domain.pods())
    domain.wait("the first input", lambda: inputs() == ["/station00/wave"])
    before = lives()
    for turn in range(ROUNDS):
        goals = []
        for number in range(turn, turn + CHANGES):
            vehicle = VEHICLES[number % len(VEHICLES)]
            goals.append(leaves(vehicle) if vehicle in there else joins(vehicle))
            there.remove(vehicle) if vehicle in there else there.append(vehicle)
        said = demand(*goals)
        assert said.count(f"reconfigures {name}\n") == CHANGES, said
        wanted = [f"/{source}/wave" for source in sorted(there)]
        domain.wait(f"the inputs {wanted}", lambda w=wanted: inputs() == w)
        assert lives() == before, "the pod was rolled out or restarted"
    # the account of the pod may read this ConfigMap and no other
    (role,) = (each for each in domain.find("Role") if each["metadata"]["name"] == f"{name}-params")
    assert [rule["resourceNames"] for rule in role["rules"]] == [[f"{name}-params"]]
