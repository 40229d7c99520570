"""What runs now, for the record: revision, versions, devices, command line."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "orbax-checkpoint", "mujoco", "pymunk")


def _git(*arguments: str) -> str | None:
    """Output of a git command in the folder of this file, or None where there is no answer."""
    command = ["git", "-C", str(Path(__file__).resolve().parent), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _revision() -> dict[str, Any] | None:
    """Revision of the source that runs and whether it was edited; None outside its repository."""
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    revision, status = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    return None if revision is None else {"git": revision, "is_dirty": bool(status)}


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions


def describe_session() -> dict[str, Any]:
    """What runs now: start time, command line, revision, versions, devices, and JAX's settings.

    Devices, precision and random numbers are JAX's and None in a process without it.
    """
    jax = sys.modules.get("jax")
    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": list(sys.orig_argv),
        "revision": _revision(),
        "versions": _versions(),
        "machine": {"platform": platform.platform(), "num_cpus": os.cpu_count()},
        "devices": None if jax is None else [f"{d.platform}: {d}" for d in jax.devices()],
        "precision": None
        if jax is None
        else {
            "matmul": str(jax.config.jax_default_matmul_precision or "default"),
            "x64": bool(jax.config.jax_enable_x64),
        },
        "random": None
        if jax is None
        else {
            "implementation": str(jax.config.jax_default_prng_impl),
            "is_partitionable": bool(jax.config.jax_threefry_partitionable),
        },
    }
