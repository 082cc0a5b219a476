"""Faults that tests plant in the program, one at a time; the oracle must find each.

Each is what a wrong line could do, in the room that the heading names. If its code goes, plant
another of its kind. :data:`FAULTS` lists them all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import timedelta
from inspect import getattr_static
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.connections import connection
from demandops.connections.connection import Connection, ConnectionType, Route
from demandops.decide import booking, decision, edits
from demandops.decide.admission import completing, permission
from demandops.decide.checks import forbidden
from demandops.decide.checks.forbidden import Usage
from demandops.decide.decision import Decision
from demandops.decide.placement import placement
from demandops.decide.placement.candidates import Choice
from demandops.decide.planning import overrides, planner
from demandops.decide.state import Changeset
from demandops.model.config.config import Config
from demandops.model.demand.demand import Application, Lease
from demandops.model.ledger.claim import Claim, path_of, text_of
from demandops.model.ledger.ledger import World
from demandops.model.ledger.records import WaitingDemand
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.load import snapshot
from demandops.repo.write.commit_batch import CommitBatch
from demandops.repo.write.proposal_branch import ProposalBranches
from demandops.serve import agenda, journal
from demandops.serve.agenda import Agenda
from demandops.serve.approvals import Approvals
from demandops.serve.demands import Demands
from demandops.serve.journal import Receipt, Ticket
from demandops.serve.worker import Worker

Wrong = Callable[..., Any]
"""A wrong function or property; its first argument is the right one, whose arguments follow."""


@dataclass
class Fault:
    """Wrong code in some places; ``seed`` found it at once when it was written."""

    seed: int
    parts: list[tuple[Any, str, Wrong]] = field(default_factory=list)

    def plant(self, patch: Callable[[Any, str, Any], None]) -> None:
        for owner, name, wrong in self.parts:
            patch(owner, name, _instead_of(getattr_static(owner, name), wrong))


def _instead_of(right: Any, wrong: Wrong) -> Any:
    if isinstance(right, property):
        return property(lambda one: wrong(right.fget, one))
    return lambda *given, **named: wrong(right, *given, **named)


FAULTS: dict[str, Fault] = {}


def plant(title: str, seed: int, owner: Any, name: str, wrong: Wrong) -> None:
    """Add a fault, or a part of one; ``name`` is what is wrong in a module or class."""
    FAULTS.setdefault(title, Fault(seed)).parts.append((owner, name, wrong))


def wrong(seed: int, owner: Any, name: str) -> Callable[[Wrong], Wrong]:
    """Add the decorated function as a fault, or as a part of one."""

    def add(made: Wrong) -> Wrong:
        plant(made.__name__, seed, owner, name, made)
        return made

    return add


def nothing(*_: Any, **more: Any) -> None:
    """Leave out what the right function does."""


def itself(_: Any, one: Any, *more: Any) -> Any:
    return one


def first_only(right: Wrong, *given: Any) -> Any:
    return [*right(*given)][:1]


def in_reverse(right: Wrong, *given: Any) -> Any:
    return right(*given)[::-1]


# ---- booking ----


plant("let_strangers_change_a_demand", 3, permission, "stranger_faults", lambda *_: ())
plant("release_only_the_first_claim", 161, booking, "claims_of", first_only)
plant("replace_what_was_joined", 2, Application, "extended", lambda _, app, more: more)
plant("replace_what_was_joined", 2, Connection, "extended", lambda _, connection, more: more)
plant("grant_one_claim_too_many", 4, forbidden, "_held", lambda held, *given: held(*given) - 1)


@wrong(6, booking, "book")
def commit_what_is_booked_already(
    book: Any, ledger: Any, item: Any, request: Any, key: Any, current: Any, now: Any, **more: Any
) -> Any:
    made = book(ledger, item, request, key, current, now, **more)
    return made.replace(key, replace(made.get(key), booked=now))


@wrong(6, booking, "shut_down")
def let_a_shutdown_end_any_join_of_its_request(shut_down: Any, ledger: Any, asked: Any) -> Any:
    """Find a claim by the request id and one of the requesters."""
    made = []
    for item in asked.demanded:
        claims = [c for c in ledger.claims_on(item.held.subject) if c.request == asked.id]
        meant = [c for c in claims if c.joined and {*c.requesters} & {*item.requesters}]
        made.append(replace(item, requesters=meant[0].requesters) if meant else item)
    return shut_down(ledger, replace(asked, demanded=tuple(made)))


@wrong(3, permission, "stranger_faults")
def take_one_common_requester_for_the_owner(
    faults: Any, request: Any, owners: Any, *more: Any
) -> Any:
    owners = {*owners}
    return () if owners & {*request.requesters()} else faults(request, owners, *more)


@wrong(2, Claim, "without_topics")
def end_the_whole_claim_by_a_shutdown_of_some_topics(_: Any, claim: Any, gone: Any) -> None:
    return None


@wrong(1, Lease, "started")
def take_back_promised_leases(started: Any, lease: Any, now: Any, before: Any = None) -> Any:
    return started(lease, now)


@wrong(7, Lease, "started")
def lose_renewals(started: Any, lease: Any, now: Any, before: Any = None) -> Any:
    return before or started(lease, now)


plant("end_leases_by_the_wall_clock", 3, Agenda, "_has_grace", lambda *_: False)


plant("never_scale", 1, planner, "_replicas_of", lambda _, scaling, *more: scaling.min)


@wrong(3, planner, "_replicas_of")
def exceed_the_most_replicas(_: Any, scaling: Any, parameters: Any, topics: Any, *more: Any) -> int:
    return len(topics) or 1


@wrong(15, planner, "_replicas_of")
def count_sources_for_topics(
    right: Any, scaling: Any, parameters: Any, topics: Any, *more: Any
) -> Any:
    return right(scaling, parameters, {topic.source: topic for topic in topics}.values(), *more)


plant("share_one_instance", 3, completing, "_separated", itself)


@wrong(3, completing, "_separated")
def move_instances_with_the_channel(separated: Any, app: Any, config: Any) -> Any:
    return replace(separated(app, config), version=app.version)


@wrong(55, completing, "_separated")
def keep_the_channel_of_the_default_version(separated: Any, app: Any, config: Any) -> Any:
    made = separated(app, config)
    return made if made.separate else app


plant("take_the_first_domain", 3, Config, "nodes_of", lambda _, config, node: (node,))


@wrong(1, completing, "_chosen")
def forget_what_is_booked_in_a_domain(chosen: Any, one: Any, booked: Any, *more: Any) -> Any:
    return chosen(one, {}, *more)


# ---- routes ----


@wrong(0, planner, "connection_topics")
def carry_only_the_first_demands_routes(topics: Any, claims: Any) -> Any:
    return topics([*claims][:1])


@wrong(0, connection, "merged_routes")
def name_a_shared_route_twice(_: Any, routes: Any) -> Any:
    return tuple(sorted(routes, key=lambda one: one.source))


plant("deliver_under_the_source_topic", 4, Route, "written_topic", lambda _, one: one.source)


@wrong(4, booking, "conflicts")
def send_a_source_topic_to_two_targets(conflicts: Any, *given: Any, **more: Any) -> Any:
    return [each for each in conflicts(*given, **more) if ".topics[" not in each.field]


@wrong(1, decision, "affected_keys")
def leave_the_clients_of_a_released_connection(
    affected: Any, before: Any, after: Any, changes: Any
) -> Any:
    left = [one for one in changes if one.after or one.before.is_on_application]
    return affected(before, after, left)


plant("leave_the_far_end", 0, ConnectionType, "keys", first_only)


# ---- placement ----

plant("let_the_last_in_first", 9, agenda, "in_turn", in_reverse)
plant("ignore_priorities", 187, WaitingDemand, "turn", lambda _, one: (one.since, one.demand))


@wrong(3, decision, "_wait")
def begin_the_wait_anew(
    wait: Any, state: Any, demand: Any, reasons: Any, now: Any, *more: Any
) -> Any:
    request = wait(state, demand, reasons, now, *more)
    return request and replace(request, waiting=replace(request.waiting, since=now))


plant("forget_those_that_wait", 7, Agenda, "may_have_room", nothing)
plant("let_others_overtake_in_a_batch", 13, Agenda, "book_those_let_in", nothing)
plant("leave_drained_nodes_full", 3, agenda, "_to_drain", lambda *_: [])
plant("place_on_drained_nodes", 1, Choice, "_closed", lambda *_: "")
plant("choose_anew_for_a_placed_demand", 14, placement, "_booked", nothing)
plant("count_no_room", 7, forbidden, "excesses", lambda *_: [])


@wrong(0, Usage, "plus")
def count_released_room_as_taken(plus: Any, usage: Any, more: Any) -> Any:
    return plus(usage, {need: n for need, n in more.items() if n > 0})


# ---- overrides ----


@wrong(29, decision, "plan_change")
def apply_no_override_to_what_a_demand_changes(
    plan: Any, before: Any, after: Any, *more: Any
) -> Any:
    object.__setattr__(after, "overrides", ())
    return plan(before, after, *more)


@wrong(0, snapshot, "render_all")
def apply_overrides_only_to_new_demands(_: Any, tree: Any, state: Any, more: Any = None) -> Any:
    return Changeset({**(more or {})}, ())


@wrong(151, World, "__post_init__")
def let_the_lowest_priority_win(right: Any, world: Any) -> None:
    right(world)
    object.__setattr__(world, "overrides", world.overrides[::-1])


@wrong(20, overrides, "fits")
def override_all_nodes(fits: Any, selector: Any, traits: Any, config: Any) -> bool:
    return bool(selector.nodes and not traits.connections) or fits(selector, traits, config)


plant("run_what_is_denied", 29, planner, "without_suspended", itself)
plant("book_what_is_denied", 3, forbidden, "denial_faults", lambda *_: ())


@wrong(3, edits, "expired_overrides")
def end_overrides_early(expired: Any, one: Any, now: Any) -> Any:
    return expired(one, now + timedelta(minutes=2))


@wrong(3, agenda, "_ends")
def end_overrides_early_one_by_one(ends: Any, state: Any) -> Any:
    return [(end - timedelta(minutes=2), name) for end, name in ends(state)]


# ---- publishing ----


@wrong(0, Worker, "_publish_commits")
def acknowledge_before_publishing(
    publish: Any, worker: Any, commits: Any, results: Any = (), *more: Any
) -> bool:
    worker._demands.answer([pair for pair in results if isinstance(pair[1], Receipt)])
    return publish(worker, commits, results, *more)


@wrong(4, Worker, "_publish_commits")
def refuse_before_publishing(
    publish: Any, worker: Any, commits: Any, results: Any = (), *more: Any
) -> bool:
    worker._demands.answer([pair for pair in results if isinstance(pair[1], InvalidInput)])
    return publish(worker, commits, results, *more)


@wrong(0, CommitBatch, "follow")
def follow_nothing(_: Any, batch: Any, followed: Any, *more: Any) -> None:
    batch.head = followed.snapshot


@wrong(1, RemoteRepository, "publish")
def push_on_any_tip(publish: Any, made: Any, expected: Any, commit: Any) -> Any:
    return publish(made, made.refresh(), commit)


@wrong(0, CommitBatch, "commit_files")
def put_a_commit_on_the_wrong_parent(commit_files: Any, batch: Any, *given: Any) -> Any:
    batch.head = replace(batch.head, commit=batch.start.commit)
    return commit_files(batch, *given)


@wrong(0, CommitBatch, "commit_files")
def remove_no_file(commit_files: Any, batch: Any, files: Any, *given: Any) -> Any:
    kept = {path: text for path, text in files.items() if text is not None}
    return commit_files(batch, kept, *given)


@wrong(2, Worker, "_attempt")
def decide_on_a_stale_tip(attempt: Any, worker: Any, *given: Any) -> Any:
    worker._tip_is_fresh = True
    return attempt(worker, *given)


plant("drop_what_a_batch_has_left", 0, Demands, "put_back", lambda *given: given[2].clear())


@wrong(4, CommitBatch, "follow")
def bring_back_what_was_deleted(follow: Any, batch: Any, followed: Any, now: Any) -> None:
    ledger, files = followed.snapshot.state.ledger, {}
    for claim in followed.before.state.ledger:
        if ledger.get(claim.key) is None:
            ledger = ledger.replace(claim.key, claim)
            files[path_of(claim.key)] = text_of(claim)
    follow(batch, followed, now)
    if files:
        author = batch._objects[followed.snapshot.commit].author
        state = replace(batch.head.state, ledger=ledger)
        batch.commit_files(files, state, "Undo\n\nRender-Version: 3\n", author, now)


@wrong(382890171, Approvals, "_has_moved")
def answer_before_a_last_merge_is_seen(moved: Any, *check: Any) -> bool:
    return False


@wrong(0, Approvals, "_receipt")
def book_again_what_was_approved(
    receipt: Any, made: Any, ticket: Any, decision: Any, snapshot: Any, recorded: Any
) -> Receipt:
    if isinstance(decision, Decision):
        batch = CommitBatch(made._repository, snapshot)
        text = f"Again\n\nOperation-Id: {ticket.operation}\nRender-Version: 3\n"
        author = batch._objects[snapshot.commit].author
        batch.commit_files(decision.files, decision.state, text, author, made._runtime.now())
        batch.publish()
    return receipt(made, ticket, decision, snapshot, recorded)


plant("turn_down_what_waits", 1, ProposalBranches, "put", lambda *_: "")


# ---- answers, withdrawals and stops ----


@wrong(0, Demands, "fail")
def forget_what_a_stop_leaves(
    fail: Any, made: Any, batch: Any, error: Any, keep: bool = False
) -> None:
    fail(made, batch, error)


plant("say_that_all_is_withdrawn", 1, Demands, "withdraw", lambda *_: True)


# ---- restart ----


plant("forget_the_journal", 0, journal, "read", lambda *_: {})


@wrong(1, journal.Journal, "_write")
def leave_the_journal_in_memory(write: Any, made: Any, records: Any, *, durably: bool) -> None:
    write(made, records, durably=False)


@wrong(1, journal.Journal, "_rewrite")
def rewrite_only_the_newest_entry(rewrite: Any, made: Any) -> None:
    made.pending = dict([*made.pending.items()][-1:])
    rewrite(made)


plant(
    "resume_in_reverse", 15, journal, "read", lambda read, path: dict([*read(path).items()][::-1])
)
plant("skip_the_search_for_operations", 16, Worker, "_published_before", lambda *_: [])


@wrong(50, snapshot, "start_at")
def start_without_overrides(first: Any, *given: Any) -> Any:
    found = first(*given)
    config = replace(found.state.config, overrides={})
    return replace(found, state=replace(found.state, config=config))


@wrong(0, snapshot, "_read_ledger")
def start_without_the_last_claim(read: Any, repo: Any, before: Any, *given: Any) -> Any:
    found = read(repo, before, *given)
    if before is None:
        found = found._replace(ledger=found.ledger.without([*found.ledger][-1:]))
    return found


_known = set[str]()
"""The demands whose proposals a generator has forgotten at a restart."""


def _forget_proposal(read: Any, path: Any) -> dict[str, Ticket]:
    found = read(path)
    for ticket in found.values():
        if ticket.proposal:
            _known.add(ticket.demand.goal.get("demand", ""))
            ticket.proposal, ticket.state = None, "committed"
    return found


@wrong(0, permission, "approval")
def skip_approval_after_a_restart(reasons: Any, request: Any, *more: Any) -> Any:
    return ((), ()) if request.demand in _known else reasons(request, *more)


FAULTS["skip_approval_after_a_restart"].parts.append((journal, "read", _forget_proposal))
