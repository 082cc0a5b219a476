"""Tables cut no word at any width. If they are to be whole, each row is one line."""

from __future__ import annotations

from demandops.cli.formats import Table
from demandops.views.rows import Column
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from tests.kit.chance import examples

NAMES = "Name", "State", "Reason", "Since"
COLUMNS = [Column("", name, rank) for rank, name in enumerate(NAMES)]
NAME = "of-edge-object-detection-fusion-cf7e0180a8bb"
ROWS = [(NAME, "failing", "Helm install failed: timed out waiting", ["2h ago", "b"])]
WORDS = st.text("abc 車-/", max_size=40)


def test_text_wraps_and_what_matters_least_is_left_out() -> None:
    assert Table(COLUMNS, ROWS).lines(80) == [
        "NAME                                          STATE    REASON          SINCE",
        "of-edge-object-detection-fusion-cf7e0180a8bb  failing  Helm install    2h ago, b",
        "                                                       failed: timed",
        "                                                       out waiting",
    ]
    assert Table(COLUMNS, ROWS).lines(60) == [
        "NAME                                          STATE",
        "of-edge-object-detection-fusion-cf7e0180a8bb  failing",
        "more columns in a wider terminal: REASON, SINCE",
    ]
    assert Table(COLUMNS, ROWS).lines(20)[1] == NAME, "a name is whole even if it is too wide"


def test_a_row_of_a_whole_table_is_one_line() -> None:
    _, row = Table(COLUMNS, ROWS, whole=True).lines(20)
    assert row.endswith("  2h ago, b")


def test_an_empty_table_says_so() -> None:
    assert Table(COLUMNS, [], "Leases", "no leases").lines(80) == ["Leases", "no leases"]


@given(st.lists(st.tuples(WORDS, WORDS, st.lists(WORDS)), max_size=4), st.integers(1, 90))
@examples(80)
def test_no_word_is_ever_cut(rows: list[tuple[str, str, list[str]]], width: int) -> None:
    """The first column is always shown whole. Another column is left out if it does not fit."""
    columns = (Column("", "Name"), Column("", "State", 1), Column("", "Since", 2))
    table = Table(columns, rows)
    shown = table.lines(width)
    told = " ".join(shown).split()
    assert [word for row in rows for word in row[0].split() if word not in told] == []
    words = [word for row in rows for word in row[0].split()]
    least = max(cell_len(word) for word in ["more columns in a wider terminal:", *words])
    assert all(cell_len(line) <= max(width, least) for line in shown)
