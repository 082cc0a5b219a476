"""Read scenarios, and run them on a state repo in memory.

Time passes only where a step has ``after``. In every step, before the step's demand is sent, the
generator's own lease clock decides which leases have ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import yaml
from demandops.base.errors import Fault, Refused
from demandops.decide.booking import Drain, Restoration
from demandops.decide.checks.forbidden import whole_usage
from demandops.decide.decision import Decision
from demandops.decide.edits import changed_claim_files
from demandops.decide.placement.relocation import following_overrides
from demandops.decide.state import State, rendered_files
from demandops.model.config.base_model import (
    FrozenModel,
    duration_text,
    parse_file,
    seconds_of,
)
from demandops.model.config.config import Config
from demandops.model.config.load import load
from demandops.model.demand.demand import Demand
from demandops.model.ledger.ledger import Ledger
from demandops.model.ledger.records import in_turn
from demandops.serve.agenda import Agenda, RateLimit
from pydantic import Field, model_validator

from tests.kit import plain_yaml
from tests.kit.clock import Clock
from tests.kit.config import configuration as skeleton_config
from tests.kit.config import skeleton, state_of, texts_below
from tests.kit.memory import NOW as START
from tests.kit.memory import MemoryRepo, is_of_ledger, ledger_in

HERE = Path(__file__).parent
_APPDEFS = HERE.parent / "appdefs"


# ---- the form of a scenario ----


class ExpectedFault(FrozenModel):
    code: str = "invalid"
    file: str = ""
    field: str = ""
    says: list[str] = Field(default_factory=list)

    def fits(self, found: Fault) -> bool:
        words = all(word in found.message for word in self.says)
        return (self.code, self.file, self.field) == (found.code, found.file, found.field) and words


class Step(FrozenModel):
    """An event of a scenario, and its expected effects; an effect that is None is not compared.

    ``config`` changes files as a person does, ``clock`` sets only the wall clock, ``restart``
    discards the generator's memory, and ``expires`` lists the demands that it then releases, in
    order. ``asks`` is who must approve the demand, and ``places`` why it got its nodes.
    ``back_to`` rolls back to the claims after a step, by its number.
    """

    why: str = ""
    after: str = "0s"
    clock: str = ""
    restart: bool = False
    config: dict[str, dict[str, Any]] = Field(default_factory=dict)
    send: dict[str, Any] | None = None
    back_to: int | None = None
    drop_newer: bool = False
    gives: Literal["booked", "released", "unchanged", "waiting", "restored"] | None = None
    waiting: list[str] | None = None
    refused: list[ExpectedFault] | None = None
    warns: list[str] | None = None
    asks: list[str] | None = None
    places: list[str] | None = None
    expires: list[str] | None = None
    runs: dict[str, list[str]] | None = None
    connections: dict[str, list[str]] | None = None
    carries: dict[str, list[str]] | None = None
    desired: list[str] | None = None
    leases: dict[str, str] | None = None
    holds: dict[str, list[str]] | None = None
    nodes: dict[str, dict[str, str]] | None = None
    effects: dict[str, str] | None = None

    @model_validator(mode="after")
    def _checkable(self) -> Step:
        optional = {name for name, each in type(self).model_fields.items() if each.default is None}
        checks = sorted(optional - {"send", "back_to"})
        if all(getattr(self, name) is None for name in checks):
            raise ValueError(f"checks nothing; add at least one of {', '.join(checks)}")
        if self.refused is not None and not self.refused:
            raise ValueError("refused is empty; list the faults that the refusal must have")
        if self.holds is not None and not (self.holds and all(self.holds.values())):
            raise ValueError("holds is empty, or lists no words for a release")
        if self.sends and (self.gives is None) == (self.refused is None):
            raise ValueError("a step with send or back_to needs either gives or refused")
        of_demand = (self.gives, self.refused, self.desired, self.warns, self.asks, self.places)
        if not self.sends and any((*of_demand, self.effects)):
            raise ValueError("the effects of a demand need a demand; add send")
        return self

    @property
    def sends(self) -> bool:
        return self.send is not None or self.back_to is not None


class Scenario(FrozenModel):
    """A scenario.

    ``config`` is merged into what ``demandops init`` writes, ``appdefs`` are of tests/appdefs,
    and ``invalid`` lists the faults that the configuration must have.
    """

    must: str = Field(min_length=1)
    appdefs: list[Literal["recorder", "monitor", "planner"]] = Field(default_factory=list)
    config: dict[str, dict[str, Any]] = Field(default_factory=dict)
    invalid: list[ExpectedFault] | None = None
    steps: list[Step] = Field(default_factory=list)

    @model_validator(mode="after")
    def _checkable(self) -> Scenario:
        if bool(self.invalid) == bool(self.steps):
            raise ValueError("a scenario needs either steps or invalid, not both")
        return self


def read(text: str, file: str) -> Scenario:
    return parse_file(Scenario, text, file)


def scenarios() -> dict[str, Path]:
    return {path.stem: path for path in sorted(HERE.glob("*.yaml"))}


# ---- the configuration ----


def _laid_over(below: Any, above: Any) -> Any:
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _laid_over(below.get(key), value) for key, value in above.items()}


def configuration(
    appdefs: Iterable[str] = (), config: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, str]:
    files = skeleton_config()
    overlays = dict[str, Any]()
    for name in (*appdefs, "driver") if appdefs else ():
        for path, text in texts_below(_APPDEFS / name).items():
            files[f"appdefs/{name}/{path}"] = text
        overlays = plain_yaml.load((_APPDEFS / "registry.yaml").read_text())
    for path, above in (*overlays.items(), *(config or {}).items()):
        below = plain_yaml.load(files[path]) if path in files else {}
        files[path] = yaml.safe_dump(_laid_over(below, above), sort_keys=False)
    return files


# ---- the state repo ----


class World(MemoryRepo):
    def __init__(self, state: State, config: Mapping[str, str]) -> None:
        super().__init__(state=state)
        self.clock, self._sent = Clock(START), 0
        self.configure(state, config)
        self.ledgers = [state.ledger]  # after each step
        self.restart()

    def configure(self, state: State, config: Mapping[str, str]) -> None:
        before = self.state.ledger
        self.state = replace(state, ledger=self.state.ledger)
        moved = following_overrides(self.state)
        self.state = replace(self.state, ledger=moved.ledger)
        empty = replace(state, ledger=Ledger())
        self._initial = {**skeleton(), **config, **rendered_files(empty)}
        ledger = {p: text for p, text in self.files.items() if is_of_ledger(p)}
        moved_files = changed_claim_files(before, moved.ledger, moved.keys)
        for path, text in moved_files.items():
            ledger.pop(path) if text is None else ledger.update({path: text})
        self.files = {**self._initial, **ledger, **rendered_files(self.state, self.files)}

    def restart(self) -> None:
        self._lease_clock = Agenda(0, self.clock)
        self._throttle = RateLimit()

    def decide(self, goal: object, now: datetime | None = None) -> Decision:
        self._sent += 1
        return super().decide(goal, self.clock.now())

    def throttle(self, request: Demand, config: Config) -> Iterable[Fault]:
        operation = f"hand-in-{self._sent}"
        return self._throttle.faults(request, config, operation, self.clock.now())

    def do_what_is_due(self) -> list[str]:
        """Do what the generator does by itself; return the demands whose leases ended, in order."""
        now, claims = self._lease_clock.ended_claims(self.state.ledger)
        done = list(dict.fromkeys(claim.demand for claim in claims))
        for demand in done:
            taken = self.take(Demand("expire", demand, demand=demand, is_complete=True))
            assert isinstance(taken, Decision)
            assert taken.files, f"nothing of '{demand}' was released at {now}"
        for node in self.state.nodes_to_drain():
            self.take(Drain(id=node))
        self.book_waiting()
        return done

    def book_waiting(self) -> None:
        for waiting in in_turn(self.state.ledger.waiting):
            taken = self.take(waiting.put)
            assert isinstance(taken, Decision), taken

    def compared(self) -> dict[str, Any]:
        """Return what steps may expect of the state.

        ``runs`` has services like `driver for vehicle00 /points on edge`, ``nodes`` what is
        requested of each node that has a capacity, such as `1 of 3`.
        """
        books = self.bookkeeping()
        services, links = books["services"].values(), books["connections"].items()
        leased = sorted((one.lease.until, one.demand) for one in self.state.ledger if one.lease)
        return {
            "runs": {f"{each['service']} for {_purpose(each)} on {each['node']}": each["requesters"]
                for each in services},
            "nodes": {id: {name: f"{one['requested']} of {one['capacity']}"
                for name, one in entry.items()} for id, entry in books.get("nodes", {}).items()},
            "waiting": [one.demand for one in in_turn(self.state.ledger.waiting)],
            "connections": {id: [*entry["requesters"]] for id, entry in links},
            "carries": {id: [*entry["topics"]] for id, entry in links},
            "leases": {demand: duration_text((until - START).total_seconds())
                for until, demand in leased},
        }  # fmt: skip

    def assert_sound(self) -> None:
        """Check that the files are exactly those of the ledger and of the ledger's releases."""
        assert ledger_in(self.files) == self.state.ledger
        counted = whole_usage(self.state).amounts
        assert self.state.usage.amounts == counted, "a change updates what nodes have left"
        asked = rendered_files(self.state, self.files)
        there = {p: text for p, text in self.files.items() if p in asked or p in self.rendered()}
        names = sorted(there.keys() ^ asked.keys())
        assert not names, f"these files are missing, or no release needs them: {names}"
        assert there == asked


