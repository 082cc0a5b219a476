"""A model of leases and of demands in DemandOps' own format, written only from the docs.

It takes goals as the plain dicts that YAML gives, and imports nothing of the program. Where the
docs leave something open, a comment says what this model does. Times are whole seconds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Literal

Goal = dict[str, Any]
Outcome = Literal["booked", "released", "unchanged", "refused"]
Subject = tuple[str, str]
"""A subject: its kind (``applications`` or ``connections``) and its id."""

BY_MESSAGE = "by message: "
"""Begins the name of a demand by a ``DeploymentRequest`` goal."""


def name_by_message(request: str, who: Iterable[str]) -> str:
    return f"{BY_MESSAGE}{request} {sorted(who)}"


@dataclass
class Held:
    """The claim of a demand on a subject; ``promised`` is the last renewal plus ``seconds``."""

    what: dict[str, Any]
    requesters: frozenset[str]
    seconds: int | None = None
    promised: int | None = None

    def same(self, other: Held | None) -> bool:
        if other is None:
            return False
        mine = (self.what, self.requesters, self.seconds)
        return mine == (other.what, other.requesters, other.seconds)


@dataclass
class Promises:
    """Each demand's claims, which may go ``slack`` seconds after the end of their lease."""

    slack: int
    default: int | None = None
    held: dict[str, dict[Subject, Held]] = field(default_factory=dict)

    def take(self, goal: Goal, now: int) -> Outcome:
        """Apply or refuse a goal as a whole.

        ``unchanged`` may be a renewal, which makes a commit only if the recorded end
        changes, which depends on the slack.
        """
        if goal.get("kind") == "Demand":
            return self._own(goal, now)
        return self._message(goal)

    # demands in our own format

    def _own(self, goal: Goal, now: int) -> Outcome:
        demand, who = goal["demand"], frozenset(goal["requesters"])
        standing = self.held.get(demand, {})
        operation = goal.get("operation", "put")
        if not who or any(held.requesters != who for held in standing.values()):
            return "refused"
        if operation == "put":
            return self._put(demand, who, goal, now)
        if not standing:
            return "refused"
        if operation == "release":
            del self.held[demand]
            return "released"
        for held in standing.values():
            if held.seconds is not None:
                held.promised = max(held.promised or 0, now + held.seconds)
        return "unchanged"

    def _put(self, demand: str, who: frozenset[str], goal: Goal, now: int) -> Outcome:
        wanted = _subjects(goal)
        if not wanted:
            return "refused"
        if any(self._contradicts(demand, subject, what) for subject, what in wanted.items()):
            return "refused"
        before = self.held.get(demand, {})
        seconds = goal.get("lease", self.default)
        after = {}
        for subject, what in wanted.items():
            held = Held(what, who, seconds, None if seconds is None else now + seconds)
            was = before.get(subject)
            if was and was.promised and held.promised:
                # a shorter lease does not take back what was promised before
                held.promised = max(held.promised, was.promised)
            after[subject] = held
        self.held[demand] = after
        same = before.keys() == after.keys() and all(
            held.same(before[subject]) for subject, held in after.items()
        )
        return "unchanged" if same else "booked"

    def _contradicts(self, demand: str, subject: Subject, what: dict[str, Any]) -> bool:
        fixed = ("type", "node") if subject[0] == "applications" else ("source", "target")
        for name, subjects in self.held.items():
            other = subjects.get(subject)
            if name == demand or other is None:
                continue
            if any(other.what[key] != what[key] for key in fixed):
                return True
            routes = other.what.get("topics", {})
            if any(routes.get(one, two) != two for one, two in what.get("topics", {}).items()):
                return True
        return False

    # DeploymentRequest goals: each has one connection; its id and requesters name the demand

    def _message(self, goal: Goal) -> Outcome:
        item = goal["connections"][0]
        who = frozenset(item["requester_ids"])
        subject = ("connections", item["id"])
        routes = dict(zip(item["source_topics"], item["target_topics"], strict=True))
        if goal.get("shutdown"):
            return self._shut_down(name_by_message(goal["id"], who), subject, routes)
        ends = {"source": item["source_node_id"], "target": item["target_node_id"]}
        if self._contradicts("", subject, {**ends, "topics": routes}):
            return "refused"
        demand = name_by_message(goal["id"], who)
        was = self.held.get(demand, {}).get(subject, Held(ends | {"topics": {}}, who))
        held = Held(ends | {"topics": was.what["topics"] | routes}, who)
        if held.same(was):
            return "unchanged"
        self.held.setdefault(demand, {})[subject] = held
        return "booked"

    def _shut_down(self, demand: str, subject: Subject, topics: Collection[str]) -> Outcome:
        held = self.held.get(demand, {}).get(subject)
        if held is None:
            return "refused"
        routes = held.what["topics"]
        left = {one: to for one, to in routes.items() if topics and one not in topics}
        if left == routes:
            return "refused"
        held.what["topics"] = left
        if not left:
            self._drop(demand, subject)
        return "released"

    def _drop(self, demand: str, subject: Subject) -> None:
        del self.held[demand][subject]
        if not self.held[demand]:
            del self.held[demand]

    # time

    def may_go(self, now: int) -> set[tuple[str, Subject]]:
        """Return the claims whose leases are over at ``now``; the generator may release them."""
        return {
            (demand, subject)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
            if held.promised is not None and held.promised < now
        }

    def must_go(self, now: int) -> set[tuple[str, Subject]]:
        """Return the claims that a check must release at ``now``, because their slack is over."""
        return self.may_go(now - self.slack)

    def gone(self, released: Iterable[tuple[str, Subject]]) -> None:
        for demand, subject in released:
            self._drop(demand, subject)

    # the view

    def claims(self) -> dict[tuple[str, Subject], tuple[dict[str, Any], frozenset[str]]]:
        return {
            (demand, subject): (deepcopy(held.what), held.requesters)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
        }


def _subjects(goal: Goal) -> dict[Subject, dict[str, Any]]:
    """Return what a put demands of each subject; no connections are derived."""
    found: dict[Subject, dict[str, Any]] = {}
    for app in goal.get("applications", []):
        inputs = {
            role: frozenset((topic["source"], topic["topic"]) for topic in topics)
            for role, topics in app["inputs"].items()
        }
        what = {"type": app["type"], "node": app["node"], "inputs": inputs}
        what["parameters"] = dict(app.get("parameters", {}))
        what |= {"version": app["version"]} if app.get("version") else {}
        found["applications", app["id"]] = what
    for connection in goal.get("connections", []):
        found["connections", connection["id"]] = {
            "source": connection["source"],
            "target": connection["target"],
            "topics": {
                route["source"]: route.get("target", route["source"])
                for route in connection["topics"]
            },
        }
    return found
