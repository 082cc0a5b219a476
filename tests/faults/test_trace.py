"""The parser of strace's output finds the files of a call, whatever bytes the call carried."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.trace import parse


@pytest.mark.parametrize(
    ("line", "paths"),
    [
        ('write(3</r/pack>, "x O_RDWR AT_FDCWD y", 19) = 19', ["/r/pack"]),
        ('write(3</r/pack>, "4</r/other>, \\"/r/third\\") = 9", 27) = 27', ["/r/pack"]),
        ('openat(AT_FDCWD</r/a>, "../b", O_RDONLY) = 3</r/b>', ["/r/b"]),
        ('newfstatat(3</r/a>, "", {st_mode=S_IFREG}, AT_EMPTY_PATH) = 0', ["/r/a"]),
        ('linkat(3</r/a>, "b", 4</r/c>, "d", 0) = 0', ["/r/a/b", "/r/c/d"]),
        ('rename("a", "/r/b") = 0', ["/r/here/a", "/r/b"]),
        ('readlink("a", "/r/b", 4096) = 4', ["/r/here/a"]),
    ],
)
def test_what_a_call_writes_is_not_taken_for_its_files(line: str, paths: list[str]) -> None:
    (call,) = parse(f"1 {line}\n", {}, Path("/r"), "/r/here")
    assert list(call.paths) == paths
