"""A state repo in memory, without Git, on which a test decides one goal after the other."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import lru_cache
from typing import Any

import jsonschema_rs
import yaml
from demandops.base.errors import Fault, Refused
from demandops.base.settings import data_folder
from demandops.decide.bookkeeping import as_data, bookkeeping
from demandops.decide.decision import Decision, decide
from demandops.decide.state import State, rendered_files
from demandops.model.config.config import Config
from demandops.model.config.load import load
from demandops.model.demand.demand import Demand
from demandops.model.demand.goals import read_journaled
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton, state_of
from tests.kit.goals import Goal
from tests.kit.plain_yaml import FAST

NOW = datetime(2026, 1, 31, 12, tzinfo=timezone.utc)


@lru_cache(maxsize=1)
def _unchanged() -> State:
    return state_of(load(configuration()))


@lru_cache(maxsize=8)
def _schema(kind: str) -> jsonschema_rs.Draft7Validator | None:
    file = data_folder("templates") / "connections" / kind / "schema.json"
    return jsonschema_rs.Draft7Validator(json.loads(file.read_text())) if file.is_file() else None


def unread_fields(path: str, text: str) -> list[str]:
    """Return what the program of a communication client would not read of its configuration."""
    schema = _schema(path.rpartition("/")[2].partition("-")[0])
    if schema is None or not path.startswith("clusters/"):
        return []
    configuration, *_ = next(yaml.load_all(text, Loader=FAST))["data"].values()
    return [error.message for error in schema.iter_errors(plain_yaml.load(configuration))]


class MemoryRepo:
    """A state repo in memory; each committed decision is the basis of the next one."""

    def __init__(
        self,
        changed: Mapping[str, str | None] | None = None,
        *,
        state: State | None = None,
        now: datetime = NOW,
    ) -> None:
        """Start from the skeleton's files, replaced or extended by ``changed``, or from a state."""
        self.now = now
        if state is not None:
            self.state, self._initial = state, rendered_files(state)
        elif not changed:
            self.state, self._initial = _unchanged(), dict(skeleton())
        else:
            files = configuration(changed)
            self.state = state_of(load(files))
            self._initial = files | rendered_files(self.state)
        self.files = dict(self._initial)

    def copy(self) -> MemoryRepo:
        twin = copy.copy(self)
        twin.files = dict(self.files)
        return twin

    @property
    def config(self) -> Config:
        return self.state.config

    def decide(self, goal: object, now: datetime | None = None) -> Decision:
        if isinstance(goal, dict) and goal.get("kind") == "Decommission":
            goal = read_journaled(goal)
        return decide(self.state, goal, now or self.now, self.files.get, throttle=self.throttle)

    def throttle(self, request: Demand, config: Config) -> Iterable[Fault]:
        """Limit no rates; a subclass may."""
        return ()

    def send(self, goal: object, now: datetime | None = None) -> Decision:
        decision = self.decide(goal, now)
        self.state = decision.state
        self._write(decision.files)
        return decision

    def _write(self, files: Mapping[str, str | None]) -> None:
        for path, text in files.items():
            assert self.files.get(path) != text, f"written or removed without need: {path}"
            assert text is None or not unread_fields(path, text), path
            self.files.pop(path) if text is None else self.files.update({path: text})

    def take(self, goal: object, now: datetime | None = None) -> Decision | Refused:
        before = dict(self.files), self.state
        try:
            return self.send(goal, now)
        except Refused as refusal:
            assert (self.files, self.state) == before, "a refused demand changed something"
            return refusal

    def take_all(self, goals: Iterable[Goal]) -> list[str]:
        """Send goals at intervals of a minute; return the one-word outcome of each."""
        return [
            outcome(self.take(goal, self.now + timedelta(minutes=minute)))
            for minute, goal in enumerate(goals)
        ]

    def faults(self, goal: object) -> list[str]:
        """Send a goal that must be refused; return its faults, each as ``field: message``."""
        refusal = self.take(goal)
        assert isinstance(refusal, Refused), f"not refused, but {refusal.outcome}"
        return [f"{fault.field}: {fault.message}" for fault in refusal.faults]

    def bookkeeping(self) -> dict[str, Any]:
        return as_data(bookkeeping(self.state), "")

    def books(self) -> dict[str, Any]:
        data = self.bookkeeping()
        return {"services": data["services"], "connections": data["connections"]}

    def below(self, *roots: str) -> dict[str, str]:
        return {
            path: text
            for path, text in self.files.items()
            if path.split("/")[0] in roots and not path.endswith("/README.md")
        }

    def rendered(self) -> dict[str, str]:
        """Return the files below ``clusters/`` that demands added."""
        added = self.files.keys() - self._initial.keys()
        return {
            p: text for p, text in self.files.items() if p in added and p.startswith("clusters/")
        }

    def objects(self, kind: str) -> dict[str, dict[str, Any]]:
        documents = [
            document
            for text in self.rendered().values()
            for document in yaml.load_all(text, Loader=FAST)
            if document["kind"] == kind
        ]
        named = {document["metadata"]["name"]: document for document in documents}
        assert len(named) == len(documents), "two objects have one name"
        return named


def rebuilt(claims: Iterable[Claim]) -> Ledger:
    ledger = Ledger()
    for claim in claims:
        ledger = ledger.replace(claim.key, claim)
    return ledger


def is_of_ledger(path: str) -> bool:
    return bool(claim_files.kind_of(path)) or path.startswith(records.WAITING_ROOT)


def ledger_in(files: Mapping[str, str]) -> Ledger:
    """Return the ledger in ``files``; files that do not belong to a ledger are ignored."""
    booked = {path: text for path, text in files.items() if is_of_ledger(path)}
    claims = [path for path in booked if claim_files.kind_of(path)]
    ledger = rebuilt(claim_files.read(booked.pop(path), path) for path in claims)
    return replace(
        ledger,
        waiting=records.read_all_waiting(booked),
    )


def outcome(taken: Decision | Refused) -> str:
    return "refused" if isinstance(taken, Refused) else taken.outcome


def books_after(goals: Iterable[Goal]) -> dict[str, Any]:
    repo = MemoryRepo()
    for goal in goals:
        repo.send(goal)
    return repo.bookkeeping()
