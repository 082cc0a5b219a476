"""Check a history: the model must allow each commit on main and each answer."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

import pygit2
from demandops.base.errors import InvalidInput, ShuttingDown, TurnedDown, Withdrawn
from demandops.model.config.discovered import DISCOVERED_ROOT
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim
from demandops.repo import verification
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import MAIN
from demandops.repo.history.commit_log import entry_of
from demandops.repo.history.commit_message import PROPOSAL
from demandops.serve.journal import Ticket

from tests.kit import plain_yaml
from tests.model import books, view
from tests.model.goals import SKELETON
from tests.model.listed import Goal, Subject
from tests.model.running import FURTHER, NEXT, Link, Override, Running, Service
from tests.simulation.world import RACK, Machine, World

SLACK_S = 30
PLACES = frozenset({"rack0", RACK})
"""The nodes for demands that name no node; each of these nodes has room for one application."""
VISITOR = "visitor"
"""A requester whose id starts with this needs approval for its demands."""


@dataclass(eq=False)
class Asked:
    """A demand that was sent to a machine when main had ``place`` commits.

    ``time`` is monotonic for our own format, and by the wall clock for a goal of the reference.
    """

    goal: Goal
    machine: Machine
    ticket: Ticket
    time: float
    place: int
    number: int
    is_answered: bool = False
    is_lost: bool = False
    is_withdrawn: bool = False
    is_asked_back: bool = False
    must_resume: bool = False
    """Whether a stop left it to the next start."""

    @property
    def is_under_way(self) -> bool:
        return not (self.is_answered or self.is_lost or self.machine.generator is None)

    @property
    def needs_approval(self) -> bool:
        return any(name.startswith(VISITOR) for name in self.goal.get("requesters", ()))

    @property
    def subjects(self) -> set[Subject]:
        """Return its subjects; demands that share one are booked in the order of sending."""
        found = {("demand", self.goal["demand"])} if "demand" in self.goal else set()
        kinds = ("applications", "connections")
        return found | {(kind, each["id"]) for kind in kinds for each in self.goal.get(kind, ())}


class Oracle:
    def __init__(self, world: World) -> None:
        self.world = world
        self.asked: dict[str, Asked] = {}
        self.edits: dict[str, Callable[[Running], object]] = {}
        """The change that a person's commit makes in the model, by the commit's id."""
        self.approved: set[str] = set()
        self.decided: set[str] = set()
        self.counts = Counter[str]()
        self._seen = world.tip
        # until a generator has seen the cluster, nothing can be placed on its node
        self.books = Running(SKELETON, nodes=PLACES, drained=frozenset({RACK}))
        self._ended: set[Override] = set()
        self._pushed_at = world.turns.monotonic()
        """When the oracle last found a new tip of main."""
        self._models = [pickle.dumps(self.books)]
        """The pickled model after each commit of main; copying the model takes ten times longer."""
        self._place: dict[str, int] = {}
        self._commit: dict[str, str] = {}
        self._parsed: dict[pygit2.Oid, Claim] = {}
        self._last: dict[Any, int] = {}
        self._claims: dict[view.Key, view.Content] = {}
        world.on_start = self._check_resumed
        world.on_push = lambda: self._guard(self._follow_main)

    def ask(self, machine: Machine, goal: Goal) -> Asked:
        turns = self.world.turns
        turns.pass_(0.001)
        assert machine.generator is not None
        ticket = machine.generator.submit(goal)
        is_ours = goal.get("kind") == "Demand"
        time = turns.monotonic() if is_ours else ticket.received.timestamp()
        place, number = len(self._models) - 1, len(self.asked)
        asked = Asked(goal, machine, ticket, time, place, number)
        self.asked[ticket.operation] = asked
        self._watch(asked)
        return asked

    def withdraw(self, asked: Asked) -> None:
        assert asked.machine.generator is not None
        asked.is_asked_back = True  # its answer comes before the call returns
        asked.is_withdrawn |= asked.machine.generator.withdraw(asked.ticket.operation)
        asked.is_asked_back = False
        if asked.ticket.future.done() and not (asked.is_withdrawn or asked.needs_approval):
            assert not isinstance(asked.ticket.future.exception(), Withdrawn), "nobody did"

    def check(self) -> None:
        self._guard(self._follow_main)
        if self.world.failure is not None:
            raise self.world.failure

    def claims(self, revision: str = MAIN) -> dict[str, Claim]:
        commit = self.world.remote.revparse_single(revision).id
        tree = trees.commit_of(self.world.remote, commit).tree
        found = {}
        for path, blob in trees.blobs(tree, ["ledger"]):
            if claim_files.kind_of(path):
                if blob.id not in self._parsed:
                    self._parsed[blob.id] = claim_files.read(trees.text_of(blob), path)
                found[path] = self._parsed[blob.id]
        return found

    # ---- commits ----

    def _follow_main(self) -> None:
        commit, new = trees.commit_of(self.world.remote, self.world.tip), []
        by: tuple[Machine, float, float] | None = None
        while str(commit.id) != self._seen:
            by = self.world.pushed_by.get(str(commit.id), by)
            new.append((commit, by))
            commit = commit.parents[0]
        self._seen = self.world.tip
        for commit, by in reversed(new):
            self._book(commit, by)
        if new:
            self._pushed_at = self.world.turns.monotonic()

    def _book(self, commit: pygit2.Commit, by: tuple[Machine, float, float] | None) -> None:
        self.counts["commits"] += 1
        claims = view.claims_in_ledger(self.claims(str(commit.id)).values())
        self.books.chosen = {
            subject: what["node"] for (subject, _), (what, _) in claims.items() if "node" in what
        }
        self.edits.get(str(commit.id), lambda books: None)(self.books)
        self._follow_overrides(commit)
        if entry_of(commit).by_generator:
            node = _discovered(commit)
            self.books.drain(RACK, not node or "goneSince" in node or node.get("drained", False))
        for operation, branch in self._operations(commit):
            assert operation not in self._place, f"{operation} is booked twice"
            self._place[operation], self._commit[operation] = len(self._models), str(commit.id)
            asked = self.asked.get(operation)
            if asked is None:
                assert by is not None
                self._own_work(claims, *by)
                continue
            if not asked.needs_approval:
                assert not asked.is_withdrawn, f"{operation} is booked, but was withdrawn"
                self._assert_in_order(asked)
            time = self.world.turns.monotonic() if branch else asked.time
            held = self._content(asked)
            outcome = self._take(self.books, asked, time)
            assert outcome != "refused", f"{operation} is booked, but the model refuses it"
            # a shorter demand and other leases need no approval
            now = self._content(asked)
            adds = any(held.get(subject) != what for subject, what in now.items())
            is_approved = branch in self.approved or not (asked.needs_approval and adds)
            assert is_approved, f"{operation} is booked, but nobody approved it"
            renews = any(one.lease for one in self.claims(str(commit.id)).values())
            assert outcome != "unchanged" or renews, f"{operation} is booked, but changes nothing"
            self.counts["waited"] += outcome == "waiting"
        _assert_same(commit, claims, view.claims_of(self.books))
        _assert_same(commit, self._waiting_on(commit), self.books.waiting_files())
        if entry_of(commit).by_generator:
            expected = [
                (
                    "city" if one[1] == FURTHER else "perception",
                    one[0].partition("@")[2],
                    sorted(topics),
                    self.books.replicas(one),
                )
                for one, topics in self.books.demanded().items()
            ]
            instances, services, links = _rendered(commit)
            _assert_same(commit, sorted(instances), sorted(expected))
            _assert_same(commit, services, self.books.services())
            _assert_same(commit, links, self.books.links())
        self.books.chosen = {}
        self._claims = claims
        self._models.append(pickle.dumps(self.books))

    def _follow_overrides(self, commit: pygit2.Commit) -> None:
        """Update the model with the overrides of a commit; fail if one ended before its time."""
        overrides, ended = _overrides(commit)
        latest = datetime.fromtimestamp(commit.commit_time + 1, timezone.utc)
        for override in overrides:
            early = f"{override.name} ended before {override.end}"
            is_new = override.name in ended and override not in self._ended
            assert not is_new or (override.end and override.end <= latest), early
        self._ended = {one for one in overrides if one.name in ended}
        self.books.overrides = frozenset(overrides) - self._ended

    def _content(self, asked: Asked) -> dict[Subject, dict[str, Any]]:
        held = self.books.of(asked.goal.get("demand", ""))
        return {subject: claim.content() for subject, claim in held.items()}

    def key_of(self, key: view.Key) -> books.Key:
        return next(one for one in self.books.claims if view.key_of(one) == key)

    def _take(self, books: Running, asked: Asked, time: float) -> str:
        received = asked.ticket.received.astimezone(timezone.utc).isoformat(timespec="microseconds")
        return books.take(asked.goal, time, received.replace("+00:00", "Z")).outcome

    def _waiting_on(self, commit: pygit2.Commit) -> dict[str, tuple[int, str, frozenset[str]]]:
        texts = trees.texts(commit.tree, ["ledger/waiting"]).values()
        files = [(file["goal"], str(file["since"])) for file in map(plain_yaml.load, texts)]
        return {
            goal["demand"]: (goal.get("priority", 0), since, frozenset(goal["requesters"]))
            for goal, since in files
        }

    def _own_work(self, claims: Any, machine: Machine, started: float, time: float) -> None:
        """Follow what a generator did by itself: it ends leases, lets in and moves."""
        both = self._claims.keys() & claims.keys()
        before = self._claims
        moved = {one for one in both if before[one][0].get("node") != claims[one][0].get("node")}
        let_in = {demand for _, demand in claims.keys() - both}
        self.counts.update(let_in=len(let_in), moved=len(moved))
        for demand in let_in:
            self.books.book_waiting(demand, self._pushed_at)
        for key in moved:
            self.books.moved(self.key_of(key))
        if gone := self._claims.keys() - both:
            self._end_leases([*map(self.key_of, gone)], machine, started, time)
        assert moved or gone or let_in, "a generator acted without a reason"

    def _operations(self, commit: pygit2.Commit) -> list[tuple[str, str]]:
        """Return the operations of a commit and of what it merges, each with its proposal."""
        commits = [commit]
        if len(commit.parents) > 1:
            remote, main = self.world.remote, commit.parents[0].id
            walker = remote.walk(commit.parents[1].id)
            walker.hide(main)
            # libgit2 may not hide all commits of main if a clock was set back
            commits += [one for one in walker if not remote.descendant_of(main, one.id)]
        return [
            (operation, next(iter(trailers.get(PROPOSAL, ())), ""))
            for each in reversed(commits)
            if (trailers := entry_of(each).trailers)
            for operation in trailers.get("Operation-Id", ())
        ]

    def _end_leases(
        self, gone: list[books.Key], machine: Machine, started: float, time: float
    ) -> None:
        for key in gone:
            claim, jump = self.books.claims[key], self.world.last_jump
            assert claim.promised is not None and claim.lease is not None, f"{key}: no lease"
            # a machine that saw a jump grants every lease its full term from the jump on
            full_term = jump + claim.lease if started < jump else jump
            least = claim.promised if jump < 0 else min(claim.promised, full_term)
            least = max(least, started + max(60, SLACK_S))
            assert time >= least, f"the lease of {key} ended {least - time} s early"
        self.books.drop(gone)

    def _assert_in_order(self, asked: Asked) -> None:
        for subject in asked.subjects:
            last = self._last.get((asked.machine, subject), -1)
            assert last < asked.number, f"{asked.ticket.operation} overtook another on {subject}"
            self._last[asked.machine, subject] = asked.number

    # ---- answers ----

    def _watch(self, asked: Asked) -> None:
        asked.ticket.future.add_done_callback(
            lambda future: self._guard(lambda: self._check_answer(asked))
        )

    def _guard(self, check: Callable[[], object]) -> None:
        """Keep a failure for :meth:`check`, because generators and futures catch errors."""
        try:
            check()
        except Exception as error:
            self.world.failure = self.world.failure or error

    def _check_answer(self, asked: Asked) -> None:
        self._follow_main()
        operation, error = asked.ticket.operation, asked.ticket.future.exception()
        if isinstance(error, ShuttingDown) and asked.ticket.journaled.result():
            asked.must_resume = True
            return
        asked.is_answered = True
        place = self._place.get(operation)
        if error is not None:
            is_withdrawn = isinstance(error, Withdrawn)
            may_be = asked.is_withdrawn or asked.is_asked_back or asked.needs_approval
            assert may_be or not is_withdrawn, "nobody did"
            assert "internal error" not in str(error), error
            assert place is None, f"{operation} is booked, but was answered {error}"
            is_decided = any(branch in str(error) for branch in self.decided)
            assert is_decided or not isinstance(error, TurnedDown), f"nobody did: {error}"
            if isinstance(error, InvalidInput) and not asked.needs_approval:
                self._assert_possible(asked, "refused")
            return
        outcome = asked.ticket.future.result().outcome
        if outcome == "unchanged":
            self._assert_possible(asked, "unchanged")
            if self._take_in_copy(pickle.dumps(self.books), asked) == "unchanged":
                self._take(self.books, asked, asked.time)
        elif outcome == "waiting" and place is None:
            self._assert_possible(asked, "waits")
        elif asked.needs_approval and place is None:  # withdrawn, or its claims were on main before
            if outcome != "released":
                self._assert_possible(asked, "unchanged")
        else:
            assert place is not None, f"{operation} is acknowledged, but not on main"
            if not asked.needs_approval:
                told = asked.ticket.future.result().commit
                assert told == self._commit[operation], f"{operation} is told to be in {told}"
                assert self._last.get(asked.machine, 0) <= place, (
                    "the acknowledgements came in another order than the commits"
                )
                self._last[asked.machine] = place

    def _assert_possible(self, asked: Asked, outcome: str) -> None:
        """Fail unless the outcome is right for the model at some time since the demand was made."""
        said = self._possible(asked)
        told = f"{asked.goal} was answered {outcome} {asked.ticket.future.exception() or ''}"
        assert outcome in said, f"{told}, but the model says {said}"

    def _possible(self, asked: Asked) -> set[str]:
        states = [*self._models[asked.place :], pickle.dumps(self.books)]
        return {self._take_in_copy(state, asked) for state in states}

    def _take_in_copy(self, model: bytes, asked: Asked) -> str:
        books: Running = pickle.loads(model)  # noqa: S301 - bytes of this oracle
        return self._take(books, asked, asked.time)

    # ---- machines ----

    def _check_resumed(self, machine: Machine) -> None:
        """Fail if a restarted machine lost a demand; watch the answers to those that it resumed."""
        self._last.pop(machine, None)
        assert machine.generator is not None
        tickets = machine.generator._demands._journal.pending
        for operation, asked in self.asked.items():
            if asked.machine is not machine or asked.is_answered or asked.is_lost:
                continue
            if operation in tickets:
                asked.ticket, asked.must_resume = tickets[operation], False
                self._watch(asked)
                continue
            assert not asked.must_resume, f"{operation} is forgotten at a stop: {asked.goal}"
            asked.is_lost = True
            if asked.ticket.state not in ("arrived", "done"):
                # at a crash, the journal may already have an outcome that the requester did not get
                may_fail = machine.has_rejected or asked.needs_approval or asked.is_withdrawn
                may_fail |= not self._possible(asked).isdisjoint({"refused", "unchanged", "waits"})
                assert may_fail or operation in self._place, (
                    f"{operation} is forgotten: {asked.goal}"
                )

    def check_end(self) -> None:
        """All demands are answered, and what is booked is in effect, long after all faults."""
        self.check()
        tip = self.world.tip
        left = [op for op, one in self.asked.items() if not (one.is_answered or one.is_lost)]
        assert not left, f"not answered: {left}"
        for machine in self.world.machines:
            assert machine.generator is not None
            assert machine.generator._demands._journal.pending == {}, "the journal has demands"
            snapshot = machine.generator.snapshot
            assert str(snapshot.commit) == tip, f"{machine.name} is behind"
            known = view.claims_in_ledger(snapshot.state.ledger)
            assert known == self._claims, f"{machine.name} knows {known}, not {self._claims}"
        for operation, asked in self.asked.items():
            error = asked.is_answered and asked.ticket.future.exception()
            told = f"{operation} is booked, but was answered {error}"
            assert not error or operation not in self._place, told
        leased = [claim.key for claim in self.claims().values() if claim.lease]
        assert not leased, f"leases did not end: {leased}"
        free, drained = self.books.free(), self.books.drained
        on = {node for what, _ in self._claims.values() if (node := what.get("node"))}
        assert not free or not self.books.waiting, f"{self.books.waiting} wait, {free} are free"
        assert not free or not on & drained, f"{on & drained} were not emptied, {free} are free"
        node = _discovered(self.world.remote.get(tip))
        there = self.world.nodes.get(RACK)
        if there is None:
            assert not node or ("goneSince" in node and RACK in on), "a node stays that is gone"
        else:
            seen = node.get("drained", False), "goneSince" in node
            assert node and seen == (there.is_cordoned, False), f"{node}, but it is {there}"
        late = [one.name for one in self.books.overrides if one.end]
        assert not late, f"did not end: {late}"
        (verdict,) = verification.verify(self.world.remote, [tip])
        assert verdict.holds, verdict


def _assert_same(commit: pygit2.Commit, found: object, expected: object) -> None:
    assert found == expected, f"after {commit.message}\n{found}\nbut expected\n{expected}"


def _discovered(commit: Any) -> dict[str, Any]:
    """Return the entry of the node that the cluster has, or nothing."""
    (*texts,) = trees.texts(commit.tree, [DISCOVERED_ROOT]).values()
    nodes = [node for text in texts for node in plain_yaml.load(text)["nodes"]]
    return next(iter(nodes), {})


def _overrides(commit: pygit2.Commit) -> tuple[list[Override], set[str]]:
    found = [
        Override.read(Path(path).stem, plain_yaml.load(text))
        for path, text in trees.texts(commit.tree, ["overrides"]).items()
        if path.endswith(".yaml")
    ]
    ended = map(plain_yaml.load, trees.texts(commit.tree, ["ledger/overrides"]).values())
    ends = {(one["override"], str(one["expires"]).replace("Z", "+00:00")) for one in ended}
    return found, {one.name for one in found if one.end and (one.name, one.end.isoformat()) in ends}


def _rendered(
    commit: pygit2.Commit,
) -> tuple[list[Any], dict[Service, tuple[list[str], int]], dict[Link, dict[str, str]]]:
    """Return the rendered instances of the tally (with their namespaces and versions), services
    and connections; both clients must name topics alike.
    """
    instances = []
    services: dict[Service, tuple[list[str], int]] = {}
    ends: dict[tuple[str, str], tuple[str, dict[str, str]]] = {}
    for path, blob in trees.blobs(commit.tree, ["clusters"]):
        name, node = Path(path).stem, Path(path).parent.name
        if name.startswith("of-"):
            services[name.removeprefix("of-"), node] = _rendered_service(trees.text_of(blob))[2:]
        elif name.startswith("ta-"):
            instances.append(_rendered_service(trees.text_of(blob)))
        elif name.startswith("mqtt-"):
            _, id, end = name.split("-")
            assert (id, end) not in ends, f"{id} has two clients at its {end}"
            ends[id, end] = node, _carried(trees.text_of(blob))
        else:
            assert name.startswith(("_", "README")) or "/_" in path, f"{path} is not needed"
    links: dict[Link, dict[str, str]] = {}
    for (id, end), (source, sent) in ends.items():
        if end == "source":
            target, read = ends.get((id, "target"), ("", {}))
            told = {named: topic for topic, named in read.items()}
            assert sorted(told) == sorted(sent.values()), f"{id} sends {sent} and reads {read}"
            links[id, source, target] = {topic: told[named] for topic, named in sent.items()}
    assert len(ends) == 2 * len(links), f"a client lacks its other end: {sorted(ends)}"
    return instances, services, links


@lru_cache(maxsize=1024)
def _rendered_service(text: str) -> tuple[str, str, list[str], int]:
    release = plain_yaml.load(text)
    values = release["spec"]["values"]
    version = NEXT if values["image"]["tag"] == NEXT else ""
    topics = sorted(values["inputs"]["egoData"])
    return release["metadata"]["namespace"], version, topics, values["replicas"]


@lru_cache(maxsize=1024)
def _carried(text: str) -> dict[str, str]:
    """Return the name at the broker of each ROS topic of a client."""
    settings = plain_yaml.load(text.partition("\n---\n")[0])["data"]["params.yaml"]
    bridge = plain_yaml.load(settings)["/**/*"]["ros__parameters"]["bridge"]
    sent, read = bridge.get("ros2mqtt", {}), bridge.get("mqtt2ros", {})
    found = [(topic, sent[topic]["mqtt_topic"]) for topic in sent.get("ros_topics", ())]
    found += [(read[named]["ros_topic"], named) for named in read.get("mqtt_topics", ())]
    assert len(dict(found)) == len(found), f"a topic is carried twice: {found}"
    return dict(found)
