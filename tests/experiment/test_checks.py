"""A run without faults passes all checks, and each fault makes its check fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from examples.experiment.full import fleet, report, routes
from examples.experiment.full.checks import checks
from examples.experiment.full.measures import savings, steps
from examples.experiment.full.outcome import Formed, Outcome, Settings
from examples.experiment.full.participants import EGO_DATA
from examples.experiment.full.process_runner import Container, RunningPod
from examples.experiment.full.rules import Near, events_of
from tests.e2e.common.expected import DETECTION, FUSION, source_end, target_end

from .test_routes import drive

VEHICLE, OVER = "vehicle00", 60.0
EGO = EGO_DATA.format(VEHICLE)
NODE_OF = {
    FUSION: "edge",
    **dict.fromkeys(DETECTION.values(), "edge"),
    **{target_end(source): "edge" for source in ("station00", VEHICLE)},
    **{source_end(source): source for source in ("station00", VEHICLE)},
}


def pod(service: str, bound: float, ended: float) -> RunningPod:
    requests = {"cpu": "50m", "memory": "64Mi"}
    manifest = {
        "metadata": {"name": f"{service}-x", "labels": {"app.kubernetes.io/instance": service}},
        "spec": {
            "nodeName": f"node-{NODE_OF[service]}",
            "containers": [{"resources": {"requests": requests}}],
        },
    }
    return RunningPod(manifest, Path(), bound, [Container("c", [], {}, starts=[bound])], ended)


def good() -> Outcome:
    """Return a run of one vehicle that passes all checks."""
    near, all_routes = Near.read(), routes.one(0, 10.0)
    poses = drive(all_routes, OVER)
    joins, leaves = events = events_of(poses, near, OVER)
    inside = [pose for pose in poses if joins.at + 3 <= pose.at <= leaves.at]
    formed = [
        Formed(
            str(number),
            VEHICLE,
            event.joins,
            {"admitted": event.at + 0.1, "committed": event.at + 0.2, "pushed": event.at + 0.3},
            fleet.requesters({VEHICLE} if event.joins else ()),
        )
        for number, event in enumerate(events)
    ]
    left = frozenset({"ConfigMap demandops-domain"})
    return Outcome(
        settings=Settings(short=True),
        routes=all_routes,
        near=near,
        set_off=0.0,
        over=OVER,
        poses=poses,
        events=events,
        formed=formed,
        pods=[pod(service, joins.at + 1, leaves.at + 1) for service in NODE_OF],
        node_ids={f"node-{node}": node for node in fleet.NODES},
        inputs=[
            (-1.0, frozenset()),
            (joins.at + 2, fleet.fusion_inputs({VEHICLE})),
            (leaves.at + 1, frozenset()),
        ],
        tracks=[(pose.at + 0.1, [(pose.x, pose.y)]) for pose in inside],
        arrivals={EGO: [pose.at + 0.1 for pose in inside]},
        published={EGO: 1000},
        carried={f"mqtt-prefix{EGO}": 400, "mqtt_client/ros_msg_type/x": 7},
        left=left,
        before=left,
    )


def faults(outcome: Outcome) -> list[str]:
    return [check.name for check in checks(outcome) if not check.holds]


def test_a_run_in_which_all_is_right_passes() -> None:
    assert faults(good()) == []


def _moved(run: Outcome) -> list[RunningPod]:
    return [replace(one, manifest=one.manifest | {"spec": _on_edge(one)}) for one in run.pods]


def _on_edge(one: RunningPod) -> dict[str, Any]:
    return dict(one.manifest["spec"]) | {"nodeName": "node-edge"}


def _restarted(run: Outcome) -> list[RunningPod]:
    twice = [Container("c", [], {}, starts=[1.0, 2.0])]
    return [replace(one, containers=twice) if one.service == FUSION else one for one in run.pods]


BREAKS: dict[str, tuple[Callable[[Outcome], dict[str, Any]], str]] = {
    "no demand": (lambda run: {"formed": []}, "plain script"),
    "a demand too much": (lambda run: {"formed": [*run.formed, run.formed[0]]}, "plain script"),
    "other requesters": (
        lambda run: {"formed": [replace(run.formed[0], bookkeeping={}), run.formed[1]]},
        "requesters of every service",
    ),
    "no input": (lambda run: {"inputs": run.inputs[:1]}, "fusion subscribed"),
    "an input too much": (
        lambda run: {"inputs": [(at, topics | {"/x"}) for at, topics in run.inputs]},
        "fusion subscribed",
    ),
    "a restart": (lambda run: {"pods": _restarted(run)}, "fusion subscribed"),
    "no data": (lambda run: {"arrivals": {}}, "data arrived"),
    "data afterwards": (
        lambda run: {"arrivals": {EGO: [*run.arrivals[EGO], OVER - 1]}},
        "data arrived",
    ),
    "data before": (lambda run: {"early": 1}, "before the first demand"),
    "the wrong node": (lambda run: {"pods": _moved(run)}, "every pod ran on the node"),
    "not fused": (lambda run: {"tracks": []}, "fusion published"),
    "something left": (lambda run: {"left": frozenset({"Pod x"})}, "at the end only"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_fault_is_found(name: str) -> None:
    change, check = BREAKS[name]
    run = good()
    assert any(check in found for found in faults(replace(run, **change(run))))


def test_the_times_of_an_event() -> None:
    joins, leaves = (step.delays() for step in steps(good()))
    assert joins == pytest.approx(
        {"demand": 0.1, "commit": 0.3, "pods": 1.0, "fused": 3.1}, abs=0.2
    )
    assert leaves == pytest.approx({"demand": 0.1, "commit": 0.3, "pods": 1.0})


def test_what_running_on_demand_saves() -> None:
    run = good()
    joins, leaves = run.events
    pods, cores, memory, carried = savings(run)
    assert pods.always == len(NODE_OF)
    assert pods.on_demand == pytest.approx(pods.always * (leaves.at - joins.at) / OVER)
    assert (cores.always, memory.always) == pytest.approx((0.05 * len(NODE_OF), 64 * len(NODE_OF)))
    assert carried.saved == pytest.approx(0.6)


def test_the_report_shows_a_fault() -> None:
    run = replace(good(), early=3)
    page = report.page(run, checks(run))
    assert '<span class="fault">fault</span> nothing arrived on the edge' in page
    assert page.count("<svg") == 3
