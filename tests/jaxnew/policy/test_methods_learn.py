"""A task that tells the methods apart: worth depends on one number of a representation, and the
numbers that do not matter are four times as large.

A utility learns which number matters. The baselines act through distances, which the others rule:
they learn the train actions and lose on unseen ones (paper figure 4 in small).
"""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from jaxnew.evaluation import measure
from jaxnew.policy import make_method
from jaxnew.policy.method import MethodContext
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from tests import probe_environments as probe

pytestmark = pytest.mark.learning

A, M, D, S = 256, 8, 4, 2
TRAIN, HELD_OUT = np.arange(128, dtype=np.int32), np.arange(128, 256, dtype=np.int32)
TABLE = np.random.default_rng(1).normal(size=(A, D)).astype(np.float32) * [1.0, 4.0, 4.0, 4.0]
TABLE = TABLE.astype(np.float32)
# What is good in one state is bad in the other.
IS_GOOD = np.stack([TABLE[:, 0] > np.quantile(TABLE[:, 0], 0.7), TABLE[:, 0] < -0.52])
WORLD, MDP = probe.TableWorld(A), probe.bandit(IS_GOOD * 1.0, np.eye(S))
ROLLOUT = RolloutConfig(
    num_envs=32, num_steps=16, normalize_observations=False, normalize_rewards=False
)
CONFIG = PPOConfig(rollout=ROLLOUT, num_minibatches=2, microbatch_size=0, lr_steps=10**9)
NUMBERS = Hyperparameters(learning_rate=3e-3, entropy_coefficient=0.01, clip=0.2)


@functools.cache
def success(name: str, has_fixed_set: bool) -> dict[str, float]:
    """Share of good choices after 100 updates: on train sets (or the fixed set), and held out."""
    method = make_method(name, MethodContext(train_ids=TRAIN))
    rollout = DeviceRollout(WORLD, MDP, method, ROLLOUT)
    learner = Learner(rollout, CONFIG)
    actions = Actions.of(TABLE, TRAIN, None if has_fixed_set else M)
    state = learner.compiled_init(jax.random.key(0), actions)
    state, _ = learner.compiled_updates(state, NUMBERS, actions, num_updates=100)
    found = {}
    for part, ids in (("train", TRAIN), ("held out", HELD_OUT)):
        size = len(TRAIN) if has_fixed_set and part == "train" else M
        episodes = measure(rollout, state.policy, Actions.of(TABLE, ids, size), 1024, seed=9)
        found[part] = float(episodes["is_success"].mean())
    return found


# A set of 8 has a good action with probability 1 - 0.7 ** 8 = 0.94; a random choice is good in 0.3.


def test_ours_generalizes() -> None:
    ours = success("ours", False)
    assert ours["train"] > 0.85
    assert ours["held out"] > 0.8


def test_a_modulated_utility_generalizes_as_well() -> None:
    modulated = success("modulated", False)
    assert modulated["train"] > 0.85
    assert modulated["held out"] > 0.8


def test_random_play_is_chance() -> None:
    found = success("random", False)
    assert found["train"] == pytest.approx(0.3, abs=0.06)  # 4 deviations of 1,024 choices.
    assert found["held out"] == pytest.approx(0.3, abs=0.06)


def test_a_discrete_policy_learns_its_actions_and_is_lost_among_others() -> None:
    discrete = success("discrete", True)
    assert discrete["train"] > 0.95
    assert discrete["held out"] < 0.45  # The nearest action shares what does not matter.


def test_a_point_in_the_space_of_representations_is_a_worse_output() -> None:
    continuous, ours = success("continuous", False), success("ours", False)
    assert continuous["train"] > 0.5  # It does learn something.
    assert continuous["held out"] < ours["held out"] - 0.2
