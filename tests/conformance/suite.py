"""Tries rules against the servers of the two actions, and says which hold.

A rule *holds*, *fails*, or *differs*: it fails, but the server is the reference, and the reference
is known to differ.
"""

from __future__ import annotations

import json
import random
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from typing import Any

from demandops_interfaces.srv import GetBookkeeping
from demandops_ros import DemandClient, DemandError

from examples.experiment import paper
from tests.kit import goals, plain_yaml
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import Client, Sent

RULES: dict[str, list[dict[str, Any]]] = plain_yaml.beside(__file__, "rules")
OUTCOMES = ("booked", "unchanged", "released")
ENDS = {"join": "shutdown", "run": "stop", "put": "release"}
"""For each verb of a step that books something, the verb that ends it."""
VERBS = (*ENDS, *ENDS.values(), "renew", "goal")
FIELDS = {"who", "id", "of", "node", "with", "is", "says", "held", "read"}
STAGES = ("admitted", "booked", "committed", "pushed")
SOME_ORDERS = 6
"""How many of the 576 orders of joining and leaving are played unless all are asked for."""


class Unlike(Exception):
    """What was seen, and the rule does not allow."""


@dataclass(frozen=True)
class Verdict:
    word: str
    rule: str
    seen: str = ""

    def __str__(self) -> str:
        return f"{self.word:8}{self.rule}" + (f"\n        {self.seen}" if self.seen else "")


@dataclass(frozen=True)
class Answer:
    """``word`` is an outcome or the code of a refusal; empty if the server does not say it."""

    succeeded: bool
    word: str
    text: str

    def __str__(self) -> str:
        return f"it {'succeeded' if self.succeeded else 'failed'}: {self.text or 'no message'}"

    def is_as(self, expected: str, words: str) -> bool:
        """Compare; a server that says only that a goal succeeded need not say how."""
        if expected in OUTCOMES and self.succeeded and not self.word:
            return True
        right = (self.succeeded, self.word) == (expected in OUTCOMES, expected)
        return right and words in self.text


class Servers:
    """The servers that are tried; a name is empty if no server of the action is tried."""

    def __init__(self, domain: int, action: str, demand_action: str, bookkeeping: str) -> None:
        self.client = Client(domain, action)
        self.client.ready()
        self.sent: list[Sent] = []
        self.demand_client: DemandClient | None = None
        if demand_action:
            self.demand_client = DemandClient(
                "vehicle00", action_name=demand_action, timeout_s=PATIENCE_S, domain_id=domain
            )
        self.are_asked = bool(bookkeeping)
        if self.are_asked:
            self._books = self.client.node.create_client(GetBookkeeping, bookkeeping)
            self.client.wait(self._books.service_is_ready)
            self.client.ask(lambda: self._books.call_async(GetBookkeeping.Request()))

    def close(self) -> None:
        self.client.close()
        if self.demand_client is not None:
            self.demand_client.close()

    def deploy(self, goal: dict[str, Any]) -> Answer:
        sent = self.client.call(goal)
        self.sent.append(sent)
        succeeded, word = sent.status == "succeeded", sent.message.partition(":")[0]
        return Answer(succeeded, "" if succeeded and word not in OUTCOMES else word, sent.message)

    def demand(
        self, document: dict[str, Any], on_stage: Callable[[str, str], None] = lambda *_: None
    ) -> Answer:
        assert self.demand_client is not None
        try:
            answer = self.demand_client.send(document, on_stage)
        except DemandError as error:
            return Answer(False, error.code, str(error))
        # the result of this action has fields for the outcome and the commit
        text = " ".join([answer.commit, *answer.warnings])
        return Answer(True, answer.outcome or "no outcome", text)

    def books(self) -> dict[str, Any]:
        """Return who requests what, and the commit that says so; nothing if nobody can be asked."""
        data: dict[str, Any] = {"services": {}, "connections": {}, "commit": "none"}
        if not self.are_asked:
            return data
        asked = self._books.call_async(GetBookkeeping.Request())
        self.client.wait(asked.done)
        return data | json.loads(asked.result().bookkeeping_json or "{}")


# ---- a rule of rules.yaml ----


