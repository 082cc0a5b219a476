"""The effects of overrides: on claims, and on the releases that are planned from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from datetime import datetime

from demandops.base.naming import Subject
from demandops.model.config.base_model import matches
from demandops.model.config.config import Config
from demandops.model.config.override import Override, Selector, Shaping
from demandops.model.demand.demand import Application, Item
from demandops.model.ledger.claim import OVERRIDE_PREFIX, Claim, ClaimKey, requesters_of
from demandops.model.ledger.ledger import By, Ledger, World
from demandops.model.release import Release, ServiceRelease, claims_of

# ---- effects on claims: ``deny`` suspends claims, ``keep`` books further claims ----
#
# A suspended claim stays booked, but nothing runs for it. The planner reads the ledger through a
# view that leaves out suspended claims.
#
# When the last claim on a subject is released, ``keep`` books a claim with the same content for the
# owner of the override. A later demand for the subject replaces this kept claim. Bookkeeping and
# history show a kept claim like any other claim.


@dataclass(frozen=True, slots=True)
class Traits:
    """The values with which a selector is compared: those of a claim, a demand or a release.

    ``service`` is set only for the release of a service. If ``requesters`` is ``None``, the
    requesters of the selector are not compared.
    """

    nodes: tuple[str, ...]
    requesters: tuple[str, ...] | None
    applications: tuple[str, ...] = ()
    appdefs: tuple[str, ...] = ()
    connections: tuple[str, ...] = ()
    service: str = ""


def with_overridden_nodes(app: Application, world: World) -> Application:
    moving = [override for override in world.overrides if override.node]
    nodes: dict[str, str] = {}
    for service in world.config.services.get(app.appdef, {}).values() if moving else ():
        if service.is_movable:
            # A selector is compared with the node before any move. Otherwise an override that
            # selects this node would no longer select the service after the move.
            chosen = (app.chosen_node(service.name),)
            traits = Traits(chosen, None, (app.id,), (app.appdef,), service=service.name)
            for override in moving:
                if override.node and selects(override, traits, world.config):
                    nodes[service.name] = override.node
    return replace(app, moved=nodes)


def traits_of(item: Claim | Item) -> Traits:
    held = item.held
    if isinstance(held, Application):
        return Traits(held.nodes, item.requesters, (held.id,), (held.appdef,))
    return Traits(held.nodes, item.requesters, connections=(held.id,))


def fits(selector: Selector, traits: Traits, config: Config) -> bool:
    fields = (
        (selector.applications, traits.applications),
        (selector.appdefs, traits.appdefs),
        (selector.services, (traits.service,) if traits.service else ()),
        (selector.connections, traits.connections),
        (selector.nodes, traits.nodes),
        (selector.requesters, traits.requesters),
    )
    for patterns, values in fields:
        if patterns is None or values is None:
            continue
        if not any(matches(value, patterns) for value in values):
            return False
    return not selector.labels or any(has_labels(selector, node, config) for node in traits.nodes)


def has_labels(selector: Selector, node: str, config: Config) -> bool:
    entry = config.nodes.get(node)
    labels = entry.labels if entry else {}
    return all(labels.get(key) == value for key, value in (selector.labels or {}).items())


def selects(override: Override, traits: Traits, config: Config) -> bool:
    return any(fits(selector, traits, config) for selector in override.select)


@dataclass(frozen=True, slots=True)
class UnsuspendedClaims(Ledger):
    # A claim is checked when it is read, so there is no second ledger to keep up to date.
    world: World | None = field(default=None, compare=False)

    def claims_on(self, subject: Subject) -> tuple[Claim, ...]:
        return tuple(claim for claim in Ledger.claims_on(self, subject) if self._is_active(claim))

    def first_claim(self, subject: Subject) -> Claim | None:
        first = Ledger.first_claim(self, subject)
        if first is None or self._is_active(first):
            return first
        return next(iter(self.claims_on(subject)), None)

    def get(self, key: ClaimKey) -> Claim | None:
        claim = Ledger.get(self, key)
        return claim if claim and self._is_active(claim) else None

    def ids_with(self, by: By, *words: str) -> tuple[str, ...]:
        return tuple(sorted({claim.subject.id for claim in self.each_with(by, *words)}))

    def _is_active(self, claim: Claim) -> bool:
        return self.world is None or suspended_by(claim, self.world) is None


def without_suspended(world: World) -> World:
    ledger = world.ledger
    if isinstance(ledger, UnsuspendedClaims) or not any(each.deny for each in world.overrides):
        return world
    parts = (getattr(ledger, part.name) for part in fields(Ledger))
    view = replace(UnsuspendedClaims(*parts), world=world)
    return replace(world, ledger=view)


def suspended_by(claim: Claim, world: World) -> Override | None:
    return denied_by(traits_of(claim), world) if world.overrides else None


def denied_by(traits: Traits, world: World) -> Override | None:
    # For the release of a service, only selectors that name services count. For claims and
    # demands, only the others count.
    for override in reversed(world.overrides):
        if override.deny and any(
            bool(selector.services) is bool(traits.service) and fits(selector, traits, world.config)
            for selector in override.select
        ):
            return override
    return None


def suspended_claims(world: World) -> Iterator[tuple[Claim, Override]]:
    if not any(override.deny for override in world.overrides):
        return
    for claim in sorted(world.ledger, key=lambda claim: (str(claim.subject), claim.demand)):
        if override := suspended_by(claim, world):
            yield claim, override


def update_kept_claims(
    before: Ledger, after: World, subjects: Iterable[Subject], now: datetime
) -> tuple[Ledger, list[ClaimKey]]:
    """Give ``subjects`` the kept claims that overrides want; return all old and new keys."""
    keys, ledger = list[ClaimKey](), after.ledger
    for subject in subjects:
        existing = [*ledger.kept_claims(subject), *before.kept_claims(subject)]
        needed = None
        if len(ledger.claims_on(subject)) == len(ledger.kept_claims(subject)):
            needed = _kept_claim(existing, before.claims_on(subject), after, now)
        keys += [claim.key for claim in existing]
        ledger = ledger.without(existing)
        if needed is not None:
            keys.append(needed.key)
            ledger = ledger.replace(needed.key, needed)
    return ledger, keys


def _kept_claim(
    existing: list[Claim], before: tuple[Claim, ...], world: World, now: datetime
) -> Claim | None:
    """Return one of the ``existing`` kept claims, or a copy of the last claim ``before``."""
    for claim in existing:
        keeping = keeping_overrides(claim, world)
        if any(override.name == claim.keeping_override for override in keeping):
            return claim
    if not before:
        return None
    last = max(before, key=lambda claim: (claim.booked, claim.demand))
    keeping = keeping_overrides(last, world)
    # if it is suspended, nothing ran for this claim, so there is nothing to keep
    if not keeping or suspended_by(last, world) is not None:
        return None
    name, who = OVERRIDE_PREFIX + keeping[0].name, (keeping[0].owner,)
    if last.is_on_application:  # what it was held for does not matter any longer
        last = replace(last, held=replace(last.application, held_for={}))
    last = replace(last, demand=name, request=name, requesters=who, booked=now)
    return replace(last, lease=None, joined=False)


def keeping_overrides(claim: Claim, world: World) -> list[Override]:
    """Return the overrides that keep the subject of a claim, the highest in rank first."""
    traits = traits_of(claim)
    if claim.keeping_override is not None:
        # A kept claim names only the override's owner, not the requesters of the demand. So
        # ``requesters`` of a selector is not compared.
        traits = replace(traits, requesters=None)
    keeping = (override for override in reversed(world.overrides) if override.keep)
    return [override for override in keeping if selects(override, traits, world.config)]


# ---- effects on a planned release: version, node, replicas, or denial ----
#
# Pins of images and patches of Helm values are applied later, when the release is rendered.


def apply_overrides(release: Release, world: World) -> Release | None:
    """Return a release with the effects of all overrides, or ``None`` if one of them denies it."""
    if not world.overrides:
        return release
    config, claims = world.config, claims_of(release, world.ledger)
    traits = _traits(release, claims)
    if isinstance(release, ServiceRelease) and denied_by(traits, world):
        return None
    kept = {claim.keeping_override for claim in claims}
    by = []
    for override in world.overrides:
        effects = effects_on(release, override, config) if selects(override, traits, config) else ()
        if override.node != release.node.id:
            # The claims record a move by an override, so a moved release is on its new node
            # already. A release that is elsewhere was not moved by this override.
            effects = tuple(effect for effect in effects if effect != "node")
        if override.keep and override.name in kept:
            effects = (*effects, "keep")
        if effects:
            by.append((override, effects))
    return apply_effects(release, by, config)


def service_denied_by(release: Release, world: World) -> Override | None:
    if isinstance(release, ServiceRelease) and any(each.deny for each in world.overrides):
        return denied_by(_traits(release, claims_of(release, world.ledger)), world)
    return None


def apply_effects(
    release: Release, by: Iterable[tuple[Override, tuple[str, ...]]], config: Config
) -> Release:
    """Return a release with the effects of overrides, of which the last one wins.

    Effects on images and Helm values are only recorded, in :attr:`ServiceRelease.shaping`.
    """
    by = tuple(by)
    if not by:
        return release
    release = replace(release, shaping=Shaping(by))
    if not isinstance(release, ServiceRelease):
        return release
    for override, effects in by:
        if "version" in effects:
            chart = config.charts[release.service.chart].at(str(override.version))
            release = replace(release, chart=chart or release.chart)
        if "replicas" in effects and (number := override.replicas) is not None:
            # Where an autoscaler owns the number, the manifest tells the GitOps controller to
            # ignore ``spec.replicas``. So the number is set as both bounds of the autoscaler.
            scaler = release.autoscaler
            replicas = replace(scaler, min=number, max=number) if scaler else number
            release = replace(release, replicas=replicas)
        if "node" in effects:
            node, domain = config.node_and_domain(str(override.node))
            release = replace(release, node=node, domain=domain)
    return release


def effects_on(release: Release, override: Override, config: Config) -> tuple[str, ...]:
    """Return the effects that an override has on a release; never ``deny`` and ``keep``."""
    possible = {"hold"}
    if isinstance(release, ServiceRelease):
        versions = config.charts[release.service.chart].versions()
        possible |= {"values", "replicas"} | ({"node"} if release.service.is_movable else set())
        possible |= {"version"} if override.version in versions else set()
    elif override.patches_clients():
        possible |= {"values"}
    possible |= {"images"} if {*release.images} & {*(override.images or ())} else set()
    return tuple(name for name in override.effects() if name in possible)


def _traits(release: Release, claims: tuple[Claim, ...]) -> Traits:
    nodes: tuple[str, ...] = (release.node.id,)
    if isinstance(release, ServiceRelease):
        appdefs = {claim.application.appdef for claim in claims}
        if release.service.is_movable:  # a selector is compared with the node before any move
            chosen = {claim.application.chosen_node(release.key.service) for claim in claims}
            nodes = tuple(sorted(chosen)) or nodes
        return Traits(
            nodes,
            release.requesters,
            release.applications,
            tuple(sorted(appdefs)),
            service=release.key.service,
        )
    return Traits(nodes, requesters_of(claims), connections=release.connections)
