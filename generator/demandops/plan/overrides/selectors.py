"""Whom an override is for: its selectors held against a release, a claim or a demand.

Knows what a selector says and what there is to match; nothing of what an override then does.
"""

from __future__ import annotations

from dataclasses import dataclass

from demandops.config.config import Config
from demandops.config.override import Override, Selector
from demandops.config.policy import matches
from demandops.demand.claim import ApplicationClaim, Claim
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand


@dataclass(frozen=True, slots=True)
class Traits:
    """What a selector looks at. Only releases of services have a ``service``."""

    nodes: tuple[str, ...]
    requesters: tuple[str, ...]
    applications: tuple[str, ...] = ()
    appdefs: tuple[str, ...] = ()
    connections: tuple[str, ...] = ()
    service: str = ""


def traits_of(subject: Claim | ApplicationDemand | ConnectionDemand) -> Traits:
    """Return what a selector sees of an application or a connection that somebody asks for."""
    if isinstance(subject, ApplicationClaim):
        ids = (subject.application,)
        return Traits((subject.node,), subject.requesters, ids, (subject.appdef,))
    if isinstance(subject, ApplicationDemand):
        return Traits((subject.node,), subject.requesters, (subject.id,), (subject.appdef,))
    name = subject.id if isinstance(subject, ConnectionDemand) else subject.connection
    ends = (subject.source, subject.target)
    return Traits(ends, subject.requesters, connections=(name,))


def fits(selector: Selector, traits: Traits, config: Config, *, whoever_asks: bool = False) -> bool:
    """Tell whether every field of a selector fits; ``whoever_asks`` passes requesters over."""
    asked = (
        (selector.applications, traits.applications),
        (selector.appdefs, traits.appdefs),
        (selector.services, (traits.service,) if traits.service else ()),
        (selector.connections, traits.connections),
        (selector.nodes, traits.nodes),
        (None if whoever_asks else selector.requesters, traits.requesters),
    )
    if any(
        patterns is not None and not any(matches(value, patterns) for value in values)
        for patterns, values in asked
    ):
        return False
    return not selector.labels or any(labelled(selector, node, config) for node in traits.nodes)


def labelled(selector: Selector, node: str, config: Config) -> bool:
    """Tell whether a node has all labels of a selector."""
    known = config.nodes.get(node)
    labels = known.labels() if known else {}
    return all(labels.get(key) == value for key, value in (selector.labels or {}).items())


def selects(
    override: Override, traits: Traits, config: Config, *, whoever_asks: bool = False
) -> bool:
    """Tell whether an override is for this: one of its selectors fits."""
    return any(
        fits(selector, traits, config, whoever_asks=whoever_asks) for selector in override.select
    )
