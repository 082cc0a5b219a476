"""The view of one thing: what it is, why, what it holds, its time line, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from demandops.base import strict_yaml
from demandops.model.config.base_model import parse_time
from demandops.model.release import ServiceRelease
from demandops.views.source import WORDS, HealthChange, Source
from demandops.views.vocabulary import Json
from demandops.views.why import (
    commits_of,
    explain,
    find,
    is_released_by_demand_id,
    last_difference,
    release_of,
    stopped_with,
)

_TONES = WORDS | {
    **dict.fromkeys(("runs", "held", "used", "in force", "approved", "exists"), "good"),
    "kept": "none",
    **dict.fromkeys(("denied", "suspended", "rejected"), "bad"),
    **dict.fromkeys(
        ("waiting", "proposed", "overdue", "partly suspended", "not rendered yet"), "busy"
    ),
}
_MOST_COMMITS = 20


def thing(source: Source, name: str, kind: str, health: Iterable[HealthChange]) -> dict[str, Any]:
    answer = explain(source, find(source, name, kind or None), _MOST_COMMITS)
    kind, runs = answer["kind"], answer["state"] == "runs"
    word = answer["state"]
    if kind == "release" and runs:
        word = answer["health"] or "unknown"
    releases = {release["name"] for release in answer.get("releases", ())}
    data: dict[str, Any] = {
        "it": answer,
        "word": word,
        "tone": _TONES.get(word, "none"),
        "tones": _TONES,
        "time_line": _time_line(answer, releases | {answer["name"]}, health),
        "difference": last_difference(source, answer),
        "text": answer["file"] and source.reader().file_reader(source.commit)(answer["file"]),
        "released": None,
        "stopped_with": [],
        "denial": "",
    }
    if kind == "demand" and answer["claims"]:
        goal, released, refused = release_of(source, answer["name"])
        by_id = is_released_by_demand_id(source.claims_of_demands[answer["name"]][0])
        goal_text = strict_yaml.dump(goal) if by_id else ""
        data |= {"released": released, "refused": refused, "goal": goal_text}
    if kind == "release" and runs:
        release = source.releases[answer["name"]]
        if isinstance(release, ServiceRelease):
            selector = {"services": [release.key.service], "nodes": [release.node.id]}
        else:
            selector = {"connections": list(release.connections)}
        data["stopped_with"] = stopped_with(source, answer["name"])
        data["denial"] = strict_yaml.dump(
            {
                "apiVersion": "demandops/v1",
                "kind": "Override",
                "select": [selector],
                "deny": True,
                "owner": "your name or team",
                "reason": "why",
                "expires": f"{source.now:%Y-%m-%d}T23:59:59Z",
            }
        )
    return data


def _time_line(answer: Json, names: set[str], health: Iterable[HealthChange]) -> list[Json]:
    # the commits and the changes of health that touch it, newest first
    events = [
        {
            "time": parse_time(commit["time"]),
            "word": word,
            "who": commit["author"],
            "summary": commit["summary"],
            "why": commit["why"] or "",
            "decision": commit["decision"],
            "commit": commit["commit"],
        }
        for word, commit in commits_of(answer)
    ]
    for change in health:
        if change.release in names:
            reason = f": {change.reason}" if change.reason else ""
            summary = f"{change.release} was {change.before}, is {change.after}{reason}"
            event = {"time": change.time, "word": change.after, "summary": summary, "who": ""}
            events.append(event | {"why": "", "decision": None, "commit": ""})
    return sorted(events, key=lambda event: event["time"], reverse=True)
