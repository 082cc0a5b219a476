"""Checks what a rule demands: the names in the template, the demand's form and its ids."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from demandops.demand import demand_goal, deployment_request_goal
from demandops.detection.rules import rule_template
from demandops.detection.rules.rule_demand import RuleDemand
from demandops.detection.rules.rule_template import Values, filled, names
from demandops.errors import Fault, fault
from demandops.quoting import quoted
from demandops.settings import API_VERSION

_HEAD = {"apiVersion": API_VERSION, "kind": "Demand"}
# Values of the right types, with which the form of a demand is checked before any event.
_SAMPLE: Values = {
    "rule": "rule",
    "entity": "entity",
    "other": "other",
    "x": 0.0,
    "y": 0.0,
    "distance": 0.0,
    "value": 0.0,
    "count": 1,
}


def faults_of_demand(
    template: RuleDemand, field: str, subjects: tuple[str, ...], momentary: frozenset[str]
) -> list[Fault]:
    """Return the faults of a rule's demand: of its names, else of its form, else of its ids.

    ``field`` is the path of the demand in the file. ``subjects`` are the names by which the
    template refers to an event's entities, ``momentary`` those of values that are known only when
    an event starts.
    """
    # A ``DeploymentRequest`` is sent again to renew it and with ``shutdown`` to end it. It must be
    # the same then, also after a restart, when momentary values are not known.
    known = {"rule", *subjects, *(momentary if template.action == "demand" else ())}
    if problems := rule_template.faults(template.data, field, known):
        return problems
    data = filled(template.data, _SAMPLE)
    if template.action == "demand":
        fixed = [name for name in ("apiVersion", "kind", "operation") if name in data]
        malformed = demand_goal.parse({**_HEAD, **data})[1]
    else:
        fixed = ["shutdown"] if "shutdown" in data else []
        malformed = deployment_request_goal.form_faults(data)
    problems = [fault(f"{field}.{name}", "is set by the detector; remove it") for name in fixed]
    written = dict(rule_template.texts(template.data, field))
    for problem in malformed:
        path = f"{field}.{problem.field}" if problem.field else field
        text, message = written.get(path, ""), problem.message
        # The writer wrote a text such as ``{x}``, which becomes a number.
        is_number = text.startswith("{") and isinstance(_SAMPLE.get(text[1:-1]), float | int)
        if is_number and message.startswith("must be text"):
            message = (
                f"{quoted(text)} becomes a number, but this field needs text; write a word before "
                f"{text}, such as 'near-{text}'"
            )
        problems.append(fault(path, message))
    return problems or list(_faults_of_ids(template, field, {f"{{{name}}}" for name in subjects}))


def _faults_of_ids(template: RuleDemand, field: str, needed: set[str]) -> Iterator[Fault]:
    """Yield a fault for each id that is missing, that may change, or that two entities would share.

    ``needed`` are names in braces, such as ``{entity}``. They must be in the id of a ``Demand``, or
    in the requesters of each application and connection of a ``DeploymentRequest``.
    """
    data: Any = template.data
    if template.action == "demand":
        yield from _missing(data, field, "demand", "requesters")
        why = "otherwise two events would share one demand"
        listed = [("demand", [data.get("demand", "")])]
        for name, what in (("demand", "id"), ("requesters", "requesters")):
            for path, text in rule_template.texts(data.get(name, ()), f"{field}.{name}"):
                if changing := sorted(names(text) - {"rule", "entity", "other"}):
                    message = (
                        f"'{{{changing[0]}}}' changes, but the demand's {what} must stay the same; "
                    )
                    yield fault(path, f"{message}leave that name out")
    else:
        yield from _missing(data, field, "id")
        why = "a shutdown ends what its requesters hold, so each event needs its own requesters"
        kind = "object_detection_fusion_app"
        listed = [
            (f"apps[{index}].{kind}.requester_ids", app.get(kind, {}).get("requester_ids", []))
            for index, app in enumerate(data.get("apps", ()))
        ]
        listed += [
            (f"connections[{index}].requester_ids", connection.get("requester_ids", []))
            for index, connection in enumerate(data.get("connections", ()))
        ]
    for path, values in listed:
        missing = needed - {f"{{{name}}}" for value in values for name in names(value)}
        if missing and any(values):
            named = " and ".join(sorted(missing))
            yield fault(f"{field}.{path}", f"must name {named}, because {why}")


def _missing(data: Any, field: str, *needed: str) -> Iterator[Fault]:  # noqa: ANN401 - plain data
    for name in needed:
        if not data.get(name):
            yield fault(f"{field}.{name}", "is missing; add it")
