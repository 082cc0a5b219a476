"""A model of leases and of demands in DemandOps' own format, written only from the docs.

It takes goals as the plain dicts that YAML gives, and imports nothing of the program. Where the
docs leave something open, a comment says what this model does. Times are whole seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Literal

Goal = dict[str, Any]
Outcome = Literal["booked", "released", "unchanged", "refused"]
Subject = tuple[str, str]
"""A subject: its kind (``applications`` or ``connections``) and its id."""

BY_MESSAGE = "by message: "
"""Begins the name of a demand by a ``DeploymentRequest`` goal."""

REPEATS_WITHIN_S = 15 * 60


def name_by_message(request: str, who: Iterable[str]) -> str:
    return f"{BY_MESSAGE}{request} {sorted(who)}"


@dataclass
class Held:
    """The hold of a demand on a subject.

    ``promised`` is the last renewal plus the lease of ``seconds``; ``holders``, ``request`` and
    ``booked`` belong to a ``DeploymentRequest`` goal.
    """

    what: dict[str, Any]
    requesters: frozenset[str]
    seconds: int | None = None
    promised: int | None = None
    request: str = ""
    holders: dict[str, frozenset[str]] = field(default_factory=dict)
    booked: int = 0

    def same(self, other: Held | None) -> bool:
        if other is None:
            return False
        mine = (self.what, self.requesters, self.seconds, self.holders)
        return mine == (other.what, other.requesters, other.seconds, other.holders)

    def holds(self) -> dict[str, dict[str, frozenset[str]]]:
        """Return who holds each topic of a connection: all, unless ``holders`` names some."""
        topics = self.what.get("topics")
        return {"holds": dict.fromkeys(topics, self.requesters) | self.holders} if topics else {}


@dataclass
class Promises:
    """Each demand's holds, which may go ``slack`` seconds after the end of their lease."""

    slack: int
    default: int | None = None
    held: dict[str, dict[Subject, Held]] = field(default_factory=dict)
    shutdowns: dict[tuple[str, frozenset[str], Subject, frozenset[str]], int] = field(
        default_factory=dict
    )

    def take(self, goal: Goal, now: int) -> Outcome:
        """Apply or refuse a goal as a whole.

        ``unchanged`` may be a renewal, which makes a commit only if the recorded end
        changes, which depends on the slack.
        """
        if goal.get("kind") == "Demand":
            return self._own(goal, now)
        return self._message(goal, now)

    # demands in our own format

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

    # DeploymentRequest goals: each has one connection; its id and requesters name the demand

    def _message(self, goal: Goal, now: int) -> Outcome:
        item = goal["connections"][0]
        who = frozenset(item["requester_ids"])
        subject = ("connections", item["id"])
        routes = dict(zip(item["source_topics"], item["target_topics"], strict=True))
        if goal.get("shutdown"):
            return self._shut_down(goal["id"], who, subject, frozenset(routes), now)
        ends = {"source": item["source_node_id"], "target": item["target_node_id"]}
        if self._contradicts("", subject, {**ends, "topics": routes}):
            return "refused"
        demand = name_by_message(goal["id"], who)
        was = self.held.get(demand, {}).get(subject, Held(ends | {"topics": {}}, frozenset()))
        holders = {one: was.holders.get(one, frozenset()) | who for one in routes}
        held = Held(
            ends | {"topics": was.what["topics"] | routes},
            was.requesters | who,
            request=goal["id"],
            holders=was.holders | holders,
            booked=now,
        )
        if held.same(was):
            return "unchanged"
        self.held.setdefault(demand, {})[subject] = held
        self.shutdowns = {one: at for one, at in self.shutdowns.items() if not one[1] & who}
        return "booked"

    def _shut_down(
        self, request: str, who: frozenset[str], subject: Subject, topics: frozenset[str], now: int
    ) -> Outcome:
        this = (request, who, subject, topics)
        if this in self.shutdowns and abs(now - self.shutdowns[this]) <= REPEATS_WITHIN_S:
            return "unchanged"
        own = name_by_message(request, who)
        around = [
            (name != own, held[subject].request != request, held[subject].booked, name)
            for name, held in self.held.items()
            if name.startswith(BY_MESSAGE) and subject in held
        ]
        names = [name for *_, name in sorted(around)]
        # no two requesters share a hold, so it does not matter whose holds are taken first
        taken = [self._take(names, one, subject, topics) for one in who]
        if not any(taken):
            return "refused"
        self.shutdowns[this] = now
        return "released"

    def _take(self, names: list[str], one: str, subject: Subject, topics: frozenset[str]) -> bool:
        theirs = [
            (name, held)
            for name in names
            if (held := self.held.get(name, {}).get(subject)) and one in held.requesters
        ]
        listed = topics or frozenset(*[held.holders for _, held in theirs[:1]])
        has_taken = False
        for topic in listed:
            holding = ((n, held) for n, held in theirs if one in held.holders.get(topic, ()))
            name, held = next(holding if topics else iter(theirs), ("", Held({}, frozenset())))
            if not name:
                continue
            has_taken = True
            held.holders[topic] -= {one}
            if not held.holders[topic]:
                del held.holders[topic], held.what["topics"][topic]
            held.requesters = frozenset().union(*held.holders.values())
            if not held.holders:
                self._drop(name, subject)
        return has_taken

    def _drop(self, demand: str, subject: Subject) -> None:
        del self.held[demand][subject]
        if not self.held[demand]:
            del self.held[demand]

    # time

    def may_go(self, now: int) -> set[tuple[str, Subject]]:
        """Return the holds whose leases are over at ``now``; the generator may release them."""
        return {
            (demand, subject)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
            if held.promised is not None and held.promised < now
        }

    def must_go(self, now: int) -> set[tuple[str, Subject]]:
        """Return the holds that a check must release at ``now``, because their slack is over."""
        return self.may_go(now - self.slack)

    def gone(self, released: Iterable[tuple[str, Subject]]) -> None:
        for demand, subject in released:
            self._drop(demand, subject)

    # the view

    def claims(self) -> dict[tuple[str, Subject], tuple[dict[str, Any], frozenset[str]]]:
        return {
            (demand, subject): (deepcopy(held.what) | held.holds(), held.requesters)
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
