"""The vocabulary of docs/json.md: what rows and JSON call the parts of each thing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime
from typing import Any

from demandops.base.naming import Subject
from demandops.model.config.base_model import plain
from demandops.model.config.override import Override, format_time
from demandops.model.demand.demand import Lease
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim
from demandops.model.release import Release
from demandops.render.gitops import path_of
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.write.proposal_branch import PendingProposal

Json = dict[str, Any]


def time_data(moment: datetime | None) -> str | None:
    return format_time(moment) if moment else None


def time_text(time: str) -> str:
    return f"{time[:19].rstrip('Z').replace('T', ' ')} UTC"


def subject_data(subject: Subject) -> Json:
    return {"kind": subject.kind.value[:-1], "id": subject.id}


def subject_text(item: Json) -> str:
    return "{kind} {id}".format(**item["subject"])


def lease_data(lease: Lease | None) -> Json | None:
    if lease is None:
        return None
    return {
        "seconds": lease.seconds,
        "slack": lease.slack,
        "until": time_data(lease.until) if lease.has_started else None,
    }


def claim_data(claim: Claim) -> Json:
    app = claim.application if claim.is_on_application else None
    return {
        "subject": subject_data(claim.subject),
        "demand": claim.demand,
        "request": claim.request,
        "version": (app and app.version) or None,
        "place": plain(app.place) if app and app.place else None,
        "services": dict(sorted(app.services.items())) if app and app.services else None,
        "reads": {id: [*outputs] for id, outputs in app.read_outputs.items()} if app else {},
        "held_for": {id: [*outputs] for id, outputs in app.held_for.items()} if app else {},
        "requesters": list(claim.requesters),
        "since": time_data(claim.booked),
        "lease": lease_data(claim.lease),
        "file": claim_files.path_of(claim.key),
    }


def place_data(release: Release) -> Json:
    return {
        "what": release.description,
        "cluster": release.node.cluster,
        "domain": release.domain.name,
        "namespace": release.domain.namespace,
        "node": release.node.id,
    }


def release_data(release: Release) -> Json:
    return {"name": release.name, **place_data(release), "file": path_of(release)}


def override_data(override: Override, effects: Iterable[str] | None = None) -> Json:
    names, written = override.effects() if effects is None else effects, plain(override)
    return {
        "name": override.name,
        "file": override.path,
        "effects": {name: written[name] for name in names},
        "priority": override.priority,
        "owner": override.owner,
        "until": time_data(override.end),
        "reason": override.reason,
    }


def proposal_data(proposal: PendingProposal) -> Json:
    return asdict(proposal) | {"since": time_data(proposal.since)}


def decision_text(decision: Json) -> str:
    unnamed = ", by whom Git does not say," if decision["outcome"] == "approved" else ""
    who = f" by {decision['by']}" if decision["by"] else unnamed
    reason = f": {decision['reason']}" if decision["reason"] else ""
    return f"{decision['outcome']}{who} at {time_text(decision['time'])}{reason}"


def commit_data(entry: LogEntry) -> Json:
    answer, requesters = entry.answer, entry.trailers.get("Requester", [])
    who = ", ".join(requesters) or entry.author
    if requesters and entry.by_person:  # a person did it to what others hold
        who = f"{entry.author}, for {who}"
    return {
        "commit": entry.commit,
        "time": time_data(entry.time),
        "author": entry.author,
        "who": who,
        "summary": entry.summary,
        "why": entry.why or None,
        "operation": entry.first("Operation") or None,
        "operation_id": entry.first("Operation-Id") or None,
        "request": entry.first("Request-Id") or None,
        "demands": entry.trailers.get("Demand-Id", []),
        "requesters": requesters,
        "applications": entry.trailers.get("Application", []),
        "connections": entry.trailers.get("Connection", []),
        "render_version": entry.first("Render-Version") or None,
        "decision": asdict(answer) | {"time": time_data(answer.time)} if answer else None,
    }
