"""A merged file with thousands of entries is loaded, or refused, in time that grows with them.

Work is counted in calls of functions, so the tests need no clock.
"""

from __future__ import annotations

import json
from typing import Any

import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.kit.config import configuration, override
from tests.unit.decide.test_budget import counted

Files = dict[str, str]
MANY = plain_yaml.beside(__file__, "many-entries")


def files_of(kind: str, count: int) -> Files:
    """Return the files with ``count`` entries of each form of a case."""
    files = Files()
    for path, document in MANY[kind].items():
        if "{}" in path:
            files |= {
                numbered(path, number): override(*one.pop("select"), **one)
                for number, one in enumerate(numbered(document, n) for n in range(count))
            }
        else:
            entries = {
                field: [numbered(one[0], number) for number in range(count)]
                for field, one in document.items()
                if isinstance(one, list)
            }
            files[path] = yaml.safe_dump({"apiVersion": "demandops/v1"} | document | entries)
    return files


def numbered(entry: Any, number: int) -> Any:
    text = json.dumps(entry).replace(' "{}"', f" {number}")
    return json.loads(text.replace("{}", f"{number:04}"))


def work_of(files: Files) -> tuple[int, tuple[Fault, ...]]:
    calls, whole = [0], configuration(files)
    with counted(calls):
        try:
            load(whole)
        except InvalidInput as invalid:
            return calls[0], invalid.faults
    return calls[0], ()


@pytest.mark.parametrize("kind", MANY)
def test_the_work_grows_with_the_entries_and_not_faster(kind: str) -> None:
    work_of({})  # what is read once for all
    none, _ = work_of({})
    few, _ = work_of(files_of(kind, 200))
    many, faults = work_of(files_of(kind, 800))
    assert many - none < 6 * (few - none), "four times as many entries"
    assert len(faults) < 4 * 800
