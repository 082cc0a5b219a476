"""A plan that follows a sequence of ledgers, to verify commits.

Planning is a function of ledger and configuration. The plan records which parts of the ledger were
read for each release. As long as none of these parts changes, the release stays the same, so only
the other releases are planned again. The generator instead predicts which releases a claim affects
(:func:`.release_keys.affected_keys`), but a proof must not rely on that prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace
from typing import Any, TypeAlias, TypeVar, cast

from demandops.base.naming import Subject
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import ReleaseKey, keys_of
from demandops.model.config.config import Config
from demandops.model.ledger.ledger import ClaimChange, Ledger, World, index_entries
from demandops.model.ledger.records import Instance
from demandops.model.release import Release

T = TypeVar("T")
Unit = TypeVar("Unit", bound="_Unit")

_Unit: TypeAlias = "Subject | ReleaseKey"
_Read: TypeAlias = "Subject | tuple[str, ...]"

# Records a read of the whole ledger.
_ALL: _Read = ("all",)


class TracedPlan:
    """The plan of one configuration, for ledgers that have the same ended overrides."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._keys: dict[Subject, tuple[ReleaseKey, ...]] = {}
        self._readers: dict[_Read, set[_Unit]] = {}
        self._planned: set[ReleaseKey] = set()

    def advance(
        self, ledger: Ledger, changes: Iterable[ClaimChange], kept: Iterable[Instance] = ()
    ) -> dict[ReleaseKey, Release | None]:
        """Plan the releases that the changes may affect; the first call plans all releases.

        ``kept`` are the service instances whose kept replicas changed. A release that does not run
        any longer is ``None``. If this raises ``Refused``, the plan is out of date and must not be
        used again.
        """
        # The reads whose result may differ now.
        reads: set[_Read] = {_ALL, *kept}
        for change in changes:
            entries = index_entries(change.before), index_entries(change.after)
            reads |= {change.key.subject}.union(*entries)
        stale = {unit for read in reads for unit in self._readers.pop(read, ())}

        def keys_needed(world: World, subject: Subject) -> tuple[ReleaseKey, ...]:
            return tuple(keys_of(world, subject, strict=True))

        for subject in ledger.claims:
            if subject in stale or subject not in self._keys:
                self._keys[subject] = self._traced(ledger, subject, keys_needed)
        for subject in [unit for unit in stale if unit in self._keys]:
            if subject not in ledger.claims:
                del self._keys[subject]
        needed = {key for keys in self._keys.values() for key in keys}
        gone = self._planned - needed
        planned: dict[ReleaseKey, Release | None] = dict.fromkeys(gone)
        for key in sorted(needed - self._planned | (needed & stale), key=repr):
            planned[key] = self._traced(ledger, key, plan)
        self._planned = needed
        return planned

    def _traced(self, ledger: Ledger, unit: Unit, work: Callable[[World, Unit], T]) -> T:
        reads: set[_Read] = set()
        traced = Ledger(
            cast(Any, _Recording(ledger.claims, reads)),
            cast(Any, _Recording(ledger.index, reads)),
            cast(Any, None),  # planning does not read the ends of leases
            ledger.ended,
            # of the kept replicas, planning reads only the steps
            kept=cast(Any, SimpleNamespace(steps=_Recording(ledger.kept.steps, reads))),
        )
        result = work(World(self._config, traced), unit)
        for read in reads:
            self._readers.setdefault(read, set()).add(unit)
        return result


class _Recording:
    """Wraps one of the ledger's mappings, and records which keys are read."""

    def __init__(self, map: Any, reads: set[_Read]) -> None:  # noqa: ANN401 - either map
        self._map, self._reads = map, reads

    def get(self, key: _Read, default: Any = None) -> Any:  # noqa: ANN401
        self._reads.add(key)
        return self._map.get(key, default)

    def __getitem__(self, key: _Read) -> Any:  # noqa: ANN401
        self._reads.add(key)
        return self._map[key]

    def __contains__(self, key: _Read) -> bool:
        self._reads.add(key)
        return key in self._map

    def __iter__(self) -> Iterator[Any]:
        self._reads.add(_ALL)
        return iter(self._map)

    def values(self) -> Any:  # noqa: ANN401
        self._reads.add(_ALL)
        return self._map.values()
