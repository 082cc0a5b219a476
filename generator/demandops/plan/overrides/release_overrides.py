"""The effects of overrides on a planned release: version, node, replicas, or denial.

Pins of images and patches of Helm values are applied later, when the release is rendered.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.override import Override, Shaping
from demandops.demand.claim import Claim, requesters_of
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import Traits, denied_by, selects
from demandops.plan.release import Release, ServiceRelease, claims_of
from demandops.plan.replicas import overridden


def apply_overrides(release: Release, world: World) -> Release | None:
    """Return a release with the effects of all overrides, or ``None`` if one of them denies it."""
    if not world.overrides:
        return release
    config, claims = world.config, claims_of(release, world.ledger)
    traits = _traits(release, claims)
    if service_denied_by(release, world) is not None:
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
    denies = any(override.deny for override in world.overrides)
    if not isinstance(release, ServiceRelease) or not denies:
        return None
    return denied_by(_traits(release, claims_of(release, world.ledger)), world)


def apply_effects(
    release: Release, by: Iterable[tuple[Override, tuple[str, ...]]], config: Config
) -> Release:
    """Return a release with the effects of overrides; the last override wins.

    ``by`` has pairs of an override and the names of its effects on the release. The effects on
    images and Helm values are only recorded, in :attr:`ServiceRelease.shaping`.
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
        if "replicas" in effects and override.replicas is not None:
            replicas = overridden(release.replicas, override.replicas)
            release = replace(release, replicas=replicas, keeps=None)
        if "node" in effects:
            node, domain = config.node_and_domain(str(override.node))
            release = replace(release, node=node, domain=domain)
    return release


def effects_on(release: Release, override: Override, config: Config) -> tuple[str, ...]:
    """Return the names of the effects that an override has on a release that it selects.

    ``deny`` and ``keep`` are never among them, because they are not effects on a release.
    """
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
