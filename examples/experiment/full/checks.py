"""The checks that a run must pass, as pure functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from examples.experiment import paper

from . import fleet
from .outcome import Outcome, steps
from .participants import EGO_DATA
from .rig import FUSION

Rows = Callable[[set[str]], Mapping[str, list[str]]]
"""The requesters of each service and connection while these vehicles are near."""
_SLACK_S = 3.0
"""How many seconds a connection's messages may still arrive after its pods have ended."""


@dataclass(frozen=True)
class Check:
    """A check of a run: `name` says what must hold, `fault` what is wrong, if anything."""

    name: str
    fault: str = ""

    @property
    def holds(self) -> bool:
        return not self.fault


def checks(outcome: Outcome) -> list[Check]:
    return [
        *common(outcome, paper.requesters),
        *_as_in_the_paper(outcome),
    ]


def common(outcome: Outcome, rows: Rows) -> list[Check]:
    """Return the checks of each run in which containers run; `rows` are its requesters."""
    return [
        Check("the detector formed the demands that a plain script over the poses gives",
              differ([str(one) for one in outcome.events], [str(one) for one in outcome.formed])),
        Check("after each demand the requesters of every service and connection are right",
              "; ".join(_requesters(outcome, rows))),
        Check("the fusion subscribed to exactly the right topics after each demand, "
              "without a restart",
              "; ".join(_inputs(outcome))),
        Check("every vehicle's data arrived on the edge while it was near, and only then",
              "; ".join(arrivals(outcome, outcome.arrivals, EGO_DATA))),
        Check("nothing arrived on the edge before the first demand",
              f"{outcome.early} messages" if outcome.early else ""),
        Check("every pod ran on the node that it was for", "; ".join(check_nodes(outcome))),
        Check("the fusion published lists with every vehicle that was near",
              "; ".join(_fused(outcome))),
        Check("at the end only the initial deployment is left",
              differ(sorted(outcome.before), sorted(outcome.left))),
    ]  # fmt: skip


def differ(expected: object, found: object) -> str:
    return "" if expected == found else f"expected {expected}, found {found}"


def _requesters(outcome: Outcome, rows: Rows) -> Iterator[str]:
    inside: set[str] = set()
    for formed in outcome.formed:
        inside ^= {formed.vehicle}
        if fault := differ(rows(inside), formed.bookkeeping):
            yield f"{formed}: {fault}"


def _as_in_the_paper(outcome: Outcome) -> Iterator[Check]:
    settings = outcome.settings
    if settings.seed == 0 and not settings.short and not settings.vanish:
        found = [formed.bookkeeping for formed in outcome.formed]
        table = [paper.expected(step) for step in range(1, len(paper.STEPS) + 1)]
        yield Check("the requesters are those of the paper's table", differ(table, found))


def _inputs(outcome: Outcome) -> Iterator[str]:
    """Yield each fault in the topics that the fusion read, and in the number of its starts.

    The fusion must read the right sets of topics in the order of the demands. Between two demands,
    it may read other sets for a short time.
    """
    seen = [topics for at, topics in outcome.inputs if at >= outcome.set_off]
    inside: set[str] = set()
    for formed in outcome.formed:
        inside ^= {formed.vehicle}
        wanted = fleet.fusion_inputs(inside)
        if wanted in seen:
            seen = seen[seen.index(wanted) + 1 :]
        else:
            yield f"after '{formed}', the fusion never read {sorted(wanted)}"
    yield from restarts(outcome, FUSION)


def restarts(outcome: Outcome, service: str) -> Iterator[str]:
    """Yield a text if a service that all demands share did not run just while one lasted."""
    pods = [pod for pod in outcome.pods if pod.service == service]
    starts = [len(container.starts) for pod in pods for container in pod.containers]
    periods = _busy_periods([formed.joins for formed in outcome.formed])
    if len(pods) != periods or set(starts) != {1}:
        yield f"{len(pods)} pods in place of {periods}, with {starts} starts of containers"


def _busy_periods(joins: Iterable[bool]) -> int:
    count = inside = 0
    for joined in joins:
        count += joined and inside == 0
        inside += 1 if joined else -1
    return count


def arrivals(
    outcome: Outcome, found: Mapping[str, Sequence[float]], key: str = "{}"
) -> Iterator[str]:
    """Yield each vehicle whose data arrived never, or when nobody demanded it, by `found`."""
    for vehicle in sorted({event.vehicle for event in outcome.events}):
        times = found.get(key.format(vehicle), ())
        spans = [
            (step.event.at, step.gone + _SLACK_S if step.gone else outcome.over)
            for step in steps(outcome)
            if step.event.vehicle == vehicle and step.event.joins
        ]
        if not times:
            yield f"nothing of {vehicle} arrived"
        stray = [at for at in times if not any(begin <= at <= end for begin, end in spans)]
        if stray:
            yield f"{len(stray)} messages of {vehicle} arrived when nobody demanded them"


def check_nodes(outcome: Outcome) -> Iterator[str]:
    """Yield a text for each pod that did not run on its own node."""
    for pod in outcome.pods:
        kind, *rest = pod.service.split("-")
        wanted = rest[:1]
        if kind == "mqtt":  # the name of a derived connection's client does not say which end it is
            wanted = rest[1:3] if rest[0] == "derived" else rest[rest[2] != "source" :][:1]
        node = outcome.node_ids.get(pod.node, pod.node)
        if node not in wanted:
            yield f"{pod.service} ran on {node}, not on {' or '.join(wanted)}"


def _fused(outcome: Outcome) -> Iterator[str]:
    for step in steps(outcome):
        if step.event.joins and step.first is None:
            yield f"no list had {step.event.vehicle}"
