"""Nodes that a cluster has: the file in which the generator keeps them, and its reader.

``inventory/clusters.yaml`` says for which clusters, and which labels mean what. The generator
writes what a decision can see of each node into ``inventory/discovered/<cluster>.yaml``. So a
decision is still a function of repo and demand. To the rest of the program they are listed nodes.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Literal

from pydantic import Field

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.base.naming import id_problem
from demandops.base.settings import API_VERSION
from demandops.model.config.base_model import (
    CamelModel,
    FileModel,
    Items,
    Moment,
    Word,
    parse_file,
    without,
)
from demandops.model.config.config import CLUSTERS_FILE, NODES_FILE, ConfigReader
from demandops.model.config.entry_patterns import EntryPattern
from demandops.model.config.inventory import (
    Cluster,
    Discovery,
    Kind,
    LabelValue,
    Node,
    PropertyName,
    PropertyValue,
    Resources,
    comparable_kind,
    kind_of,
)

DISCOVERED_ROOT = "inventory/discovered"
_NOTE = """\
# Written by the generator: the nodes as the cluster has them. Edits are put back. To change a node,
# change it in the cluster, or list it in inventory/nodes.yaml, which replaces its whole entry here.
"""
_OF_NODE = re.compile(r"(nodes\[\d+\])(?:\.(.*))?")


# The value of the label `node_id`
DiscoveredId = Annotated[LabelValue, without(id_problem)]


class DiscoveredNode(CamelModel):
    """What a cluster says of one node; the rest is in the cluster's ``discovery.entry``."""

    id: DiscoveredId
    type: Word | None = None
    capabilities: Items[Word] = ()
    properties: dict[PropertyName, PropertyValue] = Field(default_factory=dict)
    capacity: Resources | None = None
    # whether it is cordoned
    drained: bool = False
    # since when the cluster has it no longer; it is drained too
    gone_since: Moment | None = None


class DiscoveredNodesFile(FileModel):
    """``inventory/discovered/<cluster>.yaml``, which only the generator writes."""

    kind: Literal["DiscoveredNodes"]
    nodes: Items[DiscoveredNode]


def is_discovered(path: str) -> bool:
    return path.startswith(f"{DISCOVERED_ROOT}/")


def path_of(cluster: str) -> str:
    return f"{DISCOVERED_ROOT}/{cluster}.yaml"


@lru_cache(maxsize=1024)  # each look at a cluster's nodes reads the file that was loaded
def read(text: str | None, path: str) -> tuple[DiscoveredNode, ...]:
    return parse_file(DiscoveredNodesFile, text, path).nodes if text is not None else ()


def text_of(nodes: Iterable[DiscoveredNode]) -> str:
    data = [
        node.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        for node in sorted(nodes, key=lambda node: node.id)
    ]
    head = {"apiVersion": API_VERSION, "kind": "DiscoveredNodes"}
    return _NOTE + strict_yaml.dump({**head, "nodes": data})


def read_nodes(
    reader: ConfigReader,
    clusters: Mapping[str, Cluster],
    listed: Mapping[str, Node],
    required: Iterable[Mapping[str, object]],
) -> dict[str, Node]:
    """Return the discovered nodes that nobody lists; collect the faults of entries and files.

    ``required`` has the properties that definitions require of nodes.
    """
    nodes, places = dict[str, Node](), reader.places[NODES_FILE]
    examples = [pattern.example for pattern in reader.patterns[NODES_FILE]]
    for name, cluster in sorted(clusters.items()):
        if cluster.nodes == "listed":  # a file that is left over is removed by the generator
            continue
        # valid also for the first node of a role that no application knows
        data = {"type": "node", **(cluster.discovery or Discovery()).entry}
        data |= {"id": "{n}", "cluster": name}
        file, place = reader.places[CLUSTERS_FILE][name]
        pattern = EntryPattern("{n}", "id", Node, data, file, (f"{place}.discovery.entry",))
        path = path_of(name)
        try:
            examples.append(pattern.example)  # the faults of the entry are those of its file
            reader.of_clusters.append(pattern)
            known = read(reader.files.get(path), path)
        except InvalidInput as error:
            reader.faults += error.faults
            reader.incomplete.add(NODES_FILE)
            continue
        for number, node in enumerate(known):
            if node.id in places:  # a listed node is meant to differ, as a whole
                continue
            places[node.id] = (path, f"nodes[{number}]")
            own = node.model_dump(by_alias=True, exclude_defaults=True, exclude={"gone_since"})
            if node.gone_since is not None:
                own["drained"], reader.gone_since[node.id] = True, node.gone_since
            try:
                here = replace(pattern, file=path, place=("nodes", number))
                nodes[node.id] = here.entry(node.id, own)
            except InvalidInput as error:
                reader.faults += error.faults
    by_people = [*(node.properties for node in (*listed.values(), *examples)), *required]
    return dict(_of_one_kind(nodes, by_people))


def _of_one_kind(
    nodes: Mapping[str, Node], by_people: Iterable[Mapping[str, object]]
) -> Iterator[tuple[str, Node]]:
    # A property has values of one type. A label with an odd value must not make people's files
    # invalid, so they decide about the type, else most nodes do; other values do not count.
    kinds = defaultdict[str, Counter[Kind | None]](Counter)
    own = (node.properties for node in nodes.values())
    for weight, group in ((1, own), (len(nodes) + 1, by_people)):
        for properties in group:
            for name, value in properties.items():
                kinds[name][comparable_kind(value)] += weight
    common = {name: counts.most_common(1)[0][0] for name, counts in kinds.items()}
    for id, node in nodes.items():
        fitting = {n: v for n, v in node.properties.items() if kind_of(v) == common[n]}
        is_odd = len(fitting) < len(node.properties)
        yield id, node.model_copy(update={"properties": fitting}) if is_odd else node


class InvalidConfig(InvalidInput):
    """The faults of a configuration; ``of_nodes`` has one of each discovered node with faults."""

    def __init__(self, reader: ConfigReader) -> None:
        ids, faults = dict[tuple[str, str], str](), dict[object, Fault]()
        for id, at in reader.places[NODES_FILE].items():
            ids.setdefault(at, id)  # a machine's own node is before those of its further domains
        self.of_nodes: dict[str, object] = {}
        told = {(fault.file, fault.field) for fault in reader.faults}
        for fault in reader.faults:
            match = _OF_NODE.fullmatch(fault.field) if is_discovered(fault.file) else None
            # the faults of an edited file, from which no node was read, are its own
            owner = ids.get((fault.file, match[1])) if match else None
            if match is None or owner is None:
                faults[fault] = fault
                continue
            if match[2] != "id":  # people can mend it in the entry, and there it is one for all
                name = fault.file.rpartition("/")[2].removesuffix(".yaml")
                file, place = reader.places[CLUSTERS_FILE][name]
                field = f"{place}.discovery.entry" + (f".{match[2]}" if match[2] else "")
                fault = replace(fault, file=file, field=field)  # noqa: PLW2901
            self.of_nodes.setdefault(owner, fault)
            if (fault.file, fault.field) not in told:  # the entry itself may have the fault
                faults.setdefault((fault.file, fault.field), fault)
        super().__init__(faults.values())
