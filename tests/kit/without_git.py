"""A pytest plugin that keeps the tests of the core from importing Git.

Load it with ``-p tests.kit.without_git``. The scenarios use the timers of ``demandops.service``,
which need no Git, but the ``__init__`` of that package imports Git. So the plugin replaces the
package by one with an empty ``__init__``; its modules can still be imported.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import demandops

FORBIDDEN = ("git", "pygit2")


class _NoGit:
    def find_spec(self, name: str, path: Sequence[str] | None, target: object = None) -> None:
        if name.split(".", maxsplit=1)[0] in FORBIDDEN:
            raise ImportError(f"the core and its tests must not import {name}")


assert not {*FORBIDDEN} & {*sys.modules}, "Git is imported before the tests"
sys.meta_path.insert(0, _NoGit())

_service = ModuleType("demandops.service")
_service.__path__ = [str(Path(demandops.__file__).with_name("service"))]
sys.modules[_service.__name__] = _service
