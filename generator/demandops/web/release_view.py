"""The views of one demand and of one release."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, StateRepoError
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION
from demandops.decide.decision import decide
from demandops.model.ledger.claim import requesters_of
from demandops.model.release import Release, ServiceRelease
from demandops.render.gitops import path_of
from demandops.repo.reader import Reader
from demandops.views import release_causes
from demandops.views.release_causes import how_to_release, is_released_by_demand_id
from demandops.views.source import WORDS, Source, since_of, word_of

# ---- the view of one demand ----


def explained_demand(now: Source, reader: Reader, id: str) -> dict[str, Any]:
    if not (claims := now.claims_of_demands.get(id)):
        waiting = now.state.ledger.waiting.values()
        is_waiting = any(demand.demand == id for demand in waiting)
        why = ", because it waits for room on a node" if is_waiting else ""
        raise StateRepoError(f"demand {quoted(id)} holds nothing{why}")
    requesters = requesters_of(claims)
    goal = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": "release",
        "demand": id,
        "requesters": list(requesters),
    }
    released, refused = None, ""
    try:
        read = reader.file_reader(now.commit)
        released = decide(now.state, goal, now.now, read)
    except InvalidInput as error:
        refused = str(error)
    return {
        "id": id,
        "claims": claims,
        "requesters": requesters,
        "releases": now.releases_of_demands.get(id, []),
        "how": how_to_release(claims[0]),
        # for `demandops request`
        "file": strict_yaml.dump(goal) if is_released_by_demand_id(claims[0]) else "",
        "released": released,  # what would change if it were released
        "refused": refused,  # why the generator would refuse that
    }


# ---- the view of one release ----


def explained_release(now: Source, reader: Reader, name: str) -> dict[str, Any]:
    release = now.releases.get(name)
    denied = None if release else release_causes.denied_release_named(now.state, name)
    planned = release or (denied[0] if denied else None)
    path = path_of(planned) if planned else None
    path = path or reader.release_path(name, now.commit)
    if path is None:
        raise StateRepoError(f"up to commit {now.commit[:10]}, there was no release {quoted(name)}")
    history = reader.history(path, now.commit, most=20)
    last = next(iter(history.newest), None) or history.started
    if history.stopped and not release:
        last = history.stopped
    difference: list[dict[str, str]] = []  # the sign is `@` at the head of a section, or empty
    if last:
        after, before = reader.file_reader(last.commit)(path) or "", ""
        with suppress(DemandOpsError):  # the first commit has no parent to compare with
            before = reader.file_reader(f"{last.commit}~1")(path) or ""
        lines = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=2)
        for line in list(lines)[2:]:  # without the two lines that name the files
            sign = line[:1].strip()
            difference.append({"sign": sign, "text": line if sign == "@" else line[1:]})
    status, claims = now.status(name), now.claims_of_releases.get(name, [])
    word = word_of(status) if release else "stopped"
    return {
        "name": name,
        "path": path,
        "release": release,  # None if it does not run
        "denied_by": denied[1] if denied else None,
        "status": status,
        "word": word,
        "tone": WORDS.get(word, "none"),
        "since": since_of(status),
        "claims": claims,
        "requesters": requesters_of(claims),
        "files": release_causes.shaping_files(release, now.config) if release else (),
        "overrides": release.shaping.by if release else (),
        "text": reader.file_reader(now.commit)(path) or "",
        "history": history,
        "last_change": last,
        "difference": difference,  # the newest change of the release's file
        # the other releases that the override stops which the page proposes for this one
        "stop_with_it": list(_others_stopped(now, release)) if release else [],
    }


def _others_stopped(now: Source, release: Release) -> Iterable[str]:
    for name, other in now.releases.items():
        if name == release.name:
            continue
        if isinstance(release, ServiceRelease):
            # it denies the service on its node, whatever the service runs for
            if isinstance(other, ServiceRelease) and (
                (other.key.service, other.node.id) == (release.key.service, release.node.id)
            ):
                yield name
        elif not isinstance(other, ServiceRelease) and (
            # it denies all connections that the client carries
            set(other.connections) <= set(release.connections)
        ):
            yield name
