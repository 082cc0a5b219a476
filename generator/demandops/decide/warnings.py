"""What a requester or the author of a change should know, although nothing is refused for it."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import SequenceMatcher
from itertools import combinations, groupby, islice

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault, field_path, suggestion
from demandops.base.placeholders import example_of, is_pattern, shape_of
from demandops.base.quantities import amount_of, amount_text
from demandops.base.quoting import quoted, some
from demandops.connections.connection import Connection
from demandops.decide.admission.permission import PEERS, first_uncovered, needed_access
from demandops.decide.booking import Drain
from demandops.decide.checks.collisions import Names, publishers, topics_made
from demandops.decide.placement.candidates import lacks, requirement_of, unmet
from demandops.decide.placement.relocation import following_overrides, with_moves
from demandops.decide.planning.flows import flows_without_carrier, topics_of_origin
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import claims_needing
from demandops.decide.state import State, trial_releases
from demandops.model.config.appdef import ignored_fields, named_outputs
from demandops.model.config.base_model import matches
from demandops.model.config.config import CONFIG_ROOTS, DOMAINS_FILE, NODES_FILE, Config
from demandops.model.config.entry_patterns import may_match
from demandops.model.config.override import Override
from demandops.model.demand.demand import Application, Demand, Held
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import Changes, World
from demandops.model.release import Release
from demandops.render.gitops import values_of
from demandops.templating.charts import defaults, overridden
from demandops.templating.values import takes_requests

# ---- missing inputs: topics that applications read or deliver, but that do not arrive ----
#
# A demand that needs a connection gets the connection, or its requester gets a warning. Later an
# override may suspend the connection, demands may release the connection, or people may remove a
# node or an output from the configuration. Then a topic no longer arrives.


@dataclass(frozen=True, slots=True)
class MissingInput:
    """A topic that does not arrive, or an output that is no longer delivered."""

    application: str
    file: str
    reason: str

    def __str__(self) -> str:
        return f"application '{self.application}': {self.reason}"

    @property
    def warning(self) -> Fault:
        return fault(f"application '{self.application}'", self.reason).within(self.file)


def missing_inputs(state: State) -> list[MissingInput]:
    # Suspended claims need no topics, and suspended connections carry none.
    active = without_suspended(state)
    missing = {
        MissingInput(claim.application.id, claim_files.path_of(claim.key), reason)
        for claim in active.ledger
        if claim.is_on_application
        for reason in _reasons(claim.application, active, state.names)
    }
    return sorted(missing, key=lambda each: (each.application, each.reason, each.file))


def _reasons(app: Application, active: World, names: Names) -> Iterator[str]:
    config = active.config
    for role, topic in app.all_inputs():
        if topic.source not in config.nodes:
            where = f"'{topic.source}' is not in the inventory"
            yield f"{role} {topic.topic} does not arrive: {where}"
        elif topic.application and not any(publishers(names, active, topic.source, topic.topic)):
            maker = f"application '{topic.application}' of '{topic.source}'"
            yield f"{role} {topic.topic} does not arrive: {maker} does not make it"
    for flow in flows_without_carrier(config, app, active.ledger):
        if flow.key.sender in config.nodes:
            yield (
                f"{flow.name} {flow.key.topic} does not arrive: no connection carries it from "
                f"'{flow.key.sender}' to '{flow.key.receiver}'"
            )
    outputs = named_outputs(config.services.get(app.appdef, {}))
    for delivery in app.deliver:
        if delivery.output not in outputs:
            yield (
                f"{delivery.output} is no longer delivered to '{delivery.node}': the application "
                f"definition '{app.appdef}' has no such output"
            )


# ---- outputs of applications that others read by the names of the topics alone ----
#
# The demand of such a reader does not hold the application, and is not asked when it ends.


def unheld_output_warnings(state: State) -> Iterator[Fault]:
    for claim in sorted(state.ledger, key=lambda claim: claim_files.path_of(claim.key)):
        for note in unheld_outputs(claim.held, claim.demand, state):
            yield fault("", note).within(claim_files.path_of(claim.key))


def unheld_outputs(held: Held, demand: str, state: State) -> Iterator[str]:
    if not isinstance(held, Application) or held.held_for:
        return
    told = set[tuple[str, str]]()
    for _, input in held.all_inputs():
        key = next(publishers(state.names, state, input.source, input.topic), None)
        if input.application or key is None:
            continue
        claims = claims_needing(state, key)
        maker = claims[0].application
        service = state.config.services[maker.appdef][key.service]
        made = topics_made(state, service, key)
        output = f"{key.service}.{next(name for name in made if made[name] == input.topic)}"
        # a service may make thousands of topics, which are told once
        if not any(claim.demand == demand for claim in claims) and (maker.id, output) not in told:
            told.add((maker.id, output))
            yield (
                f"application '{held.id}': {input.topic} of '{input.source}' is an output of "
                f"application '{maker.id}', which may end before this demand; a Demand that names "
                f"{{application: {maker.id}, output: {output}}} instead of the topic holds it"
            )


def lost_output_notes(changes: Changes, after: State) -> Iterator[str]:
    """Yield who still reads the outputs that are no longer made after these changes."""
    for change in changes.claims:
        if change.before is None or not change.before.is_on_application or change.only_renews:
            continue
        app, lost = change.before.application, dict[ClaimKey, str]()
        for output in named_outputs(after.config.services.get(app.appdef, {})):
            for made in topics_of_origin(after.config, app, output):
                place = made.node, made.topic.topic
                reading = [claim.key for claim in after.ledger.each_with("takes", *place)]
                if reading and not any(publishers(after.names, after, *place)):
                    what = f"{made.topic.topic} of '{made.node}' ({output})"
                    lost = dict.fromkeys(reading, what) | lost
        for key in sorted(lost, key=str):
            yield (
                f"{key.subject} of demand '{key.demand}' still reads {lost[key]}, which "
                f"application '{app.id}' no longer makes"
            )


# ---- misspelled topics, which differ by a letter from a known topic of the node ----
#
# Nobody lists all topics of a node, so an unknown topic alone is no mistake. Names that differ in a
# digit, or in a letter of a short word (``lidar_fl``, ``lidar_fr``), count as two correct topics.

_WORDS = re.compile(r"[A-Za-z]+|[^A-Za-z]+")
# In words with fewer letters, one other letter often makes another correct word.
_SHORT = 4


def notes(request: Demand, before: World) -> Iterator[str]:
    # ``before`` is the world before the demand, or its own topics would all be known
    demanded: dict[str, set[str]] = {}
    told = set[tuple[str, str]]()
    for item in request.demanded if request.adds_claims else ():
        what = "application" if isinstance(item.held, Application) else "connection"
        for node, topic in _named_topics(item.held):
            entry, listed = before.config.nodes.get(node), set[str]()
            if entry:
                listed.update(entry.topics.values(), entry.types, *entry.bridged.values())
            if (node, topic) in told or topic in listed:
                continue
            told.add((node, topic))
            near = [each for each in listed if _is_misspelling(topic, each)]
            # what others demand proves a topic, but not beside one of the inventory. Thousands of
            # claims may read from a node, but nearly always one of them names the topic.
            reading = before.ledger.each_with("takes", node, topic)
            if not near and any(claim.demand != request.demand for claim in reading):
                continue
            if not near and node not in demanded:
                demanded[node] = {
                    named
                    for claim in before.ledger.each_with("from", node)
                    if claim.demand != request.demand
                    for sender, named in _named_topics(claim.held)
                    if sender == node
                }
            if not near and topic not in demanded[node]:
                near = [each for each in demanded[node] if _is_misspelling(topic, each)]
            if near:
                meant = f"did you mean '{min(near)}'?"
                yield f"{what} '{item.held.id}': '{node}' is not known to publish {topic}; {meant}"


def _named_topics(held: Held) -> list[tuple[str, str]]:
    if isinstance(held, Application):
        return [(topic.source, topic.topic) for _, topic in held.all_inputs()]
    return [(key.sender, key.topic) for key in map(held.key_of, held.topics)]


def _is_misspelling(topic: str, other: str) -> bool:
    """Return whether two topics differ by one mistake in one word of some length.

    The mistake is one wrong, missing or additional letter, or two letters in the wrong order.
    """
    words = _WORDS.findall(topic), _WORDS.findall(other)
    if abs(len(topic) - len(other)) > 1 or len(words[0]) != len(words[1]):
        return False
    differing = [pair for pair in zip(*words, strict=True) if pair[0] != pair[1]]
    if len(differing) != 1 or not "".join(differing[0]).isalpha() or len(differing[0][1]) < _SHORT:
        return False
    # such a mistake leaves all other letters as they are
    longest = max(map(len, differing[0]))
    return SequenceMatcher(None, *differing[0], autojunk=False).ratio() >= 1 - 1 / longest


# ---- overrides of equal priority that set the same of one release differently ----
#
# Of these, the one whose name comes last counts, on every machine. Few people want that.


def tied_override_warnings(releases: Iterable[Release]) -> Iterator[Fault]:
    ties: dict[tuple[str, str], Fault] = {}
    for release in releases:
        # thousands may select one release, and then the first of them show what is wrong
        for (first, mine), (last, theirs) in islice(combinations(release.shaping.by, 2), 1000):
            if first.priority != last.priority:
                continue
            tied = [
                name
                for name in mine
                if name in theirs and _result(name, first, last) != _result(name, last, first)
            ]
            if ("hold" in mine) != ("hold" in theirs) and {*mine, *theirs} - {"hold", "keep"}:
                tied.append("hold")
            if tied:
                what = " and ".join(f"'{name}'" for name in tied)
                message = (
                    f"is {last.priority}, as in {first.path}, and both set {what} of "
                    f"{release.name}; {last.path} counts, because its name comes last; give the "
                    "one that shall count a higher priority"
                )
                told = fault("priority", message).within(last.path)
                ties.setdefault((last.path, first.path), told)
    yield from (ties[pair] for pair in sorted(ties))


def _result(effect: str, first: Override, last: Override) -> str:
    before, after = getattr(first, effect), getattr(last, effect)
    if effect == "values":
        after = overridden(overridden({}, before, None), after, None)
    elif effect == "images":
        after = {**before, **after}
    return json.dumps(after, sort_keys=True, default=str)  # 1 and true are not the same


# ---- fields that are read and ignored ----


def ignored_field_warnings(config: Config) -> Iterator[Fault]:
    for path, text in sorted(config.files.items()):
        for ignored in ignored_fields(path, text):
            message = (
                "is ignored, because replicas follow demand at once; remove it, or run `demandops "
                "upgrade`, which does so"
            )
            yield fault(ignored, message).within(path)


# ---- requests that no node or no pod has ----


def request_warnings(config: Config) -> Iterator[Fault]:
    """Warn of what services request, but no node offers or Kubernetes cannot count."""
    settings = config.repo_settings
    services = {s.file + s.name: s for own in config.services.values() for s in own.values()}
    for _, service in sorted(services.items()):
        place = "requests" if service.shared else f"services.{service.name}.requests"
        for name, amount in service.requests.items():
            resource = settings.kubernetes_names.get(name, name)
            known = f"{amount} {name}" + (f" ({resource})" if resource not in (None, name) else "")
            # a node without a capacity has some cpu and memory, but nobody said that it has a GPU
            is_usual = name in ("cpu", "memory")
            if not any(
                is_usual if most is None else most >= amount_of(amount)
                for most in (node.most(name) for node in config.kinds.values())
            ):
                message = (
                    f"service '{service.name}' requests {known}; no node of the inventory has as "
                    "much, so its pods may wait for ever; add it to the capacity of nodes in "
                    + config.place_of(NODES_FILE)
                )
                yield fault(f"{place}.{name}", message).within(service.file)
            if resource and resource not in service.pod_requests:
                message = (
                    f"'{name}' is no resource of Kubernetes, so only the generator counts it; name "
                    "it in 'resources' of demandops.yaml, with Kubernetes' name or with null"
                )
                if "/" in resource:
                    message = f"pods do not get {known}, because Kubernetes gives only whole ones"
                    message += "; write a whole number"
                yield fault(f"{place}.{name}", message).within(service.file)
        chart, template = config.charts.get(service.chart), service.values
        if not service.requests or chart is None or "requests" in config.files.get(template, ""):
            continue
        with suppress(InvalidInput):  # YAML that only Helm reads
            if not chart.folder or not takes_requests(defaults(chart.folder, config.files)):
                message = (
                    f"writes no `requests`, and the chart '{service.chart}' is not known to have "
                    f"`resources`, so the pods of service '{service.name}' request nothing; write "
                    "`requests` where the chart reads them"
                )
                yield fault("", message).within(template)


# ---- values that a running service is said to take over ----


def live_warnings(state: State) -> Iterator[Fault]:
    """Warn of ``live`` values that do not exist, or for which the chart starts the pods anew."""
    config = state.config
    found = dict[Fault, None]()  # one instance of a service has what another has
    for release in (each for releases in trial_releases(config).values() for each in releases):
        service, chart, known = release.service, release.chart, dict[str, object]()
        with suppress(InvalidInput):  # which is told as a fault, or is YAML that only Helm reads
            known |= defaults(chart.folder, config.files) if chart.folder else {}
            known |= values_of(release, config, state.evaluate)
        place = "live" if service.shared else f"services.{service.name}.live"
        for name in service.live:
            # a template may write a value only sometimes
            written = re.search(rf"(?m)^{re.escape(name)}:", config.files.get(service.values, ""))
            if name not in known and not written:
                problem = (
                    f"'{name}' is no value that {service.values} writes or the chart "
                    f"'{service.chart}' has; correct it, or remove it{suggestion(name, known)}"
                )
            elif name == "parameters" and known.get("reconfigure") == "restart":
                problem = (
                    f"'{name}' restarts the pods, as `reconfigure: restart` of the chart "
                    f"'{service.chart}' says; remove it here, or write `reconfigure: live` there"
                )
            else:
                continue
            found[fault(place, problem).within(service.file)] = None
    yield from found


_TRUTH = re.compile(  # a brace inside a text is that of a placeholder: vehicle{n}
    r"(?:^|[:,\[-]|(?<![^\s\[{,:-])\{)[ ]*"
    r"\b([yY]|[nN]|[yY]es|YES|[nN]o|NO|[oO]n|ON|[oO]ff|OFF)[ ]*(?=[,\]}]|$)"
)


def truth_warnings(files: Mapping[str, str]) -> Iterator[Fault]:
    """Warn of words that are no text, although YAML 1.2 and many people take them for text."""
    for path, text in sorted(files.items()):
        is_yaml = path.split("/")[0] in CONFIG_ROOTS and path.endswith((".yaml", ".yaml.j2"))
        if not is_yaml or "/charts/" in path:  # charts are written for Helm
            continue
        for number, line in enumerate(text.splitlines(), 1):
            if match := _TRUTH.search(line.partition("#")[0].rstrip()):
                value = str(strict_yaml.plain_value(match[1])).lower()
                message = f"{match[1]} is {value}, as for Helm; write {value}, or use quotes"
                yield fault("", message, line=number).within(path)


# ---- warnings about patterns of the policy that match nothing now ----
#
# Such a pattern is misspelled, or what it matches was removed or does not exist yet. Patterns of
# requesters are not checked: the state repo has no list of requesters.


def unmatched_pattern_warnings(config: Config) -> Iterator[Fault]:
    twins: dict[tuple[str, str], str] = {}
    for kind in (config.node_patterns, config.broker_patterns):
        for entry in kind.values():
            named = f"{quoted(entry.id)} in {entry.where}"
            twin = twins.setdefault((entry.key, shape_of(entry.id)), named)
            if twin != named:
                message = f"{quoted(entry.id)} matches what {twin} does, so neither gives anything"
                place = f"{field_path(entry.place)}.{entry.key}"
                yield fault(place, f"{message}; remove one of them").within(entry.file)
    kinds_of_nodes = sorted(config.kinds.values(), key=lambda node: node.id)
    nodes = tuple(node.id for node in kinds_of_nodes)
    brokers = (*config.brokers, *config.broker_patterns)
    for name, domain in sorted(config.domains.items()):
        own = tuple(node.id for node in kinds_of_nodes if domain in config.domains_at(node))
        others = tuple(sorted(config.domains.keys() - {name}))
        # (where, patterns, what the patterns may match, all names that they may match)
        kinds = [("nodes", domain.nodes, "node", nodes)]
        for rule in domain.rules:
            place = f"rule '{rule.name}'"
            appdefs = (*config.appdefs,)
            kinds += [
                (f"{place}: applications", rule.applications, "application definition", appdefs),
                (f"{place}: nodes", rule.nodes, "node of the domain", own),
                (f"{place}: brokers", rule.brokers, "broker", brokers),
                (f"{place}: peers", rule.peers, "other access domain", others),
            ]
        file = config.file_of(DOMAINS_FILE, name)
        for where, patterns, what, names in kinds:
            for pattern in patterns:
                is_template = is_pattern(pattern)  # only ids in the inventory have placeholders
                if is_template or (pattern != "*" and not may_match(pattern, names)):
                    hint = suggestion(pattern, names) or "; there is none"
                    if is_template:
                        hint = f"; write {quoted(example_of(pattern, '*'))}"
                    message = f"{quoted(pattern)} matches no {what}{hint}"
                    yield fault(f"access domain '{name}', {where}", message).within(file)


# ---- warnings about access domains, nodes and requirements, which ``demandops check`` shows ----
#
# They report what demands cannot get, and an access that the cluster cannot prevent.

_MOST_NODES = 3


def policy_warnings(world: State) -> Iterator[Fault]:
    config = world.config
    yield from _approvals_not_needed(config)
    yield from _open_by_host_network(config)
    yield from _connections_no_longer_allowed(world)
    for id in sorted(config.nodes.keys() - config.domain_of.keys()):  # for a listed one, a fault
        if problem := config.unlisted.of_several_domains(id):
            message = f"{quoted(id)} {problem}, as until then it is in none"
            yield fault("", message).within(config.place_of(DOMAINS_FILE))
    for (id, resource), used in sorted(world.usage.amounts.items()):
        node = config.nodes.get(id)
        most = node.most(resource) if node else None
        if most is not None and used > most:
            message = (
                f"'{id}': services request {amount_text(used, resource)} {resource}, but the node "
                f"has {amount_text(most, resource)}; these services stay on the node, but no "
                "demand gets more of this resource there; raise the capacity, or move something "
                "to another node"
            )
            yield fault("", message).within(config.file_of(NODES_FILE, id))
    for id in world.nodes_to_drain():
        drain = with_moves(Drain(id=id), world, world.usage, world.names)
        file = config.file_of(NODES_FILE, config.host_of(id))
        for text in (*drain.moved, *drain.stays):
            yield fault("", f"'{id}' is drained: {text}").within(file)
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
        if not problems and all(any(lacks(node, requirement)) for node in config.kinds.values()):
            problems = [f"no node in {config.place_of(NODES_FILE)} meets all requirements"]
        for problem in problems:
            message = f"{problem}, so demands that need '{name}' are refused"
            yield fault(field, message).within(file)
    for path, text in following_overrides(world).stays:
        yield fault("node", text).within(path)


def _approvals_not_needed(config: Config) -> Iterator[Fault]:
    fields = ("requesters", "applications", "nodes")
    for name, domain in sorted(config.domains.items()):
        free = [rule for rule in domain.rules if not domain.asks(rule)]
        for rule in filter(domain.asks, domain.rules):
            # a pattern covers another if it matches it as text, with `*` longer than any `???`
            needed = [(f, p.replace("*", "*" * 99)) for f in fields for p in getattr(rule, f)]
            for other in (each for each in free if not first_uncovered(each, needed)):
                message = (
                    f"rule '{rule.name}' requires approval, but '{other.name}' covers the same "
                    "requesters and does not, so nobody is asked; one rule without approval is "
                    f"enough; narrow '{other.name}', or let it require approval too"
                )
                file = config.file_of(DOMAINS_FILE, name)
                yield fault(f"access domain '{name}'", message).within(file)


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
    nodes = [
        (domain.name, node.id, cluster, node)
        for node in config.kinds.values()
        if node.host_network
        for cluster, domain in config.places_of(node)
    ]
    nodes.sort(key=lambda each: each[:3])
    # Kubernetes applies a NetworkPolicy only to pods with their own network.
    for name, group in groupby(nodes, key=lambda pair: pair[0]):
        if config.domains[name].network == "namespace":
            listed = some([*dict.fromkeys(f"'{id}'" for _, id, *_ in group)], _MOST_NODES)
            message = (
                f"'network: namespace' of access domain '{name}' has no effect on nodes whose pods "
                f"use the host's network: {listed}; set hostNetwork: false for these nodes, "
                "or separate their network yourself"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, name))
    graphs: dict[tuple[str, int], dict[str, None]] = {}
    for name, _, at, node in nodes:
        ros = config.domains[name].ros or node.ros
        graphs.setdefault((at, ros.domain_id), {})[name] = None
    for (cluster, number), names in sorted(graphs.items()):
        if len(names) > 1:
            listed = " and ".join(f"'{name}'" for name in names)
            message = (
                f"access domains {listed} share ROS domain {number} on the network of the hosts "
                f"of cluster '{cluster}', so each may read and write the topics of the others; "
                "give each access domain its own ros.domainId"
            )
            yield fault("", message).within(config.file_of(DOMAINS_FILE, next(iter(names))))
