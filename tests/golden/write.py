"""``make golden``: write the expected folders anew. Review the diff before you commit it."""

from __future__ import annotations

import shutil

from tests.golden.cases import CASES, HERE, play


def main() -> None:
    """Write every case."""
    for case in CASES:
        expected = HERE / case / "expected"
        shutil.rmtree(expected, ignore_errors=True)
        count = 0
        for name, files in play(case):
            for path, text in files.items():
                target = expected / name / path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(text)
                count += 1
        print(f"{case}: {count} files")


if __name__ == "__main__":
    main()
