"""Where the recordings of a training are, if not in one array on the device. NumPy only.

Recordings that are too many for the device stay on the host, or are drawn there when a batch needs
them, while the previous gradient step computes. A batch holds the same numbers in any case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np

# (ids int[n], stored recordings [n, ...]) -> [n, *one drawn recording]; of each by itself.
DrawRecordings = Callable[[np.ndarray, np.ndarray], np.ndarray]


@runtime_checkable
class RecordingSource(Protocol):
    """S recordings of each of A actions on the host, of which some are asked for at a time."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(A, S, *one recording)."""
        ...

    def gather(self, rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The recordings `numbers` of the actions `rows`, whose shapes are broadcast.

        Returns:
          [*broadcast shape, *one recording], stored dtype.
        """
        ...


class StoredRecordings:
    """Recordings in an array, which may be mapped from a file that memory could not hold.

    Args:
      data: [A, S, *one recording].
      rows: int[n] those that are actions of the source; all by default.
    """

    def __init__(self, data: np.ndarray, rows: np.ndarray | None = None) -> None:
        self._data = data
        self._rows = np.arange(len(data)) if rows is None else rows

    @property
    def shape(self) -> tuple[int, ...]:
        """As in `RecordingSource`."""
        return len(self._rows), *self._data.shape[1:]

    def gather(self, rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """As in `RecordingSource`."""
        return np.asarray(self._data[self._rows[rows], numbers])


class DrawnRecordings:
    """Recordings that are kept in a smaller form and drawn from it whenever they are asked for.

    Args:
      data: [A, S, ...] in the smaller form.
      ids: int[A] the action of each row.
      draw: see `DrawRecordings`.
      shape: of one drawn recording.
      rows: int[n] those that are actions of the source; all by default.

    Raises:
      ValueError: there is not one id for each row.
    """

    def __init__(
        self,
        data: np.ndarray,
        ids: np.ndarray,
        draw: DrawRecordings,
        shape: tuple[int, ...],
        rows: np.ndarray | None = None,
    ) -> None:
        if len(ids) != len(data):
            raise ValueError(f"{len(data)} rows of recordings need as many ids, got {len(ids)}.")
        self._stored = StoredRecordings(data, rows)
        self._ids = ids if rows is None else ids[rows]
        self._draw, self._drawn_shape = draw, shape

    @property
    def shape(self) -> tuple[int, ...]:
        """As in `RecordingSource`."""
        return *self._stored.shape[:2], *self._drawn_shape

    def gather(self, rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """As in `RecordingSource`.

        Raises:
          ValueError: what `draw` returned has another shape.
        """
        rows, numbers = np.broadcast_arrays(rows, numbers)
        stored = self._stored.gather(rows.ravel(), numbers.ravel())
        drawn = self._draw(self._ids[rows.ravel()], stored)
        if drawn.shape != (rows.size, *self._drawn_shape):
            raise ValueError(
                f"{rows.size} recordings were drawn as {drawn.shape}; expected "
                f"{(rows.size, *self._drawn_shape)}. Correct the shape or what draws them."
            )
        return drawn.reshape(*rows.shape, *self._drawn_shape)


def padded_chunks(recordings: Any, batch: int) -> Iterator[Any]:
    """Chunks [batch, S, ...] of all actions; the last repeats its last action up to `batch`.

    Equal shapes, so that one program encodes them all.

    Args:
      recordings: array [A, S, ...], or a source.
      batch: actions of a chunk.
    """
    num_actions, num_recordings = recordings.shape[:2]
    batch = min(batch, num_actions)
    for start in range(0, num_actions, batch):
        rows = np.minimum(np.arange(start, start + batch), num_actions - 1)
        if isinstance(recordings, RecordingSource):
            yield recordings.gather(rows[:, None], np.arange(num_recordings)[None])
        else:
            yield recordings[rows]
