"""Text from outside cannot begin a new line, control a terminal, hide text or fill a screen."""

from __future__ import annotations

import io
import json
import logging
import sys
import unicodedata
from typing import Any

import pytest
from demandops.base import quoting
from demandops.base.errors import MOST_FAULTS, Fault, InvalidInput, StateRepoError, fault
from demandops.base.quoting import is_visible, json_escaped, one_line
from demandops.base.strict_yaml import located_in
from demandops.cli import output
from demandops.cli.authoring import check
from demandops.cli.formats import Table, print_json, show
from demandops.views.rows import Column
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from tests.kit.chance import examples

HOSTILE = "a\nERROR: forged\r\x1b[2J\x9b1m\u202eb\u200bc\u3164d\ufe0f\u2028e\x00\ud800" + "x" * 9000
TEXTS = st.one_of(st.text(), st.text("\n\t\x1b\u202e\u200b\u00ad\u3164\ufe0f'\"\\a "))


@given(TEXTS)
@examples(150)
def test_a_quoted_text_is_one_visible_line_of_bounded_length(text: str) -> None:
    for quote in (one_line(text), quoting.quoted(text), one_line(text, 5)):
        assert is_visible(quote)
        assert "".join(f"{quote}\n").splitlines() == [quote]
    assert len(one_line(text * 50, 60)) <= 60
    assert one_line(one_line(text)) == one_line(text)
    assert quoting.lines(text).count("\n") == text.count("\n")
    assert json.loads(json_escaped(json.dumps(text, ensure_ascii=False))) == text


def test_no_kind_of_character_without_a_glyph_is_visible() -> None:
    hidden = [chr(code) for code in range(sys.maxunicode + 1) if not is_visible(chr(code))]
    kinds = {unicodedata.category(char) for char in hidden}
    assert kinds >= {"Cc", "Cf", "Cs", "Cn", "Co", "Zl", "Zp"}
    assert {"\u00ad", "\u034f", "\u200b", "\u200d", "\u202e", "\u2066", "\ufeff"} <= {*hidden}
    assert is_visible("Straße/北京 Ωμέγα 🚗 e\u0301 नमस्ते 'a' \\ \"b\"")


def test_faults_and_errors_are_one_line_each() -> None:
    found = fault(HOSTILE, HOSTILE).within(HOSTILE)
    assert found.file == HOSTILE, "a program needs the file's exact name"
    assert is_visible(str(found)) and len(str(found)) < 4 * quoting.LONGEST_LINE
    assert len(str(InvalidInput([found, found])).splitlines()) == 2
    assert is_visible(str(StateRepoError(f"cannot be read: {HOSTILE}")))


def test_a_log_record_is_one_line_and_its_trace_is_indented(caplog: Any) -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(quoting.OneLineFormatter("%(levelname)s: %(message)s"))
    log = logging.Logger("of this test")
    log.addHandler(handler)
    log.error("refused: %s", HOSTILE)
    log.error("%s", InvalidInput([fault("a", "one"), fault("b", "two")]))
    try:
        raise ValueError(HOSTILE[:300])
    except ValueError:
        log.exception("internal error")
    told = stream.getvalue().removesuffix("\n").split("\n")
    assert told[0].startswith("ERROR: refused: a; ERROR: forged; \\x1b[2J")
    assert told[1:3] == ["ERROR: a: one; b: two", "ERROR: internal error"]
    assert all(line.startswith("  ") for line in told[4:])
    assert all(is_visible(line) for line in told)


def test_commands_print_no_text_that_controls_a_terminal(capsys: Any) -> None:
    table = Table([Column("", "Summary")], [[[HOSTILE[:90]]]] * 2)
    show("text", None, [HOSTILE[:90], table])
    output.errors.print(HOSTILE[:90])
    print_json({"summary": HOSTILE[:90]})
    printed, told = capsys.readouterr()
    assert all(is_visible(line) for line in (*printed.split("\n"), *told.split("\n")))
    assert json.loads(printed[printed.index("{\n") :]) == {"summary": HOSTILE[:90]}


def test_a_comment_has_no_text_that_ends_its_span() -> None:
    assert is_visible(check.code(HOSTILE))
    assert check.fence("a\u202e\n```\nb", "yaml") == "````yaml\na\\u202e\n```\nb\n````\n"


def test_faults_that_are_passed_on_are_still_counted_right() -> None:
    found = InvalidInput(Fault("invalid", f"a{n}", "is wrong") for n in range(MOST_FAULTS + 900))
    with pytest.raises(InvalidInput) as raised, located_in("a: 1\n"):
        raise found
    *listed, last = raised.value.faults
    assert (len(listed), last.message) == (MOST_FAULTS, "has 900 more faults")


# ---- tables cut no word at any width ----


WORDS = st.text("abc 車-/", max_size=40)


def test_an_empty_table_says_so() -> None:
    table = Table([Column("", "Name")], [], "Leases", "no leases")
    assert table.lines(80) == ["Leases", "no leases"]


@given(st.lists(st.tuples(WORDS, WORDS, st.lists(WORDS)), max_size=4), st.integers(1, 90))
@examples(80)
def test_no_word_is_ever_cut(rows: list[tuple[str, str, list[str]]], width: int) -> None:
    """The first column is always shown whole. Another column is left out if it does not fit."""
    columns = (Column("", "Name"), Column("", "State", 1), Column("", "Since", 2))
    table = Table(columns, [([name], [state], since) for name, state, since in rows])
    shown = table.lines(width)
    told = " ".join(shown).split()
    assert [word for row in rows for word in row[0].split() if word not in told] == []
    words = [word for row in rows for word in row[0].split()]
    least = max(cell_len(word) for word in ["more columns in a wider terminal:", *words])
    assert all(cell_len(line) <= max(width, least) for line in shown)
