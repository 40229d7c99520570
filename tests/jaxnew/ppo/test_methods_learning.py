"""A task in small on which the methods differ as in the paper: what is good lies on two sides."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import make_method
from jaxnew.policy.method import MethodContext
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.rollout.device import DeviceRollout, RolloutConfig
from jaxnew.sampling import ActionPool, draw_sets
from tests import probe_environments as probe

pytestmark = pytest.mark.learning

A, M, D, UPDATES = 96, 8, 3, 80
TRAIN, HELD_OUT = np.arange(48), np.arange(48, A)
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
# Far out on either side of the first number: no single point is near to all of them.
IS_GOOD = np.abs(TABLE[:, 0]) > 1.2
MDP = probe.bandit(np.broadcast_to(IS_GOOD * 1.0, (1, A)), np.ones((1, 2)))
HP = Hyperparameters(learning_rate=3e-3, entropy_coefficient=0.01, clip=0.2)
CONFIG = PPOConfig(
    rollout=RolloutConfig(
        num_envs=64,
        num_steps=8,
        set_size=M,
        normalize_observations=False,
        normalize_rewards=False,
    ),
    num_minibatches=2,
    microbatch_size=0,
    lr_steps=10**9,
)


@functools.cache
def share_of_good(name: str, has_fixed_set: bool, ids: tuple[int, ...]) -> float:
    """How often a trained method takes a good action, over sets of `ids` that hold one."""
    method = make_method(name, MethodContext(train_ids=TRAIN))
    rollout_config = replace(CONFIG.rollout, has_fixed_set=has_fixed_set)
    rollout = DeviceRollout(probe.TableWorld(A), MDP, method, rollout_config)
    learner = Learner(rollout, replace(CONFIG, rollout=rollout_config))
    table, pool = jnp.asarray(TABLE), ActionPool.of(TRAIN, capacity=len(TRAIN))

    @jax.jit
    def train(key: jax.Array) -> jax.Array:
        state = learner.init(key, table, pool)
        return learner.updates(state, HP, table, pool, UPDATES)[0].params

    params = train(jax.random.key(0))
    evaluated = ActionPool.of(np.asarray(ids), capacity=A)
    available = draw_sets(jax.random.split(jax.random.key(99), 4000), evaluated, M)
    obs = jnp.ones((4000, 2))
    projected = method.project(params, table)[available.ids]
    sample = method.distribution(params, obs, projected, available.mask).sample(jax.random.key(1))
    chosen = np.asarray(method.decode(sample, available, table).id)
    has_good = IS_GOOD[np.asarray(available.ids)].any(axis=1)
    return float(IS_GOOD[chosen][has_good].mean())


def test_ours_finds_good_actions_wherever_they_lie() -> None:
    assert share_of_good("ours", False, tuple(TRAIN)) > 0.95
    assert share_of_good("ours", False, tuple(HELD_OUT)) > 0.85


@pytest.mark.parametrize(("name", "has_fixed_set"), [("continuous", False), ("discrete", True)])
def test_a_point_is_near_to_one_side_only(name: str, has_fixed_set: bool) -> None:
    """The baselines learn, and are better than chance; but unseen actions on the other side of
    what they want are not found."""
    ours = share_of_good("ours", False, tuple(HELD_OUT))
    baseline = share_of_good(name, has_fixed_set, tuple(HELD_OUT))
    chance = share_of_good("random", False, tuple(HELD_OUT))
    assert chance + 0.1 < baseline < ours - 0.1


def test_one_fixed_set_is_learned_but_says_less_of_others() -> None:
    assert share_of_good("ours", True, tuple(TRAIN)) > 0.9
    assert share_of_good("random", False, tuple(TRAIN)) < 0.5
