"""A changed message or field is a diff of one file."""

from tests.unit.messages.text import FILE, text


def test_messages_are_those_of_the_file() -> None:
    assert text() == FILE.read_text(), "run `make golden` and review the diff"
