"""Each topic that a service reads comes to its node in exactly one way, in any service graph.

The configurations are random: services read each other at any depth, and some are shared.
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from random import Random
from typing import Any, NamedTuple

import pytest
import yaml
from demandops.base.errors import Refused
from demandops.decide.edits import changed_claim_files
from demandops.decide.placement.relocation import following_overrides
from demandops.decide.planning.planner import ReleaseKey, affected_keys, all_keys, plan
from demandops.decide.state import rendered_files
from demandops.decide.warnings import policy_warnings
from demandops.model.config.config import Config
from demandops.model.config.override import Override
from demandops.model.release import ServiceKey, ServiceRelease
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import brokers, override_of, skeleton, state_of
from tests.kit.memory import MemoryRepo, ledger_in

ROLES = ("a", "b")
TYPES = ("one", "two")
SOURCES = ("vehicle00", "vehicle01", "edge")
NODES = ("edge", "cloud", "vehicle01")
CLUSTER_NODE = "cloud"  # of the services that run once for the cluster


class Origin(NamedTuple):
    """What a service can read: the topics of an input role, or the output of a service."""

    name: str
    roots: frozenset[str]  # the input roles from which the topics are made; none for `once`
    # `source`: topics at their sources; `topic`: one for each input topic, at the node of an
    # application; `once`: one for an application, a node or a cluster
    kind: str


class Graphs:
    """Random definitions of two types of applications, whose services read each other."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.services: dict[str, dict[str, dict[str, Any]]] = {type: {} for type in TYPES}
        self.files: dict[str, str | None] = {**brokers("edge")}
        roles = [Origin(role, frozenset({role}), "source") for role in ROLES]
        self._origins = {type: list(roles) for type in TYPES}
        self._common = list(roles)
        appdefs: dict[str, dict[str, Any]] = {type: {"uses": {}, "services": {}} for type in TYPES}
        for number in range(random.randint(1, 5)):
            if random.random() < 0.5:
                used = self._share(f"s{number}")
                for type in TYPES:
                    appdefs[type]["uses"][f"s{number}"] = used[type]
            else:
                for type in TYPES:
                    name = f"{type[0]}{number}"
                    appdefs[type]["services"][name] = self._own(name, type)
        for type, parts in appdefs.items():
            if not parts["uses"] and not parts["services"]:
                parts["services"][f"{type}-last"] = self._own(f"{type}-last", type)
            head = {"apiVersion": "demandops/v1", "kind": "ApplicationDefinition", "name": type}
            appdef = head | {"inputs": {role: {} for role in ROLES}} | parts
            self.files[f"appdefs/{type}/appdef.yaml"] = yaml.safe_dump(appdef)
        charts = yaml.safe_load(skeleton()["registry/charts.yaml"])
        charts["charts"]["any"] = {"http": "https://charts.example", "version": "1.0.0"}
        self.files["registry/charts.yaml"] = yaml.safe_dump(charts)

    def _service(self, name: str, folder: str) -> dict[str, Any]:
        self.files[f"appdefs/{folder}/values/any.j2"] = "inputs: {{ inputs }}\n"
        outputs = {"out": f"/{{instance}}/{name.replace('-', '_')}"}
        return {
            "prefix": name.replace("-", ""), "outputs": outputs, "chart": "any",
            "values": "values/any.j2",
        }  # fmt: skip

    def _add(self, type: str, name: str, scope: str, at_source: bool, read: list[Origin]) -> Origin:
        """Add a service to a type of application; return the service's output as an origin.

        With the scope ``topic``, the service has one instance for each topic of the first origin in
        ``read``.
        """
        roots = set[str]()
        if scope == "topic":
            roots = {self._root(type, read[0])}
        elif at_source:
            roots = {root for one in read for root in one.roots}
        self.services[type][name] = {"scope": scope, "at_source": at_source, "roots": roots}
        kind = "source" if at_source else "topic" if scope == "topic" else "once"
        made = Origin(f"{name}.out", frozenset(roots if kind != "once" else ()), kind)
        self._origins[type].append(made)
        return made

    def _root(self, type: str, origin: Origin) -> str:
        name = origin.name.partition(".")[0]
        return next(iter(self.services[type][name]["roots"])) if "." in origin.name else origin.name

    def _first(self, origins: list[Origin], type: str, at_source: bool) -> Origin:
        """Return a random origin for the first input of a service with the scope ``topic``."""
        others = {name for name, one in self.services[type].items() if one["scope"] != "topic"}
        known = [one for one in origins if one.name.partition(".")[0] not in others]
        return self.random.choice([one for one in known if not at_source or one.kind == "source"])

    def _readable(self, type: str, scope: str, at_source: bool, first: Origin) -> list[Origin]:
        """Return the origins that a service may read in addition to its first origin."""
        apart, root = at_source or scope == "cluster", self._root(type, first)
        found = [one for one in self._origins[type] if not (apart and one.kind == "topic")]
        if scope == "topic":
            return [one for one in found if not one.roots or root in one.roots]
        return found

    def _chosen(self, origins: list[Origin], least: int) -> list[Origin]:
        return self.random.sample(origins, min(len(origins), self.random.randint(least, 2)))

    def _own(self, name: str, type: str) -> dict[str, Any]:
        """Return a definition for a service of one type of application alone."""
        service = self._service(name, type)
        if self.random.random() < 0.5:
            read = self._chosen(self._origins[type], least=1)
            self._add(type, name, "application", False, read)
        else:
            at_source = self.random.random() < 0.5
            first = self._first(self._origins[type], type, at_source)
            read = [first, *self._chosen(self._readable(type, "topic", at_source, first), least=0)]
            service |= {"each": "in0", "placement": "source" if at_source else "application"}
            self._add(type, name, "topic", at_source, read)
        service["inputs"] = {f"in{n}": one.name for n, one in enumerate(read)}
        return service

    def _share(self, name: str) -> dict[str, dict[str, str]]:
        """Define a service for both types; return, by type, what the service reads."""
        scope = self.random.choice(["topic", "topic", "node", "application", "cluster"])
        at_source = scope in ("topic", "node") and self.random.random() < 0.5
        definition = self._service(name, name) | {"scope": scope, "name": name}
        definition |= {"nodes": {"c-its": CLUSTER_NODE}} if scope == "cluster" else {}
        definition |= {"placement": "source" if at_source else "application"}
        first = self._first(self._common, TYPES[0], at_source or scope == "cluster")
        count = self.random.randint(0, 1)
        used, made = dict[str, dict[str, str]](), list[Origin]()
        for type in TYPES:
            more = self._readable(type, scope, at_source, first)
            read = [first, *(self.random.choice(more) for _ in range(count))]
            used[type] = {f"in{n}": one.name for n, one in enumerate(read)}
            made.append(self._add(type, name, scope, at_source, read))
        if made[0] == made[1]:
            self._common.append(made[0])
        definition["inputs"] = {f"in{n}": {} for n in range(count + 1)}
        definition |= {"each": "in0"} if scope == "topic" else {}
        head = {"apiVersion": "demandops/v1", "kind": "ServiceDefinition"}
        self.files[f"appdefs/{name}/service.yaml"] = yaml.safe_dump(head | definition)
        return used