def _purpose(entry: Mapping[str, Any]) -> str:
    of_source = f"{entry['source']} {entry['source_topic']}"
    return of_source if entry["source"] else ", ".join(entry["applications"])


# ---- the run ----


def run(scenario: Scenario) -> None:
    files = configuration(scenario.appdefs, scenario.config)
    world = World(state_of(load(files)), files)
    for number, step in enumerate(scenario.steps, 1):
        if step.config:
            files = configuration(scenario.appdefs, _laid_over(scenario.config, step.config))
            world.configure(state_of(load(files)), files)
        place = f"step {number}{f' ({step.why})' if step.why else ''}"
        _take(step, world, place)
        try:
            world.assert_sound()
        except AssertionError as error:
            raise AssertionError(f"{place}: {error}") from error
        world.ledgers.append(world.state.ledger)


def _take(step: Step, world: World, place: str) -> None:
    world.clock.pass_(seconds_of(step.after))
    if step.clock:
        sign = -1 if step.clock.startswith("-") else 1
        world.clock.set_by(sign * seconds_of(step.clock.removeprefix("-")))
    if step.restart:
        world.restart()
    ended = world.do_what_is_due()
    assert ended == (step.expires or []), f"{place}: other demands expire than expected"
    if step.sends:
        goal: object = step.send
        if step.back_to is not None:
            then = tuple(world.ledgers[step.back_to])
            goal = Restoration(id="back", to="0" * 40, claims=then, drop_newer=step.drop_newer)
        taken = world.take(goal)
        for problem in _sent(step, taken):
            raise AssertionError(f"{place}: {problem}")
        if isinstance(taken, Decision) and taken.awaited:
            world.book_waiting()
    for name, found in world.compared().items():
        wanted = getattr(step, name)
        assert wanted is None or found == wanted, f"{place}: {name}"
    for name, words in (step.holds or {}).items():
        texts = [t for path, t in world.rendered().items() if Path(path).name.startswith(name)]
        assert len(texts) == 1, f"{place}: {len(texts)} releases are called {name}…"
        missing = [word for word in words if word not in texts[0]]
        assert not missing, f"{place}: {name} holds no {missing}:\n{texts[0]}"


