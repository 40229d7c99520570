"""What policies that know the Recommender reach: anchors for the results (spec recommender 6).

`random` chooses uniformly; `dot` takes the product with the largest `beta . omega`, the best that
a policy can do whose table hides `mu`; `oracle` that with the largest `beta . omega + mu`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.recommender import Recommender, RecommenderParams, RecommenderState
from experiments.pipeline.artifacts import Domain
from jaxnew.environment import Action, Transition
from jaxnew.evaluation import Evaluator, summarize
from jaxnew.policy import Categorical
from jaxnew.policy.utility import RandomMethod
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool

SET_SIZES = (50, 500)
EPISODES = 5000
_SEED = 2020

WEIGHTS = {"random": (0.0, 0.0), "dot": (1.0, 0.0), "oracle": (1.0, 1.0)}  # beta . omega, mu.


class OpenRecommender(Recommender):
    """The Recommender with the taste itself as observation, f32[16]."""

    def reset_env(
        self, key: jax.Array, params: RecommenderParams
    ) -> tuple[jax.Array, RecommenderState]:
        _, state = super().reset_env(key, params)
        return state.omega, state

    def step_env(
        self, key: jax.Array, state: RecommenderState, action: Action, params: RecommenderParams
    ) -> Transition:
        _, state, *rest = super().step_env(key, state, action, params)
        return (state.omega, state, *rest)  # type: ignore[return-value]


class AnchorMethod(RandomMethod):
    """Scores `weights . (beta . omega, mu)` from rows that hold beta and mu, f32[..., 17]."""

    name = "anchor"

    def __init__(self, weights: tuple[float, float]) -> None:
        super().__init__()
        self._weights = weights

    def project(self, params: Any, representations: jax.Array) -> jax.Array:
        """The rows themselves."""
        del params
        return representations

    def distribution(
        self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """Logits f32[..., m]; all equal for weights of zero."""
        del params
        known, hidden = self._weights
        taste = jnp.einsum("...md,...d->...m", projected[..., :-1], obs)
        return Categorical.masked(known * taste + hidden * projected[..., -1], mask)


def rates(ids: np.ndarray, table: jax.Array, name: str, set_size: int, episodes: int) -> Any:
    """Episode metrics of one anchor with intervals, on sets drawn from `ids`."""
    env = OpenRecommender()
    method = AnchorMethod(WEIGHTS[name])
    evaluator = Evaluator(env, env.default_params, method, set_size, normalize_observations=False)
    pool = ActionPool.of(ids, capacity=len(table))
    statistics = RunningStatistics.zeros((table.shape[1] - 1,))
    is_greedy = name != "random"
    key = jax.random.key(_SEED)
    return summarize(evaluator.run({}, statistics, table, pool, key, episodes, is_greedy))


def lines(
    domain: Domain, parts: Sequence[str], set_sizes: Sequence[int], episodes: int
) -> Iterator[str]:
    """The table of all anchors, line by line as they are measured."""
    table = jnp.asarray(domain.universe.engineered["product-mu"])
    yield "| products | set size | policy | click-through rate [95 % interval] | episode length |"
    yield "|" + " --- |" * 5
    for part in parts:
        for size in set_sizes:
            for name in WEIGHTS:
                found = rates(domain.split.ids(part), table, name, size, episodes)
                rate, length = found["click_through_rate"], found["episode_length"]
                interval = f"[{rate['low']:.3f}, {rate['high']:.3f}]"
                cells = [part, str(size), name, f"{rate['mean']:.3f} {interval}"]
                yield "| " + " | ".join([*cells, f"{length['mean']:.1f}"]) + " |"
