"""A flag of one item of a list is set in the file's text, and all else stays as it is."""

from __future__ import annotations

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput

BLOCK = "nodes:  # all\n  - id: a  # first\n    type: x\n\n  - type: y\n    id: b"


@pytest.mark.parametrize(
    ("text", "id", "wanted"),
    [
        (BLOCK, "a", BLOCK.replace("# first\n", "# first\n    drained: true\n")),
        (BLOCK, "b", f"{BLOCK}\n    drained: true\n"),
        ("nodes: [{id: a}, {id: b, t: {u: 1}}]\n", "b",
         "nodes: [{id: a}, {id: b, drained: true, t: {u: 1}}]\n"),
        ("nodes:\n- drained: false # not yet\n  id: a\n", "a",
         "nodes:\n- drained: true # not yet\n  id: a\n"),
        ("nodes:\r\n- id: a\r\n  t: 1\r\n", "a",
         "nodes:\r\n- id: a\r\n  drained: true\r\n  t: 1\r\n"),
    ],
)  # fmt: skip
def test_only_the_flag_changes(text: str, id: str, wanted: str) -> None:
    assert strict_yaml.set_flag(text, "nodes", id, "drained", True) == wanted


def test_a_flag_that_has_its_own_line_is_taken_away() -> None:
    drained = strict_yaml.set_flag(BLOCK, "nodes", "a", "drained", True)
    assert strict_yaml.set_flag(drained, "nodes", "a", "drained", False) == BLOCK
    first = "nodes:\n- drained: true\n  id: a\n"
    changed = strict_yaml.set_flag(first, "nodes", "a", "drained", False)
    assert changed == first.replace("true", "false")


def test_what_two_items_share_is_left_to_a_person() -> None:
    text = "nodes:\n- &a {id: a}\n- <<: *a\n  id: b\n"
    with pytest.raises(InvalidInput):
        strict_yaml.set_flag(text, "nodes", "b", "drained", True)
