"""Settings of all tests."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

# Workers of `pytest -n` keep to one core each: XLA's thread pools suffer badly when they share.
_WORKER = os.environ.get("PYTEST_XDIST_WORKER")
if _WORKER and hasattr(os, "sched_setaffinity"):  # Not on macOS.
    _CORES = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_CORES[int(_WORKER.removeprefix("gw")) % len(_CORES)]})

# Set before jax is imported. Compiled programs are kept between tests and their child processes.
_CACHE = Path(tempfile.gettempdir()) / "jaxnew-test-cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
