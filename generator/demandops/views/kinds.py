"""The lists that people see, each once: the items, as docs/json.md has them, and the columns."""

from __future__ import annotations

import json
import shlex
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import islice
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.base.naming import SubjectKind
from demandops.base.placeholders import is_pattern, texts
from demandops.cluster.health import Health
from demandops.cluster.rollouts import ReleaseStatus
from demandops.decide import bookkeeping
from demandops.decide.planning.overrides import suspended_by
from demandops.decide.planning.planner import running_version
from demandops.model.config.base_model import duration_text, parse_file, parse_time, relative
from demandops.model.config.config import DOMAINS_FILE, NODES_FILE
from demandops.model.config.override import OVERRIDES_ROOT, Override, OverrideFile
from demandops.model.demand.demand import Lease
from demandops.model.ledger.claim import Claim, demand_id, requesters_of
from demandops.model.ledger.records import WaitingDemand, in_turn
from demandops.model.release import Release, ServiceRelease
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.history.commit_message import PROPOSAL, REJECTS
from demandops.repo.reader import Reader
from demandops.views import vocabulary
from demandops.views.rows import Column, Row, TextsOf, labels_of
from demandops.views.source import Source, claims_behind, since_of, word_of, worst_word
from demandops.views.vocabulary import Json, claim_data, lease_data, subject_text, time_data

# How many of the newest commits are searched for events and for what is gone.
MOST_COMMITS = 2_000


@dataclass(frozen=True, slots=True)
class Kind:
    """A list: its rows are made of ``entries`` and kept while the values of an entry stay equal."""

    name: str
    about: str
    columns: Sequence[Column]
    # Yields the id of each entry and the values of which ``item`` makes its item.
    entries: Callable[[Source], Iterator[tuple[str, tuple[Any, ...]]]]
    item: Callable[..., Json] = lambda source, item: item
    # Further texts by which an item is found, by label.
    labels: Callable[[Json], dict[str, Iterable[str]]] = lambda item: {}
    # The past can be listed of what a trailer of commits names, or of what has a file of this glob.
    trailer: str = ""
    files: str = ""
    # What an item has that is gone, beside nulls; and what its last commit and its file tell of it.
    blank: Json = field(default_factory=dict)
    was: Callable[[Reader, LogEntry, str], Json] = lambda reader, entry, path: {}

    @property
    def has_past(self) -> bool:
        return bool(self.trailer or self.files)

    @property
    def word(self) -> str:
        return self.name[:-1]

    @property
    def title(self) -> str:
        return self.name.capitalize()

    def row(self, item: Json) -> Row:
        labels, more = labels_of(item), self.labels(item)
        more[self.word] = (*more.get(self.word, ()), item["name"])
        for key, words in more.items():
            labels[key] = [*dict.fromkeys((*labels.get(key, ()), *filter(None, words)))]
        return Row(labels, item)


def rows_of(source: Source, name: str) -> list[Row]:
    kind, moment = KINDS[name], source.now.replace(second=0, microsecond=0)
    made_for, made = source.rows.get(name, (None, {}))
    # the follower makes a new mapping of statuses whenever it looks; the minute decides which
    # leases are over
    wanted = source.statuses, source.proposals, moment
    if made_for != wanted:
        rows: dict[str, tuple[tuple[Any, ...], Row]] = {}
        for id, values in kind.entries(source):
            before = made.get(id)
            if before is None or before[0] != values:
                before = values, kind.row(kind.item(source, *values))
            rows[id] = before
        source.rows[name], made = (wanted, rows), rows
    return [row for _, row in made.values()]


# The operations that end what their commit names.
_ENDING = frozenset({"shutdown", "release", "expire", "decommission", "rollback"})


