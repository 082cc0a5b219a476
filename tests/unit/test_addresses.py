"""Names with parts inside are taken apart by their grammar, or refused with what to write."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from demandops.base import addresses
from demandops.model.config.inventory import Zenoh
from demandops.model.config.registry import Image
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