def _sent(step: Step, taken: Decision | Refused) -> Iterator[str]:
    if isinstance(taken, Refused):
        told = "\n".join(f"{found.code}: {found}" for found in taken.faults)
        if step.refused is None:
            yield f"is refused:\n{told}"
        elif not same_faults(step.refused, taken.faults):
            yield f"is refused with other faults:\n{told}"
        return
    if step.refused is not None:
        yield f"is {taken.outcome}, but must be refused"
    elif taken.outcome != step.gives:
        yield f"is {taken.outcome}, but must be {step.gives}"
    if bool(taken.files) != (taken.outcome != "unchanged") and taken.outcome != "waiting":
        yield f"is {taken.outcome}, and makes {'a' if taken.files else 'no'} commit"
    signs = {"start": "+", "change": "~", "stop": "-"}
    desired = sorted(f"{signs[release.change]} {release.what}" for release in taken.releases)
    if step.desired is not None and desired != sorted(step.desired):
        yield f"the desired state changes in another way: {desired}"
    effects = {one.name: one.effect for one in taken.releases}
    for name, effect in (step.effects or {}).items():
        if {each for known, each in effects.items() if known.startswith(name)} != {effect}:
            yield f"has other effects: {effects}"
    if step.asks not in (None, [*taken.approval]):
        yield f"needs the approval of {taken.approval}"
    for name, texts in (("warns", taken.warnings), ("places", taken.placed)):
        wanted = getattr(step, name)
        pairs = zip(wanted or (), texts, strict=False)
        fit = len(texts) == len(wanted or ()) and all(words in one for words, one in pairs)
        if wanted is not None and not fit:
            yield f"{name}: {texts}"


def same_faults(wanted: Iterable[ExpectedFault], found: Iterable[Fault]) -> bool:
    left = list(found)
    for one in wanted:
        fitting = next((fault for fault in left if one.fits(fault)), None)
        if fitting is None:
            return False
        left.remove(fitting)
    return not left
