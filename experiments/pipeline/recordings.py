"""Recordings of a domain's actions on disk, and how training and encoding read them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew import observations
from jaxnew.actions import ActionUniverse
from jaxnew.observations import ActionObservations
from jaxnew.representation.sources import DrawnRecordings, RecordingSource, StoredRecordings
from jaxnew.task import Drawing, Play


@dataclass(frozen=True)
class Recordings:
    """The recordings of every action.

    Attributes:
      play: how they were made.
      recorded: what the play environment gave.
      drawn: the same, drawn and stored; None if nothing is drawn, or on demand.
    """

    play: Play
    recorded: ActionObservations
    drawn: ActionObservations | None = None

    @property
    def hash(self) -> str:
        """Identifies them, stored as drawings or not."""
        return self.recorded.hash

    @property
    def ids(self) -> np.ndarray:
        """int32[A] the action of each row."""
        return self.recorded.ids

    def for_training(self, ids: np.ndarray) -> jax.Array | RecordingSource:
        """The recordings of `ids`: on the device, or from a source where they are drawn."""
        rows = self.recorded.rows(ids)
        if self.play.drawing is None:
            return jnp.asarray(self.recorded.data[rows])
        return self._source(self.play.drawing, rows, self.recorded.num_recordings)

    def for_encoding(
        self, ids: np.ndarray | None = None, num_recordings: int | None = None
    ) -> np.ndarray | RecordingSource:
        """The first recordings of `ids`, to be read in parts; default: all of all actions."""
        rows = np.arange(len(self.ids)) if ids is None else self.recorded.rows(ids)
        count = num_recordings or self.recorded.num_recordings
        if self.play.drawing is not None:
            return self._source(self.play.drawing, rows, count)
        data = self.recorded.data
        return data if ids is None and num_recordings is None else np.asarray(data[rows, :count])

    def _source(self, drawing: Drawing, rows: np.ndarray, count: int) -> RecordingSource:
        if self.drawn is not None:
            return StoredRecordings(self.drawn.data[:, :count], rows)
        data = self.recorded.data[:, :count]
        return DrawnRecordings(data, self.ids, drawing.draw, drawing.format.shape, rows)


def collect(
    folder: Path,
    play: Play,
    universe: ActionUniverse,
    num_recordings: int,
    seed: int,
    stores_drawn: bool = False,
) -> Recordings:
    """Records every action into `folder`, from where it stands, and draws if it is asked for.

    Args:
      stores_drawn: see `StageOneBudget`; of no meaning for a play without a drawing.

    Raises:
      ObservationsError: see `observations.collect`.
    """
    ids = np.arange(universe.num_actions, dtype=np.int32)
    if play.drawing is not None:
        print(_sizes(play, play.drawing, len(ids), num_recordings, stores_drawn), flush=True)
    recorded = observations.collect(
        folder / f"{play.folder}-{num_recordings}",
        play.record_block,
        format=play.format,
        universe=universe,
        ids=ids,
        num_recordings=num_recordings,
        seed=seed,
        block_actions=play.block_actions,
    )
    if play.drawing is None or not stores_drawn:
        return Recordings(play, recorded)
    drawn = _draw_all(folder, play.drawing, universe, recorded, seed)
    return Recordings(play, recorded, drawn)


def _draw_all(
    folder: Path,
    drawing: Drawing,
    universe: ActionUniverse,
    recorded: ActionObservations,
    seed: int,
) -> ActionObservations:
    """All recordings, drawn into a directory of their own."""
    source = DrawnRecordings(recorded.data, recorded.ids, drawing.draw, drawing.format.shape)

    def draw_block(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        return source.gather(recorded.rows(ids)[:, None], np.arange(num_recordings)[None])

    return observations.collect(
        folder / f"{drawing.folder}-{recorded.num_recordings}",
        draw_block,
        format=drawing.format,
        universe=universe,
        ids=recorded.ids,
        num_recordings=recorded.num_recordings,
        seed=seed,
        block_actions=1,  # Of frames, 1,024 recordings are 17 MB.
        play_settings={"drawn_from": recorded.hash},
    )


def _sizes(
    play: Play, drawing: Drawing, num_actions: int, num_recordings: int, stores_drawn: bool
) -> str:
    """What drawing on demand and storing take."""
    small, large = (
        format.estimate_bytes(num_actions, num_recordings) / 1e6
        for format in (play.format, drawing.format)
    )
    now = "they are stored" if stores_drawn else "they are drawn on demand"
    return (
        f"{num_actions} actions x {num_recordings} recordings take {small:,.1f} MB where frames "
        f"are drawn on demand (--frames=on-demand) and {small + large:,.1f} MB where they are "
        f"stored (--frames=stored); {now}."
    )
