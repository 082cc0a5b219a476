"""A topic gives a warning only if it is probably a misspelling of a known topic."""

from __future__ import annotations

import pytest

from tests.kit import plain_yaml
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo


@pytest.mark.parametrize("role", ["point_cloud", "ego_data", ""])
@pytest.mark.parametrize(("source", "topic", "known", "meant"), plain_yaml.beside(__file__))
def test_it_is_told_with_the_topic_of_the_inventory_or_of_an_earlier_demand(
    source: str, topic: str, known: list[str], meant: str, role: str
) -> None:
    """As an input of an application, and on a connection alone."""
    books = MemoryRepo()
    for number, one in enumerate([*known, topic]):
        link = {"id": f"c{number}", "source": source, "target": "edge", "topics": [{"source": one}]}
        demand = put(f"d{number}", applications=[], connections=[link])
        if role:
            demand = put(f"d{number}")
            demand["applications"][0]["inputs"] = {role: [{"topic": one, "source": source}]}
        decision = books.send(demand)
    told = f"'{source}' is not known to publish {topic}; did you mean '{meant}'?"
    warned = [text for text in decision.warnings if "did you mean" in text]
    assert [told in text for text in warned] == [True] * bool(meant)
