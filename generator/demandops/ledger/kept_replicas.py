"""Kept replicas: those that a service keeps for a while although its demands need fewer.

A definition may set how long a service keeps replicas (``scaling.downAfter``). Then the service has
the highest number of replicas that its demands needed within this time. Its record, the file
``ledger/replicas/<hh>/<name>.yaml``, lists each number above the present need, with the time until
which it is kept. When that time passes, the generator removes the number by a commit. The replicas
depend on the record, never on the clock, so ``demandops verify`` computes the same bytes again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Literal, NamedTuple, TypeAlias

from pydantic import Field
from rpds import HashTrieMap, HashTrieSet

from demandops import naming, strict_yaml
from demandops.config.base_model import FrozenModel, parse_file
from demandops.errors import InvalidInput
from demandops.ledger.claim_file import (
    LEDGER_ROOT,
    Timestamp,
    format_timestamp,
    minute_of,
    parse_timestamp,
    segment,
)
from demandops.settings import LEDGER_API_VERSION

REPLICAS_ROOT = f"{LEDGER_ROOT}/replicas"

# the key of a service instance: the text ``replicas``, then the values of _FIELDS
Instance: TypeAlias = "tuple[str, ...]"

_FIELDS = ("service", "node", "application", "source", "topic", "version", "scope")


class Kept(NamedTuple):
    """One step of scaling down: a service keeps ``replicas`` replicas until ``until``."""

    replicas: int
    until: datetime


# each step has fewer replicas and a later end than the previous one
Steps: TypeAlias = "tuple[Kept, ...]"


def extended(steps: Steps, needed: int, was_needed: int, now: datetime, until: datetime) -> Steps:
    """Return the steps of a service whose demands now need more or fewer replicas.

    ``until`` is the end of a new step.
    """
    if was_needed > needed:
        # the new step ends last, so it covers each step with as many replicas or fewer
        steps = (*(step for step in steps if step.replicas > was_needed), Kept(was_needed, until))
    left: list[Kept] = []
    for step in steps:
        # the clock may have been set back, so a later step may end first
        if step.replicas > needed and step.until > (left[-1].until if left else now):
            left.append(step)
    return tuple(left)


@dataclass(frozen=True, slots=True)
class KeptReplicas:
    """The records of all services that keep replicas."""

    steps: HashTrieMap[Instance, Steps] = field(default_factory=HashTrieMap)
    # by the minute in which the first step ends, so that the next end is found without a scan
    by_minute: HashTrieMap[str, HashTrieSet[Instance]] = field(default_factory=HashTrieMap)

    def replace(self, instance: Instance, steps: Steps) -> KeptReplicas:
        """Return the records with ``steps`` for ``instance``; empty steps remove its record."""
        old = self.steps.get(instance) or ()
        if old == steps:
            return self
        all_steps, by_minute = self.steps, self.by_minute
        if old:
            minute = minute_of(old[0].until)
            left = by_minute[minute].remove(instance)
            by_minute = by_minute.insert(minute, left) if left else by_minute.remove(minute)
            all_steps = all_steps.remove(instance)
        if steps:
            minute = minute_of(steps[0].until)
            others = by_minute.get(minute) or HashTrieSet()
            by_minute = by_minute.insert(minute, others.insert(instance))
            all_steps = all_steps.insert(instance, steps)
        return KeptReplicas(all_steps, by_minute)

    def due(self, now: datetime) -> list[Instance]:
        """Return the instances whose first step of scaling down has ended, sorted."""
        return sorted(
            instance
            for minute in self.by_minute
            if minute <= minute_of(now)
            for instance in self.by_minute[minute]
            if self.steps[instance][0].until <= now
        )

    def next_end(self) -> datetime | None:
        if not self.by_minute:
            return None
        first = self.by_minute[min(self.by_minute)]
        return min(self.steps[instance][0].until for instance in first)


def path_of(instance: Instance) -> str:
    exact = json.dumps(instance[1:], ensure_ascii=True)
    return f"{REPLICAS_ROOT}/{naming.hash_of(exact, 2)}/{segment(exact)}.yaml"


def text_of(instance: Instance, steps: Steps) -> str:
    named = zip(_FIELDS, instance[1:], strict=True)
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "KeptReplicas",
            **{name: value for name, value in named if value},
            "keeps": [
                {"replicas": step.replicas, "until": format_timestamp(step.until)} for step in steps
            ],
        }
    )


class _Kept(FrozenModel):
    replicas: int = Field(ge=1, le=1000)
    until: Timestamp


class _KeptReplicasFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2"]
    kind: Literal["KeptReplicas"]
    service: str
    node: str
    application: str = ""
    source: str = ""
    topic: str = ""
    version: str = ""
    scope: Literal["", "cluster"] = ""
    keeps: tuple[_Kept, ...] = Field(min_length=1, strict=False)


def read(text: str, path: str) -> tuple[Instance, Steps] | None:
    """Return the record in a file; ``None`` if the file is not valid or belongs at another path."""
    # a person may have written the file; a mistake in it must not stop demands
    try:
        file = parse_file(_KeptReplicasFile, text, path)
    except InvalidInput:
        return None
    instance = ("replicas", *(getattr(file, name) for name in _FIELDS))
    steps = tuple(Kept(step.replicas, parse_timestamp(step.until)) for step in file.keeps)
    falls = all(a.replicas > b.replicas and a.until < b.until for a, b in pairwise(steps))
    return (instance, steps) if falls and path == path_of(instance) else None


def read_all(files: Mapping[str, str]) -> KeptReplicas:
    """Return the records in ``files``, a map from path to text; invalid files are skipped."""
    kept = KeptReplicas()
    for path, text in files.items():
        if record := read(text, path):
            kept = kept.replace(*record)
    return kept
