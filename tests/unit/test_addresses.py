"""Texts that people write: those with a grammar are taken apart by it, or refused with a remedy."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from demandops.base import addresses, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.quantities import amount_of, amount_text
from demandops.model.config.appdef import ignored_fields, without_ignored_fields
from demandops.model.config.inventory import Zenoh
from demandops.model.config.registry import Image, precedence
from demandops.model.config.repo_settings import ArgoCd, Proposals
from pydantic import ValidationError

from tests.kit import plain_yaml

_TEXT = Path(__file__).with_name("addresses.yaml").read_text().replace("HEX", "a" * 64)
TABLES = plain_yaml.load(re.sub(r"(a/?)\*(\d+)", lambda found: found[1] * int(found[2]), _TEXT))


@pytest.mark.parametrize(
    ("grammar", "text"),
    [(name, text) for name in TABLES["taken"] for text in TABLES["taken"][name]],
)
def test_what_a_grammar_allows_is_taken(grammar: str, text: str) -> None:
    getattr(addresses, grammar)(text)


@pytest.mark.parametrize(
    ("grammar", "says", "text"),
    [
        (name, says, text)
        for name, by_remedy in TABLES["refused"].items()
        for says, texts in by_remedy.items()
        for text in texts
    ],
)
def test_a_refusal_says_what_to_write(grammar: str, says: str, text: str) -> None:
    with pytest.raises(ValueError) as refused:
        getattr(addresses, grammar)(text)
    assert says in str(refused.value) and "u:p" not in str(refused.value).partition(";")[2]


def test_a_host_of_a_mirror_replaces_only_a_host() -> None:
    for name, end in {"docker.io/a/b": "a/b", "a/b": "a/b", "b": "b"}.items():
        mirrored = Image(repository=name, tag="1").pulled_from("m:5000")
        assert mirrored.repository == f"m:5000/{end}"


def test_a_bridge_listens_in_the_family_of_its_endpoint() -> None:
    for endpoint, listen in TABLES["listens"].items():
        assert Zenoh(endpoint=endpoint).listening() == (listen,)


@pytest.mark.parametrize("name", ["of the repo", "with a token"])
def test_an_address_may_be_of_ipv6_but_hold_no_secret(name: str) -> None:
    """A token is sent to https only, or to this machine."""
    model: Any = ArgoCd if name == "of the repo" else partial(Proposals, forge="gitea")
    for url in TABLES[name]["taken"]:
        assert str(model(url=url).url) == url
    for url in TABLES[name]["refused"]:
        with pytest.raises(ValidationError, match="write"):
            model(url=url)


# ---- versions and quantities ----


def test_the_order_of_versions_is_that_of_semantic_versioning() -> None:
    before = "1.0.0-1 1.0.0-2 1.0.0-10 1.0.0-a 1.0.0-a.1 1.0.0-a.b 1.0.0-b"
    listed = f"{before} 1.0.0 1.0.2 1.0.10 1.2.0 2.0.0".split()
    shuffled = sorted(listed)
    assert shuffled != listed
    assert sorted(shuffled, key=precedence) == listed


QUANTITIES = plain_yaml.beside(__file__, "quantities")


@pytest.mark.parametrize(("text", "thousandths", "of_cpu", "of_memory"), QUANTITIES["quantities"])
def test_a_quantity_is_read_as_kubernetes_does(
    text: str, thousandths: int, of_cpu: str, of_memory: str
) -> None:
    assert amount_of(text) == thousandths
    assert amount_text(thousandths, "cpu") == of_cpu
    assert amount_text(thousandths, "memory") == of_memory


@pytest.mark.parametrize("text", QUANTITIES["invalid"])
def test_an_invalid_quantity_is_a_fault(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a quantity|is finer than a thousandth"):
        amount_of(text)


# ---- one field of a text is changed, and all else stays as it is ----

EDITS = plain_yaml.beside(__file__, "text-edits")


@pytest.mark.parametrize(("text", "id", "wanted"), EDITS["flags"])
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


@pytest.mark.parametrize(("path", "text", "left"), EDITS["removed"])
def test_a_field_that_no_definition_has_any_longer_is_removed(
    path: str, text: str, left: str
) -> None:
    assert ignored_fields(path, text)
    assert without_ignored_fields(path, text) == left


@pytest.mark.parametrize(("path", "text"), EDITS["kept"])
def test_what_is_not_meant_or_cannot_be_removed_stays(path: str, text: str) -> None:
    assert without_ignored_fields(path, text) == text
