"""``demandops log --operation`` accepts the operation of every commit that the program makes."""

from __future__ import annotations

import re
from pathlib import Path

import demandops
from demandops.cli.views.log import OPERATIONS

WRITTEN = re.compile(r'^    operation = "([a-z-]+)"|\("Operation", "([a-z-]+)"\)', re.MULTILINE)


def test_every_operation_can_be_asked_for() -> None:
    texts = (path.read_text() for path in Path(demandops.__file__).parent.rglob("*.py"))
    written = {one or other for text in texts for one, other in WRITTEN.findall(text)}
    assert written | {"by-hand"} == {*OPERATIONS}
