"""The world: the configuration and the ledger in effect at one time, as one value."""

from __future__ import annotations

from dataclasses import dataclass, field

from demandops.config.config import Config
from demandops.config.override import Override, by_rank, still_active
from demandops.ledger.ledger import Ledger


@dataclass(frozen=True, slots=True)
class World:
    """The configuration and the ledger."""

    config: Config
    ledger: Ledger
    # the overrides that have not ended, in the order in which they apply
    overrides: tuple[Override, ...] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        active = by_rank(still_active(self.config.overrides, self.ledger.ended))
        object.__setattr__(self, "overrides", active)
