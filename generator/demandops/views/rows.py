"""Rows: one thing as a table, JSON and the page show it; how rows are filtered and sorted."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any, Literal, TypeVar

from demandops.model.config.base_model import matches, parse_time, relative
from demandops.views.vocabulary import Json

# The tone of each word for a state, which is its color on a terminal and on the page. The worst
# words come first.
TONES = {
    **dict.fromkeys(("unread", "failing", "invalid", "suspended", "denied", "rejected"), "bad"),
    "not in the inventory": "bad",
    **dict.fromkeys(("decision", "proposed", "waiting", "starting", "partly suspended"), "busy"),
    **dict.fromkeys(("overdue", "drained", "expired"), "busy"),
    **dict.fromkeys(("held back", "matches nothing", "not rendered yet"), "busy"),
    **dict.fromkeys(("unknown", "kept", "open", "gone", "back"), "none"),
    **dict.fromkeys(("healthy", "held", "runs", "used", "in force", "approved", "exists"), "good"),
}
RANKS = {word: float(place) for place, word in enumerate(TONES)}

# The texts of a cell at a moment.
TextsOf = Callable[[Json, datetime], "str | Iterable[str]"]


@dataclass(frozen=True, slots=True)
class Column:
    key: str  # of the item's value, to filter and to sort by
    title: str
    # A narrow terminal leaves out the columns of the highest ranks, never one of rank 0.
    rank: int = 0
    form: Literal["text", "time", "state", "command"] = "text"
    texts_of: TextsOf | None = None  # by default the item's value
    links: str = ""  # the kind of thing that its texts name
    only_wide: bool = False

    def texts(self, item: Json, now: datetime) -> list[str]:
        value: Any = self.texts_of(item, now) if self.texts_of else item[self.key]
        if value and self.form == "time":
            value = relative(parse_time(value), now)
        shown = [value] if isinstance(value, str | int | float) else value or ()
        return [text for text in map(str, shown) if text]

    def order(self, item: Json, now: datetime) -> tuple[bool, float, str]:
        """Return what rows are sorted by; what is empty comes last."""
        value = item.get(self.key)
        if self.form == "state":
            (word,) = self.texts(item, now) or ("",)
            return not word, RANKS.get(word, float(len(RANKS))), word
        if self.key == "lease" and value:
            value = value["until"]
        if isinstance(value, int | float):
            return False, float(value), ""
        text = ", ".join(self.texts(item, now)) if isinstance(value, list | dict) else value
        return not text, 0.0, str(text or "").casefold()


@dataclass(frozen=True)
class Row:
    # The texts by which it is found: ``node`` finds a row by each of its nodes.
    labels: Mapping[str, Sequence[str]]
    item: Json = field(default_factory=dict)

    @cached_property
    def texts(self) -> dict[str, tuple[str, ...]]:
        """The labels in lower case, because filters ignore case."""
        return {key: tuple(text.casefold() for text in texts) for key, texts in self.labels.items()}

    @cached_property
    def all_texts(self) -> str:
        return "\n".join(text for texts in self.texts.values() for text in texts)


def labels_of(item: Json) -> dict[str, list[str]]:
    # the item's texts by label: `requesters` of an item is its label `requester`
    labels: dict[str, list[str]] = {}
    for key, value in item.items():
        texts = [value] if isinstance(value, str) else value
        if isinstance(texts, list | tuple) and all(isinstance(text, str) for text in texts):
            label = key[:-1] if key.endswith("s") and not isinstance(value, str) else key
            labels.setdefault(label, []).extend(texts)
    return labels


class Filter:
    """A search text for rows: a row matches if it contains all words of the text.

    The word ``node:edge`` matches if the label ``node`` contains ``edge``; ``node=edge`` matches if
    a text of the label is ``edge``, where * is any text and ? one character. If the row has no such
    label, the word is searched in all texts. Quotes join words. Upper and lower case are the same.
    """

    def __init__(self, text: str) -> None:
        try:
            words = shlex.split(text)
        except ValueError:  # the text has a quote that is not closed
            words = text.split()
        self._words = [word.casefold() for word in words]

    def __bool__(self) -> bool:
        return bool(self._words)

    def matches(self, row: Row) -> bool:
        def has(word: str) -> bool:
            for sign in ":=":
                key, separator, wanted = word.partition(sign)
                if separator and key in row.texts:
                    texts = row.texts[key]
                    if sign == "=":
                        return any(matches(text, (wanted,)) for text in texts)
                    return any(wanted in text for text in texts)
            return word in row.all_texts

        return all(map(has, self._words))


def exactly(key: str, value: str) -> str:
    return shlex.quote(f"{key}={value}")


_Item = TypeVar("_Item")


def page_of(items: Sequence[_Item], page: int, size: int) -> tuple[Sequence[_Item], int, int]:
    pages = max(1, -(-len(items) // size))
    page = min(max(page, 1), pages)
    return items[(page - 1) * size : page * size], page, pages


def sorted_rows(
    rows: Iterable[Row], column: Column, now: datetime, *, down: bool = False
) -> list[Row]:
    # what is empty is last in both directions
    rows = sorted(rows, key=lambda row: column.order(row.item, now), reverse=down)
    return sorted(rows, key=lambda row: column.order(row.item, now)[0]) if down else rows
