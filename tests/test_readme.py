"""The examples in README.md, and that it names each module of the kit."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).with_name("README.md")
README = PAGE.read_text()
# each with as many empty lines before it as the page has, so that a traceback shows its line
EXAMPLES = [
    "\n" * README.count("\n", 0, found.start(1)) + found[1]
    for found in re.finditer(r"```python\n(.*?)```", README, re.DOTALL)
]
MODULES = {file.stem for file in Path(__file__).with_name("kit").glob("[a-z]*.py")}


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_passes(example: str, request: pytest.FixtureRequest) -> None:
    names: dict[str, object] = {}
    exec(compile(example, PAGE, "exec", dont_inherit=True), names)  # noqa: S102 - ours
    (test,) = [each for name, each in names.items() if name.startswith("test_")]
    assert inspect.isfunction(test)
    test(**{name: request.getfixturevalue(name) for name in inspect.signature(test).parameters})


def test_each_module_of_the_kit_is_named() -> None:
    named = set(re.findall(r"\w+", README))
    assert MODULES - named == set()