class Demands:
    """Random demands for applications of both types."""

    def __init__(self, random: Random, graphs: Graphs) -> None:
        self.random, self.graphs = random, graphs
        self.held: dict[str, list[dict[str, Any]]] = {}
        self.where = {id: random.choice(NODES) for id in ("x", "y", "z")}
        self.types = {"x": "one", "y": "one", "z": "two"}

    def next(self) -> dict[str, Any]:
        demand = self.random.choice("def")
        head = {"kind": "Demand", "demand": demand, "requesters": [f"of {demand}"]}
        if demand in self.held and self.random.random() < 0.4:
            del self.held[demand]
            return head | {"operation": "release"}
        ids = self.random.sample(sorted(self.where), self.random.randint(1, 2))
        for id in ids:
            if id not in self.others(head):
                self.where[id] = self.random.choice(NODES)
        self.held[demand] = [self._application(id) for id in ids]
        return head | {"applications": self.held[demand]}

    def others(self, goal: dict[str, Any]) -> set[str]:
        """Return the ids of all applications that demands other than ``goal`` hold."""
        others = (apps for demand, apps in self.held.items() if demand != goal["demand"])
        return {app["id"] for apps in others for app in apps}

    def _application(self, id: str) -> dict[str, Any]:
        inputs = defaultdict(list)
        for _ in range(self.random.randint(1, 4)):
            role, source = self.random.choice(ROLES), self.random.choice(SOURCES)
            topic = f"/{source}/{role}/t{self.random.randint(0, 1)}"
            inputs[role].append({"topic": topic, "source": source})
        app = {"id": id, "type": self.types[id], "node": self.where[id], "inputs": dict(inputs)}
        return app | {"deliver": self._deliveries(self.types[id])}

    def _deliveries(self, type: str) -> list[dict[str, Any]]:
        # each output is one that only one node makes under its name
        services = self.graphs.services[type].items()
        names = [name for name, one in services if one["scope"] != "topic" or one["at_source"]]
        chosen = self.random.sample(names, self.random.randint(0, min(1, len(names))))
        return [{"output": f"{name}.out", "node": "station00"} for name in chosen]


