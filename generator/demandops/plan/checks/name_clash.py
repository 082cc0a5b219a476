"""Name clashes: a demand is refused if a name or file that it needs belongs to another.

Names and paths contain a short hash of ids (:mod:`demandops.naming`), so ids can be crafted that
have the same name. A release's name is its file, its objects in a namespace, its ROS node and its
client at a broker. So no other release in the state repo may have it, on whatever node.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import TypeAlias

from rpds import HashTrieMap, HashTrieSet

from demandops.connections.connection_type import ClientKey
from demandops.demand.claim import ClaimKey
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Fault, InvalidInput, Refused, fault
from demandops.ledger import claim_file, kept_replicas, waiting
from demandops.ledger.claim_changes import Changes
from demandops.ledger.world import World
from demandops.plan.checks.topic_clash import words
from demandops.plan.planner import service_name
from demandops.plan.release_keys import ReleaseKey, is_needed, keys_of_claims

# What is named, in words, and its name.
Name: TypeAlias = "tuple[str, str]"

# For each name, the keys of the releases that have it: one, if nobody wrote claims by hand. The
# releases of suspended claims count too, because they will run again. A key that no claim needs any
# longer may be left; :func:`demandops.plan.release_keys.is_needed` tells. All names of a large
# ledger take long to find, so they follow each change, in a map that shares what did not change.
Names: TypeAlias = "HashTrieMap[Name, HashTrieSet[ReleaseKey]]"

NONE: Names = HashTrieMap()

_REMEDY = "use another id, or wait until the other is released"


def names_of(world: World, key: ReleaseKey) -> Iterator[Name]:
    """Yield the names that only the release at ``key`` may have."""
    if isinstance(key, ClientKey):
        yield from key.type.names(key)
        return
    app = world.ledger.application(key.application) if key.application is not None else None
    definitions = world.config.services
    for services in [definitions.get(app.appdef, {})] if app else definitions.values():
        service = services.get(key.service)
        # Nothing is named if the configuration no longer has the service.
        if service is not None and service.scope == key.scope:
            yield "release", service_name(world.config, service, key)
            if key.service in world.config.services_with_down_after:
                yield "record of replicas", kept_replicas.path_of(key.instance)
            return


def all_names(world: World) -> Names:
    """Return the names of all releases. This takes time for a large ledger."""
    keys = (key for claims in world.ledger.claims.values() for key in keys_of_claims(world, claims))
    return with_keys(NONE, world, dict.fromkeys(keys))


def with_keys(names: Names, world: World, keys: Iterable[ReleaseKey]) -> Names:
    for key in keys:
        for name in names_of(world, key):
            names = names.insert(name, (names.get(name) or HashTrieSet()).insert(key))
    return names


def followed(names: Names, before: World, after: World, keys: Collection[ReleaseKey]) -> Names:
    """Return the names in ``after``; only the releases at ``keys`` differ from ``before``."""
    for key in keys:
        for name in names_of(before, key):
            others = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, others) if others else names.discard(name)
    # A release that an override denies needs its name all the same.
    return with_keys(names, after, (key for key in keys if is_needed(after, key)))


def faults(
    request: DemandRequest,
    before: World,
    after: World,
    keys: Iterable[ReleaseKey],
    changes: Changes,
    names: Names,
) -> Iterator[Fault]:
    """Yield a fault for each new release that needs a name of another release.

    ``keys`` are the keys of the releases that the demand may change. ``names`` are the names of the
    releases in ``before``.
    """
    for key in keys:
        for name in names_of(after, key):
            others = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, others.insert(key))  # for the keys that follow
            # a release keeps the name that it has, even if a person gave another one this name
            if not others or not is_needed(after, key) or is_needed(before, key):
                continue
            for other in islice((each for each in others if is_needed(after, each)), 1):
                claims = {change.key.subject: change.key for change in changes.claims}
                needing = (
                    claim
                    for subject, claim in claims.items()
                    if key in keys_of_claims(after, after.ledger.claims_on(subject))
                )
                yield _located(_message(key, name, other), request, next(needing, None))


def faults_in_files(
    request: DemandRequest, changes: Changes, text_at: Callable[[str], str | None]
) -> Iterator[Fault]:
    """Yield a fault for each new claim or waiting demand whose file belongs to another.

    ``text_at`` returns the text of a file of the state repo before the change.
    """
    owners: dict[str, ClaimKey] = {}
    for change in changes.claims:
        path = claim_file.path_of(change.key)
        owner = owners.setdefault(path, change.key)
        if change.before is None and owner == change.key and (text := text_at(path)):
            with suppress(InvalidInput):  # a file that is not valid is no claim, and is replaced
                owner = claim_file.read(text, path).key
        if owner != change.key:
            other = f"{owner.subject} of demand '{owner.demand}'"
            message = f"{change.key.subject} needs the file {path}, which belongs to {other}"
            yield _located(f"{message}; {_REMEDY}", request, change.key)
    for demand in changes.waiting:
        path = waiting.path_of(demand)
        waiting_there = waiting.read(text_at(path) or "", path)
        if waiting_there is not None and waiting_there.demand != demand:
            message = f"needs the file {path}, which belongs to demand '{waiting_there.demand}'"
            yield fault("demand", f"{message}; {_REMEDY}", code="conflict")


def refuse_shared_names(world: World, keys: Iterable[ReleaseKey]) -> None:
    taken: dict[Name, ReleaseKey] = {}
    clashes = [
        (key, name, taken[name])
        for key in keys
        for name in names_of(world, key)
        if taken.setdefault(name, key) != key
    ]
    if clashes:
        raise Refused(fault("", _message(*clash), code="conflict") for clash in clashes)


def _message(key: ReleaseKey, name: Name, other: ReleaseKey) -> str:
    needed = f"the {' '.join(name)}, which belongs to {words(other)}"
    return f"{words(key)} needs {needed}; {_REMEDY}"


def _located(message: str, request: DemandRequest, claim: ClaimKey | None) -> Fault:
    for item in request.demanded:
        if claim and item.held.subject == claim.subject:
            return item.fault("id", message, code="conflict")
    clash = fault("", message, code="conflict")
    return clash.within(claim_file.path_of(claim)) if claim else clash
