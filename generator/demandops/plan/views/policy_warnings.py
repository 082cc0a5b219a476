"""Warnings about access domains: what the cluster will refuse, and what it cannot close.

``demandops check`` shows them. They are no faults: a chart renders some kinds only with certain
values, which only Helm knows.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import groupby

from demandops import strict_yaml
from demandops.config.config import DOMAINS_FILE, Config
from demandops.config.policy import AccessDomain, matches
from demandops.connections.connection import Connection
from demandops.demand.permission import PEERS, needed_access
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger.world import World
from demandops.quoting import quoted

_KIND = re.compile(r"^kind:[ \t]*(?P<kind>[^#\n]*)", re.MULTILINE)
_PLAIN = re.compile(r"\"?([A-Z][A-Za-z0-9]*)\"?")
_TEMPLATE = re.compile(r"(.*/)?templates/(?!tests/).*\.(ya?ml|tpl)")
_MOST_NODES = 3
_CRDS = re.compile(r"(.*/)?crds/.*")


def warnings(world: World) -> Iterator[Fault]:
    """Yield every warning."""
    config = world.config
    yield from _charts(config)
    yield from _open_by_host_network(config)
    yield from _connections_of_before(world)


def _connections_of_before(world: World) -> Iterator[Fault]:
    """Yield a warning for connections between domains that no rule allows any longer."""
    counts: Counter[tuple[str, str]] = Counter()
    for claim in world.ledger:
        if isinstance(claim.held, Connection):
            for domain, access in needed_access(claim.held, world.config):
                others = (value for kind, value in access if kind == PEERS)
                counts.update(
                    (domain.name, other)
                    for other in others
                    if not any(matches(other, rule.peers) for rule in domain.rules)
                )
    for (name, other), count in sorted(counts.items()):
        message = (
            f"no rule of access domain '{name}' has '{other}' in its peers; connections between "
            f"them stay ({count}), but cannot be demanded again"
        )
        yield fault("", message).within(world.config.file_of(DOMAINS_FILE, name))


def _open_by_host_network(config: Config) -> Iterator[Fault]:
    """Yield what is open between access domains because pods use the host's network."""
    nodes = [
        (config.domain_of[node.id].name, node)
        for node in config.nodes.values()
        if node.host_network and node.id in config.domain_of
    ]
    nodes.sort(key=lambda one: (one[0], one[1].id))
    for name, group in groupby(nodes, key=lambda one: one[0]):
        if config.domains[name].network == "namespace":
            ids = [node.id for _, node in group]
            message = (
                f"network: namespace of access domain '{name}' does not hold for pods with the "
                f"host's network, as on {_some(ids)}; set hostNetwork: false for these nodes, or "
                "separate their network yourself"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, name))
    graphs: dict[tuple[str, int], dict[str, None]] = {}
    for name, node in nodes:
        graphs.setdefault((node.cluster, node.ros.domain_id), {})[name] = None
    for (cluster, number), names in sorted(graphs.items()):
        if len(names) > 1:
            listed = " and ".join(f"'{one}'" for one in names)
            message = (
                f"access domains {listed} share ROS domain {number} on the host's network of "
                f"cluster '{cluster}', where each may read and write the other's topics; give "
                "each its own ros.domainId"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, next(iter(names))))


def _some(ids: list[str]) -> str:
    shown = ", ".join(f"'{id}'" for id in ids[:_MOST_NODES])
    return shown if len(ids) <= _MOST_NODES else f"{shown} and {len(ids) - _MOST_NODES} more"


def _charts(config: Config) -> Iterator[Fault]:
    """Yield a warning for each kind in a chart of the state repo that a domain may not use."""
    for folder, domains in sorted(_domains_of_charts(config).items()):
        texts = {path: text for path, text in config.files.items() if path.startswith(f"{folder}/")}
        for path in sorted(texts):
            name = path.removeprefix(f"{folder}/")
            if _CRDS.fullmatch(name):
                yield from _refused(path, "", "CustomResourceDefinition", domains, config)
            elif _TEMPLATE.fullmatch(name):
                yield from _template(path, texts[path], domains, config)
            elif name == "Chart.yaml":
                yield from _dependencies(path, texts)


def _domains_of_charts(config: Config) -> dict[str, list[AccessDomain]]:
    """Return the access domains where each chart's folder may run, by what their rules allow."""
    found: dict[str, list[AccessDomain]] = {}
    for appdef, services in config.services.items():
        domains = [
            domain
            for domain in config.domains.values()
            if not domain.rules or any(matches(appdef, rule.applications) for rule in domain.rules)
        ]
        for service in services.values():
            for source in config.charts[service.chart].sources():
                if source.folder:
                    known = found.setdefault(source.folder, [])
                    known += [domain for domain in domains if domain not in known]
    return found


def _template(path: str, text: str, domains: list[AccessDomain], config: Config) -> Iterator[Fault]:
    for match in _KIND.finditer(text):
        value, line = match["kind"].strip(), f"line {text.count(chr(10), 0, match.start()) + 1}"
        plain = _PLAIN.fullmatch(value)
        if plain:
            yield from _refused(path, line, plain[1], domains, config)
        else:
            message = (
                f"kind {quoted(value)} is computed; see yourself that its access domain may have it"
            )
            yield fault(line, message).within(path)


def _refused(
    path: str, line: str, kind: str, domains: list[AccessDomain], config: Config
) -> Iterator[Fault]:
    for domain in domains:
        if kind not in {allowed.kind for allowed in domain.allowed_kinds}:
            file = config.file_of(DOMAINS_FILE, domain.name)
            message = (
                f"{kind} is not among the kinds of access domain '{domain.name}', whose cluster "
                f"refuses it if the chart renders it; add it to kinds in {file}, or leave it out"
            )
            yield fault(line, message).within(path)


def _dependencies(path: str, texts: Mapping[str, str]) -> Iterator[Fault]:
    """Yield a warning for each subchart that is not there as files."""
    try:
        data = strict_yaml.load(texts[path], path)
    except InvalidInput:  # reported as a fault of the chart
        return
    listed = data.get("dependencies") if isinstance(data, dict) else None
    for index, one in enumerate(listed if isinstance(listed, list) else ()):
        name = one.get("name") if isinstance(one, dict) else None
        if f"{path.removesuffix('Chart.yaml')}charts/{name}/Chart.yaml" not in texts:
            message = (
                f"{quoted(str(name))} is not unpacked in charts/, so its kinds are not known; see "
                "yourself that its access domain may have them"
            )
            yield fault(f"dependencies[{index}]", message).within(path)
