"""Recordings of what actions do, in memory and as small files. NumPy only."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxnew import actions
from jaxnew.actions import ActionIdentity, ActionUniverse, content_hash
from jaxnew.storage.arrays import read_arrays, write_arrays

UNKNOWN_MODALITY = "unknown"


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
class Recordings:
    """S recordings of each of some actions.

    Attributes:
      data: [A, S, *format.shape] of `format.dtype`, possibly memory-mapped and read-only.
      ids: int32[A] the action of each row; each id once.
      format: what one recording is.
      universe_hash: of the universe that the ids belong to, or None for actions outside of it.
      action_hashes: A hashes of the recordings of each action.
      identity: what the actions are, None if unknown.
    """

    data: np.ndarray
    ids: np.ndarray
    format: RecordingFormat
    universe_hash: str | None
    action_hashes: tuple[str, ...]
    identity: ActionIdentity | None = None

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
        return content_hash(head, np.asarray(self.ids, np.int32), *self.action_hashes)

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

    def select(self, ids: np.ndarray) -> Recordings:
        """The recordings of `ids`, in that order, copied into memory.

        Raises:
          ObservationsError: an action was not recorded.
        """
        rows = self.rows(ids)
        return replace(
            self,
            data=np.asarray(self.data[rows]),
            ids=self.ids[rows],
            action_hashes=tuple(self.action_hashes[row] for row in rows),
            identity=self.identity and self.identity.rows(rows),
        )

    def fits(self, format: RecordingFormat) -> Recordings:
        """These recordings as ones of `format`, which an encoder reads.

        Raises:
          ObservationsError: they are of another modality, shape or dtype, or out of its bounds.
        """
        if self.format.modality not in (format.modality, UNKNOWN_MODALITY):
            raise ObservationsError(
                f"These are recordings of {self.format.modality!r}; the encoder knows "
                f"{format.modality!r}."
            )
        shape = (self.num_actions, self.num_recordings, *format.shape)
        problem = format.problem(self.data, shape, True)
        if problem is not None:
            raise ObservationsError(f"The array `recordings` {problem}.")
        return replace(self, format=format)

    def save(self, path: Path | str) -> None:
        """Writes one file: `ids`, `recordings`, `modality`, and what the actions are."""
        texts = {
            "modality": self.format.modality,
            "universe_hash": self.universe_hash,
            "hash": self.hash,
        }
        arrays: dict[str, Any] = {"ids": self.ids, "recordings": self.data}
        arrays |= {name: np.array(text) for name, text in texts.items() if text is not None}
        arrays |= self.identity.arrays() if self.identity else {}
        write_arrays(Path(path), arrays, is_compressed=True)

    @classmethod
    def load(cls, path: Path | str) -> Recordings:
        """Reads what `save` wrote, or recordings of a user's own.

        Args:
          path: a file with `ids` int[A] (numbers of the actions, each once), `recordings`
            [A, S, ...] with S >= 1 and, optionally, the string `modality`. An encoder checks that
            it was trained on such recordings, see `fits`. Without the rest of what `save` writes,
            nobody can tell what the actions are, and `Run.evaluate` has to be told to trust them.

        Raises:
          ObservationsError: the file is missing, damaged or was edited, or its arrays do not belong
            together.
        """
        arrays = read_arrays(Path(path), ("ids", "recordings"), ObservationsError)
        ids, data = checked_ids(arrays["ids"], None, str(path)), arrays["recordings"]
        if data.ndim < 2 or data.shape[0] != len(ids) or 0 in data.shape:
            raise ObservationsError(
                f"{path}: the array `recordings` has shape {data.shape}, expected [{len(ids)}, S, "
                "...], S >= 1 recordings of each action."
            )
        if data.dtype.kind not in "biuf":
            raise ObservationsError(f"{path}: the array `recordings` has dtype {data.dtype}.")
        modality = str(arrays.get("modality", UNKNOWN_MODALITY))
        format = RecordingFormat(modality, data.shape[2:], data.dtype.name)
        found = cls(
            data,
            ids,
            format,
            str(arrays["universe_hash"]) if "universe_hash" in arrays else None,
            tuple(row_hash(rows) for rows in data),
            ActionIdentity.from_arrays(arrays),
        )
        if str(arrays.get("hash", found.hash)) != found.hash:
            raise ObservationsError(
                f"{path} was edited: its ids and recordings hash to {found.hash}, it says "
                f"{arrays['hash']}. Restore the file, or record the actions again."
            )
        return found


def checked_ids(ids: np.ndarray, universe: ActionUniverse | None, where: str) -> np.ndarray:
    """int32[n] copy of distinct legal ids."""
    limit = {} if universe is None else {"num_actions": universe.num_actions}
    try:
        return actions.checked_ids(ids, **limit, what=f"{where}, ids")
    except ValueError as err:
        raise ObservationsError(str(err)) from err


def row_hash(rows: np.ndarray) -> str:
    """Hash of the recordings of one action."""
    return str(content_hash(np.asarray(rows)))


def action_rng(seed: int, action_id: int) -> np.random.Generator:
    """Random numbers for recording one action, the same whatever else is recorded beside it."""
    return np.random.default_rng(np.random.SeedSequence([seed, action_id]))
