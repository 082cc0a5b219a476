"""The program changes one field in a text that a person wrote, and all else stays as it is."""

from __future__ import annotations

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.appdef import ignored_fields, without_ignored_fields

from tests.kit import plain_yaml

TABLES = plain_yaml.beside(__file__)


@pytest.mark.parametrize(("text", "id", "wanted"), TABLES["flags"])
def test_only_the_flag_of_one_item_changes(text: str, id: str, wanted: str) -> None:
    assert strict_yaml.set_flag(text, "nodes", id, "drained", True) == wanted
    if wanted.count("\n") > text.count("\n"):
        # a line of its own is taken away again
        assert strict_yaml.set_flag(wanted, "nodes", id, "drained", False).rstrip() == text.rstrip()


def test_a_flag_that_begins_an_item_is_set_to_false() -> None:
    text = "nodes:\n- drained: true\n  id: a\n"
    changed = strict_yaml.set_flag(text, "nodes", "a", "drained", False)
    assert changed == text.replace("true", "false")


def test_what_two_items_share_is_left_to_a_person() -> None:
    text = "nodes:\n- &a {id: a}\n- <<: *a\n  id: b\n"
    with pytest.raises(InvalidInput):
        strict_yaml.set_flag(text, "nodes", "b", "drained", True)


@pytest.mark.parametrize(("path", "text", "left"), TABLES["removed"])
def test_a_field_that_no_definition_has_any_longer_is_removed(
    path: str, text: str, left: str
) -> None:
    assert ignored_fields(path, text)
    assert without_ignored_fields(path, text) == left


@pytest.mark.parametrize(("path", "text"), TABLES["kept"])
def test_what_is_not_meant_or_cannot_be_removed_stays(path: str, text: str) -> None:
    assert without_ignored_fields(path, text) == text
