"""Replicas are removed after the time in the definition, and the ledger alone decides when."""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from pathlib import Path

import pytest
import yaml
from demandops.decide.state import rendered_files
from demandops.model.config.appdef import Scaling
from demandops.model.ledger.records import extended, read_replicas, replicas_path, replicas_text
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.appdefs.test_scaling import books, demand, fact, values
from tests.kit.chance import examples
from tests.kit.memory import NOW, ledger_in

PAGE = (Path(__file__).parents[3] / "docs" / "appdef.md").read_text()
WINDOW = timedelta(minutes=10)
SCALING = "{max: 9, per: {topics: 1}, downAfter: 10m}"
STEPS = st.lists(
    st.tuples(st.integers(0, 400), st.one_of(st.none(), st.integers(0, 9))), max_size=25
)
"""Steps: the seconds that pass, and the number of topics that are demanded after these seconds.

If the number is 0, the demand is released. If it is None, only the time passes.
"""


@given(STEPS)
@examples(15)
def test_a_service_has_the_most_that_it_needed_in_the_time(
    steps: list[tuple[int, int | None]],
) -> None:
    repo, now = books(SCALING), NOW
    needs: list[tuple[datetime, int]] = []
    """(time, number) of each need: from this time on, the service needed this many replicas."""
    for seconds, topics in [(0, 1), *steps]:
        now += timedelta(seconds=seconds)
        repo.scale_down(now)
        if topics:
            repo.send(demand(topics=topics), now)
            needs.append((now, topics))
        elif topics == 0 and needs:
            repo.send(demand() | {"operation": "release", "applications": []}, now)
            needs = []
        assert ledger_in(repo.files) == repo.state.ledger
        again = rendered_files(repo.state)
        assert {path: repo.files[path] for path in again} == again
        if not needs:
            assert not repo.state.ledger.kept.steps
            assert not any(path.startswith("ledger/replicas/") for path in repo.files)
            continue
        ends = [*(since for since, _ in needs[1:]), now + WINDOW]
        recent = [count for (_, count), end in zip(needs, ends, strict=True) if end + WINDOW > now]
        assert values(repo)["replicas"] == max(recent)


def test_the_commit_says_until_when_replicas_are_kept() -> None:
    repo = books(SCALING)
    repo.send(demand(topics=4))
    repo.send(demand(topics=2))
    assert fact(repo) == "4 until 2026-01-31T12:10:00Z"


def test_a_clock_that_was_set_back_gives_a_valid_record() -> None:
    late, early = NOW + timedelta(hours=1), NOW
    steps = extended((), 3, 5, late, late + WINDOW)
    steps = extended(steps, 1, 3, early, early + WINDOW)
    assert [one.replicas for one in steps] == [5]
    instance = ("replicas", "service", "edge", "app", "", "", "", "")
    text = replicas_text(instance, steps)
    assert read_replicas(text, replicas_path(instance)) == (instance, steps)
    assert read_replicas(text, replicas_path((*instance[:-1], "other"))) is None


@pytest.mark.parametrize(
    ("scaling", "problem"),
    [
        ("{downAfter: 10m}", "'downAfter' does nothing without 'per' or 'sizes'; remove"),
        ("{max: 3, autoscaler: {cpu: 70}, downAfter: 10m}", "an autoscaler has a delay of its own"),
        ("{max: 3, per: {topics: 1}, downAfter: 0s}", "downAfter is zero; leave it out"),
        ("{max: 3, per: {topics: 1}, downAfter: soon}", "'soon' is not a duration"),
    ],
)
def test_a_time_that_does_nothing_is_a_fault(scaling: str, problem: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(problem)):
        Scaling.model_validate(yaml.safe_load(scaling))


def test_the_example_of_the_page() -> None:
    section = PAGE[PAGE.index("### Coming down later") :].partition("\n## ")[0]
    (scaling,) = re.findall(r"^    scaling: (\{.*\})$", section, re.MULTILINE)
    row = r"^\| (\d\d:\d\d) \| (?:(\d+) topics)?[^|]* \| (\d) \|$"
    rows = re.findall(row, section, re.MULTILINE)
    assert len(rows) > 5
    repo = books(scaling)
    for time, topics, wanted in rows:
        now = NOW.replace(hour=int(time[:2]), minute=int(time[3:]))
        repo.scale_down(now)
        if topics:
            repo.send(demand(topics=int(topics)), now)
        assert values(repo)["replicas"] == int(wanted), time
