"""Does the learner learn? Probe tasks, each of which fails for one kind of mistake.

All are the same environment with other tables, so one compiled program trains them all. With three
seeds each, values came out to 1e-6, the right choices with 0.998 (held-out actions: 0.977) or more;
the bounds leave room for other roundings, not for other algorithms.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import make_method
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig, TrainState
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from tests import probe_environments as probe

pytestmark = pytest.mark.learning

S, A, M, D = 4, 64, 8, 4
TRAIN, HELD_OUT = np.arange(32), np.arange(32, 64)
DISCOUNT = 0.9
METHOD = make_method("ours")
CONFIG = PPOConfig(
    rollout=RolloutConfig(
        num_envs=32,
        num_steps=8,
        # Values and rewards stay in the units of the task.
        normalize_observations=False,
        normalize_rewards=False,
    ),
    num_epochs=4,
    num_minibatches=2,
    microbatch_size=0,
    lr_steps=10**9,
)
HP = Hyperparameters(learning_rate=3e-3, entropy_coefficient=0.01, clip=0.2, discount=DISCOUNT)
# What an action is worth is a function of its row.
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
STATES = np.eye(S)


@functools.cache
def program() -> Any:
    """A jitted (mdp, actions, key) -> state after 60 updates."""

    @jax.jit
    def train(mdp: probe.TableParams, actions: Actions, key: jax.Array) -> TrainState:
        rollout = DeviceRollout(probe.TableWorld(A), mdp, METHOD, CONFIG.rollout)
        learner = Learner(rollout, CONFIG)
        return learner.updates(learner.init(key, actions), HP, actions, 60)[0]

    return train


def train(mdp: probe.TableParams, seed: int = 0) -> Any:
    """Parameters after training with the train actions only."""
    state = program()(mdp, Actions.of(TABLE, TRAIN, M), jax.random.key(seed))
    assert program()._cache_size() == 1
    return state.params


def values(params: Any) -> np.ndarray:
    """f[S]."""
    return np.asarray(METHOD.value(params, jnp.asarray(STATES, jnp.float32)))


def share_of(params: Any, is_good: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """f[S] probability of choosing an action with `is_good` bool[S, A], averaged over sets of `ids`
    that hold one."""
    available = Actions.of(TABLE, ids, M).draw(jax.random.split(jax.random.key(99), 200))
    shares = []
    for state in range(S):
        obs = jnp.broadcast_to(jnp.asarray(STATES[state], jnp.float32), (200, S))
        projected = METHOD.project(params, TABLE)[available.ids]
        distribution = METHOD.distribution(params, obs, projected, available.mask)
        probabilities = np.asarray(jax.nn.softmax(distribution.logits))
        good = is_good[state][np.asarray(available.ids)]
        share = (probabilities * good).sum(axis=1)
        shares.append(share[good.any(axis=1)].mean())
    return np.array(shares)


def test_constant_value() -> None:
    """Reward 1 always: the critic, its loss and its optimizer."""
    params = train(probe.bandit(np.ones((S, A)), STATES))
    np.testing.assert_allclose(values(params), 1.0, atol=0.01)


def test_observed_value() -> None:
    """The reward depends on the state seen: values are not shifted against observations."""
    rewards = np.array([1.0, -1.0, 0.5, 0.0])
    params = train(probe.bandit(np.broadcast_to(rewards[:, None], (S, A)), STATES))
    np.testing.assert_allclose(values(params), rewards, atol=0.01)


def test_discounted_value() -> None:
    """Three steps to a reward of 1: bootstrapping and discount, and no leak over the end."""
    next_state = np.broadcast_to(np.array([1, 2, 3, 3])[:, None], (S, A))
    is_last = np.broadcast_to((np.arange(S) >= 2)[:, None], (S, A))
    params = train(
        probe.table_params(STATES, next_state, is_last * 1.0, is_last, starts=(0, 0, 0, 0))
    )
    expected = [DISCOUNT**2, DISCOUNT, 1.0]
    np.testing.assert_allclose(values(params)[:3], expected, atol=0.01)


def test_choice_of_action() -> None:
    """One action is better in every state: the sign and the credit of the policy gradient."""
    is_good = np.broadcast_to(TABLE[:, 0] > 0, (S, A))
    params = train(probe.bandit(is_good * 1.0, STATES))
    assert share_of(params, is_good, TRAIN).min() > 0.95


def test_choice_that_depends_on_the_state() -> None:
    """What is right in two states is wrong in the others."""
    is_good = (TABLE[:, 0] > 0)[None] ^ (np.arange(S) >= 2)[:, None]
    params = train(probe.bandit(is_good * 1.0, STATES))
    assert share_of(params, is_good, TRAIN).min() > 0.95


def test_unseen_actions_are_chosen_by_what_they_do() -> None:
    """The paper's claim in small: worth is a function of the representation, a quarter of the
    actions is worth something, and the 32 actions of the test were never in a training set."""
    worth = TABLE[:, 0] + TABLE[:, 1] - 0.5 * TABLE[:, 2]
    is_good = np.broadcast_to(worth > np.quantile(worth, 0.75), (S, A))
    params = train(probe.bandit(is_good * 1.0, STATES))
    untrained = METHOD.init(jax.random.key(0), jnp.zeros(S), D)
    chance = share_of(untrained, is_good, HELD_OUT).mean()
    assert 0.2 < chance < 0.4
    assert share_of(params, is_good, TRAIN).min() > 0.95
    assert share_of(params, is_good, HELD_OUT).min() > 0.9