def past_rows(source: Source, name: str) -> tuple[list[Row], str]:  # noqa: PLR0912 - a rule each
    """Return what is gone, the newest first, and the commit where the search ended, if it did.

    The newest commit that names a thing which is not there now is the one that ended it. What came
    back is listed too: nothing of it ended since what is there now began.
    """
    kind, past, reader = KINDS[name], dict[str, Json](), source.reader()
    began: dict[str, datetime | None] = {}  # what is there now; None if it was never gone
    for row in rows_of(source, name):
        since = row.item.get("since") if kind.trailer else None
        began[row.item["name"]] = parse_time(since) if since else None
    removed = dict[str, dict[str, str]]()
    if kind.files:
        removed = commit_log.removed_files(reader.objects, source.commit, kind.files)
    for number, entry in enumerate(reader.log(source.commit)):
        if number == MOST_COMMITS:
            return [*map(kind.row, past.values())], entry.commit
        by, time, operation = entry.author, entry.time, entry.first("Operation")
        reason = entry.first("Reason") if operation else entry.why
        files, rejected = removed.get(entry.commit, {}), entry.trailers.get(REJECTS, ())
        named = entry.trailers.get(kind.trailer, [*files])
        if name == "proposals" and (answer := entry.answer):
            by, time, operation, reason = answer.by, answer.time, answer.outcome, answer.reason
            named = named or [each.partition(" ")[0] for each in rejected]
        elif rejected:
            continue  # what was proposed, and never was there
        for gone in named:
            if gone in began:
                now = began[gone]
                if now and entry.time > now and operation in _ENDING:
                    began[gone] = now = None
                if now is None or (gone not in past and operation not in _ENDING):
                    continue
            item: Json = {column.key: None for column in kind.columns} | kind.blank
            item |= {"name": gone, "state": "back" if gone in began else "gone"}
            item |= {"requesters": [], "applications": [], "connections": []}
            item["ended"] = {"time": time_data(time), "by": by, "operation": operation or None}
            item["ended"] |= {"reason": reason or None, "commit": entry.commit}
            if gone not in past:
                past[gone] = item | kind.was(reader, entry, files.get(gone, ""))
            item = past[gone]
            if not kind.files:
                item["since"] = time_data(entry.time)  # of the oldest commit that names it
            if len(named) == 1 and not item["requesters"]:  # what a commit names is all of it
                item["requesters"] = entry.trailers.get("Requester", [])
                item["demands"] = entry.trailers.get("Demand-Id", [])
                item["applications"] = entry.trailers.get("Application", [])
                item["connections"] = entry.trailers.get("Connection", [])
    return [*map(kind.row, past.values())], ""


# ---- columns that several lists have ----

REQUESTERS = Column("requesters", "Requesters", 2, links="requester")
HEALTH = Column("health", "Health", 1, "state")
STATE = Column("state", "State", 2, "state")
SINCE = Column("since", "Since", 6, "time")


def _lease_text(item: Json, now: datetime) -> str:
    if (lease := item.get("lease")) is None:
        return ""
    if not lease["until"]:
        return "not started"
    end = parse_time(lease["until"])
    released = end + timedelta(seconds=lease["slack"])
    if end >= now:
        return f"ends {relative(end, now)}"
    then = "waits for a generator" if released < now else f"released {relative(released, now)}"
    return f"ended {relative(end, now)}, {then}"


LEASE = Column("lease", "Lease", 5, texts_of=_lease_text)


def _ended(item: Json, now: datetime) -> str:
    if not (ended := item.get("ended")):
        return ""
    how = f", {ended['operation']}" if ended["operation"] else ""
    how += f" in {ended['commit'][:10]}" + (f": {ended['reason']}" if ended["reason"] else "")
    return f"{relative(parse_time(ended['time']), now)} by {ended['by']}{how}"


ENDED = Column("ended", "Ended", 3, texts_of=_ended)


def _named(kind: str) -> Column:
    return Column("name", kind.capitalize(), links=kind)


def _text(
    key: str, title: str, rank: int, texts_of: Callable[[Json], Any], links: str = ""
) -> Column:
    return Column(key, title, rank, texts_of=lambda item, now: texts_of(item), links=links)


def _wide(key: str, title: str, links: str = "", texts_of: TextsOf | None = None) -> Column:
    return Column(key, title, 9, texts_of=texts_of, links=links, only_wide=True)


def _command(title: str, words_of: Callable[[Json], list[str]]) -> Column:
    def text(item: Json, now: datetime) -> str:
        return "" if item.get("ended") else shlex.join(words_of(item))

    return Column("name", title, 9, "command", text, only_wide=True)


def _pairs(key: str, sign: str = ": ", text: Callable[[Any], str] = str) -> TextsOf:
    return lambda item, now: [f"{name}{sign}{text(value)}" for name, value in item[key].items()]


