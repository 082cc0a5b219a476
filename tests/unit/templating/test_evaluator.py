"""What people wrote is evaluated in a process with limits, and no evaluation stops another."""

from __future__ import annotations

import json
import os
import resource
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import InvalidInput, OverLimit
from demandops.decide.state import State, try_configuration
from demandops.model.config.load import load
from demandops.model.ledger.ledger import Ledger
from demandops.templating import evaluator as process_module
from demandops.templating.evaluator import Evaluator, processor_time
from demandops.templating.values import SchemaTask, ValuesTask, evaluate

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton
from tests.kit.goals import perception
from tests.kit.memory import MemoryRepo

FOLDER = "appdefs/object-detection-fusion"
TEMPLATE = f"{FOLDER}/values/object-detection.yaml.j2"
ENDLESS = "{% for a in range(9999) %}" * 3 + "{% endfor %}" * 3
SECONDS = 0.1  # for an evaluation here, so that what never ends costs little


def values(
    text: str, context: Mapping[str, Any] | None = None, on: Evaluator | None = None
) -> dict[str, Any]:
    with processor_time(SECONDS):
        return (on or Evaluator())({"a.j2": text}, ValuesTask("a.j2", context or {}, None))


@pytest.fixture(scope="module")
def shared() -> Evaluator:
    return Evaluator()


@pytest.mark.parametrize("text", plain_yaml.beside(__file__, "endless"))
def test_a_template_that_would_run_for_ever_or_grow_ends(text: str, shared: Evaluator) -> None:
    with pytest.raises(OverLimit) as refused:
        values(text, on=shared)
    assert [(fault.code, fault.file) for fault in refused.value.faults] == [("over-limit", "a.j2")]
    assert values("x: {{ 1 + 1 }}", on=shared) == {"x": 2}


def doubling(times: int) -> dict[str, object]:
    """Return a schema of ``times`` nested definitions; each doubles the work of a validation."""
    steps: dict[str, object] = {
        f"d{i}": {"allOf": [{"$ref": f"#/$defs/d{i + 1}"}] * 2} for i in range(times)
    }
    return {"$ref": "#/$defs/d0", "$defs": {**steps, f"d{times}": {"type": "object"}}}


@pytest.mark.parametrize(
    "schema",
    [
        doubling(60),
        {"additionalProperties": {"allOf": [{"$ref": "#"}] * 2}},
        {"patternProperties": {f"(a|b){{{n}}}": {"$ref": "#"} for n in range(300)}},
    ],
    ids=["doubling", "doubling by depth", "doubling by patterns"],
)
def test_a_schema_that_would_never_end_ends(schema: object, shared: Evaluator) -> None:
    nested: dict[str, Any] = {}
    for _ in range(60):
        nested = {"ab" * 300: nested}
    files = {"a.j2": "{{ x | block(0) }}", "c/values.schema.json": json.dumps(schema)}
    with processor_time(SECONDS), pytest.raises(OverLimit):
        shared(files, ValuesTask("a.j2", {"x": nested}, "c"))


def test_a_schema_that_is_nested_without_end_is_a_fault(shared: Evaluator) -> None:
    text = '{"not":' * 100_000 + "{}" + "}" * 100_000
    with pytest.raises(InvalidInput):
        shared({"s.json": text}, SchemaTask("s.json"))


def test_the_answer_is_that_of_an_evaluation_in_this_process(shared: Evaluator) -> None:
    tasks = list[tuple[Mapping[str, str], ValuesTask | SchemaTask]]()

    def both(files: Mapping[str, str], task: ValuesTask | SchemaTask) -> dict[str, Any]:
        tasks.append((files, task))
        expected = evaluate(files, task)
        assert shared(files, task) == expected
        return expected

    for gitops in ("flux", "argocd"):
        files = {path: text for path, text in skeleton(gitops).items() if path in configuration()}
        books = MemoryRepo(state=State(load(files), Ledger(), both))
        books.send(perception())
    assert tasks


def test_only_what_changed_of_the_files_is_sent_and_what_is_gone_is_gone(shared: Evaluator) -> None:
    assert shared({"a.j2": "{% include 'b.j2' %}", "b.j2": "x: 1"}, task()) == {"x": 1}
    assert shared({"a.j2": "{% include 'b.j2' %}", "b.j2": "x: 2"}, task()) == {"x": 2}
    with pytest.raises(InvalidInput, match=r"'b.j2' does not exist"):
        shared({"a.j2": "{% include 'b.j2' %}"}, task())


