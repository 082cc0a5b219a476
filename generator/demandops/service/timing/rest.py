"""A pause after an error: the worker does not fetch, but still publishes demands."""

from __future__ import annotations

from demandops.runtime import Runtime

FIRST_S, LONGEST_S = 1.0, 60.0


class Rest:
    """A pause after an error; each further error doubles it until a success."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._next, self._until = FIRST_S, runtime.monotonic()

    def __bool__(self) -> bool:
        return self._runtime.monotonic() < self._until

    @property
    def follows_success(self) -> bool:
        return self._next == FIRST_S

    def seconds_left(self) -> float:
        return self._until - self._runtime.monotonic()

    def begin(self) -> None:
        self._until = self._runtime.monotonic() + self._next
        self._next = min(2 * self._next, LONGEST_S)

    def succeeded(self) -> None:
        self._next = FIRST_S
