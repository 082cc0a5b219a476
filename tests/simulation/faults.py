"""Faults that tests plant in the program, one at a time; the oracle must find each.

Each is what a wrong line could do, in the room that the heading names. If its code goes, plant
another of its kind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.load import snapshot
from demandops.repo.write.commit_batch import CommitBatch
from demandops.repo.write.proposal_branch import ProposalBranches
from demandops.serve import agenda, journal, node_discovery
from demandops.serve.agenda import Agenda
from demandops.serve.approvals import Approvals
from demandops.serve.demands import Demands
from demandops.serve.journal import Receipt, Ticket
from demandops.serve.worker import Worker

Wrong = Callable[..., Any]
"""A wrong function or property; its first argument is the right one, whose arguments follow."""


@dataclass
class Fault:
    """Wrong code in a module or class, or in two; ``seed`` found it at once when it was written."""

    seed: int
    owner: Any
    name: str
    wrong: Wrong
    second: tuple[Any, str, Wrong] | None = None

    def plant(self, patch: Callable[[Any, str, Any], None]) -> None:
        for part in ((self.owner, self.name, self.wrong), self.second):
            if part:
                owner, name, wrong = part
                patch(owner, name, _instead_of(getattr_static(owner, name), wrong))


def _instead_of(right: Any, wrong: Wrong) -> Any:
    if isinstance(right, property):
        return property(lambda one: wrong(right.fget, one))
    return lambda *given, **named: wrong(right, *given, **named)


def nothing(*_: Any, **more: Any) -> None:
    """Leave out what the right function does."""


def itself(_: Any, one: Any, *more: Any) -> Any:
    return one


def first_only(right: Wrong, *given: Any) -> Any:
    return [*right(*given)][:1]


def with_(made: Any, **changed: Any) -> Any:
    """Change attributes of an object, even of a frozen one, and return the object."""
    for name, value in changed.items():
        object.__setattr__(made, name, value)
    return made


def answered_first(kind: type) -> Wrong:
    """Return a ``Worker._publish_commits`` that first gives the answers of a kind."""

    def publish(right: Wrong, worker: Any, commits: Any, results: Any = (), *more: Any) -> Any:
        worker._demands.answer([pair for pair in results if isinstance(pair[1], kind)])
        return right(worker, commits, results, *more)

    return publish


def separating(change: Wrong) -> Wrong:
    """Return a ``with_separate_instances`` that changes each application, demanded and made."""

    def separate(right: Wrong, asked: Any, config: Config) -> Any:
        made = [
            replace(new, held=change(old.held, new.held))
            if isinstance(old.held, Application) else new
            for old, new in zip(asked.demanded, right(asked, config).demanded, strict=True)
        ]  # fmt: skip
        return replace(asked, demanded=tuple(made))

    return separate


def ending_any_join(shut_down: Wrong, ledger: Any, asked: Any) -> Any:
    """Find a claim by the request id and one of the requesters."""
    made = []
    for item in asked.demanded:
        claims = [c for c in ledger.claims_on(item.held.subject) if c.request == asked.id]
        meant = [c for c in claims if c.joined and {*c.requesters} & {*item.requesters}]
        made.append(replace(item, requesters=meant[0].requesters) if meant else item)
    return shut_down(ledger, replace(asked, demanded=tuple(made)))


def undoing_deletions(follow: Wrong, batch: Any, followed: Any, now: Any) -> None:
    ledger, files = followed.snapshot.state.ledger, {}
    for claim in followed.before.state.ledger:
        if ledger.get(claim.key) is None:
            ledger = ledger.replace(claim.key, claim)
            files[path_of(claim.key)] = text_of(claim)
    follow(batch, followed, now)
    if files:
        author = batch._objects[followed.snapshot.commit].author
        state = replace(batch.head.state, ledger=ledger)
        batch.commit_files(files, state, "Undo\n\nRender-Version: 3\n", now, author)


def booking_again(
    right: Wrong, made: Any, ticket: Any, decision: Any, snapshot: Any, *more: Any
) -> Any:
    if isinstance(decision, Decision):
        batch = CommitBatch(made._repository, snapshot)
        text = f"Again\n\nOperation-Id: {ticket.operation}\nRender-Version: 3\n"
        author = batch._objects[snapshot.commit].author
        batch.commit_files(decision.files, decision.state, text, made._runtime.now(), author)
        batch.publish()
    return right(made, ticket, decision, snapshot, *more)


_forgotten = set[str]()
"""The demands whose proposals a generator has forgotten at a restart."""


def forgetting_proposals(read: Wrong, path: Any) -> dict[str, Ticket]:
    found = read(path)
    for ticket in found.values():
        if ticket.proposal:
            _forgotten.add(ticket.demand.goal.get("demand", ""))
            ticket.proposal, ticket.state = None, "committed"
    return found


# fmt: off
FAULTS: dict[str, Fault] = {
    # ---- booking ----
    "let_strangers_change_a_demand": Fault(3, permission, "stranger_faults", lambda *_: ()),
    "take_one_common_requester_for_the_owner": Fault(3, permission, "stranger_faults",
        lambda faults, request, owners, *more:
            () if {*owners} & {*request.requesters()} else faults(request, owners, *more)),
    "release_only_the_first_claim": Fault(214, booking, "claims_of", first_only),
    "replace_what_was_joined": Fault(11, Application, "extended", lambda _, app, more: more,
        (Connection, "extended", lambda _, connection, more: more)),
    "grant_one_claim_too_many": Fault(2, forbidden, "_held",
        lambda held, *given: held(*given) - 1),
    "commit_what_is_booked_already": Fault(6, booking, "book",
        lambda book, ledger, item, request, key, current, now, **more:
            (made := book(ledger, item, request, key, current, now, **more))
            .replace(key, replace(made.get(key), booked=now))),
    "let_a_shutdown_end_any_join_of_its_request": Fault(11, booking, "shut_down", ending_any_join),
    "end_the_whole_claim_by_a_shutdown_of_some_topics": Fault(7, Claim, "without_topics", nothing),
    "take_back_promised_leases": Fault(41, Lease, "started",
        lambda started, lease, now, before=None: started(lease, now)),
    "lose_renewals": Fault(3, Lease, "started",
        lambda started, lease, now, before=None: before or started(lease, now)),
    "end_leases_by_the_wall_clock": Fault(3, Agenda, "_has_grace", lambda *_: False),
    "never_scale": Fault(0, planner, "_replicas_of", lambda _, scaling, *more: scaling.min),
    "exceed_the_most_replicas": Fault(0, planner, "_replicas_of",
        lambda _, scaling, parameters, topics, *more: len(topics) or 1),
    "count_sources_for_topics": Fault(15, planner, "_replicas_of",
        lambda right, scaling, parameters, topics, *more:
            right(scaling, parameters, {one.source: one for one in topics}.values(), *more)),
    "share_one_instance": Fault(0, decision, "with_separate_instances", itself),
    "move_instances_with_the_channel": Fault(0, decision, "with_separate_instances",
        separating(lambda app, made: replace(made, version=app.version))),
    "keep_the_channel_of_the_default_version": Fault(95, decision, "with_separate_instances",
        separating(lambda app, made: made if made.separate else app)),
    "take_the_first_domain": Fault(2, Config, "nodes_of", lambda _, config, node: (node,)),
    "forget_what_is_booked_in_a_domain": Fault(14, completing, "_chosen",
        lambda chosen, one, booked, *more: chosen(one, {}, *more)),

    # ---- routes ----
    "carry_only_the_first_demands_routes": Fault(7, planner, "connection_topics",
        lambda topics, claims: topics([*claims][:1])),
    "name_a_shared_route_twice": Fault(7, connection, "merged_routes",
        lambda _, routes: tuple(sorted(routes, key=lambda one: one.source))),
    "deliver_under_the_source_topic": Fault(4, Route, "written_topic", lambda _, one: one.source),
    "send_a_source_topic_to_two_targets": Fault(8, booking, "conflicts",
        lambda conflicts, *given, **more:
            [each for each in conflicts(*given, **more) if ".topics[" not in each.field]),
    "leave_the_clients_of_a_released_connection": Fault(1, decision, "affected_keys",
        lambda affected, before, after, changes: affected(before, after,
            [one for one in changes if one.after or one.before.is_on_application])),
    "leave_the_far_end": Fault(0, ConnectionType, "keys", first_only),

    # ---- placement ----
    "let_the_last_in_first": Fault(1, agenda, "in_turn",
        lambda in_turn, *given: in_turn(*given)[::-1]),
    "ignore_priorities": Fault(79, agenda, "in_turn",
        lambda _, waiting: sorted(waiting.values(), key=lambda one: (one.since, one.demand))),
    "begin_the_wait_anew": Fault(3, decision, "_wait",
        lambda wait, state, demand, reasons, now, *more:
            (request := wait(state, demand, reasons, now, *more))
            and replace(request, waiting=replace(request.waiting, since=now))),
    "forget_those_that_wait": Fault(7, Agenda, "may_have_room", nothing),
    "let_others_overtake_in_a_batch": Fault(4, Agenda, "book_those_let_in", nothing),
    "leave_drained_nodes_full": Fault(5, World, "nodes_to_drain", lambda *_: []),
    "place_on_drained_nodes": Fault(1, Choice, "_closed", lambda *_: ""),
    "choose_anew_for_a_placed_demand": Fault(7, placement, "_booked", nothing),
    "count_no_room": Fault(7, forbidden, "excesses", lambda *_: []),
    "count_released_room_as_taken": Fault(0, Usage, "plus",
        lambda plus, usage, more: plus(usage, {need: n for need, n in more.items() if n > 0})),

    # ---- nodes of clusters ----
    "see_no_cordon": Fault(4, node_discovery, "discover",
        lambda discover, cluster, seen, *more:
            discover(cluster, [one._replace(is_cordoned=False) for one in seen], *more)),
    "let_nodes_go_only_with_other_news": Fault(1, node_discovery, "discover",
        lambda discover, *given: discover(*given)._replace(has_gone=False)),
    "take_out_nodes_that_claims_need": Fault(15, node_discovery, "discover",
        lambda discover, *given: discover(*given[:-1], lambda id: False)),

    # ---- overrides ----
    "apply_no_override_to_what_a_demand_changes": Fault(6, decision, "plan_change",
        lambda plan, before, after, *more: plan(before, with_(after, overrides=()), *more)),
    "apply_overrides_only_to_new_demands": Fault(0, snapshot, "render_all",
        lambda _, tree, state, more=None: Changeset({**(more or {})}, ())),
    "let_the_lowest_priority_win": Fault(173, World, "__post_init__",
        lambda right, world: [right(world), with_(world, overrides=world.overrides[::-1])]),
    "override_all_nodes": Fault(0, overrides, "fits",
        lambda fits, selector, traits, config:
            bool(selector.nodes and not traits.connections) or fits(selector, traits, config)),
    "run_what_is_denied": Fault(1, planner, "without_suspended", itself),
    "book_what_is_denied": Fault(1, forbidden, "denial_faults", lambda *_: ()),
    "end_overrides_early": Fault(17, edits, "expired_overrides",
        lambda expired, one, now: expired(one, now + timedelta(minutes=2))),
    "end_overrides_early_one_by_one": Fault(1, agenda, "_ends",
        lambda ends, state: [(end - timedelta(minutes=2), name) for end, name in ends(state)]),

    # ---- publishing ----
    "acknowledge_before_publishing": Fault(0, Worker, "_publish_commits", answered_first(Receipt)),
    "refuse_before_publishing": Fault(1, Worker, "_publish_commits", answered_first(InvalidInput)),
    "follow_nothing": Fault(0, CommitBatch, "follow",
        lambda _, batch, followed, *more: with_(batch, head=followed.snapshot)),
    "push_on_any_tip": Fault(1, RemoteRepository, "publish",
        lambda publish, made, expected, commit: publish(made, made.refresh(), commit)),
    "put_a_commit_on_the_wrong_parent": Fault(0, CommitBatch, "commit_files",
        lambda commit_files, batch, *given: commit_files(
            with_(batch, head=replace(batch.head, commit=batch.start.commit)), *given)),
    "remove_no_file": Fault(0, CommitBatch, "commit_files",
        lambda commit_files, batch, files, *given: commit_files(
            batch, {path: text for path, text in files.items() if text is not None}, *given)),
    "decide_on_a_stale_tip": Fault(20, Worker, "_attempt",
        lambda attempt, worker, *given: attempt(with_(worker, _tip_is_fresh=True), *given)),
    "drop_what_a_batch_has_left": Fault(1, Demands, "put_back", lambda *given: given[2].clear()),
    "bring_back_what_was_deleted": Fault(1, CommitBatch, "follow", undoing_deletions),
    "answer_before_a_last_merge_is_seen": Fault(119, Approvals, "_has_moved",
        lambda *_: False),
    "book_again_what_was_approved": Fault(0, Approvals, "_receipt", booking_again),
    "turn_down_what_waits": Fault(1, ProposalBranches, "put", lambda *_: ""),

    # ---- answers, withdrawals and stops ----
    "forget_what_a_stop_leaves": Fault(8, Demands, "fail",
        lambda fail, made, batch, error, keep=False: fail(made, batch, error)),
    "say_that_all_is_withdrawn": Fault(6, Demands, "withdraw", lambda *_: True),

    # ---- restart ----
    "forget_the_journal": Fault(1, journal, "read", lambda *_: {}),
    "leave_the_journal_in_memory": Fault(1, journal.Journal, "_write",
        lambda write, made, records, *, durably: write(made, records, durably=False)),
    "rewrite_only_the_newest_entry": Fault(1, journal.Journal, "_rewrite",
        lambda rewrite, made: rewrite(with_(made, pending=dict([*made.pending.items()][-1:])))),
    "resume_in_reverse": Fault(10, journal, "read",
        lambda read, path: dict([*read(path).items()][::-1])),
    "skip_the_search_for_operations": Fault(8, Worker, "_published_before", lambda *_: []),
    "start_without_overrides": Fault(28, snapshot, "start_at",
        lambda start, *given: replace(found := start(*given), state=replace(
            found.state, config=replace(found.state.config, overrides={})))),
    "start_without_the_last_claim": Fault(0, snapshot, "_read_ledger",
        lambda read, repo, before, *given:
            found if (found := read(repo, before, *given)) and before is not None
            else found._replace(ledger=found.ledger.without([*found.ledger][-1:]))),
    "skip_approval_after_a_restart": Fault(0, permission, "approval",
        lambda reasons, request, *more:
            ((), ()) if request.demand in _forgotten else reasons(request, *more),
        (journal, "read", forgetting_proposals)),
}
# fmt: on
