"""The times of the stages between a goal and its pods, and a table of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

_STAGES = ("committed", "pushed", "fetched", "applied", "ready", "in all")


@dataclass(frozen=True)
class Times:
    """The monotonic times in seconds at which a demand reached each stage.

    `committed` and `pushed` come from the node's feedback. The test finds the later times by
    polling every 0.1 s.
    """

    goal: float
    committed: float
    pushed: float
    fetched: float
    applied: float
    ready: float

    @property
    def total(self) -> float:
        """The seconds from the goal until the last pod is ready or gone."""
        return self.ready - self.goal

    def row(self) -> list[float]:
        """Return the seconds that each stage took, and their sum."""
        at = astuple(self)
        return [at[place + 1] - at[place] for place in range(len(at) - 1)] + [self.total]


class Table:
    """A table of times with one titled row for each demand."""

    def __init__(self, heading: str) -> None:
        self._heading = heading
        self._rows: list[tuple[str, Times]] = []

    def add(self, title: str, times: Times) -> None:
        self._rows.append((title, times))

    def show(self, say: Callable[[str], None]) -> None:
        width = max(len(title) for title, _ in self._rows)
        say(f"\n{self._heading} (seconds)")
        say(" " * (width + 2) + "".join(f"{stage:>11}" for stage in _STAGES))
        for title, times in self._rows:
            say(f"  {title:<{width}}" + "".join(f"{value:11.2f}" for value in times.row()))
