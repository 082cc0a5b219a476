"""Every scenario of ``tests/scenarios`` holds, and a scenario that checks nothing is refused."""

from __future__ import annotations

import pytest
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load

from tests.scenarios import running

FILES = running.scenarios()


@pytest.mark.parametrize("name", FILES)
def test_scenario(name: str) -> None:
    scenario = running.read(FILES[name].read_text(), str(FILES[name]))
    if scenario.invalid is None:
        running.run(scenario)
        return
    with pytest.raises(InvalidInput) as error:
        load(running.configuration(scenario.appdefs, scenario.config))
    told = "\n".join(f"{found.code}: {found}" for found in error.value.faults)
    assert running.same_faults(scenario.invalid, error.value.faults), told


DEMAND = "send: {kind: Demand, demand: d, requesters: [a]}"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "must be a mapping"),
        ("steps: [{gives: booked}]", "must: is missing"),
        ("must: do nothing", "needs either steps"),
        ("must: do nothing\nsteps: []", "needs either steps"),
        ("must: check nothing\nsteps: [{after: 1h}]", "checks nothing"),
        (f"must: check nothing\nsteps: [{{{DEMAND}}}]", "checks nothing"),
        (f"must: look away\nsteps: [{{{DEMAND}, runs: {{}}}}]", "needs either gives or refused"),
        (f"must: take all\nsteps: [{{{DEMAND}, refused: []}}]", "refused is empty"),
        ("must: compare nothing\nsteps: [{gives: booked}]", "add send"),
        ("must: hold nothing\nsteps: [{holds: {}}]", "holds is empty"),
        ("must: hold nothing\nsteps: [{holds: {of-edge: []}}]", "lists no words"),
        ("must: misspell\nsteps: [{expire: [d]}]", "expire: is not a field here"),
        ("must: accept no faults\ninvalid: []", "needs either steps"),
        ("must: be both\ninvalid: [{field: x}]\nsteps: [{runs: {}}]", "or invalid, not both"),
    ],
)
def test_a_scenario_that_could_not_fail_is_not_read(text: str, told: str) -> None:
    with pytest.raises(InvalidInput) as error:
        running.read(text, "scenario.yaml")
    assert told in str(error.value)


def _failing(scenario: str) -> str:
    with pytest.raises(AssertionError) as error:
        running.run(running.read(scenario, "scenario.yaml"))
    return str(error.value)


PUT = """
must: show that it can fail
steps:
- send:
    kind: Demand
    demand: d
    lease: 10m
    requesters: [vehicle00]
    applications:
    - {id: edge/fusion, type: object-detection-fusion, node: edge,
       inputs: {ego_data: [{topic: /ego, source: vehicle00}]}}
"""


@pytest.mark.parametrize(
    ("claimed", "told"),
    [
        ("gives: released", "is booked, but must be released"),
        ("refused: [{field: demand}]", "is booked, but must be refused"),
        ("gives: booked\n  runs: {}", "runs"),
        ("gives: booked\n  connections: {}", "connections"),
        ("gives: booked\n  carries: {derived/vehicle00/edge: [/other]}", "carries"),
        ("gives: booked\n  leases: {d: 11m}", "leases"),
        ("gives: booked\n  desired: []", "the desired state changes in another way"),
        ("gives: booked\n  warns: [something]", "warns of ()"),
        ("gives: booked\n  holds: {of-edge: [nonsense]}", "holds no ['nonsense']"),
        ("gives: booked\n  holds: {xx: [nonsense]}", "0 releases are called xx"),
        ("gives: booked\n- {after: 10m, expires: [d]}", "other demands expire"),
        ("gives: booked\n- {after: 11m, runs: {}}", "other demands expire"),
    ],
)
def test_a_scenario_fails_where_something_else_comes_out(claimed: str, told: str) -> None:
    assert told in _failing(f"{PUT}  {claimed}\n")


def test_a_refusal_must_be_the_one_that_is_expected() -> None:
    bad = PUT.replace("node: edge", "node: egde")
    fault = "code: unknown-node, field: 'applications[0].node'"
    running.run(running.read(f"{bad}  refused: [{{{fault}, says: [edge]}}]\n", "scenario.yaml"))
    for claimed in (
        "{field: 'applications[0].node'}",
        "{code: unknown-node, field: 'applications[1].node'}",
        f"{{{fault}, says: [nonsense]}}",
        f"{{{fault}}}, {{{fault}, says: [edge]}}",
    ):
        assert "is refused with other faults" in _failing(f"{bad}  refused: [{claimed}]\n")


def test_the_scenarios_are_where_they_are_looked_for() -> None:
    assert len(FILES) >= 20
