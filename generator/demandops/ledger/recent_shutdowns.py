"""Recent shutdowns, so that a shutdown that is sent again within 15 minutes is recognized.

A client that lost the answer sends its shutdown again, perhaps to another generator. Without a
record of the first shutdown, the repeat could release another demand of the same requesters. If a
join or a restoration books something for one of the requesters, the record is removed, because the
next shutdown may mean what was booked.

Each record is one file: ``ledger/shutdowns/<hh>/<digest>.yaml``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import islice
from typing import Literal, TypeAlias

from pydantic import Field
from rpds import HashTrieMap, HashTrieSet

from demandops import strict_yaml
from demandops.config.base_model import FrozenModel, parse_file
from demandops.demand.demand_request import Shutdown
from demandops.errors import InvalidInput
from demandops.ledger.claim_file import (
    LEDGER_ROOT,
    Timestamp,
    format_timestamp,
    minute_of,
    parse_timestamp,
)
from demandops.settings import LEDGER_API_VERSION

SHUTDOWNS_ROOT = f"{LEDGER_ROOT}/shutdowns"

# how long after a shutdown the same shutdown counts as a repeat, not as a new one
REMEMBERED = timedelta(minutes=15)

# How old a record must be before forget removes it because of its age. This is longer than
# REMEMBERED, because a repeat that was received in time may wait in a journal before it is decided.
_KEPT = timedelta(hours=1)

# How many old records one request removes at most, so that its commit stays small. It adds one
# record, so old records do not pile up.
_FORGOTTEN = 10

_Index: TypeAlias = "HashTrieMap[str, HashTrieSet[str]]"


@dataclass(frozen=True, slots=True)
class RecentShutdown:
    """The record of a shutdown that released something; ``at`` is when it was received."""

    digest: str
    request: str
    requesters: tuple[str, ...]
    at: datetime

    @classmethod
    def of(cls, request: Shutdown, at: datetime) -> RecentShutdown:
        # what is listed twice or in another order is the same shutdown
        listed = {
            (
                item.held.subject.kind.value,
                item.held.subject.id,
                tuple(sorted(set(item.requesters))),
                item.held.distinguishing_values(),
                tuple(sorted({words for words, _ in item.held.listed_topics(item.held)})),
            )
            for item in request.demanded
        }
        exact = json.dumps([request.id, sorted(listed)], ensure_ascii=True)
        digest = hashlib.sha256(exact.encode()).hexdigest()[:20]
        return cls(digest, request.id, tuple(sorted(request.requesters())), at)


@dataclass(frozen=True, slots=True)
class RecentShutdowns:
    """The recent shutdowns by digest, and their digests by requester and by minute."""

    by_digest: HashTrieMap[str, RecentShutdown] = field(default_factory=HashTrieMap)
    by_requester: _Index = field(default_factory=HashTrieMap)
    by_minute: _Index = field(default_factory=HashTrieMap)

    def earlier(self, shutdown: RecentShutdown) -> RecentShutdown | None:
        """Return the record of the shutdown that ``shutdown`` repeats, or ``None``."""
        record = self.by_digest.get(shutdown.digest)
        # a person may have written a record that has this digest and other requesters
        same = record is not None and replace(record, at=shutdown.at) == shutdown
        return record if record and same and abs(shutdown.at - record.at) <= REMEMBERED else None

    def replace(self, digest: str, shutdown: RecentShutdown | None) -> RecentShutdowns:
        """Return all records, with the one at ``digest`` replaced; ``None`` removes the record."""
        old = self.by_digest.get(digest)
        if old == shutdown:
            return self
        by_digest, by_requester, by_minute = self.by_digest, self.by_requester, self.by_minute
        if old is not None:
            by_digest = by_digest.remove(digest)
            by_minute = _removed(by_minute, minute_of(old.at), digest)
            for who in old.requesters:
                by_requester = _removed(by_requester, who, digest)
        if shutdown is not None:
            by_digest = by_digest.insert(digest, shutdown)
            by_minute = _added(by_minute, minute_of(shutdown.at), digest)
            for who in shutdown.requesters:
                by_requester = _added(by_requester, who, digest)
        return RecentShutdowns(by_digest, by_requester, by_minute)

    def forget(
        self, now: datetime, requesters: Iterable[str] = ()
    ) -> tuple[RecentShutdowns, tuple[str, ...]]:
        """Return the records that are left, and the digests of those that are removed.

        Those are the ten oldest of more than an hour, and all that name one of ``requesters``.
        """
        ended = sorted(minute for minute in self.by_minute if minute < minute_of(now - _KEPT))
        old = (digest for minute in ended for digest in sorted(self.by_minute[minute]))
        forgotten = {*islice(old, _FORGOTTEN)}
        forgotten |= {digest for who in requesters for digest in self.by_requester.get(who, ())}
        left = self
        for digest in forgotten:
            left = left.replace(digest, None)
        return left, tuple(sorted(forgotten))


def _added(index: _Index, key: str, digest: str) -> _Index:
    return index.insert(key, index.get(key, HashTrieSet()).insert(digest))


def _removed(index: _Index, key: str, digest: str) -> _Index:
    left = index[key].remove(digest)
    return index.insert(key, left) if left else index.remove(key)


def path_of(digest: str) -> str:
    return f"{SHUTDOWNS_ROOT}/{digest[:2]}/{digest}.yaml"


def digest_in(path: str) -> str:
    return path.rsplit("/", 1)[-1].removesuffix(".yaml")


def text_of(shutdown: RecentShutdown) -> str:
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "Shutdown",
            "digest": shutdown.digest,
            "request": shutdown.request,
            "requesters": list(shutdown.requesters),
            "at": format_timestamp(shutdown.at),
        }
    )


class _ShutdownFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2"]
    kind: Literal["Shutdown"]
    digest: str = Field(pattern=r"^[0-9a-f]{20}$")
    request: str
    requesters: tuple[str, ...] = Field(min_length=1, strict=False)
    at: Timestamp


def read(text: str, path: str) -> RecentShutdown | None:
    """Return the record in a file; ``None`` if the file is not valid or belongs at another path."""
    try:
        file = parse_file(_ShutdownFile, text, path)
    except InvalidInput:
        return None
    requesters = tuple(sorted(set(file.requesters)))  # a person may have listed one twice
    record = RecentShutdown(file.digest, file.request, requesters, parse_timestamp(file.at))
    return record if path == path_of(file.digest) else None


def read_all(files: Mapping[str, str]) -> RecentShutdowns:
    """Return the records in ``files``, a map from path to text; invalid files are skipped."""
    shutdowns = RecentShutdowns()
    for path, text in files.items():
        if record := read(text, path):
            shutdowns = shutdowns.replace(record.digest, record)
    return shutdowns
