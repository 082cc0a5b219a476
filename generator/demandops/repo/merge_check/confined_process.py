"""Runs a program that must not reach the network, and that ends.

Call it as ``confined_process.py SECONDS PROGRAM ARG…``; the seconds are those of processors.

A process of its own, without site packages, because limits that a fork sets in a program with
threads may block it.
"""

from __future__ import annotations

import ctypes
import os
import resource
import sys
from contextlib import suppress

# helm renders a chart with 100 MB; Go reserves addresses beforehand.
MEMORY = 4 << 30
_LIMITS = {resource.RLIMIT_AS: MEMORY, resource.RLIMIT_FSIZE: 64 << 20, resource.RLIMIT_CORE: 0}
_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000


if __name__ == "__main__":
    for limit, most in (_LIMITS | {resource.RLIMIT_CPU: int(sys.argv[1])}).items():
        _, hard = resource.getrlimit(limit)
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        with suppress(ValueError, OSError):
            resource.setrlimit(limit, (allowed, allowed))
    unshare = getattr(ctypes.CDLL(None), "unshare", None)
    # A user without rights may make a network namespace only in a user namespace of its own. Some
    # kernels and containers allow neither; then the program's own settings must do.
    if unshare and unshare(_NEW_USER | _NEW_NETWORK):
        unshare(_NEW_NETWORK)
    try:
        os.execv(sys.argv[2], sys.argv[2:])  # noqa: S606 - no shell is wanted
    except OSError as error:
        sys.exit(f"Error: {sys.argv[2]} cannot be run: {error.strerror}")
