"""``messages.txt`` has the messages and fields, so its diff shows each change of them."""

from tests.unit.messages.text import FILE, text


def test_messages_are_those_of_the_file() -> None:
    assert text() == FILE.read_text(), "run `make golden` and review the diff"
