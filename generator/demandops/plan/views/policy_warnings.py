"""Warnings about access domains, nodes and requirements on nodes, which ``demandops check`` shows.

Some warnings report what the cluster will refuse or what demands cannot get. Others report an
access that the cluster cannot prevent. None is a fault, because the check may not know enough. For
example, a chart may render a refused kind only with certain values, and only Helm can find that
out.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from itertools import groupby, islice

from demandops.charts import chart_files
from demandops.config.config import DOMAINS_FILE, NODES_FILE, Config
from demandops.config.policy import AccessDomain, matches
from demandops.connections.connection import Connection
from demandops.demand.permission import PEERS, needed_access
from demandops.errors import MOST_FAULTS, Fault, fault
from demandops.ledger.operations.drain import Drain
from demandops.ledger.world import World
from demandops.plan.checks.name_clash import all_names
from demandops.plan.nodes.capacity import overcommitted, whole_usage
from demandops.plan.nodes.choice import lacks, requirement_of, unmet
from demandops.plan.nodes.relocation import following_overrides, with_moves
from demandops.quoting import quoted

# Kinds are read line by line, because a template of Helm is no YAML before it is rendered.
_KIND = re.compile(r"kind:[ \t]*(?P<kind>[^#]*)")
_PLAIN = re.compile(r"\"?([A-Z][A-Za-z0-9]*)\"?")
_TEMPLATE = re.compile(r"(.*/)?templates/(?!tests/).*\.(ya?ml|tpl)")
_CRDS = re.compile(r"(.*/)?crds/.*")
_MOST_NODES = 3


def warnings(world: World) -> Iterator[Fault]:
    config = world.config
    yield from _kinds_of_charts(config)
    yield from _open_by_host_network(config)
    yield from _connections_no_longer_allowed(world)
    for node, excess in overcommitted(world, whole_usage(world)):
        message = (
            f"{excess}; these services stay on the node, but no demand gets more of this resource "
            "there; raise the capacity, or move something to another node"
        )
        file = config.file_of(NODES_FILE, node.id)
        yield fault("", f"'{node.id}': {message}").within(file)
    for id in config.drained_nodes:
        if world.ledger.applications_on.get(id):
            drain = with_moves(Drain(id), world, whole_usage(world), all_names(world))
            file = config.file_of(NODES_FILE, config.host_of(id))
            for text in (*drain.moved, *drain.stays):
                yield fault("", f"'{id}' is drained: {text}").within(file)
    yield from _unfit_places(config)
    for path, text in following_overrides(world).stays:
        yield fault("node", text).within(path)


def _unfit_places(config: Config) -> Iterator[Fault]:
    placed = {  # a shared service is in several definitions, but in one file
        (service.file, service.name): service
        for services in config.services.values()
        for service in services.values()
        if service.place
    }
    for (file, name), service in sorted(placed.items()):
        field = "place" if service.shared else f"services.{name}.place"
        requirement = requirement_of(service)
        problems = [*unmet(requirement, config)]
        if not problems and all(any(lacks(node, requirement)) for node in config.nodes.values()):
            problems = [f"no node in {config.place_of(NODES_FILE)} meets all requirements"]
        for problem in problems:
            message = f"{problem}, so demands that need '{name}' are refused"
            yield fault(field, message).within(file)


def _connections_no_longer_allowed(world: World) -> Iterator[Fault]:
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
            f"no rule of access domain '{name}' has '{other}' among its 'peers', so nobody can "
            "demand a connection between the two domains; claims on such connections stay in "
            f"effect: {count}"
        )
        yield fault("", message).within(world.config.file_of(DOMAINS_FILE, name))


def _open_by_host_network(config: Config) -> Iterator[Fault]:
    """Yield warnings of access domains that are open because pods use the host's network."""
    nodes = [
        (config.domain_of[node.id].name, node)
        for node in config.nodes.values()
        if node.host_network and node.id in config.domain_of
    ]
    nodes.sort(key=lambda pair: (pair[0], pair[1].id))
    # Kubernetes applies a NetworkPolicy only to pods with their own network.
    for name, group in groupby(nodes, key=lambda pair: pair[0]):
        if config.domains[name].network == "namespace":
            ids = [node.id for _, node in group]
            listed = ", ".join(f"'{id}'" for id in ids[:_MOST_NODES])
            if len(ids) > _MOST_NODES:
                listed += f" and {len(ids) - _MOST_NODES} more"
            message = (
                f"'network: namespace' of access domain '{name}' has no effect on nodes whose pods "
                f"use the host's network: {listed}; set hostNetwork: false for these nodes, "
                "or separate their network yourself"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, name))
    graphs: dict[tuple[str, int], dict[str, None]] = {}
    for name, node in nodes:
        graphs.setdefault((node.cluster, node.ros.domain_id), {})[name] = None
    for (cluster, number), names in sorted(graphs.items()):
        if len(names) > 1:
            listed = " and ".join(f"'{name}'" for name in names)
            message = (
                f"access domains {listed} share ROS domain {number} on the network of the hosts "
                f"of cluster '{cluster}', so each may read and write the topics of the others; "
                "give each access domain its own ros.domainId"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, next(iter(names))))


