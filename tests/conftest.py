"""Settings of all tests."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

# Workers of `pytest -n` keep to one core each: XLA's thread pools suffer badly when they share.
_WORKER = os.environ.get("PYTEST_XDIST_WORKER")
if _WORKER and hasattr(os, "sched_setaffinity"):  # Not on macOS.
    _CORES = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_CORES[int(_WORKER.removeprefix("gw")) % len(_CORES)]})

# Set before jax is imported. Compiled programs are kept between tests and their child processes.
_CACHE = Path(tempfile.gettempdir()) / "jaxnew-test-cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Programs that are compiled fast rather than fast programs: most tests run theirs once. Child
# processes do the same, so that bits can be compared.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that are marked `optimized` or `slow` get fast programs, as users do."""
    if "jax" in sys.modules:
        computes = any(item.get_closest_marker(name) for name in ("optimized", "slow"))
        sys.modules["jax"].config.update("jax_disable_most_optimizations", not computes)
