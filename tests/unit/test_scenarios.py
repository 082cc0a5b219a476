"""Every scenario of ``tests/scenarios`` holds, and a scenario that checks nothing is refused."""

from __future__ import annotations

import pytest
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.scenarios import running

FILES = running.scenarios()


@pytest.mark.parametrize("name", FILES)
def test_scenario(name: str) -> None:
    scenario = running.read(FILES[name].read_text(), str(FILES[name]))
    if scenario.invalid is None:
        running.run(scenario)
        return
    with pytest.raises(InvalidInput) as error:
        load(running.configuration(scenario.appdefs, scenario.config))
    told = "\n".join(f"{found.code}: {found}" for found in error.value.faults)
    assert running.same_faults(scenario.invalid, error.value.faults), told


WRONG = plain_yaml.beside(__file__, "wrong-scenarios")


@pytest.mark.parametrize(("text", "told"), WRONG["unread"])
def test_a_scenario_that_could_not_fail_is_not_read(text: str, told: str) -> None:
    with pytest.raises(InvalidInput) as error:
        running.read(text, "scenario.yaml")
    assert told in str(error.value)


@pytest.mark.parametrize(("claimed", "told"), WRONG["wrong"])
def test_a_scenario_fails_where_something_else_comes_out(claimed: str, told: str) -> None:
    scenario = running.read(f"{WRONG['put']}  {claimed}\n", "scenario.yaml")
    with pytest.raises(AssertionError) as error:
        running.run(scenario)
    assert told in str(error.value)
