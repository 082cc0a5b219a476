"""Tables cut no word at any width. If the output is not a terminal, each row is one line."""

from __future__ import annotations

from demandops.cli.table import Column, Table
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from tests.kit.chance import examples

COLUMNS = (
    Column("Name"),
    Column("State", 1),
    Column("Reason", 2, wraps=True),
    Column("Since", 3),
)
ROWS = [
    ("of-edge-object-detection-fusion-cf7e0180a8bb", "failing", "not ready: 0 of 1", "2h ago"),
    ("short", "healthy", "", ["a", "b"]),
]
WORDS = st.text("abc 車-/", max_size=40)


def test_a_wide_terminal_shows_everything() -> None:
    assert Table(COLUMNS, ROWS).lines(100) == [
        "NAME                                          STATE    REASON             SINCE",
        "of-edge-object-detection-fusion-cf7e0180a8bb  failing  not ready: 0 of 1  2h ago",
        "short                                         healthy                     a",
        "                                                                          b",
    ]


def test_text_wraps_and_what_matters_least_is_left_out() -> None:
    long = [(ROWS[0][0], "failing", "Helm install failed: timed out waiting", "2h ago")]
    assert Table(COLUMNS, long).lines(80) == [
        "NAME                                          STATE    REASON             SINCE",
        "of-edge-object-detection-fusion-cf7e0180a8bb  failing  Helm install       2h ago",
        "                                                       failed: timed out",
        "                                                       waiting",
    ]
    assert Table(COLUMNS, long).lines(60) == [
        "NAME                                          STATE",
        "of-edge-object-detection-fusion-cf7e0180a8bb  failing",
        "more columns in a wider terminal: REASON, SINCE",
    ]


def test_a_name_is_whole_even_if_it_alone_is_too_wide() -> None:
    assert Table(COLUMNS, ROWS).lines(20)[1] == ROWS[0][0]


def test_elsewhere_a_row_is_one_line() -> None:
    _, _, last = Table(COLUMNS, ROWS).lines(None)
    assert last.endswith("  a, b")


def test_an_empty_table_says_so() -> None:
    assert Table(COLUMNS, [], "Leases", "no leases").lines(80) == ["Leases", "no leases"]


@given(st.lists(st.tuples(WORDS, WORDS, st.lists(WORDS)), max_size=4), st.integers(1, 90))
@examples(80)
def test_no_word_is_ever_cut(rows: list[tuple[str, str, list[str]]], width: int) -> None:
    """The first column is always shown whole. Another column is left out if it does not fit."""
    columns = (Column("Name", wraps=True), Column("State", 1, wraps=True), Column("Since", 2))
    table = Table(columns, rows)
    shown = table.lines(width)
    told = " ".join(shown).split()
    assert [word for row in rows for word in row[0].split() if word not in told] == []
    words = [word for row in rows for word in row[0].split()]
    least = max(cell_len(word) for word in ["more columns in a wider terminal:", *words])
    assert all(cell_len(line) <= max(width, least) for line in shown)
