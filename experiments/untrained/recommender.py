"""What policies that know the Recommender reach (docs/recommender.md, "Anchors").

`random` chooses uniformly; `dot` takes the product with the largest `beta . omega`, the best that
a policy can do whose table hides `mu`; `oracle` that with the largest `beta . omega + mu`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.recommender import (
    Recommender,
    RecommenderParams,
    RecommenderSettings,
    RecommenderState,
)
from experiments.reports.anchors import Line
from jaxnew.environment import Action, Transition
from jaxnew.evaluation import measure, summarize
from jaxnew.policy import Categorical
from jaxnew.policy.utility import RandomMethod
from jaxnew.rollout.contract import Policy, RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from jaxnew.task.domain import Domain

SET_SIZES = (50, 500)
EPISODES = 5000
METRICS = ("click_through_rate", "episode_length")

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


def play(env: OpenRecommender, actions: Actions, name: str, episodes: int) -> dict[str, np.ndarray]:
    """Episode metrics f32[episodes] of one of `WEIGHTS`, from rows that hold beta and mu."""
    config = RolloutConfig(normalize_observations=False, normalize_rewards=False)
    method = AnchorMethod(WEIGHTS[name])
    rollout = DeviceRollout(env, env.default_params, method, config)
    return measure(rollout, Policy({}), actions, episodes, is_greedy=name != "random")


def measure_anchors(
    domain: Domain,
    parts: Sequence[str],
    set_sizes: Sequence[int],
    episodes: int,
    settings: RecommenderSettings,
) -> Iterator[Line]:
    """The lines of all anchors as they are measured; see `Line`."""
    env, episodes = OpenRecommender(**asdict(settings)), episodes or EPISODES
    table = domain.universe.engineered["product-mu"]
    for size in set_sizes or SET_SIZES:
        for part in parts:
            actions = Actions.of(table, domain.split.ids(part), size, name=f"the {part} actions")
            for name in WEIGHTS:
                found = summarize(play(env, actions, name, episodes))
                yield Line(name, part, size, episodes, "", {key: found[key] for key in METRICS})
