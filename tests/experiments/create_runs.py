"""What tests read out of runs, without compiling anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer, Kind


def _record(path: Path, kind: Kind) -> tuple[Checkpointer, Path, list[dict[str, Any]]]:
    checkpointer = Checkpointer(path / "checkpoints")
    folder = checkpointer._path(kind, checkpointer.steps(kind)[-1])
    return checkpointer, folder, checkpointer._read_record(folder)["leaves"]


def saved(path: Path, kind: Kind) -> dict[str, str]:
    """Hashes of all that the newest checkpoint of a kind holds, by path."""
    return {leaf["path"]: leaf["sha256"] for leaf in _record(path, kind)[2]}


def parameters(path: Path) -> dict[str, np.ndarray]:
    """A policy's parameters in the newest checkpoint, called `utility.bias` and so on."""
    checkpointer, folder, leaves = _record(path, "latest")
    values = checkpointer._read_values(folder, leaves)
    pairs = zip((leaf["path"] for leaf in leaves), values, strict=True)
    return {
        name.removeprefix(".params['").removesuffix("']").replace("']['", "."): value
        for name, value in pairs
        if name.startswith(".params")
    }


def timeless(path: Path) -> list[dict[str, Any]]:
    """A run's metrics without those that say how long things took."""
    lines = metrics.read(path)
    return [{k: v for k, v in line.items() if not k.startswith("time/")} for line in lines]
