"""Lists that can be filtered, sorted and paged, as plain values."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import TypeAlias, TypeVar

# How many rows a page of a list has at most.
PAGE = 100

# How many texts of a cell the page shows.
_MOST_PARTS = 4


@dataclass(frozen=True, slots=True)
class Link:
    path: str
    params: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Part:
    text: str
    link: Link | None = None


Text: TypeAlias = "str | int | Part"
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Cell:
    """The content of one field of a row: texts, or a time.

    ``tone`` is the cell's color. ``order`` is the sort key; by default it is the time or the first
    text.
    """

    parts: tuple[Part, ...] = ()
    time: datetime | None = None
    tone: str = ""
    order: float | str | None = None

    @property
    def shown(self) -> tuple[Part, ...]:
        return self.parts[:_MOST_PARTS]

    @property
    def more(self) -> int:
        return max(0, len(self.parts) - _MOST_PARTS)

    @property
    def rank(self) -> tuple[bool, float, str]:
        """The key by which rows are sorted; in ascending order, empty cells come last."""
        order = self.order
        if order is None:
            order = self.time.timestamp() if self.time else self.parts[0].text if self.parts else ""
        if isinstance(order, str):
            return order == "", 0.0, order.casefold()
        return False, float(order), ""


@dataclass(frozen=True, slots=True)
class Column:
    key: str
    title: str


@dataclass(frozen=True)
class Row:
    """One row of a list: ``cells`` by column, and ``hidden`` texts that only filters search."""

    cells: Mapping[str, Cell]
    hidden: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @cached_property
    def texts(self) -> dict[str, tuple[str, ...]]:
        """The texts of each column and hidden field; lower case, because filters ignore case."""
        all_texts = {
            key: tuple(part.text for part in cell.parts) for key, cell in self.cells.items()
        }
        for key, texts in self.hidden.items():
            all_texts[key] = (*all_texts.get(key, ()), *texts)
        return {key: tuple(text.casefold() for text in texts) for key, texts in all_texts.items()}

    @cached_property
    def all_texts(self) -> str:
        return "\n".join(text for texts in self.texts.values() for text in texts)


@dataclass(frozen=True, slots=True)
class Table:
    """One page of a filtered and sorted list.

    ``total`` counts all rows of the list, ``matching`` the rows that match the filter. ``sort`` is
    the key of a column, with ``-`` in front for the reverse order.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    total: int
    matching: int
    sort: str
    page: int
    pages: int


def cell(*texts: Text, tone: str = "", order: float | str | None = None) -> Cell:
    """Return a cell with all of ``texts`` that are not empty."""
    parts = (text if isinstance(text, Part) else Part(str(text)) for text in texts)
    return Cell(tuple(part for part in parts if part.text), tone=tone, order=order)


class Filter:
    """A search text for rows: a row matches if it contains all words of the text.

    The word ``node:edge`` matches if the field ``node`` contains ``edge``; ``node=edge`` matches if
    a text of the field is exactly ``edge``. If the row has no such field, the word is searched in
    all texts. Quotes join words. Upper and lower case are the same.
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
                    return wanted in texts if sign == "=" else any(wanted in text for text in texts)
            return word in row.all_texts

        return all(map(has, self._words))


def exactly(key: str, value: str) -> str:
    """Return the filter text for rows whose field ``key`` has exactly this value."""
    return shlex.quote(f"{key}={value}")


def table(
    columns: Sequence[Column], rows: Iterable[Row], wanted: Filter, sort: str, page: int
) -> Table:
    """Return a page of the rows that match the filter.

    An unknown ``sort`` means the first column.
    """
    every = list(rows)
    matching = [row for row in every if wanted.matches(row)]
    key = sort.removeprefix("-")
    if key not in {column.key for column in columns}:
        sort = key = columns[0].key
    matching.sort(key=lambda row: row.cells[key].rank, reverse=sort.startswith("-"))
    shown, page, pages = page_of(matching, page, PAGE)
    return Table(tuple(columns), tuple(shown), len(every), len(matching), sort, page, pages)


def page_of(items: Sequence[Item], page: int, size: int) -> tuple[Sequence[Item], int, int]:
    """Return the items of a page, the number of the page, and the number of pages.

    A number out of range means the nearest page.
    """
    pages = max(1, -(-len(items) // size))
    page = min(max(page, 1), pages)
    return items[(page - 1) * size : page * size], page, pages
