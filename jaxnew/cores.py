"""What the operating system grants this process: its cores, and word of its parent's end."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # Of Linux's `prctl`.


def available_cores() -> int:
    """How many there are, at least 1; those of the machine where the system does not say more."""
    if hasattr(os, "sched_getaffinity"):  # Not on macOS.
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def signal_at_parents_end(number: signal.Signals) -> None:
    """Has Linux send a signal to this process when its parent ends, however that ends.

    It also comes when only the thread ends that started this process. Other systems send nothing.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(number))
