"""Episodes of environments on the host: those of `evaluate`, played again to be looked at.

A pool that keeps what it was told plays them, and each is played again from its seed and its
actions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from experiments.pipeline.training import EVALUATION_SEED, Trainer
from jaxnew.ppo import TrainState
from jaxnew.rollout.pool import HostEnvironments, HostPool, HostStep
from jaxnew.task import Film


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


def check_film(episode: HostEpisode, film: Film) -> None:
    """Refuses a film that does not end as its episode did.

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
