"""``make golden``: write the expected files of all cases. Review the diff before you commit it."""

from __future__ import annotations

import shutil

from tests.golden.cases import CASES, GOLDEN, to_store


def main() -> None:
    for case in CASES:
        expected = GOLDEN / case / "expected"
        shutil.rmtree(expected, ignore_errors=True)
        count = 0
        for step, files in to_store(case).items():
            for path, text in files.items():
                target = expected / step / path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(text)
                count += 1
        print(f"{case}: {count} files")


if __name__ == "__main__":
    main()
