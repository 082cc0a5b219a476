"""``make golden``: write ``messages.txt``. Review the diff before you commit it."""

from tests.unit.messages.test_messages import FILE, text

FILE.write_text(text())