def _decide(proposal: Json, verb: str) -> list[str]:
    return ["demandops", verb, proposal["name"], "--commit", proposal["commit"]]


HOLDS = _text(
    "applications", "Holds", 3, lambda item: [*item["applications"], *item["connections"]], "held"
)


def _runs(source: Source, releases: list[str]) -> Json:
    # the health is null if no cluster was asked
    health = worst_word(map(source.status, releases)) if source.statuses else None
    return {"releases": releases, "health": health}


def domains_of(source: Source, nodes: Iterable[str]) -> list[str]:
    domain_of = source.config.domain_of
    return sorted({domain_of[id].name for id in nodes if id in domain_of})


def nodes_of(claim: Claim) -> tuple[str, ...]:
    if claim.is_on_application:
        delivered = (delivery.node for delivery in claim.application.deliver)
        return tuple(sorted({*claim.application.needed_nodes(), *delivered}))
    return tuple(sorted({*claim.held.nodes, *filter(None, (claim.connection.broker,))}))


def _subjects(claims: Iterable[Claim]) -> Json:
    subjects = {claim.subject for claim in claims}
    return {
        kind.value: sorted(subject.id for subject in subjects if subject.kind is kind)
        for kind in (SubjectKind.APPLICATION, SubjectKind.CONNECTION)
    }


# ---- what is held: demands, applications, claims, leases and requesters ----


def state_of(source: Source, claims: Sequence[Claim]) -> str:
    # a claim is held by its demand, kept by an override, or suspended by an override
    active = [claim for claim in claims if not suspended_by(claim, source.state)]
    if len(active) < len(claims):
        return "partly suspended" if active else "suspended"
    if any(claim.lease and claim.lease.has_ended(source.now) for claim in claims):
        return "overdue"
    return "kept" if all(claim.keeping_override for claim in claims) else "held"


def _held(source: Source, claims: Sequence[Claim], state: str) -> Json:
    # what items have in common that consist of claims
    nodes = sorted({node for claim in claims for node in nodes_of(claim)})
    return {
        "state": state,
        "requesters": list(requesters_of(claims)),
        "nodes": nodes,
        "domains": domains_of(source, nodes),
        "since": time_data(min((claim.booked for claim in claims), default=None)),
        "lease": lease_data(_first_lease(claims)),
        "ended": None,
    }


def _first_lease(claims: Iterable[Claim]) -> Lease | None:  # that ends
    leases = (claim.lease for claim in claims if claim.lease)
    return min(leases, key=lambda lease: lease.until, default=None)


