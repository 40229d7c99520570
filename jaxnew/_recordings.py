"""What recordings of actions are, in memory and on disk. NumPy only."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxnew.actions import ActionUniverse, content_hash

KIND = "jaxnew action recordings"
FORMAT_VERSION = 1
MANIFEST = "manifest.json"
DATA = "recordings.npy"


class ObservationsError(ValueError):
    """Recordings are missing, unfinished, damaged, or not those that were asked for."""


@dataclass(frozen=True)
class RecordingFormat:
    """What one recording is.

    Attributes:
      modality: play environment and version, e.g. `GridWorld-v0 play`.
      shape: shape of one recording, e.g. `(T, D)` or `(T, H, W, C)`.
      dtype: NumPy name of the stored type, e.g. `uint8`.
      low, high: inclusive bounds of the values, or None. Floats must be finite in any case.
    """

    modality: str
    shape: tuple[int, ...]
    dtype: str
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "dtype", np.dtype(self.dtype).name)

    def estimate_bytes(self, num_actions: int, num_recordings: int) -> int:
        """Size of the recordings of `num_actions` actions."""
        return num_actions * num_recordings * math.prod(self.shape) * np.dtype(self.dtype).itemsize

    def problem(self, data: np.ndarray, shape: tuple[int, ...], with_values: bool) -> str | None:
        """Says how `data` differs from an array of `shape` in this format, or None if it does not.

        Args:
          with_values: also look at every value, not only at shape and dtype.
        """
        if data.shape != shape:
            return f"has shape {data.shape}, expected {shape}"
        if data.dtype != np.dtype(self.dtype):
            return f"has dtype {data.dtype}, expected {self.dtype}"
        if not with_values or data.size == 0:
            return None
        if np.issubdtype(data.dtype, np.inexact) and not np.isfinite(data).all():
            return "has a value that is not finite"
        low, high = data.min(), data.max()
        if (self.low is not None and low < self.low) or (
            self.high is not None and high > self.high
        ):
            return f"has values in [{low}, {high}], expected [{self.low}, {self.high}]"
        return None


@dataclass(frozen=True)
class ActionObservations:
    """S recordings of each of some actions.

    Attributes:
      data: [A, S, *format.shape] of `format.dtype`, possibly memory-mapped and read-only.
      ids: int32[A] the action of each row; each id once.
      format: what one recording is.
      universe_hash: of the universe that the ids belong to, or None for actions outside of it.
      action_hashes: A hashes of the recordings of each action.
    """

    data: np.ndarray
    ids: np.ndarray
    format: RecordingFormat
    universe_hash: str | None
    action_hashes: tuple[str, ...]

    @property
    def num_actions(self) -> int:
        return len(self.ids)

    @property
    def num_recordings(self) -> int:
        return int(self.data.shape[1])

    @property
    def hash(self) -> str:
        """Identifies the recordings by content, actions and modality."""
        head = f"{self.universe_hash} {self.format.modality}"
        return content_hash(head, self.ids, *self.action_hashes)

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """int64[n] rows of `data` that hold the actions `ids`.

        Raises:
          ObservationsError: an action was not recorded.
        """
        row_of = {action_id: row for row, action_id in enumerate(self.ids.tolist())}
        missing = [action_id for action_id in np.ravel(ids).tolist() if action_id not in row_of]
        if missing:
            raise ObservationsError(
                f"No recordings of action {missing[0]} ({len(missing)} of {np.size(ids)} asked for "
                "are missing). Collect them, or ask for recorded actions only."
            )
        return np.array([row_of[action_id] for action_id in np.ravel(ids).tolist()], np.int64)

    def select(self, ids: np.ndarray) -> ActionObservations:
        """The recordings of `ids`, in that order, copied into memory.

        Raises:
          ObservationsError: an action was not recorded.
        """
        rows = self.rows(ids)
        hashes = tuple(self.action_hashes[row] for row in rows)
        data = np.asarray(self.data[rows])
        return ActionObservations(data, self.ids[rows], self.format, self.universe_hash, hashes)


def checked_ids(ids: np.ndarray, universe: ActionUniverse | None, where: str) -> np.ndarray:
    """int32[n] copy of distinct legal ids."""
    checked = np.asarray(ids)
    if checked.ndim != 1 or checked.size == 0 or not np.issubdtype(checked.dtype, np.integer):
        raise ObservationsError(
            f"{where}: ids must be a non-empty vector of integers, got {checked.dtype}"
            f"{list(checked.shape)}."
        )
    limit = 2**31 if universe is None else universe.num_actions
    if checked.min() < 0 or checked.max() >= limit:
        raise ObservationsError(
            f"{where}: ids span {checked.min()}..{checked.max()}; legal are 0..{limit - 1}."
        )
    if len(np.unique(checked)) != len(checked):
        raise ObservationsError(f"{where}: an id is listed twice; list each once.")
    return checked.astype(np.int32)


def row_hash(rows: np.ndarray) -> str:
    """Hash of the recordings of one action."""
    return str(content_hash(np.asarray(rows)))


def manifest_hash(manifest: dict[str, Any]) -> str:
    """Hash of a manifest without its own `hash` entry."""
    return str(content_hash(json.dumps(manifest, sort_keys=True)))


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of the recording directory `path`, checked to be whole and of this format."""
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        kind, version = manifest["kind"], manifest["format_version"]
        if kind != KIND or version != FORMAT_VERSION:
            raise ObservationsError(
                f"{path} holds {kind!r} of format {version}; this program reads {KIND!r} of "
                f"format {FORMAT_VERSION}. Collect again in another directory."
            )
        recorded_hash = manifest.pop("hash")
        if manifest_hash(manifest) != recorded_hash:
            raise KeyError("it does not have the hash recorded in it")
    except FileNotFoundError as err:
        raise ObservationsError(
            f"{path} has no {MANIFEST}: there are no recordings. Run collect first."
        ) from err
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as err:
        raise ObservationsError(
            f"{path / MANIFEST} is damaged ({err!r}). Restore it from a copy, or delete the "
            "directory and collect again."
        ) from err
    return dict(manifest)


def open_data(path: Path, format: RecordingFormat, shape: tuple[int, ...]) -> np.memmap:
    """The memory-mapped recordings, read-only, with the right shape and dtype."""
    try:
        data = np.load(path / DATA, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as err:
        raise ObservationsError(
            f"{path / DATA} is missing or damaged ({err}). Run collect again to repair it."
        ) from err
    problem = format.problem(data, shape, False)
    if problem is not None:
        raise ObservationsError(f"{path / DATA} {problem}. Run collect again to repair it.")
    return cast(np.memmap, data)
