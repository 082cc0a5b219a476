"""A pytest plugin that keeps the tests of the core from importing Git.

Load it with ``-p tests.kit.without_git``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

FORBIDDEN = ("git", "pygit2")


class _NoGit:
    def find_spec(self, name: str, path: Sequence[str] | None, target: object = None) -> None:
        if name.split(".", maxsplit=1)[0] in FORBIDDEN:
            raise ImportError(f"the core and its tests must not import {name}")


assert not {*FORBIDDEN} & {*sys.modules}, "Git is imported before the tests"
sys.meta_path.insert(0, _NoGit())
