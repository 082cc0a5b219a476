"""Why releases run: their claims, and the files of people that shape them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.base.naming import Subject
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import all_keys, keys_of, takes
from demandops.model.config.config import DOMAINS_FILE, IMAGES_FILE, NODES_FILE, Config
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger.claim import Claim, demand_id
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.release import Release, ServiceRelease, claims_of


def releases(world: World, subject: Subject | None = None) -> Iterator[Release]:
    keys = keys_of(world, subject) if subject else all_keys(world)
    yield from filter(None, (plan(world, key) for key in keys))


def claims_behind(ledger: Ledger, release: Release) -> list[Claim]:
    # callers pass a ledger without suspended claims
    return by_booking(claim for claim in claims_of(release, ledger) if needs(claim, release))


def by_booking(claims: Iterable[Claim]) -> list[Claim]:
    return sorted(claims, key=lambda claim: (claim.booked, str(claim.subject), claim.demand))


def needs(claim: Claim, release: Release) -> bool:
    if not isinstance(release, ServiceRelease):
        return True
    return takes(claim.application, release.service, release.key)


def how_to_release(claim: Claim) -> str:
    if claim.keeping_override is not None:
        return f"remove 'keep' from {OVERRIDES_ROOT}/{claim.keeping_override}.yaml"
    if is_released_by_demand_id(claim):
        return f"send 'operation: release' for demand '{claim.demand}'"
    return f"send request '{claim.request}' again with shutdown: true"


def is_released_by_demand_id(claim: Claim) -> bool:
    # A goal of the reference's action has no demand id. The generator derives it from the request.
    is_of_a_request = claim.demand == demand_id(claim.request, claim.requesters)
    return claim.keeping_override is None and not is_of_a_request


def shaping_files(release: Release, config: Config) -> list[tuple[str, str, str]]:
    # (file, entry, what it decides) for all that shapes a release but overrides
    images = {name: config.images[name] for name in release.images if name in config.images}
    if isinstance(release, ServiceRelease):
        images = {name: release.version.image(name, image) for name, image in images.items()}
    node, domain, file_of = release.node, release.domain, config.file_of
    return [
        (ROOT_FILE, "gitops", f"written for {config.repo_settings.gitops}"),
        *release.shaping_entries(config),
        *(
            (file_of(IMAGES_FILE, name), f"images.{name}", image.reference())
            for name, image in images.items()
        ),
        (file_of(NODES_FILE, node.id), node.id, f"in cluster {node.cluster}"),
        (file_of(DOMAINS_FILE, domain.name), domain.name, f"namespace {domain.namespace}"),
    ]
