"""Faults that are planted in the program, which the oracle must find."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Any

from demandops.config.appdef.scaling import Scaling
from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.config.override import by_rank
from demandops.connections import route
from demandops.connections.route import Route
from demandops.decision import Decision, decision
from demandops.demand import chosen_domain, permission, separate_instance
from demandops.demand.claim import Claim
from demandops.demand.lease import Lease
from demandops.errors import InvalidInput
from demandops.ledger import claim_file, world
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations import conflicts, demand_release, ownership, put, shutdown
from demandops.ledger.recent_shutdowns import RecentShutdowns
from demandops.ledger.waiting import Wait, WaitingDemand, in_turn
from demandops.plan import override_lifecycle, planner, release_keys, scale_down
from demandops.plan.checks import denial, quota
from demandops.plan.nodes import placement
from demandops.plan.nodes.capacity import Room, Usage
from demandops.plan.nodes.choice import Choice
from demandops.plan.overrides import claim_overrides
from demandops.render.changes import changeset
from demandops.service import Receipt, demand_lifecycle, generator
from demandops.service.approvals import approvals
from demandops.service.approvals.approvals import Approvals
from demandops.service.approvals.proposal import Proposal
from demandops.service.demand_lifecycle import Demands
from demandops.service.evaluation import Evaluator
from demandops.service.ticket import Ticket
from demandops.service.timing import expiry, waiting_turns
from demandops.service.timing.draining import Draining
from demandops.service.timing.expiry import LeaseExpiry, OverrideExpiry, ScaleDown
from demandops.service.timing.waiting_turns import WaitingTurns
from demandops.service.worker import Worker
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.remote_repository import RemoteRepository
from demandops.staterepo.git.repository import PushDenied
from demandops.staterepo.history import commit_message
from demandops.staterepo.load import snapshot
from demandops.staterepo.write import journal
from demandops.staterepo.write.commit_batch import CommitBatch
from demandops.staterepo.write.proposal_branch import ProposalBranches

Patch = Callable[[Any, str, Any], None]

# ---- the first 26 ----


def acknowledge_before_publishing(patch: Patch) -> None:
    publish = Worker._publish_commits

    def early(worker: Worker, commits: CommitBatch, results: list[Any], certain: int) -> bool:
        worker._demands.answer([pair for pair in results if isinstance(pair[1], Receipt)])
        return publish(worker, commits, results, certain)

    patch(Worker, "_publish_commits", early)


def refuse_before_publishing(patch: Patch) -> None:
    publish = Worker._publish_commits

    def early(worker: Worker, commits: CommitBatch, results: list[Any], certain: int) -> bool:
        worker._demands.answer([pair for pair in results if isinstance(pair[1], InvalidInput)])
        return publish(worker, commits, results, certain)

    patch(Worker, "_publish_commits", early)


def forget_the_journal(patch: Patch) -> None:
    patch(journal, "read", lambda path: {})


def leave_the_journal_in_memory(patch: Patch) -> None:
    write = journal.Journal._write
    patch(
        journal.Journal,
        "_write",
        lambda made, records, *, durably: write(made, records, durably=False),
    )


def skip_the_search_for_operations(patch: Patch) -> None:
    patch(Evaluator, "published_before", lambda *_: [])


def take_a_repeat_for_another_shutdown(patch: Patch) -> None:
    patch(RecentShutdowns, "earlier", lambda *_: None)


def end_leases_by_the_wall_clock(patch: Patch) -> None:
    patch(LeaseExpiry, "_has_ended", lambda expiry, claim, now: claim.lease is not None)


def follow_nothing(patch: Patch) -> None:
    def follow(batch: CommitBatch, advance: Any, before: object, now: object) -> None:
        batch.head = advance.snapshot

    patch(CommitBatch, "follow", follow)


def push_on_any_tip(patch: Patch) -> None:
    publish = RemoteRepository.publish
    patch(
        RemoteRepository,
        "publish",
        lambda made, expected, commit: publish(made, made.refresh(), commit),
    )


def lose_renewals(patch: Patch) -> None:
    patch(Lease, "renewed", lambda lease, term, now: lease)


def book_again_what_was_approved(patch: Patch) -> None:
    receipt = Approvals._receipt

    def twice(made: Approvals, ticket: Any, decision: Any, snapshot: Any, recorded: Any) -> Receipt:
        if isinstance(decision, Decision):
            batch = CommitBatch(made._repository, snapshot)
            text = f"Again\n\nOperation-Id: {ticket.operation}\nRender-Version: 2\n"
            author = batch._objects[snapshot.commit].author
            batch.commit_files(decision.files, decision.state, text, author, made._runtime.now())
            batch.publish()
        return receipt(made, ticket, decision, snapshot, recorded)

    patch(Approvals, "_receipt", twice)


def bring_back_what_was_deleted(patch: Patch) -> None:
    follow = CommitBatch.follow

    def undo(batch: CommitBatch, advance: Any, before: Any, now: Any) -> None:
        ledger, files = advance.snapshot.state.ledger, {}
        for claim in before.state.ledger:
            if ledger.get(claim.key) is None:
                ledger = ledger.replace(claim.key, claim)
                files[claim_file.path_of(claim.key)] = claim_file.text_of(claim)
        follow(batch, advance, before, now)
        if files:
            author = batch._objects[advance.snapshot.commit].author
            state = replace(batch.head.state, ledger=ledger)
            batch.commit_files(files, state, "Undo\n\nRender-Version: 2\n", author, now)

    patch(CommitBatch, "follow", undo)


def let_the_last_in_first(patch: Patch) -> None:
    in_turn = waiting_turns.in_turn
    patch(waiting_turns, "in_turn", lambda waiting: in_turn(waiting)[::-1])


def forget_those_that_wait(patch: Patch) -> None:
    patch(WaitingTurns, "is_due", lambda *_: False)


def leave_drained_nodes_full(patch: Patch) -> None:
    patch(Draining, "is_due", lambda *_: False)
    patch(Draining, "move_due", lambda *_: None)


def place_on_drained_nodes(patch: Patch) -> None:
    patch(Choice, "_closed", lambda *_: "")


def count_no_room(patch: Patch) -> None:
    patch(Choice, "_shortage", lambda *_: [])
    patch(Room, "is_full", lambda *_: False)


def let_others_overtake_in_a_batch(patch: Patch) -> None:
    patch(WaitingTurns, "follow", lambda *_: None)


def come_down_at_once(patch: Patch) -> None:
    patch(scale_down, "_steps", lambda *_: ())


def come_down_early(patch: Patch) -> None:
    patch(Scaling, "kept_for", property(lambda _: timedelta(seconds=60)))


def never_come_down(patch: Patch) -> None:
    patch(ScaleDown, "is_due", lambda *_: False)
    patch(ScaleDown, "end_due", lambda *_: None)


def share_one_instance(patch: Patch) -> None:
    patch(separate_instance, "_separated", lambda app, config: app)


def move_instances_with_the_channel(patch: Patch) -> None:
    separated = separate_instance._separated

    def by_name(app: Any, config: Any) -> Any:
        made = separated(app, config)
        return replace(made, version=app.version)

    patch(separate_instance, "_separated", by_name)


def keep_the_channel_of_the_default_version(patch: Patch) -> None:
    separated = separate_instance._separated

    def by_name(app: Any, config: Any) -> Any:
        made = separated(app, config)
        return made if made.separate else app

    patch(separate_instance, "_separated", by_name)


def take_the_first_domain(patch: Patch) -> None:
    patch(Config, "nodes_of", lambda config, node: (node,))


def forget_what_is_booked_in_a_domain(patch: Patch) -> None:
    chosen = chosen_domain._chosen
    patch(
        chosen_domain,
        "_chosen",
        lambda one, booked, *more: chosen(one, None, *more),
    )


# ---- booking ----


def keep_former_requesters(patch: Patch) -> None:
    book = put.book

    def kept(ledger: Any, one: Any, request: str, key: Any, current: Any, now: Any) -> Any:
        former = current.requesters if current else ()
        one = replace(one, requesters=(*one.requesters, *former))
        return book(ledger, one, request, key, current, now)

    patch(put, "book", kept)


def let_strangers_change_a_demand(patch: Patch) -> None:
    patch(ownership, "refuse_other_owners", lambda *_: None)
    patch(put, "refuse_other_owners", lambda *_: None)


def release_only_the_first_claim(patch: Patch) -> None:
    owned = demand_release.owned_claims
    patch(demand_release, "owned_claims", lambda *given: owned(*given)[:1])


def book_against_another_node(patch: Patch) -> None:
    patch(conflicts, "_of_application", lambda *_: ())


def take_back_promised_leases(patch: Patch) -> None:
    patch(Lease, "renewed", lambda lease, term, now: term.lease_from(now))


def let_a_shutdown_end_a_demand(patch: Patch) -> None:
    meant = shutdown._claims_meant

    def joined(ledger: Any, request: Any, one: Any, who: str) -> Any:
        claims = ledger.claims_held_by(who, one.held.subject)
        return meant(ledger, request, one, who) or [c for c in claims if not c.joined]

    patch(shutdown, "_claims_meant", joined)


def replace_what_was_joined(patch: Patch) -> None:
    patch(Claim, "extending", lambda claim, current: claim)


def commit_what_is_booked_already(patch: Patch) -> None:
    patch(Claim, "after_booking", lambda claim, current: claim)


def grant_one_claim_too_many(patch: Patch) -> None:
    patch(quota, "_held", lambda *given, held=quota._held: held(*given) - 1)


# ---- routes ----


def carry_only_the_first_demands_routes(patch: Patch) -> None:
    topics = planner.connection_topics
    patch(planner, "connection_topics", lambda claims: topics([*claims][:1]))


def name_a_shared_route_twice(patch: Patch) -> None:
    def each(routes: Iterable[Any]) -> tuple[Any, ...]:
        return tuple(sorted(routes, key=lambda one: one.source))

    patch(route, "merged_routes", each)


def deliver_under_the_source_topic(patch: Patch) -> None:
    patch(Route, "written_topic", property(lambda one: one.source))


def send_a_source_topic_to_two_targets(patch: Patch) -> None:
    patch(conflicts, "_of_routes", lambda *_: ())


def leave_the_clients_of_a_released_connection(patch: Patch) -> None:
    affected = decision.affected_keys

    def kept(before: Any, after: Any, changes: Iterable[Any]) -> Any:
        left = [one for one in changes if one.after or one.before.is_on_application]
        return affected(before, after, left)

    patch(decision, "affected_keys", kept)


def leave_the_far_end(patch: Patch) -> None:
    keys = release_keys._client_keys
    patch(release_keys, "_client_keys", lambda world, claim: [*keys(world, claim)][:1])


def connect_any_ends(patch: Patch) -> None:
    of_connection = conflicts._of_connection

    def any_ends(one: Any, demanded: Any, ledger: Any, above: bool) -> Iterator[Any]:
        found = of_connection(one, demanded, ledger, above)
        return (fault for fault in found if not fault.field.endswith(("source", "target")))

    patch(conflicts, "_of_connection", any_ends)


# ---- overrides ----


def apply_no_override_to_what_a_demand_changes(patch: Patch) -> None:
    build = changeset.build_changeset

    def without(before: Any, after: Any, *more: Any) -> Any:
        object.__setattr__(after, "overrides", ())
        return build(before, after, *more)

    patch(changeset, "build_changeset", without)


def let_the_lowest_priority_win(patch: Patch) -> None:
    patch(world, "by_rank", lambda overrides: by_rank(overrides)[::-1])


def override_all_nodes(patch: Patch) -> None:
    fits = claim_overrides.fits

    def anywhere(selector: Any, traits: Any, config: Any) -> bool:
        return bool(selector.nodes and not traits.connections) or fits(selector, traits, config)

    patch(claim_overrides, "fits", anywhere)


def run_what_is_denied(patch: Patch) -> None:
    for module in (planner, release_keys):
        patch(module, "without_suspended", lambda one: one)


def book_what_is_denied(patch: Patch) -> None:
    patch(denial, "faults", lambda *_: ())


def deny_renewals(patch: Patch) -> None:
    faults = denial.faults

    def all_changes(request: Any, after: Any, changes: Any) -> Any:
        same = [replace(one, before=None) for one in changes.claims]
        return faults(request, after, replace(changes, claims=tuple(same)))

    patch(denial, "faults", all_changes)


def apply_overrides_only_to_new_demands(patch: Patch) -> None:
    followed = CommitBatch._followed

    def subjects_only(batch: CommitBatch, advance: Any, before: Any, now: Any) -> Any:
        return followed(batch, replace(advance, config_changed=False), before, now)

    patch(CommitBatch, "_followed", subjects_only)


def end_overrides_early(patch: Patch) -> None:
    for module in (expiry, override_lifecycle):
        expired = module.expired_overrides
        patch(
            module,
            "expired_overrides",
            lambda one, now, expired=expired: expired(one, now + timedelta(minutes=2)),
        )


def never_end_overrides(patch: Patch) -> None:
    patch(OverrideExpiry, "is_due", lambda *_: False)
    patch(OverrideExpiry, "end_due", lambda *_: None)


def end_overrides_without_a_marker(patch: Patch) -> None:
    patch(override_lifecycle, "_marker", lambda override: {})


def apply_what_had_expired_when_merged(patch: Patch) -> None:
    patch(override_lifecycle, "expired_overrides", lambda *_: [])


# ---- placement ----


def ignore_priorities(patch: Patch) -> None:
    patch(WaitingDemand, "turn", property(lambda one: (one.since, one.demand)))


def begin_the_wait_anew(patch: Patch) -> None:
    admitted = decision.admitted

    def anew(state: Any, *more: Any) -> Any:
        request = admitted(state, *more)
        if isinstance(request, Wait) and request.waiting is not None:
            return replace(request, waiting=replace(request.waiting, since=more[1]))
        return request

    patch(decision, "admitted", anew)


def count_released_room_as_taken(patch: Patch) -> None:
    plus = Usage.plus
    patch(
        Usage,
        "plus",
        lambda usage, more: plus(usage, {need: n for need, n in more.items() if n > 0}),
    )


def count_room_twice(patch: Patch) -> None:
    most = Node.most
    patch(Node, "most", lambda node, resource: 2 * (most(node, resource) or 0))


def let_strangers_end_a_wait(patch: Patch) -> None:
    patch(demand_release, "is_waiting", lambda ledger, one: one.demand in ledger.waiting)


def wait_on_after_the_booking(patch: Patch) -> None:
    patch(Ledger, "without_waiting", lambda ledger, demands: ledger)


def choose_anew_for_a_placed_demand(patch: Patch) -> None:
    patch(placement, "_booked", lambda *_: None)


def lose_who_waits(patch: Patch) -> None:
    patch(waiting_turns, "in_turn", lambda waiting: in_turn(waiting)[:1])


# ---- publishing ----


def put_a_commit_on_the_wrong_parent(patch: Patch) -> None:
    write = CommitBatch._write

    def on_the_start(batch: CommitBatch, *given: Any) -> Any:
        batch.head = batch.head.with_commit(batch.start.commit, batch.head.state)
        return write(batch, *given)

    patch(CommitBatch, "_write", on_the_start)


def write_each_commit_from_the_first_tree(patch: Patch) -> None:
    write = CommitBatch._write

    def from_the_start(batch: CommitBatch, *given: Any) -> Any:
        batch._tree = trees.commit_of(batch._objects, batch.start.commit).tree
        return write(batch, *given)

    patch(CommitBatch, "_write", from_the_start)


def remove_no_file(patch: Patch) -> None:
    write = CommitBatch._write

    def without(batch: CommitBatch, files: Any, *given: Any) -> Any:
        kept = {path: text for path, text in files.items() if text is not None}
        return write(batch, kept, *given)

    patch(CommitBatch, "_write", without)


def leave_out_the_operation(patch: Patch) -> None:
    of_decision = commit_message.of_decision
    patch(
        commit_message,
        "of_decision",
        lambda *given: "\n".join(
            line for line in of_decision(*given).split("\n") if "Operation-Id" not in line
        ),
    )


def decide_on_a_stale_tip(patch: Patch) -> None:
    attempt = Worker._attempt

    def fresh(worker: Worker, *given: Any) -> Any:
        worker._tip_is_fresh = True
        return attempt(worker, *given)

    patch(Worker, "_attempt", fresh)


def forget_what_a_commit_could_settle(patch: Patch) -> None:
    patch(CommitBatch, "record_in_next_commit", lambda *_: None)


def acknowledge_rejected_pushes(patch: Patch) -> None:
    publish = CommitBatch.publish

    def always(batch: CommitBatch) -> bool:
        try:
            return publish(batch)
        except PushDenied:
            return True

    patch(CommitBatch, "publish", always)


def drop_what_a_batch_has_left(patch: Patch) -> None:
    patch(Demands, "put_back", lambda demands, batch: batch.clear())


def tell_the_commit_before(patch: Patch) -> None:
    commit = CommitBatch.commit

    def before(batch: CommitBatch, *given: Any) -> str:
        was = str(batch.head.commit)
        commit(batch, *given)
        return was

    patch(CommitBatch, "commit", before)


def believe_that_a_lost_push_failed(patch: Patch) -> None:
    patch(Ticket, "mark_maybe_published", lambda *_: None)


# ---- restart ----


def forget_proposals_at_the_start(patch: Patch) -> None:
    patch(Approvals, "_resume", lambda *_: None)


def rewrite_only_the_newest_entry(patch: Patch) -> None:
    rewrite = journal.Journal._rewrite

    def newest(made: Any) -> None:
        made.pending = dict([*made.pending.items()][-1:])
        rewrite(made)

    patch(journal.Journal, "_rewrite", newest)


def remove_from_the_journal_in_memory(patch: Patch) -> None:
    done = journal.Journal.mark_done
    patch(
        journal.Journal,
        "mark_done",
        lambda made, operations, *, durably=False: done(made, operations),
    )


def resume_in_reverse(patch: Patch) -> None:
    read = journal.read
    patch(journal, "read", lambda path: dict([*read(path).items()][::-1]))


def resume_with_a_new_time(patch: Patch) -> None:
    resumed = demand_lifecycle.ticket_from_journal

    def later(entry: Any) -> Any:
        ticket = resumed(entry)
        ticket.received += timedelta(minutes=5)
        return ticket

    patch(demand_lifecycle, "ticket_from_journal", later)


def start_without_overrides(patch: Patch) -> None:
    first = generator.state_in_effect.first_snapshot

    def without(*given: Any) -> Any:
        found = first(*given)
        config = found.state.config.model_copy(update={"overrides": {}})
        return replace(found, state=replace(found.state, config=config))

    patch(generator.state_in_effect, "first_snapshot", without)


def start_without_the_last_claim(patch: Patch) -> None:
    texts = snapshot._claim_texts
    patch(snapshot, "_claim_texts", lambda *given: iter([*texts(*given)][:-1]))


def start_with_nobody_waiting(patch: Patch) -> None:
    load = snapshot.load

    def without(*given: Any) -> Any:
        found = load(*given)
        ledger = found.state.ledger.without_waiting([*found.state.ledger.waiting])
        return replace(found, state=replace(found.state, ledger=ledger))

    patch(snapshot, "load", without)


def start_with_ended_overrides(patch: Patch) -> None:
    load = snapshot.load

    def without(*given: Any) -> Any:
        found = load(*given)
        ledger = replace(found.state.ledger, ended={})
        return replace(found, state=replace(found.state, ledger=ledger))

    patch(snapshot, "load", without)


# ---- approval ----


def book_without_approval(patch: Patch) -> None:
    patch(permission, "approval_reasons", lambda *_: ())


def skip_approval_after_a_restart(patch: Patch) -> None:
    resumed = demand_lifecycle.ticket_from_journal
    reasons = permission.approval_reasons
    known: set[str] = set()

    def remembered(entry: Any) -> Any:
        if entry.proposal:
            known.add(json.dumps(entry.goal, sort_keys=True))
            entry = replace(entry, proposal=None)
        return resumed(entry)

    patch(demand_lifecycle, "ticket_from_journal", remembered)
    patch(
        permission,
        "approval_reasons",
        lambda request, changes, config: (
            ()
            if request.demand in {json.loads(k).get("demand") for k in known}
            else reasons(request, changes, config)
        ),
    )


def begin_leases_before_the_approval(patch: Patch) -> None:
    patch(permission, "with_leases_from_approval", lambda request: request)


def propose_only_the_first_of_a_branch(patch: Patch) -> None:
    wait_for = Proposal.wait_for
    patch(Proposal, "wait_for", lambda made, left: wait_for(made, left[:1]))


def leave_replaced_proposals_open(patch: Patch) -> None:
    patch(Approvals, "withdraw_replaced", lambda *_: None)


def leave_released_proposals_open(patch: Patch) -> None:
    patch(Approvals, "remove_released", lambda *_: None)


def forget_that_a_proposal_was_merged(patch: Patch) -> None:
    patch(approvals.commit_log, "operations_since", lambda *_: {})


def turn_down_what_waits(patch: Patch) -> None:
    patch(ProposalBranches, "put", lambda *_: "")