def _kinds_of_charts(config: Config) -> Iterator[Fault]:
    """Yield a warning for each Kubernetes kind in a chart that an access domain does not allow.

    There is also a warning for each kind that cannot be read from the chart's files. Only charts
    and libraries in the state repo are read.
    """
    # A chart may run in an access domain that has no rules, or in which a rule allows an
    # application that uses the chart.
    domains_of: dict[str, list[AccessDomain]] = {}
    for appdef, services in config.services.items():
        allowing = [
            domain
            for domain in config.domains.values()
            if not domain.rules or any(matches(appdef, rule.applications) for rule in domain.rules)
        ]
        for service in services.values():
            for source in config.charts[service.chart].sources():
                top = source.folder
                for folder in chart_files.folders(top, config.files) if top else ():
                    domains = domains_of.setdefault(folder, [])
                    domains += [domain for domain in allowing if domain not in domains]
    paths = sorted(config.files)
    for folder, domains in sorted(domains_of.items()):
        for chart in chart_files.dependencies(folder, config.files):
            if (
                chart.folder is None
                and f"{folder}/charts/{chart.name}/Chart.yaml" not in config.files
            ):
                message = (
                    f"subchart {quoted(chart.name)} is not unpacked in charts/, so the kinds of "
                    "its objects are not known; check yourself that the access domain allows these "
                    "kinds"
                )
                yield fault(f"dependencies[{chart.index}]", message).within(f"{folder}/Chart.yaml")
        for path in chart_files.below(folder, paths):
            name = path.removeprefix(f"{folder}/")
            if _CRDS.fullmatch(name):
                yield from _refused(path, None, "CustomResourceDefinition", domains, config)
            elif _TEMPLATE.fullmatch(name):
                # A pull request of a stranger may have a template with any number of kinds.
                faults = _template(path, config.files[path], domains, config)
                shown = [*islice(faults, MOST_FAULTS + 1)]
                yield from shown[:MOST_FAULTS]
                if len(shown) > MOST_FAULTS:
                    yield Fault("more", "", "has more objects of such kinds", path)


def _template(path: str, text: str, domains: list[AccessDomain], config: Config) -> Iterator[Fault]:
    for line, words in enumerate(text.split("\n"), start=1):
        match = _KIND.match(words)
        if match is None:
            continue
        value = match["kind"].strip()
        plain = _PLAIN.fullmatch(value)
        if plain:
            yield from _refused(path, line, plain[1], domains, config)
        else:
            message = (
                f"the template computes the kind {quoted(value)}; check yourself that the access "
                "domain allows it"
            )
            yield fault("", message, line=line).within(path)


def _refused(
    path: str, line: int | None, kind: str, domains: list[AccessDomain], config: Config
) -> Iterator[Fault]:
    for domain in domains:
        if kind not in {allowed.kind for allowed in domain.allowed_kinds}:
            remedy = domain.how_to_allow(kind, config.file_of(DOMAINS_FILE, domain.name))
            message = (
                f"{kind} is not among the kinds of access domain '{domain.name}', so the cluster "
                f"refuses such an object if the chart renders one; {remedy}, or remove the object "
                "from the chart"
            )
            yield fault("", message, line=line).within(path)
