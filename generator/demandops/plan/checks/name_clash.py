"""Name clashes: a demand is refused if a name or file that it needs belongs to another.

Names and paths contain a short hash of ids (:mod:`demandops.naming`), so ids can be crafted that
have the same name. A release's name is its file, its objects in a namespace, its ROS node and its
client at a broker. So no other release in the state repo may have it, on whatever node.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
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

_Reader: TypeAlias = Callable[[str], "str | None"]

Name: TypeAlias = "tuple[str, str]"
"""What is named, in words, and its name."""

Names: TypeAlias = "HashTrieMap[Name, HashTrieSet[ReleaseKey]]"
"""For each name, the keys of the releases that have it: one, if nobody wrote claims by hand.

The releases of suspended claims count too, because they will run again. A key that no claim needs
any longer may be left; :func:`demandops.plan.release_keys.is_needed` tells.
"""

NONE: Names = HashTrieMap()


def names_of(world: World, key: ReleaseKey) -> Iterator[Name]:
    """Yield the names that only the release at ``key`` may have.

    Nothing is yielded for a service that the configuration no longer has.
    """
    if isinstance(key, ClientKey):
        yield from key.type.names(key)
        return
    app = world.ledger.application(key.application) if key.application is not None else None
    definitions = world.config.services
    for services in [definitions.get(app.appdef, {})] if app else definitions.values():
        service = services.get(key.service)
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
    """Return ``names`` with the names of the releases at ``keys``."""
    for key in keys:
        for name in names_of(world, key):
            names = names.insert(name, (names.get(name) or HashTrieSet()).insert(key))
    return names


def without_keys(names: Names, world: World, keys: Iterable[ReleaseKey]) -> Names:
    """Return ``names`` without the names of the releases at ``keys``, as ``world`` has them."""
    for key in keys:
        for name in names_of(world, key):
            left = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, left) if left else names.discard(name)
    return names


def followed(names: Names, before: World, after: World, keys: Collection[ReleaseKey]) -> Names:
    """Return the names in ``after``, given those in ``before``; only releases at ``keys`` differ.

    A release that an override denies needs its name all the same.
    """
    needed = (key for key in keys if is_needed(after, key))
    return with_keys(without_keys(names, before, keys), after, needed)


def faults(
    request: DemandRequest,
    before: World,
    after: World,
    keys: Iterable[ReleaseKey],
    changes: Changes,
    names: Names,
) -> Iterator[Fault]:
    """Yield a fault for each new release that needs a name of another release.

    Args:
        request: the demand.
        before, after: the world before and after the demand.
        keys: the keys of the releases that the demand may change.
        changes: what the demand changes in the ledger.
        names: the names of the releases in ``before``.
    """
    for key in keys:
        for name in names_of(after, key):
            others = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, others.insert(key))  # for the keys that follow
            # a release keeps the name that it has, even if a person gave another one this name
            if not others or not is_needed(after, key) or is_needed(before, key):
                continue
            for other in (one for one in others if is_needed(after, one)):
                subjects = {change.key.subject: change.key for change in changes.claims}
                claim = next(
                    (
                        subjects[subject]
                        for subject in subjects
                        if key in keys_of_claims(after, after.ledger.claims_on(subject))
                    ),
                    None,
                )
                yield _located(_message(key, name, other), request, claim)
                break


def faults_in_files(request: DemandRequest, changes: Changes, read: _Reader) -> Iterator[Fault]:
    """Yield a fault for each new claim or waiting demand whose file belongs to another.

    ``read`` returns the text of a file of the state repo before the change, or ``None``.
    """
    owners: dict[str, ClaimKey] = {}
    for change in changes.claims:
        path = claim_file.path_of(change.key)
        owner = owners.setdefault(path, change.key)
        if change.before is None and owner == change.key and (text := read(path)):
            with suppress(InvalidInput):  # a file that is not valid is no claim, and is replaced
                owner = claim_file.read(text, path).key
        if owner != change.key:
            other = f"{owner.subject} of demand '{owner.demand}'"
            message = f"{change.key.subject} needs the file {path}, which belongs to {other}"
            yield _located(f"{message}; {_REMEDY}", request, change.key)
    for demand in changes.waiting:
        path = waiting.path_of(demand)
        other_wait = waiting.read(read(path) or "", path)
        if other_wait is not None and other_wait.demand != demand:
            message = f"needs the file {path}, which belongs to demand '{other_wait.demand}'"
            yield fault("demand", f"{message}; {_REMEDY}", code="conflict")


def refuse_shared_names(world: World, keys: Iterable[ReleaseKey]) -> None:
    """Raise :class:`Refused` if two of the releases at ``keys`` need one name."""
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


_REMEDY = "use another id, or wait until the other is released"


def _located(message: str, request: DemandRequest, claim: ClaimKey | None) -> Fault:
    """Return a fault at the item of the request that needs a claim, or in the claim's file."""
    for one in request.demanded:
        if claim and one.held.subject == claim.subject:
            return one.fault("id", message, code="conflict")
    found = fault("", message, code="conflict")
    return found.within(claim_file.path_of(claim)) if claim else found
