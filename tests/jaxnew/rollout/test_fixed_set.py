"""One set for ever is the same as that set in every episode, and is stored once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import make_method
from jaxnew.policy.method import MethodContext
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.rollout.device import DeviceRollout, RolloutConfig
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool, AvailableSet
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy

A, D, N, T = 12, 3, 4, 10
IDS = np.array([1, 2, 5, 7, 8, 11])
POOL = ActionPool.of(IDS, capacity=len(IDS))
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
CONFIG = RolloutConfig(num_envs=N, num_steps=T, set_size=len(IDS), has_fixed_set=True)


class InOrder(DeviceRollout):
    """Draws the whole pool in its order for every step of every environment."""

    def _draw(self, key: jax.Array, shape: tuple[int, ...], pool: ActionPool) -> AvailableSet:
        del key
        ids = jnp.broadcast_to(pool.ids, (*shape, len(IDS)))
        return AvailableSet(ids, ids >= 0)


def learner_of(name: str, has_fixed_set: bool) -> Learner:
    config = replace(CONFIG, has_fixed_set=has_fixed_set)
    rollout_class = DeviceRollout if has_fixed_set else InOrder
    method = make_method(name, MethodContext(train_ids=IDS))
    rollout = rollout_class(probe.TableWorld(A), probe.ladder(A), method, config)
    ppo = PPOConfig(rollout=config, num_minibatches=2, microbatch_size=10, lr_steps=10**6)
    return Learner(rollout, ppo)


def updated(name: str, has_fixed_set: bool) -> Any:
    """(rollout batch, parameters after an update) from the same keys."""
    learner = learner_of(name, has_fixed_set)
    state = learner.init(jax.random.key(0), jnp.asarray(TABLE), POOL)
    # Away from uniform, where gradients are rounding.
    state = replace(state, params=numpy_policy.randomized(state.params, seed=1))
    batch = learner.rollout.collect(
        jax.random.key(1), state.rollout, state.params, jnp.asarray(TABLE), POOL, 0.9
    )[1]
    update = jax.jit(learner.update)
    return batch, update(state, Hyperparameters(), jnp.asarray(TABLE), POOL)[0].params


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["ours", "discrete", "continuous"])
def test_a_fixed_set_is_that_set_in_every_episode(name: str) -> None:
    fixed, fixed_params = updated(name, True)
    drawn, drawn_params = updated(name, False)
    assert fixed.available is None
    assert drawn.available.ids.shape == (T, N, len(IDS))
    for a, b in zip(
        jax.tree.leaves(fixed), jax.tree.leaves(replace(drawn, available=None)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    for a, b in zip(jax.tree.leaves(fixed_params), jax.tree.leaves(drawn_params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.unit
def test_given_statistics_are_used_and_frozen() -> None:
    config = replace(CONFIG, freezes_observation_statistics=True)
    rollout = DeviceRollout(probe.TableWorld(A), probe.ladder(A), make_method("ours"), config)
    given = RunningStatistics(jnp.arange(4.0), jnp.full(4, 4.0), jnp.float32(50.0))
    state = rollout.init(jax.random.key(0), POOL, given)
    first = np.asarray(probe.ladder(A).observations)[0]
    expected = (first - np.arange(4.0)) / 2.0
    np.testing.assert_allclose(state.observation, np.tile(expected, (N, 1)), rtol=1e-5, atol=1e-6)
    params = rollout.method.init(jax.random.key(1), state.observation[0], D)
    after, _, _ = rollout.collect(jax.random.key(2), state, params, jnp.asarray(TABLE), POOL, 0.9)
    for a, b in zip(
        jax.tree.leaves(after.observation_statistics), jax.tree.leaves(given), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    # Those of rewards go on.
    assert float(after.return_statistics.count) > float(state.return_statistics.count)
