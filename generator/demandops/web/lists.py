"""The lists of the page: the cells of a row, and where their texts link to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from demandops.model.config.base_model import parse_time
from demandops.views.kinds import Kind
from demandops.views.rows import TONES, Column, Row

# The lists of the page, in the order of its navigation.
LISTS = (
    "demands",
    "applications",
    "releases",
    "connections",
    "nodes",
    "requesters",
    "leases",
    "overrides",
    "proposals",
)
# How many rows a page of a list has at most.
PAGE = 100


@dataclass(frozen=True, slots=True)
class Part:
    text: str
    view: str = ""  # to which it links, with parameters
    params: Mapping[str, str] = field(default_factory=dict)


def part(kind: str, name: str) -> Part:
    """Return the name of a thing with a link to its view; none if ``kind`` is empty."""
    # what is held is an application or a connection
    params = {"name": name} if kind == "held" else {"kind": kind, "name": name}
    return Part(name, "thing", params) if kind else Part(name)


@dataclass(frozen=True, slots=True)
class Cell:
    column: Column
    parts: tuple[Part, ...]
    time: datetime | None = None  # instead of texts
    tone: str = ""


def cells_of(kind: Kind, row: Row, now: datetime) -> list[Cell]:
    cells = []
    for column in kind.columns:
        if column.only_wide and column.form != "command":
            continue
        texts = column.texts(row.item, now)
        value = row.item.get(column.key) if column.form == "time" else None
        tone = TONES.get(texts[0], "none") if column.form == "state" and texts else ""
        parts = tuple(part(column.links, text) for text in texts)
        cells.append(Cell(column, parts, parse_time(value) if value else None, tone))
    return cells
