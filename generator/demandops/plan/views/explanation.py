"""Why a release runs: the claims that ask for it, and the files of people that shaped it.

The auditor's view of a plan; pure, and no part of what is written.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from demandops.config.config import (
    BROKERS_FILE,
    CHARTS_FILE,
    DDS_ROUTER_IMAGE,
    DOMAINS_FILE,
    IMAGES_FILE,
    MQTT_CLIENT_IMAGE,
    NODES_FILE,
    ZENOH_BRIDGE_IMAGE,
    Config,
)
from demandops.config.override import OVERRIDES_ROOT, Override
from demandops.config.repo_settings import ROOT_FILE
from demandops.demand.claim import ApplicationClaim, Claim, Subject, demand_id, is_override_claim
from demandops.demand.demand_request import OVERRIDE_PREFIX
from demandops.ledger.apply import Ledger
from demandops.plan.planner import denied, plan
from demandops.plan.release import Bridge, MqttEnd, Release, ServiceRelease
from demandops.plan.release_keys import all_keys, keys_of


@dataclass(frozen=True, slots=True)
class Shaping:
    """A file that people own, which of its entries shaped a release, and what that says."""

    file: str
    entry: str
    what: str


def find(ledger: Ledger, config: Config, name: str) -> Release | None:
    """Return the release of a name, or nothing where none of that name runs."""
    releases = (plan(ledger, config, key) for key in all_keys(ledger, config))
    return next((release for release in releases if release and release.name == name), None)


def names(ledger: Ledger, config: Config) -> list[str]:
    """Return the names of all releases that run."""
    releases = (plan(ledger, config, key) for key in all_keys(ledger, config))
    return [release.name for release in releases if release]


def releases_of(ledger: Ledger, config: Config, subject: Subject) -> list[Release]:
    """Return the releases that run because something holds an application or a connection."""
    releases = (
        plan(ledger, config, key) for key in dict.fromkeys(keys_of(ledger, config, subject))
    )
    return [release for release in releases if release]


def claims_behind(ledger: Ledger, release: Release) -> list[Claim]:
    """Return the claims that ask for a release, the first that was booked first.

    Args:
        ledger: the books without suspended claims.
        release: what runs.
    """
    claims: Iterable[Claim]
    if isinstance(release, ServiceRelease):
        users = (claim for id in release.applications for claim in ledger.application(id))
        claims = [claim for claim in users if _takes(claim, release)]
    else:
        ids = release.connections if isinstance(release, Bridge) else (release.connection,)
        claims = [claim for id in ids for claim in ledger.connection(id)]
    return sorted(claims, key=lambda claim: (claim.booked, str(claim.subject), claim.demand))


def _takes(claim: ApplicationClaim, release: ServiceRelease) -> bool:
    """Tell whether a claim on an application needs this service of it."""
    if release.service.each is None:
        return True
    topics = claim.inputs.get(release.service.each, ())
    return any((t.source, t.topic) == (release.key.source, release.key.topic) for t in topics)


def how_to_release(claim: Claim) -> str:
    """Return how its requesters give a claim up."""
    if is_override_claim(claim):
        return (
            f"remove keep from {OVERRIDES_ROOT}/{claim.demand.removeprefix(OVERRIDE_PREFIX)}.yaml"
        )
    if claim.demand == demand_id(claim.request, claim.requesters):
        return f"send request '{claim.request}' again with shutdown: true"
    return f"send operation: release for demand '{claim.demand}'"


def shaped_by(release: Release, config: Config) -> list[Shaping]:
    """Return the files of people that say what a release is, and where."""
    found = [Shaping(ROOT_FILE, "gitops", f"written for {config.repo_settings.gitops}")]
    of_kind = _service if isinstance(release, ServiceRelease) else _client
    found += of_kind(release, config)
    found.append(Shaping(NODES_FILE, release.node.id, f"in cluster {release.node.cluster}"))
    domain = release.domain
    return [*found, Shaping(DOMAINS_FILE, domain.name, f"namespace {domain.namespace}")]


def denied_called(ledger: Ledger, config: Config, name: str) -> tuple[Release, Override] | None:
    """Return the release of a name that claims need, and the override that denies it."""
    for key in all_keys(ledger, config):
        found = denied(ledger, config, key)
        if found is not None and found[0].name == name:
            return found
    return None


def kept_by(claim: Claim, config: Config) -> Override | None:
    """Return the override whose own claim this is, or nothing where somebody asks for it."""
    return (
        config.overrides.get(claim.demand.removeprefix(OVERRIDE_PREFIX))
        if is_override_claim(claim)
        else None
    )


def _service(release: Release, config: Config) -> Iterator[Shaping]:
    assert isinstance(release, ServiceRelease)  # noqa: S101 - the caller chose by that
    folder = f"appdefs/{release.appdef}"
    yield Shaping(f"{folder}/appdef.yaml", f"services.{release.key.service}", "what it is")
    yield Shaping(config.values_template(release.appdef, release.service), "", "its Helm values")
    chart, name = release.chart, release.service.chart
    where = chart.oci or chart.http or f"folder {chart.folder or f'{folder}/charts/{name}'}"
    yield Shaping(CHARTS_FILE, f"charts.{name}", f"version {chart.version} from {where}")
    for image in release.service.images:
        yield Shaping(IMAGES_FILE, f"images.{image}", config.images[image].reference())


def _client(release: Release, config: Config) -> Iterator[Shaping]:
    image = DDS_ROUTER_IMAGE
    if isinstance(release, Bridge):
        image = ZENOH_BRIDGE_IMAGE
    elif isinstance(release, MqttEnd):
        image = MQTT_CLIENT_IMAGE
        broker = release.broker
        yield Shaping(BROKERS_FILE, broker.node, f"broker at {broker.host}:{broker.port}")
    if image in config.images:
        yield Shaping(IMAGES_FILE, f"images.{image}", config.images[image].reference())
