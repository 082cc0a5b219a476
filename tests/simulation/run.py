"""``make simulate``: plays histories for ``SIMULATE_S`` seconds; the first seed is ``SEED``.

Without ``SEED``, the first seed is random. For each history that fails, the program prints the
command that plays the history again. It stops after ten failures. At the end it prints what was
played, and how many histories it plays in one minute of processor time. This number does not depend
on what else the machine does.
"""

from __future__ import annotations

import gc
import logging
import os
import random
import sys
import time
import traceback
from collections import Counter

from tests.kit import repo
from tests.kit.repo import NO_GIT_CONFIG
from tests.simulation.history import clean_up, play, template


def main() -> int:
    os.environ.update(NO_GIT_CONFIG)
    logging.disable(logging.CRITICAL)
    repo.force_writes(False)
    seed = int(os.environ.get("SEED") or random.SystemRandom().randrange(10**9))
    most = int(os.environ.get("HISTORIES") or 10**9)
    end = time.monotonic() + float(os.environ.get("SIMULATE_S") or 60)
    counts = Counter[str](histories=0, demands=0, commits=0, failures=0)
    template()
    gc.freeze()  # all present objects stay, so the garbage collector need not search them
    began = time.process_time()
    try:
        while time.monotonic() < end and counts["histories"] < most and counts["failures"] < 10:
            try:
                tip, seen = play(seed)
                counts.update(seen)
            except Exception:
                traceback.print_exc(limit=-6)
                print(f"\nfailed; to repeat: make simulate SEED={seed} HISTORIES=1\n", flush=True)
                counts["failures"] += 1
            else:
                if most == 1:
                    print(f"the last commit is {tip}")
            counts["histories"] += 1
            seed += 1
    finally:
        minutes = (time.process_time() - began) / 60
        clean_up()
    print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()))
    print(f"{counts['histories'] / minutes:.0f} histories in each minute of processor time")
    return 1 if counts["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
