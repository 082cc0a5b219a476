"""Why: one explanation of each kind of thing, with its past, for ``demandops why`` and the page.

:func:`find` says which thing a name means, also one that is gone, and :func:`explain` tells all
about it in the vocabulary of docs/json.md.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from demandops.base.errors import DemandOpsError, InvalidInput, StateRepoError, closest, suggestion
from demandops.base.naming import Subject, SubjectKind, object_name
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION
from demandops.decide.decision import Decision, decide
from demandops.decide.override_report import affected_releases
from demandops.decide.state import effect_on_pods
from demandops.decide.warnings import missing_inputs
from demandops.model.config.config import DOMAINS_FILE, IMAGES_FILE, NODES_FILE, Config
from demandops.model.config.override import SELECTED
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.records import waiting_path
from demandops.model.release import Release, ServiceRelease
from demandops.render.gitops import domain_folder, path_of
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry, PathHistory
from demandops.repo.history.commit_message import PROPOSAL, REJECTS
from demandops.repo.load import ledger_files
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import PendingProposal
from demandops.views import kinds, vocabulary
from demandops.views.kinds import effect_texts
from demandops.views.source import Source, by_booking
from demandops.views.vocabulary import Json

# ---- which thing a name means ----

# If several things have a name and nobody says which is meant, the first is. Only what has a file
# for each instance (a release, an application, a connection) must be told apart.
KINDS = (
    *("release", "application", "connection", "demand", "requester", "node"),
    *("override", "proposal", "appdef", "domain", "service"),
)
_TOLD_APART = KINDS[:3]
_MOST_LISTED = 8
# The trailer that names the thing in the commits that are about it.
_TRAILERS = {"demand": "Demand-Id", "requester": "Requester"}


@dataclass(frozen=True, slots=True)
class Thing:
    kind: str  # one of `KINDS`, `claim` or `file`
    name: str
    path: str = ""  # a file or folder whose history is the thing's
    also: tuple[str, ...] = ()  # the other kinds of things that have this name


def find(source: Source, name: str, kind: str | None = None) -> Thing:
    # only the history up to the commit of ``source`` counts
    if not name.strip():
        raise InvalidInput.at("NAME", "is empty; name a thing, such as a release or a demand")
    reader = source.reader()
    if name.startswith(("clusters/", "bootstrap/", f"{claim_files.LEDGER_ROOT}/")):
        return _by_path(source, reader, name.rstrip("/"))
    node = Thing("node", name)
    there = {each: path for each, path in _there(source, name) if kind in (None, each)}
    if not there:
        there = {each: path for each, path in _gone(source, reader, name) if kind in (None, each)}
    elif {*there} == {"node"} and not kind and _node(source, node)["state"] == "unused":
        # it may have the name of a requester that has left, which is then what is asked for
        gone = (each for each, _ in _gone(source, reader, name) if each == "requester")
        there |= dict.fromkeys(gone, "")
    several = [each for each in _TOLD_APART if each in there]
    if len(several) > 1:
        kinds = ", ".join(several)
        raise StateRepoError(
            f"{quoted(name)} names several things: {kinds}; choose one with --kind"
        )
    if there:
        first, *also = sorted(there, key=KINDS.index)
        return Thing(first, name, there[first], tuple(also))
    # a part of a release's name, or the start of a demand's id; what runs before what has ended
    running = sorted(release for release in source.releases if name in release)
    demands = sorted(id for id in _demands(source) if id.startswith(name))
    files = commit_log.RELEASE_FILES
    stopped = commit_log.removed_files(reader.objects, source.commit, files).values()
    ended = sorted({release for names in stopped for release in names})
    were = [release for release in ended if name in release]
    past = {id for entry in reader.log(source.commit) for id in entry.trailers.get("Demand-Id", ())}
    for each, names, what in (
        ("release", running, "releases have {} in their name"),
        ("demand", demands, "demand ids begin with {}"),
        ("release", were, "releases have {} in their name"),
        ("demand", sorted(id for id in past if id.startswith(name)), "demand ids begin with {}"),
    ):
        if kind in (None, each) and names:
            if len(names) > 1:
                listed = ", ".join(names[:_MOST_LISTED])
                more = ", …" if len(names) > _MOST_LISTED else ""
                raise StateRepoError(
                    f"{len(names)} {what.format(quoted(name))}; give a longer part: {listed}{more}"
                )
            return find(source, names[0], each)
    if "/" in name and _has_history(source, reader, name.rstrip("/")):
        return _by_path(source, reader, name.rstrip("/"))
    config, ledger = source.config, source.state.ledger
    if name in config.kinds or config.unlisted.why_not(name):
        raise StateRepoError(f"{quoted(name)} {config.why_no_node(name)}")
    known = {*source.releases, *ended, *_demands(source), *ledger.indexed_names("requester")}
    known |= {id for subject_kind in SubjectKind for id in ledger.subjects(subject_kind)}
    known |= {*config.nodes, *config.appdefs, *config.overrides, *config.domains}
    known |= {proposal.branch for proposal in source.proposals}
    parts = {part for running_name in source.releases for part in running_name.split("-")}
    close = closest(name, known | parts)  # a part of a release's name is also accepted
    known = {close} if close else known
    if kind is not None:
        remedy = "; leave out --kind" if close in (None, name) else suggestion(name, known)
        raise StateRepoError(f"no {kind} is called {quoted(name)}{remedy}")
    raise StateRepoError(
        f"nothing called {quoted(name)} runs or ran up to commit {source.commit[:10]}"
        f"{suggestion(name, known)}"
    )


def _demands(source: Source) -> set[str]:
    waiting = {*source.state.ledger.waiting}
    proposed = {id for proposal in source.proposals for id in proposal.demands}
    return source.state.ledger.indexed_names("demand") | waiting | proposed


def _there(source: Source, name: str) -> Iterator[tuple[str, str]]:
    # the kinds of things that have this whole name now, each with its path
    config, ledger = source.config, source.state.ledger
    denied = (release for release, _ in source.denied if release.name == name)
    if release := source.releases.get(name) or next(denied, None):
        yield "release", path_of(release)
    for subject in (Subject(kind, name) for kind in SubjectKind):
        if ledger.claims_on(subject):
            yield subject.kind.value[:-1], claim_files.folder_of(subject)
    requesters = {who for waiting in ledger.waiting.values() for who in waiting.requesters}
    requesters |= {who for proposal in source.proposals for who in proposal.requesters}
    proposed = {proposal.branch for proposal in source.proposals}
    node, domain = config.nodes.get(name), config.domain_of.get(name)
    of_services = {each: appdef for appdef, own in config.services.items() for each in own}
    override = config.overrides[name].path if name in config.overrides else None
    folder = f"{domain_folder(node.cluster, domain)}/" if node and domain else ""
    paths = {
        "demand": "" if name in _demands(source) else None,
        "requester": "" if name in requesters or ("requester", name) in ledger.index else None,
        "node": (folder and folder + object_name("", name)) if node else None,
        "override": "" if f"override/{name}" in proposed and not override else override,
        "proposal": "" if name in proposed else None,
        "appdef": f"appdefs/{name}/appdef.yaml" if name in config.appdefs else None,
        "domain": config.file_of(DOMAINS_FILE, name) if name in config.domains else None,
        "service": f"appdefs/{of_services[name]}/appdef.yaml" if name in of_services else None,
    }
    yield from ((kind, path) for kind, path in paths.items() if path is not None)


def _gone(source: Source, reader: Reader, name: str) -> Iterator[tuple[str, str]]:
    if path := commit_log.release_path(reader.objects, source.commit, name):
        yield "release", path
    for subject in (Subject(kind, name) for kind in SubjectKind):
        if _has_history(source, reader, folder := claim_files.folder_of(subject)):
            yield subject.kind.value[:-1], folder
    override = f"overrides/{name}.yaml"
    if _has_history(source, reader, override):
        yield "override", override
    for entry in reader.log(source.commit):
        named = [kind for kind, key in _TRAILERS.items() if name in entry.trailers.get(key, ())]
        if named or _is_about_proposal(entry, name):
            yield from ((kind, "") for kind in named or ("proposal",))
            return


def _is_about_proposal(entry: LogEntry, branch: str) -> bool:
    return entry.first(PROPOSAL) == branch or entry.first(REJECTS).partition(" ")[0] == branch


def _by_path(source: Source, reader: Reader, path: str) -> Thing:
    if (claim := ledger_files.claim_in(path, source.state.ledger)) is not None:
        return Thing("claim", claim.demand, path)
    name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
    if (release := source.releases.get(name)) and path_of(release) == path:
        return Thing("release", name, path)
    text = reader.file_reader(source.commit)(path)
    if text is None and not _has_history(source, reader, path):
        raise StateRepoError(
            f"{quoted(path)} is not in the state repo at commit {source.commit[:10]} and "
            "never was before; correct the path"
        )
    if text is not None or not path.startswith(("clusters/", "ledger/")):
        return Thing("file", path, path)
    return Thing("claim" if claim_files.kind_of(path) else "release", name, path)


def _has_history(source: Source, reader: Reader, path: str) -> bool:
    history = reader.history(path, source.commit, 0)
    return bool(history.started or history.stopped)


# ---- all about one thing ----


def explain(source: Source, thing: Thing, most: int = 10) -> Json:
    """Return all about a thing, with at most so many of the commits that changed it."""
    reader = source.reader()
    answer: Json = {
        "commit": source.commit,
        "kind": thing.kind,
        "name": thing.name,
        "also": list(thing.also),
        "file": thing.path or None,
        "proposals": [vocabulary.proposal_data(proposal) for proposal in _proposals(source, thing)],
        **_EXPLAINED[thing.kind](source, thing),
        **_past(source, reader, thing, most),
    }
    if thing.kind == "file" and answer["stopped"]:
        answer["state"] = "gone"
    if answer["state"] == "gone" and answer["proposals"]:
        answer["state"] = "proposed"
    last = answer["stopped"] or answer["started"]
    if answer["state"] == "gone" and last and last["decision"]:
        answer["state"] = last["decision"]["outcome"]
    answer["runs"] = answer["state"] in _RUNNING
    files = {claim["file"] for claim in answer.get("claims", ())}
    lacking = missing_inputs(source.state) if files else ()
    reasons = (str(missing) for missing in lacking if missing.file in files)
    answer["missing_inputs"] = list(dict.fromkeys(reasons))
    files = {thing.path, *(release["file"] for release in answer.get("releases", ()))}
    answer["not_rendered"] = sorted(files & source.not_rendered) if source.is_newest else []
    return answer


# The states in which a thing has an effect now
_RUNNING = (
    *("runs", "held", "kept", "overdue", "partly suspended"),
    *("used", "in force", "not rendered yet"),
)


def _proposals(source: Source, thing: Thing) -> Iterator[PendingProposal]:
    for each in source.proposals:
        named = {"demand": each.demands, "requester": each.requesters, "proposal": (each.branch,)}
        override = each.branch.removeprefix("override/")
        if thing.name in (named | {"override": (override,)}).get(thing.kind, ()):
            yield each


def _release(source: Source, thing: Thing) -> Json:
    if release := source.releases.get(thing.name):
        return {
            **kinds.release_of(source, release),
            **_held(source, source.claims_of_releases[thing.name], ()),
            "state": "runs",
            "shaped_by": [
                {"file": file, "entry": entry or None, "what": what}
                for file, entry, what in shaping_files(release, source.config)
            ],
            "overrides": [vocabulary.override_data(*each) for each in release.shaping.by],
        }
    for release, override in source.denied:
        if release.name == thing.name:
            denied = vocabulary.override_data(override, ("deny",))
            return {"state": "denied", **vocabulary.place_data(release), "denied_by": denied}
    return {"state": "gone"}


def shaping_files(release: Release, config: Config) -> list[tuple[str, str, str]]:
    # (file, entry, what it decides) for all that shapes a release but overrides
    images = {name: config.images[name] for name in release.images if name in config.images}
    if isinstance(release, ServiceRelease):
        pins = release.version.images
        images |= {name: pins[name].over(images[name]) for name in images if name in pins}
    node, domain, file_of = release.node, release.domain, config.file_of
    return [
        (ROOT_FILE, "gitops", f"written for {config.repo_settings.gitops}"),
        *release.shaping_entries(config),
        *(
            (file_of(IMAGES_FILE, name), f"images.{name}", image.reference())
            for name, image in images.items()
        ),
        (file_of(NODES_FILE, node.id), node.id, f"in cluster {node.cluster}"),
        (file_of(DOMAINS_FILE, domain.name), domain.name, f"namespace {domain.namespace}"),
    ]


def _subject(source: Source, thing: Thing) -> Json:
    subject = Subject(SubjectKind(f"{thing.kind}s"), thing.name)
    claims = by_booking(source.state.ledger.claims_on(subject))
    what = str(subject)
    if claims and not claims[0].is_on_application:
        connection = claims[0].connection
        word = connection.type.word.upper() if connection.type else ""
        what = f"{word} {what} from {connection.source} to {connection.target}".lstrip()
    held = _held(source, claims)
    state = "runs" if held["state"] == "held" else held["state"]
    return {**held, "state": state, "what": what, "subject": vocabulary.subject_data(subject)}


def _demand(source: Source, thing: Thing) -> Json:
    name = thing.name
    answer = _held(source, source.state.ledger.claims_with("demand", name))
    answer["what"] = f"demand '{name}'"
    if waiting := source.state.ledger.waiting.get(name):
        answer |= {"state": "waiting", "requesters": list(waiting.requesters)}
        answer |= {"file": waiting_path(name), "since": vocabulary.time_data(waiting.since)}
    return answer


def _requester(source: Source, thing: Thing) -> Json:
    name, ledger = thing.name, source.state.ledger
    answer = _held(source, ledger.claims_with("requester", name))
    answer["what"] = f"requester '{name}'"
    waits = {each.demand for each in ledger.waiting.values() if name in each.requesters}
    if waits and answer["state"] == "gone":
        answer["state"] = "waiting"
    return answer | {"demands": sorted({*waits, *(claim["demand"] for claim in answer["claims"])})}


def _claim(source: Source, thing: Thing) -> Json:
    claim = ledger_files.claim_in(thing.path, source.state.ledger)
    if claim is None:
        return {"state": "gone"}
    of_claim = {"what": str(claim.subject), "subject": vocabulary.subject_data(claim.subject)}
    return _held(source, [claim]) | of_claim


def _node(source: Source, thing: Thing) -> Json:
    node, domain = source.config.nodes.get(thing.name), source.config.domain_of.get(thing.name)
    running = (release for release in source.releases.values() if release.node.id == thing.name)
    claims = _claims_where(source, lambda claim: claim.held.needs(thing.name))
    held = _held(source, claims, running)
    what = "not in the inventory"
    if node:
        since = source.config.gone_since.get(source.config.host_of(thing.name))
        drained = ", drained" if node.drained else ""
        drained = f", gone since {since:%Y-%m-%d %H:%M:%S} UTC" if since else drained
        what = f"{node.type} in cluster {node.cluster}, access domain "
        what += f"{domain.name if domain else 'none'}{drained}"
        listed = source.config.file_of(NODES_FILE, thing.name)
        held["shaped_by"] = [{"file": listed, "entry": thing.name, "what": what}]
    return _used(held | {"what": what})


def _override(source: Source, thing: Thing) -> Json:
    entry = next((e for e in source.overrides if e.override.name == thing.name), None)
    if entry is None:
        return {"state": "gone"}
    data = vocabulary.override_data(entry.override)
    held = _held(source, [*entry.claims], affected_releases(entry, source.state))
    what = f"{', '.join(effect_texts(data))}, of {data['owner']}: {data['reason']}"
    return {**held, "state": entry.state, "what": what}


def _proposal(source: Source, thing: Thing) -> Json:
    proposal = next(_proposals(source, thing), None)
    return {"state": "proposed", "what": proposal.summary} if proposal else {"state": "gone"}


def _appdef(source: Source, thing: Thing) -> Json:
    held = _held(source, source.state.ledger.claims_with("definition", thing.name))
    return _used(held | {"what": source.config.appdefs[thing.name].description})


def _domain(source: Source, thing: Thing) -> Json:
    domain, of_node = source.config.domains[thing.name], source.config.domain_of
    nodes = sorted(id for id, each in of_node.items() if each.name == thing.name)
    approval = ", approval required" if domain.approval == "required" else ""
    held = _held(source, _claims_where(source, lambda claim: claim.held.home in nodes))
    what = f"namespace {domain.namespace}, {len(nodes)} nodes{approval}"
    return _used(held | {"what": what, "nodes": nodes})


def _service(source: Source, thing: Thing) -> Json:
    running = [
        release
        for release in source.releases.values()
        if isinstance(release, ServiceRelease) and release.key.service == thing.name
    ]
    claims = {id(c): c for each in running for c in source.claims_of_releases[each.name]}
    held = _held(source, by_booking(claims.values()), running)
    return _used(held | {"what": f"a service of {thing.path}"})


def _used(answer: Json) -> Json:
    return answer | {"state": "used" if answer["claims"] or answer["releases"] else "unused"}


_EXPLAINED: dict[str, Callable[[Source, Thing], Json]] = {
    **{"release": _release, "application": _subject, "connection": _subject, "demand": _demand},
    **{"requester": _requester, "claim": _claim, "node": _node, "override": _override},
    **{"proposal": _proposal, "appdef": _appdef, "domain": _domain, "service": _service},
    "file": lambda source, thing: {"state": "exists"},
}


def _claims_where(source: Source, is_meant: Callable[[Claim], bool]) -> list[Claim]:
    claims = filter(is_meant, source.state.ledger)
    return sorted(claims, key=lambda claim: (str(claim.subject), claim.demand))


def _held(source: Source, claims: Sequence[Claim], needed: Iterable[Release] | None = None) -> Json:
    """Return the claims and releases of a thing; by default the releases that the claims need."""
    if needed is None:
        keys, behind = {claim.key for claim in claims}, source.claims_of_releases.items()
        names = (name for name, own in behind if any(claim.key in keys for claim in own))
        needed = map(source.releases.__getitem__, names)
    return {
        "state": kinds.state_of(source, claims) if claims else "gone",
        "requesters": list(requesters_of(claims)),
        "claims": [kinds.claim_item(source, c, kinds.state_of(source, [c])) for c in claims],
        "releases": [kinds.release_of(source, r) for r in sorted(needed, key=lambda r: r.name)],
    }


# ---- the past ----


def _past(source: Source, reader: Reader, thing: Thing, most: int) -> Json:
    history = PathHistory(None, (), 0, None)
    if thing.kind in _TRAILERS or thing.kind == "proposal":
        key = _TRAILERS.get(thing.kind, "")
        about = [
            entry
            for entry in reader.log(source.commit)  # newest first
            if thing.name in entry.trailers.get(key, ()) or _is_about_proposal(entry, thing.name)
        ]
        there = {kind for kind, _ in _there(source, thing.name)}
        stopped = about.pop(0) if about and thing.kind not in there else None
        # else the history was made anew, or it never was on main; a rejection starts nothing
        started = next((each for each in reversed(about) if REJECTS not in each.trailers), None)
        about = [each for each in about if each is not started]
        more = max(len(about) - most, 0)
        history = PathHistory(started, tuple(about[:most]), more, stopped)
    elif thing.path:
        history = reader.history(thing.path, source.commit, most)
    if thing.kind in SELECTED:
        log, listed = reader.log(source.commit), {entry.commit for entry in history.newest}
        edits = (entry for entry in log if reader.edits(entry, thing.kind, thing.name))
        newest = [*history.newest, *(entry for entry in edits if entry.commit not in listed)]
        newest.sort(key=lambda entry: entry.time, reverse=True)
        more = history.more + max(len(newest) - most, 0)
        history = replace(history, newest=tuple(newest[:most]), more=more)

    def row(entry: LogEntry | None) -> Json | None:
        if entry is None:
            return None
        behind = reader.person_commits_behind(entry, most=5)
        return vocabulary.commit_data(entry) | {
            "carries_out": [vocabulary.commit_data(commit) for commit in behind]
        }

    return {
        "started": row(history.started),
        "changes": [row(entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": row(history.stopped),
    }


def commits_of(answer: Json) -> list[tuple[str, Json]]:
    """Return the commits of an explanation with what each did, newest first."""
    commits = [("stopped", answer["stopped"]), *(("changed", each) for each in answer["changes"])]
    return [(word, each) for word, each in (*commits, ("started", answer["started"])) if each]


def last_difference(source: Source, answer: Json) -> tuple[list[Json], str]:
    """Return the lines that the newest change of a thing's file added, removed and kept.

    The sign of a line is ``+``, ``-``, ``@`` at the head of a section, or empty. With them, what
    the change did to the pods of a release that runs.
    """
    if not answer["file"] or not (commits := commits_of(answer)):
        return [], ""
    reader, last = source.reader(), commits[0][1]["commit"]
    after, before = reader.file_reader(last)(answer["file"]) or "", ""
    with suppress(DemandOpsError):  # the first commit has no parent to compare with
        before = reader.file_reader(f"{last}~1")(answer["file"]) or ""
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=2)
    release = source.releases.get(answer["name"]) if answer["kind"] == "release" else None
    shown = [
        {"sign": (sign := line[:1].strip()), "text": line if sign == "@" else line[1:]}
        for line in list(lines)[2:]  # without the two lines that name the files
    ]
    return shown, effect_on_pods(release, release, before or None, after) if release else ""


# ---- what would follow ----


def release_of(source: Source, demand: str) -> tuple[Decision | None, str]:
    """Return what would follow from the release of a demand, or why it would be refused."""
    goal = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": "release",
        "demand": demand,
        "requesters": list(requesters_of(source.claims_of_demands[demand])),
    }
    try:
        read = source.reader().file_reader(source.commit)
        return decide(source.state, goal, source.now, read), ""
    except InvalidInput as error:
        return None, str(error)


def stopped_with(source: Source, name: str) -> list[str]:
    """Return the other releases that an override stops which denies this one."""
    release = source.releases[name]

    def service_of(each: Release) -> tuple[str, ...]:
        return (each.key.service, each.node.id) if isinstance(each, ServiceRelease) else ()

    def is_stopped(other: Release) -> bool:
        if isinstance(release, ServiceRelease) or isinstance(other, ServiceRelease):
            # it denies the service on its node, for whatever
            return service_of(other) == service_of(release)
        return {*other.connections} <= {*release.connections}  # it denies all that a client carries

    others = (other for other in source.releases.values() if other.name != name)
    return [other.name for other in others if is_stopped(other)]