class Rule:
    """The steps of a rule, with ids and topics that begin with ``name``."""

    def __init__(self, name: str, steps: list[dict[str, Any]], servers: Servers) -> None:
        self._name, self._steps, self._servers = name, steps, servers

    def try_it(self) -> None:
        books = self._servers.books()
        try:
            for number, step in enumerate(self._steps, 1):
                answer = self._send(step)
                if not answer.is_as(step["is"], step.get("says", "")):
                    raise Unlike(f"goal {number} must be {step['is']}; {answer}")
                before, books = books, self._servers.books()
                if step["is"] not in ("booked", "released") and books != before:
                    raise Unlike(f"goal {number} is {step['is']}, and made {books['commit']}")
                if self._servers.are_asked:
                    self._compare(number, step, books)
        finally:
            for step in self._steps:  # end what was booked, so that no rule meets another
                verb = self._verb(step)
                if verb in ENDS and step["is"] in OUTCOMES:
                    rest = {key: step[key] for key in ("who", "id", "of", "node") if key in step}
                    self._send(rest | {ENDS[verb]: ""})

    def _compare(self, number: int, step: dict[str, Any], books: dict[str, Any]) -> None:
        tables: dict[str, Iterable[dict[str, list[str]]]] = {
            "held": (entry["topics"] for entry in books["connections"].values()),
            "read": (
                role for entry in books["services"].values() for role in entry["inputs"].values()
            ),
        }
        for name in tables.keys() & step.keys():
            found = defaultdict[str, list[str]](list)
            for table in tables[name]:
                for topic, who in table.items():
                    if topic.startswith(f"/{self._name}/"):
                        found[topic.rpartition("/")[2]] += who
            wanted = {topic: sorted(who.split()) for topic, who in step[name].items()}
            if (seen := {topic: sorted(who) for topic, who in found.items()}) != wanted:
                raise Unlike(f"after goal {number}, {name} must be {wanted}, and is {seen}")

    @staticmethod
    def _verb(step: dict[str, Any]) -> str:
        (verb,) = step.keys() - FIELDS
        assert verb in VERBS, verb
        return str(verb)

    def _send(self, step: dict[str, Any]) -> Answer:
        verb = self._verb(step)
        more = json.loads(json.dumps(step.get("with", {})).replace("RULE", self._name))
        if verb == "goal":
            return self._servers.deploy(
                json.loads(json.dumps(step["goal"]).replace("RULE", self._name))
            )
        who, id = step.get("who", "vehicle00").split(), step.get("id", "r")
        on, node = f"{self._name}/{step.get('of', 'one')}", step.get("node", "edge")
        topics = [f"/{self._name}/{topic}" for topic in step[verb].split()]
        if verb in ("put", "release", "renew"):
            document: dict[str, Any] = {"operation": verb, "demand": f"{self._name}/{id}"}
            if verb == "put":
                link = {"id": on, "source": "vehicle00", "target": node}
                link["topics"] = [{"source": topic} for topic in topics]
                document["connections"] = [link | more]
            return self._servers.demand(document | {"requesters": who})
        is_shutdown = verb in ENDS.values()
        if verb in ("run", "stop"):
            ego = [(topic, "vehicle00") for topic in topics]
            app = goals.application(on, node=node, who=who, ego=ego, clouds=())
            return self._servers.deploy(goals.goal([app | more], id=id, shutdown=is_shutdown))
        ends = ("vehicle00", node)
        item = goals.connection(on, who=who, ends=ends, topics=topics, broker="")
        return self._servers.deploy(goals.goal([], [item | more], id=id, shutdown=is_shutdown))


def random_steps(seed: int, count: int = 40) -> Iterator[dict[str, Any]]:
    """Yield joins and shutdowns by a few parties, with what ten lines of bookkeeping say of each.

    A party is a request id with its requesters. It holds what it joined and has not shut down, and
    no party takes from another. In the end each shuts down all, and nothing is left.
    """
    chance = random.Random(seed)
    held: dict[tuple[str, str], set[str]] = {
        party: set() for party in product(("vehicle00", "vehicle01", "station00 vehicle00"), "rs")
    }
    goals_of = [
        (party, chance.sample("abc", chance.randint(1, 3)), chance.random() < 0.5)
        for party in chance.choices([*held], k=count)
    ]
    for party, topics, joins in [*goals_of, *((party, [], False) for party in held)]:
        before = held[party]
        held[party] = before | {*topics} if joins else before - {*(topics or before)}
        changed = held[party] != before
        outcome = ("booked" if changed else "unchanged") if joins else "released"
        requesters = {
            topic: {each for (who, _), own in held.items() if topic in own for each in who.split()}
            for topic in set[str]().union(*held.values())
        }
        yield {
            "join" if joins else "shutdown": " ".join(topics),
            "who": party[0],
            "id": party[1],
            "is": outcome if joins or changed else "not-held",
            "held": {topic: " ".join(who) for topic, who in requesters.items()},
        }


# ---- the wire ----


def feedback_has_the_type(servers: Servers) -> None:
    topic = f"{servers.client.action}/_action/feedback"
    ours = servers.client.node.get_subscriptions_info_by_topic(topic)
    theirs = servers.client.node.get_publishers_info_by_topic(topic)
    wanted, found = ({str(end.topic_type_hash) for end in ends} for ends in (ours, theirs))
    if not found or not found <= wanted:
        raise Unlike(f"the hashes of its type are {found}, not {wanted}")


