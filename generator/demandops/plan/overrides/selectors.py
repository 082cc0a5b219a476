"""Selectors: which releases, claims and demands an override matches.

Knows no effects of overrides.
"""

from __future__ import annotations

from dataclasses import dataclass

from demandops.config.config import Config
from demandops.config.override import Override, Selector
from demandops.config.policy import matches
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded


@dataclass(frozen=True, slots=True)
class Traits:
    """The values that a selector is compared with; only a service's release has a ``service``."""

    nodes: tuple[str, ...]
    requesters: tuple[str, ...]
    applications: tuple[str, ...] = ()
    appdefs: tuple[str, ...] = ()
    connections: tuple[str, ...] = ()
    service: str = ""


def traits_of(one: Claim | Demanded) -> Traits:
    """Return the traits of a claimed or demanded application or connection."""
    held = one.held
    if isinstance(held, Application):
        return Traits(held.nodes, one.requesters, (held.id,), (held.appdef,))
    return Traits(held.nodes, one.requesters, connections=(held.id,))


def fits(
    selector: Selector, traits: Traits, config: Config, *, any_requester: bool = False
) -> bool:
    """Return whether every field of a selector matches; ``any_requester`` ignores requesters."""
    fields = (
        (selector.applications, traits.applications),
        (selector.appdefs, traits.appdefs),
        (selector.services, (traits.service,) if traits.service else ()),
        (selector.connections, traits.connections),
        (selector.nodes, traits.nodes),
        (None if any_requester else selector.requesters, traits.requesters),
    )
    if any(
        patterns is not None and not any(matches(value, patterns) for value in values)
        for patterns, values in fields
    ):
        return False
    return not selector.labels or any(has_labels(selector, node, config) for node in traits.nodes)


def has_labels(selector: Selector, node: str, config: Config) -> bool:
    """Return whether a node has all labels of a selector."""
    known = config.nodes.get(node)
    labels = known.labels() if known else {}
    return all(labels.get(key) == value for key, value in (selector.labels or {}).items())


def selects(
    override: Override, traits: Traits, config: Config, *, any_requester: bool = False
) -> bool:
    """Return whether one of an override's selectors matches."""
    return any(
        fits(selector, traits, config, any_requester=any_requester) for selector in override.select
    )