def instances(
    graphs: Graphs, app: dict[str, Any], moved: Mapping[str, str]
) -> Iterator[ServiceKey]:
    """Yield the keys of the services that must run for an application of a demand.

    ``moved`` maps a service to the node on which it runs, if that is not the application's node.
    """
    for name, service in graphs.services[app["type"]].items():
        own = moved.get(name, app["node"])
        if service["scope"] == "application":
            yield ServiceKey(name, own, application=app["id"])
        elif service["scope"] == "node" and not service["at_source"]:
            yield ServiceKey(name, own)
        elif service["scope"] == "cluster":
            yield ServiceKey(name, CLUSTER_NODE, for_cluster=True)
        for one in (one for role in service["roots"] for one in app["inputs"].get(role, ())):
            topic, source = one["topic"], one["source"]
            node = source if service["at_source"] else own
            if service["scope"] == "topic":
                yield ServiceKey(name, node, source=source, topic=topic)
            else:
                yield ServiceKey(name, node)


def delivered(
    repo: MemoryRepo, demands: Demands, services: list[ServiceRelease]
) -> Iterator[tuple[str, str]]:
    """Yield (topic, receiving node) of each delivery, which has what its demand's inputs make."""
    for app in (app for apps in demands.held.values() for app in apps):
        booked = repo.state.ledger.application(app["id"])
        assert booked is not None
        wanted = {*instances(demands.graphs, app, booked.moved)}
        for delivery in app["deliver"]:
            name = delivery["output"].partition(".")[0]
            for one in services:
                if one.key.service == name and one.key in wanted:
                    yield one.outputs["out"], delivery["node"]


def assert_follows(
    repo: MemoryRepo, demands: Demands, nodes: Mapping[str, Mapping[str, str]]
) -> None:
    """Check that exactly what the demands need runs, and that all files follow from the ledger.

    Each topic that is read arrives in one way, and no other topic is carried. ``nodes`` has the
    nodes of the services that do not run on their application's node, by application.
    """
    releases = {key: plan(repo.state, key) for key in all_keys(repo.state)}
    services = [one for one in releases.values() if isinstance(one, ServiceRelease)]
    held = [app for apps in demands.held.values() for app in apps]
    assert {key for key in releases if isinstance(key, ServiceKey)} == {
        key for app in held for key in instances(demands.graphs, app, nodes[app["id"]])
    }
    assert ledger_in(repo.files) == repo.state.ledger
    assert in_clusters(repo.files) == in_clusters(rendered_files(repo.state))
    made = {(one.node.id, topic) for one in services for topic in one.outputs.values()}
    for claim in repo.state.ledger:
        if claim.is_on_application:
            made |= {(one.source, one.topic) for _, one in claim.application.all_inputs()}
    brought = [
        (connection["source"], topic, connection["target"])
        for connection in repo.books()["connections"].values()
        for topic in connection["topics"]
    ]
    for source, topic, _ in brought:
        assert (source, topic) in made, f"carries {topic} of {source}, where nothing makes it"
    read = {
        (topic.topic, one.node.id)
        for one in services
        for topics in one.inputs.values()
        for topic in topics
    }
    read |= {*delivered(repo, demands, services)}
    for topic, node in read:
        ways = [source for source, name, target in brought if (name, target) == (topic, node)]
        ways += [node] if (node, topic) in made else []
        assert len(ways) == 1, f"{topic} comes to {node} from {ways}"
    assert {(topic, target) for _, topic, target in brought} <= read, (
        "a connection carries a topic that nobody reads"
    )