def stages_are_told(servers: Servers) -> None:
    """Look at all goals so far; feedback may be lost at first, and come later than the result."""
    whole = 0
    for sent in servers.sent:
        if sent.message.startswith("unchanged"):
            continue  # nothing is committed
        told = [stage.removesuffix(f" {sent.commit}") for stage in sent.feedback]
        whole += told == [*STAGES]
        begin = STAGES.index(told[0]) if told and told[0] in STAGES else 0
        last = 1 if sent.status == "aborted" else len(STAGES)  # it may be refused once admitted
        if told != [*STAGES[begin : begin + len(told)]] or begin + len(told) > last:
            raise Unlike(f"{sent.feedback}, and {sent.status}: {sent.message}")
    if not whole:
        raise Unlike(f"no goal was told all of {', '.join(STAGES)}")


def stages_are_fields(servers: Servers) -> None:
    told: list[str] = []
    link = {"id": "stages", "source": "vehicle00", "target": "edge", "topics": [{"source": "/s"}]}
    demand = {"demand": "stages", "connections": [link]}
    answer = servers.demand(demand, lambda stage, _: told.append(stage))
    servers.demand({"demand": "stages", "operation": "release"})
    if told != [stage for stage in STAGES if stage in told] or not answer.text.strip():
        raise Unlike(f"{told}, then {answer}")


def a_result_can_be_asked_for_again(servers: Servers) -> None:
    sent = servers.client.call({})
    again = sent.handle.get_result_async()
    servers.client.wait(again.done)
    if again.result().result.message != sent.message:
        raise Unlike(f"{sent.message!r}, then {again.result().result.message!r}")


def an_ended_goal_cannot_be_cancelled(servers: Servers) -> None:
    if servers.client.cancel(servers.client.call({})):
        raise Unlike("its cancelling was accepted")


# ---- the paper's table ----


def the_paper_s_table(servers: Servers, orders: Iterable[tuple[int, ...]]) -> None:
    """Let vehicles join and leave; the steps of each order are numbered as in the paper."""
    before = paper.observed(servers.books())
    for order in orders:
        inside: set[str] = set()
        for step in order:
            vehicle, _, verb = paper.STEPS[step - 1].partition(" ")
            inside ^= {vehicle}
            answer = servers.deploy(goals.experiment(step))
            where = f"in the order {order}, step {step}"
            if not answer.is_as("booked" if verb == "joins" else "released", ""):
                raise Unlike(f"{where}: {answer}")
            if servers.are_asked:
                books, wanted = servers.books(), paper.requesters(inside)
                if books["commit"] not in answer.text:
                    raise Unlike(f"{where}: {answer}, and the newest commit is {books['commit']}")
                found = paper.observed(books)
                if found != before | wanted:
                    raise Unlike(f"{where}: the requesters must be {wanted}, and are {found}")


def orders(seed: int, *, every: bool) -> list[tuple[int, ...]]:
    """Return all orders of joining and of leaving; by default some, with the paper's first."""
    found = [(*joins, *leaves) for joins, leaves in product(
        permutations(range(1, 5)), permutations(range(5, 9))
    )]  # fmt: skip
    others = found[1:] if every else random.Random(seed).sample(found[1:], SOME_ORDERS - 1)
    return [found[0], *others]


# ---- all rules ----


def all_rules(
    servers: Servers, played: list[tuple[int, ...]], seed: int
) -> Iterator[tuple[str, str, Any]]:
    """Yield each rule's name, how the reference differs, and a function that tries the rule."""
    yield "the feedback has the type of the action", "", partial(feedback_has_the_type, servers)
    again = partial(a_result_can_be_asked_for_again, servers)
    yield "a result can be asked for again", "", again
    ended = partial(an_ended_goal_cannot_be_cancelled, servers)
    yield "a goal that has ended cannot be cancelled", "", ended
    table = f"the paper's table, in {len(played)} orders of joining and leaving"
    yield table, "", partial(the_paper_s_table, servers, played)
    if servers.demand_client is not None:
        yield "the stages of a Demand are told, in order", "", partial(stages_are_fields, servers)
    for action, rules in RULES.items():
        if action == "Demand" and servers.demand_client is None:
            continue
        for number, entry in enumerate(rules):
            rule = Rule(f"{action}{number}", entry["steps"], servers)
            yield f"{action}: {entry['rule']}", entry.get("reference", ""), rule.try_it
    steps = [*random_steps(seed)]
    counted = f"{len(steps)} random joins and shutdowns are counted, and nothing is left"
    yield counted, "all rows of counting", Rule("random", steps, servers).try_it
    plain_text = "its feedback and its results are plain text"
    stages = "each stage is told, in order, and of what is refused at most the first"
    yield stages, plain_text, partial(stages_are_told, servers)


def verdicts(
    servers: Servers, played: list[tuple[int, ...]], seed: int, *, is_reference: bool = False
) -> Iterator[Verdict]:
    for name, difference, try_it in all_rules(servers, played, seed):
        try:
            try_it()
        except Unlike as unlike:
            differs = is_reference and difference
            seen = f"{difference}: {unlike}" if differs else str(unlike)
            yield Verdict("differs" if differs else "fails", name, seen)
        else:
            yield Verdict("holds", name)
