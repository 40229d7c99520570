"""Settings of all tests."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

# Set before jax is imported. Compiled programs are kept between tests and their child processes.
_CACHE = Path(tempfile.gettempdir()) / "jaxnew-test-cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
