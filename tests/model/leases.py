"""Demands that name themselves, and leases, once more: from what is promised alone.

Plain dicts over goals as they come in YAML; nothing of the program is imported. What a sentence
leaves open is said in a comment. Time is whole seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Literal

Goal = dict[str, Any]
Outcome = Literal["booked", "released", "unchanged", "refused"]
Subject = tuple[str, str]
"""``applications`` or ``connections``, and the id."""

BY_MESSAGE = "by message: "
"""Stands before the request id and requesters of a demand that the reference's goal makes."""


@dataclass
class Held:
    """What one demand holds on one subject, and until when that was promised.

    ``promised`` is the last renewal and the lease on top of it, nothing for one without an end;
    ``slack`` is how much later it may go.
    """

    what: dict[str, Any]
    requesters: frozenset[str]
    seconds: int | None
    promised: int | None

    def same(self, other: Held | None) -> bool:
        """Tell whether both are the same but for the time."""
        if other is None:
            return False
        mine = (self.what, self.requesters, self.seconds)
        return mine == (other.what, other.requesters, other.seconds)


@dataclass
class Promises:
    """Who holds what until when, by demand and subject."""

    slack: int
    default: int | None = None
    held: dict[str, dict[Subject, Held]] = field(default_factory=dict)

    def take(self, goal: Goal, now: int) -> Outcome:
        """Book, replace, release or renew as a whole, or refuse as a whole.

        ``unchanged`` covers a renewal that only moves what is promised: whether the record follows
        is left to the slack, so a commit may be made of it or not.
        """
        if goal.get("kind") == "Demand":
            return self._own(goal, now)
        return self._message(goal, now)

    # our own

    def _own(self, goal: Goal, now: int) -> Outcome:
        demand, who = goal["demand"], frozenset(goal["requesters"])
        standing = self.held.get(demand, {})
        owners = {one for held in standing.values() for one in held.requesters}
        operation = goal.get("operation", "put")
        if not who or (owners and not owners & who):
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

    # the reference's: connections alone, each in the same names, which make the demand

    def _message(self, goal: Goal, now: int) -> Outcome:
        item = goal["connections"][0]
        who = frozenset(item["requester_ids"])
        demand = f"{BY_MESSAGE}{goal['id']} {sorted(who)}"
        subject = ("connections", item["id"])
        routes = dict(zip(item["source_topics"], item["target_topics"], strict=True))
        what = {
            "source": item["source_node_id"], "target": item["target_node_id"], "topics": routes,
        }  # fmt: skip
        if goal.get("shutdown"):
            return self._shut_down(demand, who, subject, what)
        if self._contradicts("", subject, what):
            return "refused"
        mine = self.held.setdefault(demand, {})
        was = mine.get(subject)
        if was:
            what["topics"] = was.what["topics"] | routes
        mine[subject] = Held(what, who, None, None)
        return "unchanged" if mine[subject].same(was) else "booked"

    def _shut_down(
        self, demand: str, who: frozenset[str], subject: Subject, what: dict[str, Any]
    ) -> Outcome:
        around = {
            name: held[subject]
            for name, held in self.held.items()
            if subject in held
            and all(held[subject].what[end] == what[end] for end in ("source", "target"))
        }
        meant = [demand] if demand in around else []
        meant = meant or [name for name, held in around.items() if held.requesters == who]
        meant = meant or [name for name, held in around.items() if held.requesters > who]
        if len(meant) != 1:
            return "refused"
        held = around[meant[0]]
        rest = {one: two for one, two in held.what["topics"].items() if one not in what["topics"]}
        if rest and rest == held.what["topics"]:
            return "refused" if what["topics"] else self._drop(meant[0], subject)
        if not rest or not what["topics"]:
            return self._drop(meant[0], subject)
        held.what = held.what | {"topics": rest}
        return "released"

    def _drop(self, demand: str, subject: Subject) -> Outcome:
        del self.held[demand][subject]
        if not self.held[demand]:
            del self.held[demand]
        return "released"

    # time

    def may_go(self, now: int) -> set[tuple[str, Subject]]:
        """What may be released at ``now``: the last renewal and the lease are over."""
        return self._over(now)

    def must_go(self, now: int) -> set[tuple[str, Subject]]:
        """What must be released at a look at ``now``: the slack has passed as well."""
        return self._over(now - self.slack)

    def _over(self, now: int) -> set[tuple[str, Subject]]:
        return {
            (demand, subject)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
            if held.promised is not None and held.promised < now
        }

    def gone(self, released: Iterable[tuple[str, Subject]]) -> None:
        """Forget what was released at the end of its lease."""
        for demand, subject in released:
            self._drop(demand, subject)

    # the view

    def claims(self) -> dict[tuple[str, Subject], tuple[dict[str, Any], frozenset[str]]]:
        """Return what stands by demand and subject: what it is, and in whose name."""
        return {
            (demand, subject): (deepcopy(held.what), held.requesters)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
        }


def _subjects(goal: Goal) -> dict[Subject, dict[str, Any]]:
    """Return what a put lists; its maker lists no subject twice and leaves nothing to derive."""
    found: dict[Subject, dict[str, Any]] = {}
    for app in goal.get("applications", []):
        inputs = {
            role: frozenset((topic["source"], topic["topic"]) for topic in topics)
            for role, topics in app["inputs"].items()
        }
        what = {"type": app["type"], "node": app["node"], "inputs": inputs}
        what["parameters"] = dict(app.get("parameters", {}))
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
