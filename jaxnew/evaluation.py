"""A policy on action sets -> numbers with intervals.

Episode `i` draws its set, its start and its actions from `fold_in(key, i)`, and inference always
runs at one width, so an episode is the same however many others are evaluated beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.environment import Environment
from jaxnew.metrics import mean_interval, wilson_interval
from jaxnew.policy import PolicyMethod
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool, AvailableSet, check_set_size, draw_sets


@dataclass(frozen=True)
class Evaluator:
    """Plays whole episodes with frozen statistics; compiled once per (width, set size, mode).

    Attributes:
      env, env_params: the task, with concrete parameters.
      method: the policy.
      set_size: m, actions available in an episode.
      padded_set_size: width of the sets, 0 for `set_size`.
      normalize_observations: whether the policy was trained on normalised observations.
      first_size: actions of the set that are available at the first step, 0 for all of them; then
        `growth` more become available at every step.
      width: episodes played at a time.
    """

    env: Environment
    env_params: Any
    method: PolicyMethod
    set_size: int
    padded_set_size: int = 0
    normalize_observations: bool = True
    first_size: int = 0
    growth: int = 1
    width: int = 128

    def __post_init__(self) -> None:
        check_growth(self.first_size, self.growth, self.set_size)

    @property
    def max_episode_steps(self) -> int:
        """Length of the longest episode."""
        return self.env.max_episode_steps(self.env_params)

    def run(
        self,
        params: Any,
        statistics: RunningStatistics,
        table: jax.Array,
        pool: ActionPool,
        key: jax.Array,
        num_episodes: int,
        deterministic: bool = False,
    ) -> dict[str, np.ndarray]:
        """Plays episodes `0..num_episodes-1`.

        Args:
          params: of the policy.
          statistics: of raw observations; not updated.
          table: f32[A, d] representations.
          pool: actions that sets are drawn from.
          key: consumed.
          num_episodes: at least 1.
          deterministic: take the most likely action instead of sampling.

        Returns:
          For each of the environment's `episode_metrics`, f32[num_episodes] at the episode's end;
          and `num_steps`, agent steps.

        Raises:
          ValueError: the pool is smaller than a set, or `num_episodes` < 1.
        """
        check_set_size(pool, self.set_size)
        if num_episodes < 1:
            raise ValueError(f"num_episodes={num_episodes} must be at least 1.")
        play = self._play_greedy if deterministic else self._play_sampled
        blocks = []
        for start in range(0, num_episodes, self.width):
            block = play(params, statistics, table, pool, key, jnp.int32(start))
            blocks.append(jax.tree.map(np.asarray, block))
        return {
            name: np.concatenate([block[name] for block in blocks])[:num_episodes]
            for name in blocks[0]
        }

    def play_block(
        self,
        params: Any,
        statistics: RunningStatistics,
        table: jax.Array,
        pool: ActionPool,
        key: jax.Array,
        start: jax.Array,
        deterministic: bool = False,
    ) -> dict[str, jax.Array]:
        """Episodes `start..start+width-1`, pure: f32[width] per metric. See `run`."""
        episodes = start + jnp.arange(self.width)
        keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), 3))(episodes)
        keys_sets, keys_reset, keys_steps = keys[:, 0], keys[:, 1], keys[:, 2]
        available = draw_sets(keys_sets, pool, self.set_size, self.padded_set_size or None)
        obs, state = jax.vmap(self.env.reset_env, in_axes=(0, None))(keys_reset, self.env_params)
        projected = self.method.project(params, table)[available.ids]

        def step(carry: tuple[Any, ...], t: jax.Array) -> tuple[tuple[Any, ...], None]:
            obs, state, is_over, metrics = carry
            if self.normalize_observations:
                obs = statistics.normalize(obs)
            now = self._available_at(available, t)
            distribution = self.method.distribution(params, obs, projected, now.mask)
            keys_now = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, t)))(keys_steps)
            if deterministic:
                sample = distribution.mode()
            else:
                sample = jax.vmap(lambda d, k: d.sample(k))(distribution, keys_now[:, 0])
            obs, state, _, terminated, truncated, info = jax.vmap(
                self.env.step_env, in_axes=(0, 0, 0, None)
            )(keys_now[:, 1], state, self.method.decode(sample, now, table), self.env_params)
            metrics = {
                name: jnp.where(is_over, old, self._metric(name, info, t))
                for name, old in metrics.items()
            }
            return (obs, state, is_over | terminated | truncated, metrics), None

        names = (*self.env.episode_metrics, "num_steps")
        zeros = {name: jnp.zeros(self.width) for name in names}
        carry = (obs, state, jnp.zeros(self.width, bool), zeros)
        (_, _, _, metrics), _ = jax.lax.scan(step, carry, jnp.arange(self.max_episode_steps))
        return metrics

    def _available_at(self, available: AvailableSet, t: jax.Array) -> AvailableSet:
        """What may be chosen at step `t`: sets are in random order, so a beginning is a set too."""
        is_there = is_there_at(self.first_size, self.growth, t, available.ids.shape[-1])
        return AvailableSet(available.ids, available.mask & is_there)

    @staticmethod
    def _metric(name: str, info: dict[str, jax.Array], t: jax.Array) -> jax.Array:
        value = t + 1 if name == "num_steps" else info[name]
        return jnp.asarray(value, jnp.float32)

    @cached_property
    def _play_sampled(self) -> Any:
        return jax.jit(self.play_block)

    @cached_property
    def _play_greedy(self) -> Any:
        return jax.jit(partial(self.play_block, deterministic=True))


def check_growth(first_size: int, growth: int, set_size: int) -> None:
    """Raises ValueError unless sets can grow so; see `Evaluator`."""
    if not 0 <= first_size <= set_size or growth < 0:
        raise ValueError(
            f"first_size={first_size} must be in 0..{set_size} (the set size) and "
            f"growth={growth} at least 0."
        )


def is_there_at(first_size: int, growth: int, t: Any, width: int) -> Any:
    """bool[..., width] what is there at step t int[...] of a growing set; see `Evaluator`."""
    t = t[..., None]
    return (np.arange(width) < first_size + growth * t) | (first_size == 0)


def summarize(episodes: dict[str, np.ndarray]) -> dict[str, dict[str, float | str]]:
    """Mean and 95 % interval over episodes of each metric of `Evaluator.run`.

    Metrics of only zeros and ones get a Wilson interval, others a normal one.
    """
    summary: dict[str, dict[str, float | str]] = {}
    for name, values in episodes.items():
        is_proportion = bool(np.isin(values, (0.0, 1.0)).all()) and name.startswith(("is_", "has_"))
        interval = (
            wilson_interval(int(values.sum()), len(values))
            if is_proportion
            else mean_interval(values.astype(np.float64))
        )
        summary[name] = {
            "mean": float(values.mean(dtype=np.float64)),
            "low": interval.low,
            "high": interval.high,
            "interval": "Wilson 95 %" if is_proportion else "normal 95 %",
        }
    return summary
