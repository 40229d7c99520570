"""Zero-shot episodes of a trained policy as films, successes apart from failures (paper figure 8).

Episodes on the host are those of `evaluate`: a pool that keeps what it was told plays them, and
each is played again from its seed and its actions, this time to be looked at.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from experiments import _plots as plots
from experiments._flags import UsageError
from experiments._training import EVALUATION_SEED, Trainer, load_state, load_trainer
from experiments._video import write_video
from jaxnew.ppo import TrainState
from jaxnew.rollout.pool import HostEnvironments, HostPool, HostStep
from jaxnew.task import Film

SUCCESS, FAILURE = "success", "failure"
_FILE = "episode-{:03d}"
_NUM_COLUMNS = 5
_GOOD, _BAD = "#1b7f4d", "#b3382c"


@dataclass(frozen=True)
class HostEpisode:
    """An episode of a pool of host environments.

    Attributes:
      number: i of `HostEvaluator`.
      seed: of its reset.
      ids, positions: int32[T] and f32[T, k], what its environment was told.
      metrics: of the pool's `episode_metrics`, at its end.
    """

    number: int
    seed: np.random.SeedSequence
    ids: np.ndarray
    positions: np.ndarray
    metrics: dict[str, float]


class RecordedPool:
    """A pool that keeps the episodes of an evaluation.

    Args:
      pool: what plays.

    Attributes:
      episodes: those that are over, by number.
    """

    def __init__(self, pool: HostPool) -> None:
        self._pool = pool
        self._running: list[list[tuple[int, np.ndarray]]] = [[] for _ in range(pool.num_envs)]
        self._numbers = np.arange(pool.num_envs)
        self._seed = 0
        self.episodes: dict[int, HostEpisode] = {}

    def __getattr__(self, name: str) -> Any:
        """What the pool has."""
        return getattr(self._pool, name)

    def reset_numbered(self, seed: int) -> np.ndarray:
        """See `HostPool`; forgets what was kept."""
        self._seed, self.episodes = seed, {}
        self._running = [[] for _ in self._running]
        self._numbers = np.arange(len(self._running))
        return self._pool.reset_numbered(seed)

    def send(self, half: int, ids: np.ndarray, positions: np.ndarray) -> None:
        """See `HostPool`; keeps the actions."""
        first = half * len(ids)
        for row, (action_id, position) in enumerate(zip(ids, positions, strict=True)):
            self._running[first + row].append((int(action_id), np.array(position)))
        self._pool.send(half, ids, positions)

    def receive(self, half: int) -> HostStep:
        """See `HostPool`; keeps the episodes that are over."""
        step = self._pool.receive(half)
        is_over = np.asarray(step.terminated) | np.asarray(step.truncated)
        first = half * len(is_over)
        for row in np.flatnonzero(is_over):
            metrics = {name: float(values[row]) for name, values in step.metrics.items()}
            self._keep(first + int(row), metrics)
        return step

    def _keep(self, env: int, metrics: dict[str, float]) -> None:
        number = int(self._numbers[env])
        ids, positions = zip(*self._running[env], strict=True)
        self.episodes[number] = HostEpisode(
            number,
            np.random.SeedSequence(self._seed, spawn_key=(number,)),
            np.array(ids, np.int32),
            np.array(positions, np.float32),
            metrics,
        )
        self._running[env] = []
        self._numbers[env] += len(self._numbers)


def play_host_episodes(
    trainer: Trainer, state: TrainState, split: str, count: int, seed: int = EVALUATION_SEED
) -> list[HostEpisode]:
    """Episodes `0..count-1`, sampled, exactly as `evaluate` plays them.

    Args:
      trainer: of a run on the host.
      state: whose parameters play.
      split: part of the split that available sets are drawn from.
      count: how many.
      seed: of the evaluation.
    """
    evaluator = trainer.evaluator
    environments = evaluator.environments
    pool = RecordedPool(environments.pool)
    recorded = HostEnvironments(
        lambda: pool, environments.max_episode_steps, environments.stack_size
    )
    replace(evaluator, environments=recorded).run(
        state.params, None, trainer.table, trainer.pools[split], jax.random.key(seed), count
    )
    return [pool.episodes[number] for number in range(count)]


def film_run(
    path: Path,
    out: Path,
    count: int,
    size: int = 512,
    suffix: str = ".gif",
    title: str = "",
    num_workers: int = 0,
) -> list[Path]:
    """Films of the best checkpoint's first episodes on sets of test actions.

    Into `out/success` and `out/failure` go, for every episode, its film, its first and its last
    picture; earlier ones are removed. Beside `out`, a sheet of the last pictures and a table.

    Args:
      path: a run of `train` on the host.
      out: folder.
      count: episodes.
      size: pixels of the pictures' height.
      suffix: .gif or .mp4.
      title: of the sheet.
      num_workers: processes for environments; 0: one per core.

    Returns:
      The sheet, the table and the films.

    Raises:
      UsageError: the task's episodes cannot be drawn.
      RuntimeError: an episode went another way when it was played again.
    """
    run, trainer, _ = load_trainer(path, num_workers)
    host = trainer.task.host
    if host is None or host.make_film is None:
        raise UsageError(f"Episodes of task {trainer.task.name} cannot be filmed.")
    with closing(trainer):
        state, _ = load_state(run, trainer, "best")
        episodes = play_host_episodes(trainer, state, "test", count)
    clear(out)
    rows, stills, films = [], [], []
    for episode in episodes:
        film = host.make_film(episode.seed, episode.ids, episode.positions, size=size)
        outcome = checked_outcome(episode, film, trainer.task.selection_metric)
        stem = out / outcome / _FILE.format(episode.number)
        films.append(write_video(film.frames, stem.with_suffix(suffix)))
        for word, frame in (("start", film.frames[0]), ("end", film.frames[-1])):
            Image.fromarray(frame).save(stem.with_name(f"{stem.name}-{word}.png"))
        stills.append((episode.number, outcome, film.frames[-1]))
        rows.append(
            {
                "episode": episode.number,
                "outcome": outcome,
                "num_actions": len(episode.ids),
                **episode.metrics,
                "action_ids": " ".join(map(str, episode.ids)),
                "film": films[-1].relative_to(out.parent),
            }
        )
    table = out.with_suffix(".csv")
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return [*plots.save(sheet(stills, title), out.with_suffix(".png")), table, *films]


def clear(out: Path) -> None:
    """Removes films and pictures of an earlier call."""
    for outcome in (SUCCESS, FAILURE):
        (out / outcome).mkdir(parents=True, exist_ok=True)
        for file in (out / outcome).glob("episode-*"):
            file.unlink()


def checked_outcome(episode: HostEpisode, film: Film, metric: str) -> str:
    """`success` or `failure`, of an episode whose film ends as it did.

    Raises:
      RuntimeError: it does not.
    """
    shown = {name: film.metrics[name] for name in episode.metrics}
    if not np.allclose(
        list(shown.values()), list(episode.metrics.values()), atol=1e-5, equal_nan=True
    ):
        raise RuntimeError(
            f"Episode {episode.number} ended with {episode.metrics}, and with {shown} when it was "
            "played again; the environment is not a function of its seed and its actions."
        )
    return SUCCESS if episode.metrics[metric] > 0 else FAILURE


def sheet(stills: Sequence[tuple[int, str, np.ndarray]], title: str = "") -> Figure:
    """The last pictures of episodes, with their numbers and outcomes.

    Args:
      stills: (number, outcome, uint8[height, width, 3]) of each.
      title: of the sheet; the share of successes is added.
    """
    num_rows = -(-len(stills) // _NUM_COLUMNS)
    figure = plots.new_figure(2.4 * _NUM_COLUMNS, 2.6 * num_rows + 0.4)
    every = figure.subplots(num_rows, _NUM_COLUMNS, squeeze=False).ravel()
    for axes in every[len(stills) :]:
        axes.set_axis_off()
    for axes, (number, outcome, picture) in zip(every, stills, strict=False):
        axes.imshow(picture, interpolation="none")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_color(plots.GRID_COLOR)
        color = _GOOD if outcome == SUCCESS else _BAD
        axes.set_title(f"episode {number}: {outcome}", fontsize=9, color=color)
    share = f"{sum(outcome == SUCCESS for _, outcome, _ in stills)} of {len(stills)} successful"
    plots.set_title(figure, f"{title} ({share})" if title else share)
    return figure
