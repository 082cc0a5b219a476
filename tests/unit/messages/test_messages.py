"""``messages.txt`` has all messages and fields, so each change of one shows in the file's diff."""

from tests.unit.messages.text import FILE, text


def test_messages_are_those_of_the_file() -> None:
    assert text() == FILE.read_text(), "run `make golden` and review the diff"
