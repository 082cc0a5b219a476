"""Changes to the ledger when overrides change or end: kept claims, markers of ended overrides.

An override whose end had passed when it was merged never applies. The generator ends an override
that was in effect with a commit of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Protocol

from demandops.config.config import Config
from demandops.config.override import Override, format_time
from demandops.demand.claim import ClaimKey
from demandops.ledger import claim_file, ended_override_file
from demandops.ledger.ledger import Ledger
from demandops.plan.overrides import kept_claims
from demandops.subject import Subject


class LedgerAndConfig(Protocol):
    """Ledger and configuration at one time, for example :class:`demandops.decision.State`."""

    @property
    def ledger(self) -> Ledger:
        """The claims."""

    @property
    def config(self) -> Config:
        """The files that people write."""


@dataclass(frozen=True, slots=True)
class LedgerUpdate:
    """Ledger and configuration after overrides changed, with the ledger files to write.

    ``keys`` are the claims that may have changed.
    """

    ledger: Ledger
    config: Config
    keys: tuple[ClaimKey, ...] = ()
    files: Mapping[str, str | None] = field(default_factory=dict)


def update_ledger(
    before: LedgerAndConfig,
    after: LedgerAndConfig,
    subjects: Iterable[Subject],
    markers: Mapping[str, str],
    now: datetime,
) -> LedgerUpdate:
    """Return the update that a change of the configuration requires.

    Args:
        before, after: ledger and configuration before and after the change.
        subjects: those whose claims a person changed.
        markers: the current markers, path → text.
        now: new overrides that end by then do not apply.
    """
    config = after.config
    known = {one.name: one for one in before.config.active_overrides}
    expired = [
        one
        for one in expired_overrides(config, now)
        if one.name not in known or known[one.name].end != one.end
    ]
    stale = ended_override_file.stale_markers(markers, config.overrides)
    ended = {
        name: end
        for name, end in config.ended_overrides.items()
        if ended_override_file.path_of(name) not in stale
    }
    ended |= {one.name: format_time(one.end) for one in expired if one.end}
    config = config.with_ended_overrides(ended)
    files: dict[str, str | None] = dict.fromkeys(stale)
    for override in expired:
        files |= _marker(override)
    kept = (*kept_claims.kept_subjects(before.ledger), *kept_claims.kept_subjects(after.ledger))
    updated, keys = kept_claims.update_kept_claims(
        before.ledger, after.ledger, dict.fromkeys((*subjects, *kept)), config, now
    )
    files |= changed_claim_files(after.ledger, updated, keys)
    return LedgerUpdate(updated, config, tuple(keys), files)


def end_override(state: LedgerAndConfig, override: Override, now: datetime) -> LedgerUpdate:
    """Return the update that ends an override."""
    if override.end is None:
        raise ValueError(f"{override.path} has no end")
    ended = {**state.config.ended_overrides, override.name: format_time(override.end)}
    after = LedgerUpdate(state.ledger, state.config.with_ended_overrides(ended))
    update = update_ledger(state, after, (), {}, now)
    return replace(update, files={**update.files, **_marker(override)})


def _marker(override: Override) -> dict[str, str]:
    return {ended_override_file.path_of(override.name): ended_override_file.text_of(override)}


def changed_claim_files(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> dict[str, str | None]:
    """Return the claim files at ``keys`` that differ, path → text; ``None`` removes a file."""
    files: dict[str, str | None] = {}
    for key in keys:
        claim = after.get(key)
        if claim != before.get(key):
            files[claim_file.path_of(key)] = claim_file.text_of(claim) if claim else None
    return files


def expired_overrides(config: Config, now: datetime) -> list[Override]:
    """Return the overrides in effect whose end has passed, sorted by their end."""
    expired = [
        (one.end, one.name, one) for one in config.active_overrides if one.end and one.end <= now
    ]
    return [one for _, _, one in sorted(expired, key=lambda item: item[:2])]


def changed_override_files(before: Config, after: Config) -> list[str]:
    """Return the files of the overrides that took effect, changed or stopped applying."""
    old = {one.name: one for one in before.active_overrides}
    new = {one.name: one for one in after.active_overrides}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