def test_evaluations_of_a_demand_share_its_time() -> None:
    evaluator = Evaluator()
    with processor_time(each=1, together=SECONDS):
        with pytest.raises(OverLimit):
            evaluator({"a.j2": ENDLESS}, task())
        with pytest.raises(OverLimit, match="took all the time"):
            evaluator({"a.j2": "x: 1"}, task())
    assert evaluator({"a.j2": "x: 1"}, task()) == {"x": 1}


def task() -> ValuesTask:
    return ValuesTask("a.j2", {}, None)


@pytest.fixture
def idle(shared: Evaluator) -> list[Any]:
    """The processes of children that have ended an evaluation and wait for the next."""
    assert values("x: 1", on=shared) == {"x": 1}
    return [child._process for child in shared._idle]


def test_a_child_that_somebody_ended_is_replaced(shared: Evaluator, idle: list[Any]) -> None:
    for process in idle:
        process.kill()
        process.wait()
    assert values("x: 1", on=shared) == {"x": 1}


def test_a_child_that_kept_too_much_of_earlier_evaluations_is_replaced(
    shared: Evaluator, idle: list[Any]
) -> None:
    for process in idle:
        resource.prlimit(process.pid, resource.RLIMIT_AS, (2**20, 2**20))
    assert values("x: {{ ('a' * 9999999) | length }}", on=shared) == {"x": 9999999}


def test_a_child_that_somebody_stopped_is_given_up(
    shared: Evaluator, idle: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for process in idle:
        process.send_signal(signal.SIGSTOP)
    monkeypatch.setattr(process_module, "_LONGEST_WAIT_S", 0)
    more_than_a_pipe_holds = {"a.j2": "x: 1", "b.j2": "x" * 999_999}
    for _ in idle:
        with processor_time(SECONDS), pytest.raises(OverLimit):
            shared(more_than_a_pipe_holds, task())
    assert [process.poll() for process in idle] == [-signal.SIGKILL] * len(idle)


def test_if_memory_is_short_the_kernel_ends_the_child_first(idle: list[Any]) -> None:
    adjustments = [Path(f"/proc/{one.pid}/oom_score_adj").read_text() for one in idle]
    assert {text.strip() for text in adjustments} == {"1000"}


@pytest.mark.parametrize("of", ["{}[joiner()]", "[1].index(joiner())", "'a'[range]", "{}[{}.get]"])
def test_every_process_gives_the_same_faults(of: str) -> None:
    faults = set()
    for _ in range(2):
        with pytest.raises(InvalidInput) as error:
            values(f"x: {{{{ {of} }}}}")
        faults.add(error.value.faults)
    assert len(faults) == 1
    assert "0x" not in str(faults)


def test_threads_do_not_wait_for_each_other(
    shared: Evaluator, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, results, children = threading.Barrier(4), list[str](), list[Any]()
    child = process_module._Child
    monkeypatch.setattr(process_module, "_Child", lambda: children.append(child()) or children[-1])

    def endless() -> None:
        started.wait()
        with processor_time(30), pytest.raises(OverLimit):
            shared({"a.j2": ENDLESS}, task())
        results.append("ended")

    def quick() -> None:
        started.wait()
        results.append(str(values("x: 1", on=shared)["x"]))

    hang = threading.Thread(target=endless, daemon=True)
    others = [threading.Thread(target=quick) for _ in range(3)]
    for thread in (hang, *others):
        thread.start()
    for thread in others:
        thread.join()
    assert results == ["1", "1", "1"]
    for each in children:  # so that nothing runs on beside other tests
        each._process.kill()
    hang.join()
    assert results[-1] == "ended"


def test_the_child_has_neither_environment_nor_descriptors_of_its_parent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("DEMANDOPS_SECRET", "not for templates")
    evaluator = Evaluator()
    with (tmp_path / "open").open("w") as file:
        os.set_inheritable(file.fileno(), True)
        values("x: 1", on=evaluator)
        (child,) = evaluator._idle
        process = Path(f"/proc/{child._process.pid}")
        assert b"DEMANDOPS_SECRET" not in (process / "environ").read_bytes()
        assert sorted(int(each.name) for each in (process / "fd").iterdir()) == [0, 1, 2]


def test_a_configuration_is_not_invalid_because_it_takes_too_long() -> None:
    config = load(configuration({TEMPLATE: ENDLESS + skeleton()[TEMPLATE]}))
    with processor_time(SECONDS), pytest.raises(OverLimit) as late:
        try_configuration(State(config, Ledger(), Evaluator()))
    assert {fault.file for fault in late.value.faults} == {TEMPLATE}


def test_each_evaluation_tells_that_its_caller_goes_on(shared: Evaluator) -> None:
    told = list[str]()
    with processor_time(SECONDS, meanwhile=lambda: told.append("again")):
        for _ in range(3):
            shared({"a.j2": "x: 1"}, task())
    assert told == ["again"] * 3
