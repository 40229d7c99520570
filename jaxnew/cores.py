"""Cores that this process may use."""

from __future__ import annotations

import os


def available_cores() -> int:
    """How many there are, at least 1; those of the machine where the system does not say more."""
    if hasattr(os, "sched_getaffinity"):  # Not on macOS.
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