def in_clusters(files: Mapping[str, str]) -> dict[str, str]:
    return {path: text for path, text in files.items() if path.startswith("clusters/")}


def overrides(random: Random, graphs: Graphs) -> Iterator[Override]:
    """Yield random overrides, each of which moves a service, or all services of an application."""
    names = sorted({name for services in graphs.services.values() for name in services})
    for number in range(random.randint(0, 2)):
        by_service = {"services": [random.choice(names)]}
        select = random.choice([by_service, by_service, {"applications": ["x"]}])
        yield override_of(f"o{number}", select, priority=number, node=random.choice(NODES))


def wanted(graphs: Graphs, app: dict[str, Any], active: Iterable[Override]) -> dict[str, Any]:
    """Return the new node of each service of ``app`` that an override moves; the last wins."""
    return {
        name: override.node
        for override in active
        for name, service in graphs.services[app["type"]].items()
        if not service["at_source"] and service["scope"] != "cluster"
        if name in (override.select[0].services or [name] * (app["id"] == "x"))
    }


def configure(repo: MemoryRepo, config: Config) -> tuple[tuple[str, str], ...]:
    """Replace the configuration as a generator does.

    Return (file, reason) for each override that cannot move a service.
    """
    state = state_of(config, repo.state.ledger)
    moved = following_overrides(state)
    for path, text in changed_claim_files(state.ledger, moved.ledger, moved.keys).items():
        repo.files.pop(path) if text is None else repo.files.update({path: text})
    repo.state = replace(state, ledger=moved.ledger)
    for path in in_clusters(repo.files):
        del repo.files[path]
    repo.files |= in_clusters(rendered_files(repo.state))
    return moved.stays


@pytest.mark.parametrize("moving", [False, True])
@examples(16)
@given(chances, st.integers(1, 7))
def test_every_topic_that_a_service_reads_comes_in_one_way_and_no_other_is_carried(
    moving: bool, random: Random, length: int
) -> None:
    """If ``moving``, overrides move services back and forth."""
    graphs = Graphs(random)
    demands = Demands(random, graphs)
    repo = MemoryRepo(graphs.files)
    plain, releases = repo.config, dict[ReleaseKey, Any]()
    for _ in range(length):
        before, state = (copy.deepcopy(demands.held), dict(demands.where)), repo.state
        taken = repo.take(demands.next())
        if isinstance(taken, Refused):
            assert moving and {fault.code for fault in taken.faults} == {"conflict"}
            demands.held, demands.where = before
        elif not moving:
            changed = affected_keys(state, repo.state, taken.changes.claims)
            releases |= {key: plan(repo.state, key) for key in changed}
            planned = {key: plan(repo.state, key) for key in all_keys(repo.state)}
            assert {key: one for key, one in releases.items() if one} == planned
        active = {one.name: one for one in overrides(random, graphs)} if moving else {}
        stays = configure(repo, replace(plain, overrides=active)) if moving else ()
        told = [(one.file, one.message) for one in policy_warnings(repo.state)]
        assert {*stays} <= {*told}, "check must tell what stays"
        apps = [app for apps in demands.held.values() for app in apps]
        booked = {app["id"]: repo.state.ledger.application(app["id"]) for app in apps}
        moved = {id: dict(app.moved) for id, app in booked.items() if app}
        for app in apps:
            if not any(f"'{app['id']}'" in why for _, why in stays):
                assert moved[app["id"]] == wanted(graphs, app, active.values())
        assert_follows(repo, demands, moved)
    configure(repo, plain)
    assert not repo.state.ledger.ids_with("moved")
    assert_follows(repo, demands, defaultdict(dict))
