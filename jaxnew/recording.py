"""Recordings of what actions do: of every action of a domain, and of new ones.

Made on demand, and said beforehand.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew import collection
from jaxnew.actions import SPLIT_NAMES, ActionIdentity, ActionUniverse, load_ids
from jaxnew.observations import RecordingFormat, Recordings
from jaxnew.representation.modality import Modality
from jaxnew.representation.sources import DrawnRecordings, RecordingSource, StoredRecordings
from jaxnew.storage.files import check_new
from jaxnew.storage.progress import say
from jaxnew.task.budgets import StageOneBudget
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from jaxnew.task.task import Drawing, Play, Task

# One encoder is shared by all policy seeds, as in the paper; so are the recordings.
REPRESENTATION_SEED = 31
CHANGES, ORACLE = "-changes", "-oracle"


class Learned(NamedTuple):
    """What the name of a learned representation says: `hvae` or `vae`, of what, and how read; and
    whether mean changes are appended.
    """

    kind: str
    play: Play
    modality: Modality
    appends_changes: bool


def parse_representation(domain: Domain, name: str) -> Learned:
    """What a learned representation's name, such as `hvae` or `vae-onehot`, says.

    The suffix `-changes` says that mean changes are appended, see `Autoencoder.mean_changes`, and
    behind it `-oracle` that the encoder is trained on all actions, test ones included.

    Raises:
      UsageError: the name is not of that form.
    """
    base = name.removesuffix(ORACLE)
    kind, _, modality_name = base.removesuffix(CHANGES).partition("-")
    modality_name = modality_name or next(iter(domain.play.modalities))
    of_play = {name: play for play in domain.task.plays for name in play.modalities}
    if kind not in ("hvae", "vae") or modality_name not in of_play:
        legal = [f"{k}-{m}" for k in ("hvae", "vae") for m in of_play]
        raise UsageError(
            f"Unknown representation {name!r}. Learned: hvae, vae, {', '.join(legal)}, each also "
            f"with {CHANGES} and {ORACLE}; engineered: {', '.join(domain.universe.engineered)}; "
            "random-SIZE; or an embed run, or an .npz file."
        )
    play = of_play[modality_name]
    modality = play.modalities[modality_name]
    appends_changes = base.endswith(CHANGES)
    if appends_changes and not modality.is_gaussian_vector:
        raise UsageError(
            f"{name!r}: changes are appended where recordings are vectors with a Gaussian "
            f"likelihood, and {modality_name!r} are not; leave out {CHANGES}."
        )
    return Learned(kind, play, modality, appends_changes)


@dataclass(frozen=True)
class PlayRecordings:
    """The recordings of every action of a domain, and how training and encoding read them.

    Attributes:
      play: how they were made.
      recorded: what the play environment gave.
      drawn: the same, drawn and stored; None if nothing is drawn, or on demand.
    """

    play: Play
    recorded: Recordings
    drawn: Recordings | None = None

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
        recorded = self.recorded
        rows = np.arange(recorded.num_actions) if ids is None else recorded.rows(ids)
        count = num_recordings or recorded.num_recordings
        if self.play.drawing is not None:
            return self._source(self.play.drawing, rows, count)
        is_all = ids is None and num_recordings is None
        return recorded.data if is_all else np.asarray(recorded.data[rows, :count])

    def _source(self, drawing: Drawing, rows: np.ndarray, count: int) -> RecordingSource:
        if self.drawn is not None:
            return StoredRecordings(self.drawn.data[:, :count], rows)
        data, ids = self.recorded.data[:, :count], self.recorded.ids
        return DrawnRecordings(data, ids, drawing.draw, drawing.format.shape, rows)


def collect(
    domain: Domain,
    runs: Path | str,
    num_recordings: int,
    play: Play | None = None,
    stores_drawn: bool = False,
    seed: int = REPRESENTATION_SEED,
) -> PlayRecordings:
    """Records every action of a domain below `runs`, from where it stands, and draws if asked to.

    Args:
      num_recordings: S, per action.
      play: which ones; default: the task's first.
      stores_drawn: see `StageOneBudget`; of no meaning for a play without a drawing.
      seed: of the recordings.

    Raises:
      ObservationsError: see `jaxnew.collection.collect`.
    """
    play, folder = play or domain.play, domain.actions_folder(Path(runs))
    ids = np.arange(domain.universe.num_actions, dtype=np.int32)
    drawing = play.drawing
    if drawing is not None:
        say(_sizes(play.format, drawing.format, len(ids), num_recordings, stores_drawn))
    path = folder / f"{play.folder}-{num_recordings}"
    recorded = _recorded(path, domain, play, ids, num_recordings, seed)
    if drawing is None or not stores_drawn:
        return PlayRecordings(play, recorded)
    drawn = _draw_all(folder, drawing, domain.universe, recorded, seed)
    return PlayRecordings(play, recorded, drawn)


def stores(play: Play, preset: StageOneBudget, stores_drawn: bool | None) -> bool:
    """Whether what is drawn is stored: what was said, else what the preset says.

    Raises:
      UsageError: something was said, and nothing is drawn.
    """
    if stores_drawn is not None and play.drawing is None:
        raise UsageError("These recordings are no drawn frames; leave out --frames (stores_drawn).")
    return preset.stores_drawn if stores_drawn is None else stores_drawn


def record(
    task: Task | str,
    ids: str | Path | np.ndarray = "all",
    *,
    output: Path | str,
    universe: str = "",
    representation: str = "",
    num_recordings: int | None = None,
    budget: str = "laptop",
    seed: int = REPRESENTATION_SEED,
    overwrite: bool = False,
) -> Recordings:
    """Records actions into one file, which an encoder reads (paper algorithm 2, first step).

    They need not have existed when anything was trained. Goes on where an earlier call was killed.

    Args:
      task: the domain, or what `load_task` takes.
      ids: int[n], or the file of `load_ids`, or `all`, or a part of the universe's default split,
        or `new`: all that the task's own universe has not.
      output: the file, `.npz`.
      universe: see `Task.with_universe`.
      representation: what the encoder learned, such as `hvae-video`; default: the task's first.
      num_recordings: S, per action; default: as the budget's encoders have.
      budget: a preset of stage one.
      seed: of the recordings.
      overwrite: replace the file if there is one.

    Returns:
      What encoders read: drawn recordings, where recordings are drawn.

    Raises:
      UsageError, ValueError: there are no such actions, universe, representation or budget.
      StorageError: the file exists, or its place cannot be written.
      ObservationsError: see `jaxnew.collection.collect`.
    """
    own = load_task(task) if isinstance(task, str) else task
    domain, output = Domain.of(own.with_universe(universe)), Path(output)
    chosen = _chosen(domain, ids, own)
    play = parse_representation(domain, representation).play if representation else domain.play
    partial = output.with_name(f".{output.name}.unfinished")
    check_new(output, overwrite or partial.exists())  # A call that was killed goes on.
    count = num_recordings or domain.stage_one(play, budget).num_recordings
    recorded = _recorded(partial / play.folder, domain, play, chosen, count, seed)
    if play.drawing is not None:
        recorded = _draw_all(partial, play.drawing, domain.universe, recorded, seed)
    identity = ActionIdentity.of(domain.universe, chosen, domain.task.universe_name)
    replace(recorded, identity=identity).save(output)
    shutil.rmtree(partial)
    return Recordings.load(output)


def _recorded(
    path: Path, domain: Domain, play: Play, ids: np.ndarray, num_recordings: int, seed: int
) -> Recordings:
    """What the play environment gives of some actions, collected in a directory."""
    return collection.collect(
        path,
        play.record_block,
        format=play.format,
        universe=domain.universe,
        ids=ids,
        num_recordings=num_recordings,
        seed=seed,
        block_actions=play.block_actions,
    )


def _chosen(domain: Domain, ids: str | Path | np.ndarray, own: Task) -> np.ndarray:
    """int32[n] the actions that `record` was asked for."""
    if not isinstance(ids, str | Path):
        return np.asarray(ids)
    if ids == "all":
        return np.arange(domain.universe.num_actions, dtype=np.int32)
    if ids == "new":
        known = set(own.make_universe().action_hashes)
        new = [i for i, key in enumerate(domain.universe.action_hashes) if key not in known]
        if not new:
            raise UsageError(
                f"{domain.universe.name} has no action that task {own.name} lacks; name a universe "
                "that has some, or other ids."
            )
        return np.array(new, np.int32)
    if ids in SPLIT_NAMES:
        return domain.split.ids(str(ids))
    if not Path(ids).is_file():
        raise UsageError(
            f"ids={str(ids)!r} is neither all, new, {', '.join(SPLIT_NAMES)}, nor a file of ids."
        )
    return load_ids(Path(ids), domain.universe)


def _draw_all(
    folder: Path, drawing: Drawing, universe: ActionUniverse, recorded: Recordings, seed: int
) -> Recordings:
    """All recordings, drawn into a directory of their own."""
    source = DrawnRecordings(recorded.data, recorded.ids, drawing.draw, drawing.format.shape)

    def draw_block(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        return source.gather(recorded.rows(ids)[:, None], np.arange(num_recordings)[None])

    return collection.collect(
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
    small: RecordingFormat, large: RecordingFormat, num_actions: int, count: int, is_stored: bool
) -> str:
    """What drawing on demand and storing take."""
    less, more = (form.estimate_bytes(num_actions, count) / 1e6 for form in (small, large))
    now = "they are stored" if is_stored else "they are drawn on demand"
    return (
        f"{num_actions} actions x {count} recordings take {less:,.1f} MB where frames are drawn on "
        f"demand (--frames=on-demand) and {less + more:,.1f} MB where they are stored "
        f"(--frames=stored); {now}."
    )
