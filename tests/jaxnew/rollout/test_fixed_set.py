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
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import Actions, AvailableSet
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy

A, D, N, T = 12, 3, 4, 10
IDS = np.array([1, 2, 5, 7, 8, 11])
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
FIXED = Actions.of(TABLE, IDS)
CONFIG = RolloutConfig(num_envs=N, num_steps=T)


class InOrder(Actions):
    """Draws the whole pool in its order for every episode."""

    def draw(self, keys: jax.Array) -> AvailableSet:
        ids = jnp.broadcast_to(self.pool.ids, (*keys.shape, len(IDS)))
        return AvailableSet(ids, ids >= 0)


# As dataclasses of flax are, so that it may cross `jit`.
jax.tree_util.register_dataclass(
    InOrder,
    data_fields=["table", "pool"],
    meta_fields=["set_size", "padded_size", "is_fixed", "first_size", "growth"],
)
DRAWN = InOrder(FIXED.table, FIXED.pool, len(IDS), len(IDS))


def updated(name: str, actions: Actions) -> Any:
    """(rollout batch, parameters after an update) from the same keys."""
    method = make_method(name, MethodContext(train_ids=IDS))
    rollout = DeviceRollout(probe.TableWorld(A), probe.ladder(A), method, CONFIG)
    ppo = PPOConfig(rollout=CONFIG, num_minibatches=2, microbatch_size=10, lr_steps=10**6)
    learner = Learner(rollout, ppo)
    state = learner.init(jax.random.key(0), actions)
    # Away from uniform, where gradients are rounding.
    state = replace(state, params=numpy_policy.randomized(state.params, seed=1))
    batch = rollout.collect(jax.random.key(1), state.rollout, state.params, actions, 0.9)[1]
    return batch, jax.jit(learner.update)(state, Hyperparameters(), actions)[0].params


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["ours", "discrete", "continuous"])
def test_a_fixed_set_is_that_set_in_every_episode(name: str) -> None:
    fixed, fixed_params = updated(name, FIXED)
    drawn, drawn_params = updated(name, DRAWN)
    assert fixed.available.ids.tolist() == IDS.tolist()
    assert drawn.available.ids.shape == (T, N, len(IDS))
    rest = (jax.tree.leaves(replace(batch, available=None)) for batch in (fixed, drawn))
    for a, b in zip(*rest, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    for a, b in zip(jax.tree.leaves(fixed_params), jax.tree.leaves(drawn_params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.unit
def test_given_statistics_are_used_and_frozen() -> None:
    config = replace(CONFIG, freezes_observation_statistics=True)
    rollout = DeviceRollout(probe.TableWorld(A), probe.ladder(A), make_method("ours"), config)
    given = RunningStatistics(jnp.arange(4.0), jnp.full(4, 4.0), jnp.float32(50.0))
    state = rollout.init(jax.random.key(0), FIXED, given)
    first = np.asarray(probe.ladder(A).observations)[0]
    expected = (first - np.arange(4.0)) / 2.0
    np.testing.assert_allclose(state.observation, np.tile(expected, (N, 1)), rtol=1e-5, atol=1e-6)
    params = rollout.method.init(jax.random.key(1), state.observation[0], D)
    after, _, _ = rollout.collect(jax.random.key(2), state, params, FIXED, 0.9)
    for a, b in zip(
        jax.tree.leaves(after.observation_statistics), jax.tree.leaves(given), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    # Those of rewards go on.
    assert float(after.return_statistics.count) > float(state.return_statistics.count)
