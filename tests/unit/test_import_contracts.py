"""What the contracts of import-linter in ``pyproject.toml`` cannot say."""

from __future__ import annotations

import subprocess
import sys

from tests.unit.test_package_layout import MODULES, ROOT, dotted, tomllib


def test_each_module_has_a_place_in_the_order_of_the_rooms() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (layers,) = (each["layers"] for each in settings["contracts"] if each["id"] == "rooms")
    places = tuple(
        f"{place}." for layer in layers for place in layer.replace("|", ":").split(" : ")
    )
    modules = [dotted(path) for path in MODULES if path.stem != "__init__"]
    assert [module for module in modules if not module.startswith(places)] == []


def test_the_process_with_limits_starts_without_what_is_slow_or_to_be_kept() -> None:
    loaded = "import demandops.templating.child, sys; print(*sys.modules)"
    command = [sys.executable, "-c", loaded]
    names = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    others = ("pydantic", "pygit2", "kubernetes", "demandops.model", "demandops.repo")
    assert {*others, "demandops.base.runtime"}.isdisjoint(names)
