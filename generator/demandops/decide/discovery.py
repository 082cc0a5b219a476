"""Nodes that clusters have: what becomes of a cluster's file when its nodes change.

The generator calls :func:`discover` with what a cluster says now, and commits the new file. A node
that the cluster no longer has is drained, and leaves the file after a time, unless claims need it.
All that must be remembered is in the file.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError

from demandops.base.quantities import amount_of
from demandops.base.quoting import quoted
from demandops.model.config.base_model import Word, seconds_of, time_text
from demandops.model.config.discovered import (
    DiscoveredId,
    DiscoveredNode,
    is_discovered,
    path_of,
    read,
    text_of,
)
from demandops.model.config.inventory import (
    NODE_LABEL,
    Cluster,
    Discovery,
    PropertyName,
    PropertyValue,
    Quantity,
    ResourceName,
)

# Labels with these prefixes need no mention in `inventory/clusters.yaml`
_CAPABILITY, _PROPERTY = "capability.demandops/", "property.demandops/"
# Kubernetes counts pods like a resource, but no service requests them
_UNREQUESTED = "pods"
# Where a capacity lacks one of these, a node has as much as is asked for; of all others it has none
_UNLIMITED = ("cpu", "memory")
_ID, _WORD = TypeAdapter[str](DiscoveredId), TypeAdapter[str](Word)
_NAME, _VALUE = TypeAdapter[str](PropertyName), TypeAdapter[object](PropertyValue)
_RESOURCE, _AMOUNT = TypeAdapter[str](ResourceName), TypeAdapter[str](Quantity)
_INTEGER, _DECIMAL = re.compile(r"-?[0-9]{1,15}"), re.compile(r"-?[0-9]{1,15}\.[0-9]{1,9}")


class ClusterNode(NamedTuple):
    """A node as its cluster has it, without what no decision sees."""

    name: str
    labels: Mapping[str, str]
    allocatable: Mapping[str, str]
    is_cordoned: bool
    # for the key of each label, and "" for the cordon: the program that wrote it last
    writers: Mapping[str, str]


class Discovered(NamedTuple):
    """The file of a cluster, and in words what differs and what of the cluster was not usable."""

    path: str
    text: str | None
    came: tuple[str, ...] = ()
    # what the cluster has no longer, and what is taken out therefore
    gone: tuple[str, ...] = ()
    left: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    # the ids that the file did not have before
    new_ids: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    # whether a node is left that the cluster no longer has
    has_gone: bool = False


def discover(
    cluster: Cluster,
    seen: Iterable[ClusterNode],
    before: str | None,
    now: datetime,
    files: Mapping[str, str],
    unfit: Mapping[str, object],
    is_needed: Callable[[str], bool],
) -> Discovered:
    """Return the file of a cluster after ``before``, given all its nodes.

    ``files`` has the file of each node by id, ``unfit`` why a node of an id cannot be as the
    cluster has it, and ``is_needed`` says whether a node must stay yet.
    """
    path, discovery = path_of(cluster.name), cluster.discovery or Discovery()
    known, problems = {node.id: node for node in read(before, path)}, list[str]()
    by_id = defaultdict[str, list[ClusterNode]](list)
    for source in seen:
        by_id[source.labels.get(NODE_LABEL, "")].append(source)
    nodes, came, gone, left, changed = dict[str, DiscoveredNode](), [], [], [], []
    for id, sources in sorted(by_id.items()):
        source, old = sources[0], known.get(id)
        file = files.get(id, path)
        why = _refused(id, sources, is_taken=file != path and is_discovered(file))
        if not why and id in unfit:
            why = f"node '{id}' is not taken over as the cluster has it: {unfit[id]}"
        if why:
            problems.append(why)
            nodes |= {id: old} if old else {}
            continue
        if file != path:
            problems.append(f"node '{id}' is as {file} lists it, not as the cluster has it")
        node = nodes[id] = _node(id, source, discovery, problems)
        if old is None or old.gone_since is not None:
            came.append(f"{id}{' is back' if old else ''}: {_described(node)}")
        elif differing := list(_differences(old, node, source, discovery)):
            changed.append(f"{id}: {', '.join(differing)}")
    keeps = timedelta(seconds=seconds_of(discovery.gone_after))
    for id in sorted(known.keys() - nodes.keys()):
        since = min(known[id].gone_since or now, now)  # the clock may have been set back
        is_listed = files.get(id, path) != path  # then claims need what people list
        if now - since >= keeps and (is_listed or not is_needed(id)):
            left.append(f"{id}: taken out, as the cluster has not had it since {time_text(since)}")
            continue
        nodes[id] = known[id].model_copy(update={"gone_since": since})
        if known[id].gone_since is None:
            gone.append(f"{id}: not in the cluster any more, so it is drained")
    return Discovered(
        path,
        text_of(nodes.values()) if nodes or before is not None else None,
        tuple(came),
        tuple(gone),
        tuple(left),
        tuple(changed),
        tuple(sorted(nodes.keys() - known.keys())),
        tuple(problems),
        any(node.gone_since is not None for node in nodes.values()),
    )


def _refused(id: str, sources: list[ClusterNode], *, is_taken: bool) -> str:
    # what stays as it was: two machines with one id would share what is placed on one of them
    if not _is_valid(_ID, id):
        return f"node {quoted(sources[0].name)}: {NODE_LABEL} {quoted(id)} is no id; label it anew"
    if len(sources) > 1:
        named = " and ".join(sorted(quoted(each.name) for each in sources)[:2])
        return f"{NODE_LABEL} '{id}' is the label of {named}; label one of them anew"
    if is_taken:
        return f"node '{id}' is in another cluster already; label one of them anew"
    return ""


def _node(id: str, source: ClusterNode, how: Discovery, problems: list[str]) -> DiscoveredNode:
    labels = source.labels

    def usable(kind: TypeAdapter[Any], value: object, key: str) -> bool:
        if not (is_usable := _is_valid(kind, value)):
            told = quoted(str(value))
            problems.append(f"node '{id}': {told} of label {quoted(key)} is left out")
        return is_usable

    words = _keys(how.capability_labels, _CAPABILITY, labels)
    names = _keys(how.property_labels, _PROPERTY, labels)
    properties = {name: _read(labels[key]) for name, key in names.items()}
    role = labels.get(how.type_label)
    capacity = dict[str, str]()
    for resource, amount in sorted(source.allocatable.items()):
        if resource == _UNREQUESTED or not _is_valid(_RESOURCE, resource):
            continue
        if not _is_valid(_AMOUNT, amount):
            problems.append(f"node '{id}': it offers no {resource}, as {quoted(amount)} is unclear")
            amount = "0"  # noqa: PLW2901
        if amount_of(amount) or resource in _UNLIMITED:
            capacity[resource] = amount
    return DiscoveredNode(
        id=id,
        type=role if role is not None and usable(_WORD, role, how.type_label) else None,
        capabilities=tuple(
            word
            for word, key in words.items()
            if labels[key] != "false" and usable(_WORD, word, key)
        ),
        properties={
            name: value
            for name, value in properties.items()
            if usable(_NAME, name, names[name]) and usable(_VALUE, value, names[name])
        },
        capacity=capacity or None,
        drained=source.is_cordoned,
    )


def _keys(named: Mapping[str, str], prefix: str, labels: Mapping[str, str]) -> dict[str, str]:
    # the label of each capability or property that the node has
    by_prefix = {key.removeprefix(prefix): key for key in labels if key.startswith(prefix)}
    return {name: key for name, key in sorted((by_prefix | dict(named)).items()) if key in labels}


def _read(value: str) -> object:
    if _INTEGER.fullmatch(value):
        return int(value)
    if _DECIMAL.fullmatch(value):
        return float(value)
    return {"true": True, "false": False}.get(value, value)


def _is_valid(kind: TypeAdapter[Any], value: object) -> bool:
    try:
        kind.validate_python(value, strict=True)
    except ValidationError:
        return False
    return True


def _fields(node: DiscoveredNode) -> dict[str, Any]:
    data = node.model_dump(mode="json", by_alias=True, exclude={"id", "gone_since"})
    return {name: value for name, value in data.items() if value}


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True)


def _described(node: DiscoveredNode) -> str:
    told = (f"{name} {_text(value)}" for name, value in _fields(node).items())
    return ", ".join(told) or "without labels"


def _differences(
    old: DiscoveredNode, node: DiscoveredNode, source: ClusterNode, how: Discovery
) -> Iterator[str]:
    before, after = _fields(old), _fields(node)
    for field in sorted(
        field for field in {*before, *after} if before.get(field) != after.get(field)
    ):
        was, now = before.get(field), after.get(field)
        told = f"{field} {_text(was)} → {_text(now)}"
        keys = list[str]()  # the labels from which the field comes
        match field:
            case "drained" if now:
                told, keys = "cordoned", [""]
            case "drained":
                told = "no longer cordoned"
            case "type":
                keys = [how.type_label]
            case "capabilities":
                words = {*(was or ())} ^ {*(now or ())}
                keys = [how.capability_labels.get(word, _CAPABILITY + word) for word in words]
            case "properties":
                had, has = was or {}, now or {}
                names = [name for name in {*had, *has} if had.get(name) != has.get(name)]
                keys = [how.property_labels.get(name, _PROPERTY + name) for name in names]
        writers = {source.writers[key] for key in keys if key in source.writers}
        yield " ".join([told, *(f"by {quoted(writer)}" for writer in sorted(writers))])