def _demands(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    held = source.claims_of_demands.items()
    for id, claims in sorted(held, key=lambda pair: (min(c.booked for c in pair[1]), pair[0])):
        runs = _runs(source, source.releases_of_demands.get(id, []))
        yield id, (claims, state_of(source, claims), runs)
    for waiting in in_turn(source.state.ledger.waiting):
        yield f"waiting {waiting.demand}", (waiting, "waiting", {"releases": [], "health": None})


def _demand(source: Source, holds: list[Claim] | WaitingDemand, state: str, runs: Json) -> Json:
    waiting = holds if isinstance(holds, WaitingDemand) else None
    claims = [] if isinstance(holds, WaitingDemand) else holds
    suspending = filter(None, (suspended_by(claim, source.state) for claim in claims))
    item = {
        "name": waiting.demand if waiting else claims[0].demand,
        **_held(source, claims, state),
        "requests": sorted({claim.request for claim in claims}),
        **_subjects(claims),
        "suspended_by": sorted({override.path for override in suspending}),
        **runs,
    }
    if waiting:
        item |= {"requests": [waiting.put.id], "requesters": list(waiting.requesters)}
        item["since"] = time_data(waiting.since)
    return item


def _leases(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    leased = [
        (lease.until, id, values)
        for id, values in _demands(source)
        if id in source.claims_of_demands and (lease := _first_lease(values[0]))
    ]
    yield from ((id, values) for _, id, values in sorted(leased, key=lambda each: each[:2]))


def _applications(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    releases: defaultdict[str, list[str]] = defaultdict(list)
    for name, release in source.releases.items():
        for id in release.applications if isinstance(release, ServiceRelease) else ():
            releases[id].append(name)
    ledger = source.state.ledger
    for id in ledger.subjects(SubjectKind.APPLICATION):
        claims = ledger.application_claims(id)
        yield id, (claims, state_of(source, claims), _runs(source, releases[id]))


def _application(source: Source, claims: tuple[Claim, ...], state: str, runs: Json) -> Json:
    app = claims[0].application
    running = running_version(source.state, app.id)
    return {
        "name": app.id,
        "appdef": app.appdef,
        "node": app.node,
        "version": (running.name if running else "") or app.version or None,
        **_held(source, claims, state),
        "demands": [*dict.fromkeys(claim.demand for claim in claims)],
        **runs,
    }


def _claims(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for claim in sorted(source.state.ledger, key=lambda claim: (str(claim.subject), claim.demand)):
        yield f"{claim.subject} {claim.demand}", (claim, state_of(source, [claim]))


def claim_item(source: Source, claim: Claim, state: str) -> Json:
    data, denying = claim_data(claim), suspended_by(claim, source.state)
    kept = source.config.overrides.get(claim.keeping_override or "")
    way = f"send request '{claim.request}' again with shutdown: true"
    if claim.keeping_override is not None:
        way = f"remove 'keep' from {OVERRIDES_ROOT}/{claim.keeping_override}.yaml"
    # a goal of the reference's action has no demand id: the generator derives it from the request
    elif claim.demand != demand_id(claim.request, claim.requesters):
        way = f"send 'operation: release' for demand '{claim.demand}'"
    return {
        "name": data["file"],
        **_held(source, [claim], state),
        **data,
        "release_by": way,
        "kept_by": vocabulary.override_data(kept, ("keep",)) if kept else None,
        "suspended_by": vocabulary.override_data(denying, ("deny",)) if denying else None,
    }


def _subject(item: Json, now: datetime) -> list[str]:
    return [subject_text(item), *(f"held for {id}" for id in item["held_for"])]


def _requesters(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    claims_of: defaultdict[str, list[Claim]] = defaultdict(list)
    waiting: defaultdict[str, list[str]] = defaultdict(list)
    for claim in source.state.ledger:
        for requester in claim.requesters:
            claims_of[requester].append(claim)
    for demand in source.state.ledger.waiting.values():
        for requester in demand.requesters:
            waiting[requester].append(demand.demand)
    for requester in sorted({*claims_of, *waiting}):
        claims = claims_of[requester]
        demands, of_demand = {claim.demand for claim in claims}, source.releases_of_demands
        releases = {name for demand in demands for name in of_demand.get(demand, ())}
        state, runs = state_of(source, claims) if claims else "waiting", sorted(releases)
        yield requester, (requester, claims, state, waiting[requester], _runs(source, runs))


def _requester(
    source: Source, name: str, claims: list[Claim], state: str, waiting: list[str], runs: Json
) -> Json:
    return {
        "name": name,
        **_held(source, claims, state),
        "demands": sorted({*waiting, *(claim.demand for claim in claims)}),
        **_subjects(claims),
        **runs,
        "requesters": [name],
    }


# ---- what runs: releases, services and connections ----


def _releases(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for planned in source.running:
        name = planned.target.name
        status = source.status(name) if source.statuses else None
        yield name, (planned.release, planned.claims, status)


def _services(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for name, values in _releases(source):
        if isinstance(values[0], ServiceRelease):
            yield name, values


def release_of(source: Source, release: Release) -> Json:
    # that runs, or that an override stops
    claims = source.claims_of_releases.get(release.name)
    claims = claims_behind(source.state.ledger, release) if claims is None else claims
    status = source.status(release.name) if source.statuses else None
    return _release(source, release, claims, status)


def _release_was(reader: Reader, entry: LogEntry, path: str) -> Json:
    _, cluster, domain, node, _ = path.split("/")
    place = {"node": node, "cluster": cluster, "domains": [domain]}
    return place | {"requesters": entry.trailers.get("Requester", [])}


def _release(
    source: Source, release: Release, claims: list[Claim], status: ReleaseStatus | None
) -> Json:
    own: Json
    if isinstance(release, ServiceRelease):
        own = {
            "version": release.chart.version,
            "application_version": release.version.name or None,
            "versions_asked": bookkeeping.versions_asked(release, source.active.ledger),
            **bookkeeping.service_entry(source.active, release),
        }
    else:
        own = {"version": None, "application_version": None, "versions_asked": {}}
        own |= {"service": None, "applications": [], "connections": list(release.connections)}
    # what a cluster says of it; null if none was asked
    word = word_of(status) if status else None
    status = status or ReleaseStatus(Health("waiting"))
    return {
        **vocabulary.release_data(release),
        "type": release.node.type,
        "domains": [release.domain.name],
        "connections": [],
        "requesters": list(requesters_of(claims)),
        "demands": [*dict.fromkeys(claim.demand for claim in claims)],
        **own,
        "seen": status.seen or None,
        "health": word,
        "since": time_data(since_of(status)),
        "failing": status.health.failing,
        "object": status.health.object or None,
        "reason": status.health.reason or None,
    }


def _connections(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    ledger, clients_of = source.active.ledger, defaultdict[str, list[str]](list)
    for name, release in source.releases.items():
        if not isinstance(release, ServiceRelease):
            for id in release.connections:
                clients_of[id].append(name)
    for id in ledger.subjects(SubjectKind.CONNECTION):
        if claims := ledger.connection_claims(id):  # that are not suspended
            yield id, (claims, _runs(source, clients_of[id]))


def _connection(source: Source, claims: tuple[Claim, ...], runs: Json) -> Json:
    entry = bookkeeping.connection_entry(claims)
    nodes = [entry["source"], entry["target"]]
    return {
        "name": claims[0].subject.id,
        **entry,
        "nodes": nodes,
        "domains": domains_of(source, nodes),
        "demands": [*dict.fromkeys(claim.demand for claim in claims)],
        **runs,
    }


def _asked_topics(topics: dict[str, list[str]], item: Json) -> list[str]:
    # a topic is followed by its requesters if the item has others too
    return [
        topic if who == item["requesters"] else f"{topic} ({', '.join(who)})"
        for topic, who in topics.items()
    ]


def _inputs(item: Json, now: datetime) -> list[str]:
    return [text for topics in item["inputs"].values() for text in _asked_topics(topics, item)]


def _versions(item: Json, now: datetime) -> list[str]:
    asked = item["versions_asked"].items()
    return [
        item["application_version"] or item["version"] or "",
        *(f"{version} requested by {', '.join(requesters)}" for version, requesters in asked),
    ]


# ---- where it runs, and by which rules: nodes, domains and application definitions ----


def _nodes(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    # those of the inventory and of claims, and what uses each, if only as a source of inputs
    running: defaultdict[str, list[str]] = defaultdict(list)
    for name, release in source.releases.items():
        running[release.node.id].append(name)
    needing: defaultdict[str, list[Claim]] = defaultdict(list)
    for claim in source.state.ledger:
        for id in nodes_of(claim):
            needing[id].append(claim)
    # A claim may need a node that a person removed from the inventory.
    for id in sorted({*source.config.kinds, *needing}):
        yield id, (id, needing[id], _runs(source, sorted(running[id])))


def _node(source: Source, id: str, claims: list[Claim], runs: Json) -> Json:
    node, domain = source.config.nodes.get(id), source.config.domain_of.get(id)
    gone_since = source.config.gone_since.get(source.config.host_of(id))
    state = "open" if node else "not in the inventory"
    if is_pattern(id):  # it stands for all nodes that it matches
        data = source.config.node_patterns[id.partition("@")[0]].data
        written = {name: data.get(name, ()) for name in ("type", "capabilities")}
        written["properties"] = data.get("properties", {})
        if any(is_pattern(text) for _, text in texts(data.get("position"))):
            written["position"] = None
        node = source.config.kinds[id].model_copy(update=written)
        state, possible = "pattern", source.config.domains_at(node)
        domain = possible[0] if len(possible) == 1 else None
    return {
        "name": id,
        "state": "gone" if gone_since else "drained" if node and node.drained else state,
        "type": node.type if node else None,
        "cluster": node.cluster if node else None,
        "domain": domain.name if domain else None,
        "file": source.config.file_of(NODES_FILE, source.config.host_of(id)) if node else None,
        "drained": bool(node and node.drained),
        "gone_since": time_data(gone_since),
        "capabilities": list(node.capabilities) if node else [],
        "properties": dict(node.properties) if node else {},
        "position": node.position.model_dump() if node and node.position else None,
        "releases": runs["releases"],
        **_subjects(claims),
        "demands": sorted({claim.demand for claim in claims}),
        "requesters": list(requesters_of(claims)),
        "health": runs["health"],
    }


def _domains(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    nodes: defaultdict[str, list[str]] = defaultdict(list)
    clusters: defaultdict[str, set[str]] = defaultdict(set)
    for node in sorted(source.config.kinds.values(), key=lambda node: node.id):
        for cluster, domain in source.config.places_of(node):
            nodes[domain.name].append(node.id)
            clusters[domain.name].add(cluster)
    for name, domain in sorted(source.config.domains.items()):
        item = {
            "name": name,
            "namespace": domain.namespace,
            "approval": domain.approval,
            "when_full": domain.when_full,
            "network": domain.network,
            "rules": len(domain.rules),
            "quotas": domain.quotas.model_dump(by_alias=True, exclude_none=True),
            "clusters": sorted(clusters[name]),
            "nodes": [*dict.fromkeys(nodes[name])],
            "file": source.config.file_of(DOMAINS_FILE, name),
        }
        yield name, (item,)


def _appdefs(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    held: defaultdict[str, list[str]] = defaultdict(list)
    ledger = source.state.ledger
    for id in ledger.subjects(SubjectKind.APPLICATION):
        if app := ledger.application(id):
            held[app.appdef].append(id)
    for name, services in sorted(source.config.services.items()):
        item = {
            "name": name,
            "services": sorted(services),
            "charts": sorted({service.chart for service in services.values()}),
            "applications": held[name],
            "file": f"appdefs/{name}/appdef.yaml",
        }
        yield name, (item,)


# ---- what people decide, and what happened: overrides, proposals and events ----


def _overrides(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for entry in source.overrides:
        item = {
            **vocabulary.override_data(entry.override),
            "state": entry.state,
            "releases": [vocabulary.release_data(release) for release in entry.releases],
            "claims": [claim_data(claim) for claim in entry.claims],
        }
        yield entry.override.name, (item,)


def _override_was(reader: Reader, entry: LogEntry, path: str) -> Json:
    text, name = reader.file_reader(f"{entry.commit}~1")(path) or "", path.rsplit("/", 1)[-1]
    try:
        file = parse_file(OverrideFile, text, path)
        return vocabulary.override_data(Override.from_file(name.removesuffix(".yaml"), file))
    except InvalidInput:  # it never was in effect
        return {}


def effect_texts(override: Json, *_: object) -> list[str]:
    texts = []
    for name, value in override["effects"].items():
        # of images and values their names, and `hold: true` without its value
        shown = ", ".join(value) if isinstance(value, dict) else value
        texts.append(name if value is True else f"{name} {shown}")
    return texts


def _affected(item: Json, now: datetime) -> list[str]:
    releases = dict.fromkeys(release["name"] for release in item["releases"])
    return [*releases, *dict.fromkeys(map(subject_text, item["claims"]))]


def _proposals(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for proposal in source.proposals:
        data, link = vocabulary.proposal_data(proposal), source.proposal_links.get(proposal.branch)
        yield proposal.branch, ({"name": proposal.branch, **data, "link": link},)


def _proposal_was(reader: Reader, entry: LogEntry, path: str) -> Json:
    # a rejection names the branch and the commit that was proposed
    commit = entry.first(REJECTS).partition(" ")[2] or entry.commit
    required = entry.trailers.get("Approval-Required-By", [])
    return {"commit": commit, "summary": entry.summary, "required_by": required}


def _events(source: Source) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for entry in islice(source.reader().log(source.commit), MOST_COMMITS):
        yield entry.commit, (event(entry),)


def event(entry: LogEntry) -> Json:
    return {"name": entry.commit, **vocabulary.commit_data(entry)}


def _told(commit: Json, now: datetime) -> str:
    decision = commit["decision"]
    return f"{commit['summary']}{f'; {vocabulary.decision_text(decision)}' if decision else ''}"


_NODE = Column("node", "Node", 3, links="node")
_VERSION = Column("version", "Version", 7, texts_of=_versions)
_CLUSTER = Column("cluster", "Cluster", 8)
_COMMIT = _text("commit", "Commit", 0, lambda item: item["commit"][:10])
_FOR = _text("applications", "For", 5, lambda item: item["applications"] or item["connections"])
_ENDS = replace(
    LEASE, title="Ends", rank=1, texts_of=lambda *lease: _lease_text(*lease).removeprefix("ends ")
)
_TERM = _text("term", "Term", 3, lambda item: duration_text(item["lease"]["seconds"]))
_REASON = _text(
    "reason", "Reason", 1, lambda item: ": ".join(filter(None, (item["object"], item["reason"])))
)
_TOPICS = _text(
    "topics", "Topics", 5, lambda item: _asked_topics(bookkeeping.carried_topics(item), item)
)
_SUSPENDED_BY = _text(
    "suspended_by",
    "Suspended by",
    4,
    lambda item: (item["suspended_by"] or {}).get("name", ""),
    "override",
)

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "demands",
            "What requesters hold, until they release it or its lease ends.",
            (
                *(_named("demand"), STATE, HEALTH, ENDED, REQUESTERS, HOLDS, LEASE, SINCE),
                *(_wide("requests", "Requests"), _wide("nodes", "Nodes", "node")),
                _wide("suspended_by", "Suspended by"),
            ),
            _demands,
            _demand,
            trailer="Demand-Id",
        ),
        Kind(
            "applications",
            "What is held, each once, however many demands hold it.",
            (
                *(_named("application"), STATE, HEALTH, ENDED, Column("appdef", "Type", 3)),
                *(Column("node", "Node", 4, links="node"), REQUESTERS),
                *(Column("version", "Version", 7), SINCE, _wide("demands", "Demands", "demand")),
                _wide("releases", "Releases", "release"),
            ),
            _applications,
            _application,
            lambda item: {"type": [item["appdef"] or ""]},
            trailer="Application",
        ),
        Kind(
            "releases",
            "Helm releases and the clients of connections, each shared by all who need it.",
            (
                *(_named("release"), HEALTH, ENDED, _REASON),
                *(_NODE, replace(REQUESTERS, rank=4), _FOR, SINCE, _VERSION, _CLUSTER),
                _text("seen", "Seen", 9, lambda item: (item["seen"] or "")[:10]),
            ),
            _releases,
            _release,
            files=commit_log.RELEASE_FILES,
            blank={"versions_asked": {}, "application_version": None, "object": None},
            was=_release_was,
        ),
        Kind(
            "services",
            "Releases of services, one for each service on a node, shared by all who need it.",
            (
                *(_named("release"), HEALTH, Column("service", "Service", 6), _NODE, REQUESTERS),
                _text("source", "For", 5, lambda item: item["source"] or item["applications"]),
                *(_VERSION, _CLUSTER, _wide("inputs", "Takes in", texts_of=_inputs)),
                _wide("parameters", "Parameters", texts_of=_pairs("parameters", " = ")),
            ),
            _services,
            _release,
            lambda item: {"release": [item["name"]]},
        ),
        Kind(
            "connections",
            "Topics that are carried from one node to another.",
            (
                *(_named("connection"), HEALTH, ENDED, Column("type", "Type", 4)),
                Column("source", "From", 2, links="node"),
                *(Column("target", "To", 2, links="node"), REQUESTERS),
                *(_TOPICS, _wide("releases", "Releases", "release")),
            ),
            _connections,
            _connection,
            lambda item: {
                "topic": bookkeeping.carried_topics(item),
                "from": [item["source"]],
                "to": [item["target"]],
            },
            trailer="Connection",
            blank={"topics": {}},
        ),
        Kind(
            "leases",
            "Demands that end unless their requester renews them. The first to end comes first.",
            (_named("demand"), _ENDS, REQUESTERS, _TERM, HOLDS),
            _leases,
            _demand,
            lambda item: {"demand": [item["name"]]},
        ),
        Kind(
            "nodes",
            "The machines of the inventory, and what needs each of them.",
            (
                *(_named("node"), STATE, HEALTH, Column("type", "Type", 3)),
                *(Column("domain", "Domain", 4), Column("cluster", "Cluster", 6)),
                _text("releases", "Releases", 5, lambda item: str(len(item["releases"]))),
                *(REQUESTERS, _wide("capabilities", "Capabilities")),
                _wide("properties", "Properties", texts_of=_pairs("properties", text=json.dumps)),
                _wide("file", "File"),
                Column("gone_since", "Gone since", 9, "time", only_wide=True),
            ),
            _nodes,
            _node,
        ),
        Kind(
            "requesters",
            "Who demands something, and what each holds.",
            (
                *(_named("requester"), STATE, HEALTH, ENDED),
                *(Column("demands", "Demands", 3, links="demand"), HOLDS, LEASE, SINCE),
                _wide("nodes", "Nodes", "node"),
            ),
            _requesters,
            _requester,
            trailer="Requester",
        ),
        Kind(
            "domains",
            "Access domains: nodes of one owner, and what the policy says about them.",
            (
                *(Column("name", "Domain"), Column("approval", "Approval", 2)),
                *(Column("when_full", "When full", 5), Column("namespace", "Namespace", 4)),
                *(Column("clusters", "Clusters", 3), Column("nodes", "Nodes", 1, links="node")),
                Column("rules", "Rules", 6),
                *(_wide("quotas", "Quotas", texts_of=_pairs("quotas")), _wide("file", "File")),
            ),
            _domains,
        ),
        Kind(
            "appdefs",
            "Application definitions: the types of application that can be demanded.",
            (
                *(Column("name", "Type"), Column("services", "Services", 1)),
                Column("applications", "Applications", 2, links="application"),
                *(Column("charts", "Charts", 3), _wide("file", "File")),
            ),
            _appdefs,
        ),
        Kind(
            "claims",
            "What one demand holds of one subject.",
            (
                *(Column("subject", "Subject", texts_of=_subject, links="held"), STATE, REQUESTERS),
                *(Column("demand", "Demand", 3, links="demand"), LEASE, SINCE, _SUSPENDED_BY),
                *(_wide("request", "Request"), _wide("file", "File")),
            ),
            _claims,
            claim_item,
            lambda item: {
                item["subject"]["kind"]: [item["subject"]["id"]],
                "kind": [item["subject"]["kind"]],
            },
        ),
        Kind(
            "overrides",
            "What runs otherwise than demanded, and why.",
            (
                *(_named("override"), STATE, ENDED),
                Column("effects", "Does", 2, texts_of=effect_texts),
                *(Column("until", "Until", 3, "time"), Column("owner", "Owner", 4)),
                *(Column("releases", "To", 5, texts_of=_affected), Column("reason", "Reason", 6)),
                _wide("priority", "Priority"),
                _command("End it", lambda item: ["demandops", "override", "end", item["name"]]),
            ),
            _overrides,
            labels=lambda item: {
                **{
                    key: [release[key] for release in item["releases"]]
                    for key in ("node", "domain", "cluster")
                },
                "release": [release["name"] for release in item["releases"]],
                "requester": [who for claim in item["claims"] for who in claim["requesters"]],
                "demand": [claim["demand"] for claim in item["claims"]],
            },
            files=f"{OVERRIDES_ROOT}/*.yaml",
            blank={"effects": {}, "releases": [], "claims": []},
            was=_override_was,
        ),
        Kind(
            "proposals",
            "Changes that a person approves by merging a branch, or refuses by deleting it.",
            (
                *(Column("name", "Branch"), _COMMIT, ENDED, REQUESTERS),
                *(Column("since", "Since", 3, "time"), Column("summary", "What", 1)),
                *(Column("required_by", "Required by", 4), Column("link", "Link", 5)),
                _wide("demands", "Demands", "demand"),
                _command("See", lambda item: ["git", "diff", f"origin/main...{item['commit']}"]),
                _command("Approve", lambda item: _decide(item, "approve")),
                _command("Refuse", lambda item: [*_decide(item, "reject"), "-m", "REASON"]),
            ),
            _proposals,
            trailer=PROPOSAL,
            was=_proposal_was,
        ),
        Kind(
            "events",
            "The newest commits, by demands, people and the generator.",
            (
                *(Column("time", "When", 0, "time"), _COMMIT),
                *(Column("summary", "What", 1, texts_of=_told), Column("who", "Who", 2)),
                Column("operation", "Operation", 3, only_wide=True),
                Column("author", "Author", 3, only_wide=True),
                _wide("request", "Request"),
            ),
            _events,
        ),
    )
}
