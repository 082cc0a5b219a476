"""Faults that tests plant in the program, one at a time; the oracle must find each.

Each is what a wrong line could do, in the room that the heading names. If its code goes, plant
another of its kind. :data:`FAULTS` lists them all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import timedelta
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.connections import connection
from demandops.connections.connection import Route
from demandops.decide import booking, changeset, decision
from demandops.decide.admission import admitted_request, permission
from demandops.decide.checks import quotas
from demandops.decide.decision import Decision
from demandops.decide.placement import placement, relocation
from demandops.decide.placement.candidates import Choice
from demandops.decide.placement.capacity import Room, Usage
from demandops.decide.planning import overrides, planner, release_keys
from demandops.model.config.appdef import Scaling
from demandops.model.config.config import Config
from demandops.model.config.override import by_rank
from demandops.model.demand.claim import Claim, Lease
from demandops.model.ledger import claim_file, ledger
from demandops.model.ledger.records import RecentShutdowns, Wait, WaitingDemand
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.load import snapshot
from demandops.repo.write import journal
from demandops.repo.write.commit_batch import CommitBatch
from demandops.repo.write.proposal_branch import ProposalBranches
from demandops.serve import demand_lifecycle, generator
from demandops.serve.approvals.approvals import Approvals
from demandops.serve.demand_lifecycle import Demands
from demandops.serve.evaluation import Evaluator
from demandops.serve.queue import Receipt, Ticket
from demandops.serve.timing import expiry, own_work
from demandops.serve.timing.expiry import LeaseExpiry, ScaleDown
from demandops.serve.timing.own_work import Draining, WaitingTurns
from demandops.serve.worker import Worker

Patch = Callable[[Any, str, Any], None]

# ---- booking ----


def keep_former_requesters(patch: Patch) -> None:
    book = booking.book

    def kept(ledger: Any, one: Any, request: str, key: Any, current: Any, now: Any) -> Any:
        former = current.requesters if current else ()
        one = replace(one, requesters=(*one.requesters, *former))
        return book(ledger, one, request, key, current, now)

    patch(booking, "book", kept)


def let_strangers_change_a_demand(patch: Patch) -> None:
    patch(booking, "refuse_other_owners", lambda *_: None)


def release_only_the_first_claim(patch: Patch) -> None:
    owned = booking.owned_claims
    patch(booking, "owned_claims", lambda *given: owned(*given)[:1])


def replace_what_was_joined(patch: Patch) -> None:
    patch(Claim, "extending", lambda claim, current: claim)


def commit_what_is_booked_already(patch: Patch) -> None:
    patch(Claim, "after_booking", lambda claim, current: claim)


def grant_one_claim_too_many(patch: Patch) -> None:
    patch(quotas, "_held", lambda *given, held=quotas._held: held(*given) - 1)


def take_a_repeat_for_another_shutdown(patch: Patch) -> None:
    patch(RecentShutdowns, "earlier", lambda *_: None)


def take_back_promised_leases(patch: Patch) -> None:
    patch(Lease, "renewed", lambda lease, term, now: term.lease_from(now))


def lose_renewals(patch: Patch) -> None:
    patch(Lease, "renewed", lambda lease, term, now: lease)


def end_leases_by_the_wall_clock(patch: Patch) -> None:
    patch(LeaseExpiry, "_has_ended", lambda expiry, claim, now: claim.lease is not None)


def come_down_at_once(patch: Patch) -> None:
    patch(planner, "_steps", lambda *_: ())


def come_down_early(patch: Patch) -> None:
    patch(Scaling, "kept_for", property(lambda _: timedelta(seconds=60)))


def never_come_down(patch: Patch) -> None:
    patch(ScaleDown, "is_due", lambda *_: False)
    patch(ScaleDown, "end_due", lambda *_: None)


def share_one_instance(patch: Patch) -> None:
    patch(admitted_request, "_separated", lambda app, config: app)


def move_instances_with_the_channel(patch: Patch) -> None:
    separated = admitted_request._separated

    def by_name(app: Any, config: Any) -> Any:
        made = separated(app, config)
        return replace(made, version=app.version)

    patch(admitted_request, "_separated", by_name)


def keep_the_channel_of_the_default_version(patch: Patch) -> None:
    separated = admitted_request._separated

    def by_name(app: Any, config: Any) -> Any:
        made = separated(app, config)
        return made if made.separate else app

    patch(admitted_request, "_separated", by_name)


def take_the_first_domain(patch: Patch) -> None:
    patch(Config, "nodes_of", lambda config, node: (node,))


def forget_what_is_booked_in_a_domain(patch: Patch) -> None:
    chosen = admitted_request._chosen
    patch(admitted_request, "_chosen", lambda one, booked, *more: chosen(one, {}, *more))


# ---- routes ----


def carry_only_the_first_demands_routes(patch: Patch) -> None:
    topics = planner.connection_topics
    patch(planner, "connection_topics", lambda claims: topics([*claims][:1]))


def name_a_shared_route_twice(patch: Patch) -> None:
    def each(routes: Iterable[Any]) -> tuple[Any, ...]:
        return tuple(sorted(routes, key=lambda one: one.source))

    patch(connection, "merged_routes", each)


def deliver_under_the_source_topic(patch: Patch) -> None:
    patch(Route, "written_topic", property(lambda one: one.source))


def send_a_source_topic_to_two_targets(patch: Patch) -> None:
    patch(booking, "_route_conflicts", lambda *_: ())


def leave_the_clients_of_a_released_connection(patch: Patch) -> None:
    affected = decision.affected_keys

    def kept(before: Any, after: Any, changes: Iterable[Any]) -> Any:
        left = [one for one in changes if one.after or one.before.is_on_application]
        return affected(before, after, left)

    patch(decision, "affected_keys", kept)


def leave_the_far_end(patch: Patch) -> None:
    keys = release_keys._client_keys
    patch(release_keys, "_client_keys", lambda world, claim: [*keys(world, claim)][:1])


# ---- placement ----


def let_the_last_in_first(patch: Patch) -> None:
    in_turn = own_work.in_turn
    patch(own_work, "in_turn", lambda waiting: in_turn(waiting)[::-1])


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


def forget_those_that_wait(patch: Patch) -> None:
    patch(WaitingTurns, "is_due", lambda *_: False)


def let_others_overtake_in_a_batch(patch: Patch) -> None:
    patch(WaitingTurns, "follow", lambda *_: None)


def leave_drained_nodes_full(patch: Patch) -> None:
    patch(Draining, "is_due", lambda *_: False)
    patch(Draining, "move_due", lambda *_: None)


def place_on_drained_nodes(patch: Patch) -> None:
    patch(Choice, "_closed", lambda *_: "")


def choose_anew_for_a_placed_demand(patch: Patch) -> None:
    patch(placement, "_booked", lambda *_: None)


def count_no_room(patch: Patch) -> None:
    patch(Choice, "_shortage", lambda *_: [])
    patch(Room, "is_full", lambda *_: False)


def count_released_room_as_taken(patch: Patch) -> None:
    plus = Usage.plus
    patch(
        Usage,
        "plus",
        lambda usage, more: plus(usage, {need: n for need, n in more.items() if n > 0}),
    )


# ---- overrides ----


def apply_no_override_to_what_a_demand_changes(patch: Patch) -> None:
    build = changeset.build_changeset

    def without(before: Any, after: Any, *more: Any) -> Any:
        object.__setattr__(after, "overrides", ())
        return build(before, after, *more)

    patch(changeset, "build_changeset", without)


def apply_overrides_only_to_new_demands(patch: Patch) -> None:
    followed = CommitBatch._followed

    def subjects_only(batch: CommitBatch, advance: Any, before: Any, now: Any) -> Any:
        return followed(batch, replace(advance, config_changed=False), before, now)

    patch(CommitBatch, "_followed", subjects_only)


def let_the_lowest_priority_win(patch: Patch) -> None:
    patch(ledger, "by_rank", lambda overrides: by_rank(overrides)[::-1])


def override_all_nodes(patch: Patch) -> None:
    fits = overrides.fits

    def anywhere(selector: Any, traits: Any, config: Any) -> bool:
        return bool(selector.nodes and not traits.connections) or fits(selector, traits, config)

    patch(overrides, "fits", anywhere)


def run_what_is_denied(patch: Patch) -> None:
    for module in (planner, release_keys):
        patch(module, "without_suspended", lambda one: one)


def book_what_is_denied(patch: Patch) -> None:
    patch(quotas, "denial_faults", lambda *_: ())


def end_overrides_early(patch: Patch) -> None:
    for module in (expiry, relocation):
        expired = module.expired_overrides
        patch(
            module,
            "expired_overrides",
            lambda one, now, expired=expired: expired(one, now + timedelta(minutes=2)),
        )


# ---- publishing ----


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


def put_a_commit_on_the_wrong_parent(patch: Patch) -> None:
    commit_files = CommitBatch.commit_files

    def on_the_start(batch: CommitBatch, *given: Any) -> Any:
        batch.head = batch.head.with_commit(batch.start.commit, batch.head.state)
        return commit_files(batch, *given)

    patch(CommitBatch, "commit_files", on_the_start)


def remove_no_file(patch: Patch) -> None:
    commit_files = CommitBatch.commit_files

    def without(batch: CommitBatch, files: Any, *given: Any) -> Any:
        kept = {path: text for path, text in files.items() if text is not None}
        return commit_files(batch, kept, *given)

    patch(CommitBatch, "commit_files", without)


def decide_on_a_stale_tip(patch: Patch) -> None:
    attempt = Worker._attempt

    def fresh(worker: Worker, *given: Any) -> Any:
        worker._tip_is_fresh = True
        return attempt(worker, *given)

    patch(Worker, "_attempt", fresh)


def drop_what_a_batch_has_left(patch: Patch) -> None:
    patch(Demands, "put_back", lambda demands, batch, *more: batch.clear())


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


def turn_down_what_waits(patch: Patch) -> None:
    patch(ProposalBranches, "put", lambda *_: "")


# ---- restart ----


def forget_the_journal(patch: Patch) -> None:
    patch(journal, "read", lambda path: {})


def leave_the_journal_in_memory(patch: Patch) -> None:
    write = journal.Journal._write
    patch(
        journal.Journal,
        "_write",
        lambda made, records, *, durably: write(made, records, durably=False),
    )


def rewrite_only_the_newest_entry(patch: Patch) -> None:
    rewrite = journal.Journal._rewrite

    def newest(made: Any) -> None:
        made.pending = dict([*made.pending.items()][-1:])
        rewrite(made)

    patch(journal.Journal, "_rewrite", newest)


def resume_in_reverse(patch: Patch) -> None:
    read = journal.read
    patch(journal, "read", lambda path: dict([*read(path).items()][::-1]))


def skip_the_search_for_operations(patch: Patch) -> None:
    patch(Evaluator, "published_before", lambda *_: [])


def start_without_overrides(patch: Patch) -> None:
    first = generator.state_in_effect.first_snapshot

    def without(*given: Any) -> Any:
        found = first(*given)
        config = replace(found.state.config, overrides={})
        return replace(found, state=replace(found.state, config=config))

    patch(generator.state_in_effect, "first_snapshot", without)


def start_without_the_last_claim(patch: Patch) -> None:
    texts = snapshot._claim_texts
    patch(snapshot, "_claim_texts", lambda *given: iter([*texts(*given)][:-1]))


def skip_approval_after_a_restart(patch: Patch) -> None:
    resumed, reasons = demand_lifecycle.ticket_from_journal, permission.approval_reasons
    known = set[str]()

    def forgotten(entry: Any) -> Ticket:
        if entry.proposal:
            known.add(entry.goal.get("demand", ""))
        return resumed(replace(entry, proposal=None))

    def without(request: Any, *more: Any) -> tuple[str, ...]:
        return () if request.demand in known else reasons(request, *more)

    patch(demand_lifecycle, "ticket_from_journal", forgotten)
    patch(permission, "approval_reasons", without)


FAULTS: dict[Callable[[Patch], None], int] = {
    keep_former_requesters: 7,
    let_strangers_change_a_demand: 1,
    release_only_the_first_claim: 17,
    replace_what_was_joined: 2,
    commit_what_is_booked_already: 8,
    grant_one_claim_too_many: 4,
    take_a_repeat_for_another_shutdown: 16,
    take_back_promised_leases: 5,
    lose_renewals: 3,
    end_leases_by_the_wall_clock: 3,
    come_down_at_once: 8,
    come_down_early: 1,
    never_come_down: 15,
    share_one_instance: 1,
    move_instances_with_the_channel: 4,
    keep_the_channel_of_the_default_version: 22,
    take_the_first_domain: 1,
    forget_what_is_booked_in_a_domain: 100,
    carry_only_the_first_demands_routes: 0,
    name_a_shared_route_twice: 0,
    deliver_under_the_source_topic: 6,
    send_a_source_topic_to_two_targets: 6,
    leave_the_clients_of_a_released_connection: 0,
    leave_the_far_end: 0,
    let_the_last_in_first: 6,
    ignore_priorities: 44,
    begin_the_wait_anew: 13,
    forget_those_that_wait: 6,
    let_others_overtake_in_a_batch: 13,
    leave_drained_nodes_full: 4,
    place_on_drained_nodes: 3,
    choose_anew_for_a_placed_demand: 0,
    count_no_room: 3,
    count_released_room_as_taken: 0,
    apply_no_override_to_what_a_demand_changes: 8,
    apply_overrides_only_to_new_demands: 1,
    let_the_lowest_priority_win: 63,
    override_all_nodes: 8,
    run_what_is_denied: 26,
    book_what_is_denied: 6,
    end_overrides_early: 6,
    acknowledge_before_publishing: 0,
    refuse_before_publishing: 0,
    follow_nothing: 0,
    push_on_any_tip: 1,
    put_a_commit_on_the_wrong_parent: 0,
    remove_no_file: 0,
    decide_on_a_stale_tip: 2,
    drop_what_a_batch_has_left: 0,
    bring_back_what_was_deleted: 0,
    book_again_what_was_approved: 0,
    turn_down_what_waits: 0,
    forget_the_journal: 1,
    leave_the_journal_in_memory: 1,
    rewrite_only_the_newest_entry: 1,
    resume_in_reverse: 1,
    skip_the_search_for_operations: 22,
    start_without_overrides: 6,
    start_without_the_last_claim: 0,
    skip_approval_after_a_restart: 6,
}
"""Each planted fault, with a seed that found it at once when the table was written."""
