"""A policy on action sets -> numbers with intervals.

Episode `i` draws its set, its start and its actions from `fold_in(key, i)`, and inference always
runs at one width, so an episode is the same however many others are evaluated beside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np

from jaxnew.rollout.contract import Episode, Policy, Rollout
from jaxnew.sampling import Actions

EVALUATION_SEED = 2020  # Shared by all runs, so that they are evaluated on the same episodes.
_Z_95 = 1.959963984540054


def measure(
    rollout: Rollout,
    policy: Policy,
    actions: Actions,
    num_episodes: int,
    seed: int = EVALUATION_SEED,
    is_greedy: bool = False,
) -> dict[str, np.ndarray]:
    """Plays episodes `0..num_episodes-1`.

    Args:
      rollout: where.
      policy: who acts.
      actions: what sets are drawn from.
      num_episodes: at least 1.
      seed: of the episodes.
      is_greedy: take the most likely action instead of sampling.

    Returns:
      For each of the rollout's `episode_metrics`, f32[num_episodes] at the episode's end; and
      `num_steps`, agent steps.

    Raises:
      ValueError: `num_episodes` < 1.
    """
    if num_episodes < 1:
        raise ValueError(f"num_episodes={num_episodes} must be at least 1.")
    return rollout.measure(policy, actions, jax.random.key(seed), num_episodes, is_greedy)


def play(
    rollout: Rollout,
    policy: Policy,
    actions: Actions,
    first: int,
    count: int,
    seed: int = EVALUATION_SEED,
    is_greedy: bool = False,
) -> list[Episode]:
    """Episodes `first..first+count-1` of `measure`, with all that happened in them.

    Raises:
      ValueError: `first` < 0 or `count` < 1.
    """
    if first < 0 or count < 1:
        raise ValueError(f"first={first} must be at least 0, and count={count} at least 1.")
    return rollout.episodes(policy, actions, jax.random.key(seed), first, count, is_greedy)


class Interval(NamedTuple):
    """An estimate with a 95 % confidence interval."""

    mean: float
    low: float
    high: float


def wilson_interval(successes: int, trials: int) -> Interval:
    """Wilson's 95 % score interval for a proportion: inside [0, 1], sound for rare events.

    Raises:
      ValueError: not 0 <= successes <= trials, or no trial.
    """
    from scipy.stats import binomtest

    found = binomtest(successes, trials).proportion_ci(method="wilson")
    return Interval(successes / trials, float(found.low), float(found.high))


def mean_interval(values: np.ndarray) -> Interval:
    """Mean with its normal 95 % interval, `mean +- 1.96 s / sqrt(n)`; no width for one value.

    Args:
      values: f[n], n >= 1, independent (episodes of one policy, or one number per seed).

    Raises:
      ValueError: `values` is not a non-empty vector.
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"Need a non-empty vector of values, got shape {values.shape}.")
    mean = float(values.mean())
    spread = float(values.std(ddof=1)) if values.size > 1 else 0.0
    half = _Z_95 * spread / math.sqrt(values.size)
    return Interval(mean, mean - half, mean + half)


def summarize(episodes: dict[str, np.ndarray]) -> dict[str, dict[str, float | str]]:
    """Mean and 95 % interval over episodes of each metric of `measure`.

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
