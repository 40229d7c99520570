"""Shape Stacking keeps the promises of every environment, on short simulations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import ShapeStacking, scene
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from jaxnew.checks.environment import check_forms
from tests import contract

pytestmark = pytest.mark.contract

# A tenth of a second: shapes are still in the air, which no promise forbids.
ENV = ShapeStacking(MujocoC(settle_steps=10, num_threads=1))
PARAMS = ENV.default_params
CHANGES = {"max_actions": jnp.int32(4)}
NUM_ENVS, NUM_STEPS = 2, 21


@pytest.fixture(scope="module")
def run():
    return contract.rollout_function(ENV, NUM_ENVS, NUM_STEPS)


@pytest.fixture(scope="module")
def rollout(run) -> contract.Rollout:
    return run(jax.random.key(0), PARAMS)


def test_one_trace_serves_every_key_id_and_parameter() -> None:
    contract.check_traces_once(ENV, PARAMS, PARAMS.replace(**CHANGES))


def test_trees_match() -> None:
    check_forms(ENV, PARAMS)


def test_observations_are_as_declared(rollout) -> None:
    contract.check_observations(ENV, PARAMS, rollout)
    assert ENV.observation_spec(PARAMS).shape == (84, 84, 4)


def test_same_key_same_trajectory(run, rollout) -> None:
    contract.check_same_key_same_trajectory(rollout, run(jax.random.key(0), PARAMS))


def test_different_keys_different_starts(rollout) -> None:
    contract.check_different_keys_different_starts(rollout, min_distinct=NUM_ENVS)


def test_final_observation_is_the_real_one(rollout) -> None:
    contract.check_final_observation(rollout)


def test_episodes_end(rollout) -> None:
    assert ENV.max_episode_steps(PARAMS) == 10
    contract.check_episodes_end(ENV, PARAMS, rollout)


def test_ends_are_never_merged(rollout) -> None:
    contract.check_flags_exclusive(rollout)


def test_rewards_are_paid_at_ends_only(rollout) -> None:
    """Nothing is higher than ten bounding spheres of the largest shape."""
    contract.check_rewards(rollout, low=0.0, high=15.0)
    np.testing.assert_array_equal(rollout.reward > 0.0, rollout.done)


def test_a_changed_limit_ends_episodes(run) -> None:
    params = PARAMS.replace(**CHANGES)
    changed = run(jax.random.key(1), params)
    contract.check_episodes_end(ENV, params, changed)
    assert (changed.info["episode_length"][changed.truncated] == 4).all()


def test_each_parameter_matters(run) -> None:
    contract.check_parameters_matter(run, PARAMS, CHANGES)


def test_invalid_actions_are_counted() -> None:
    contract.check_invalid_actions_counted(ENV, PARAMS)


def test_old_frames_are_zero_after_resets_and_then_move_up(rollout) -> None:
    """The stack of every first observation, and of those that follow."""
    first = np.concatenate([rollout.first_obs, rollout.obs[rollout.done]])
    assert not first[..., :-1].any()
    assert first[..., -1].any(axis=(1, 2)).all()
    before = np.concatenate([rollout.first_obs[None], rollout.obs[:-1]])
    np.testing.assert_array_equal(rollout.final_obs[..., :-1], before[..., 1:])
    assert (rollout.final_obs[..., -1] != before[..., -1]).any()


def test_info_adds_up(rollout) -> None:
    """Counts and the largest height accumulate within an episode and start anew after it."""
    assert set(ENV.episode_metrics) | {"invalid_action"} == set(rollout.info)
    length, placed, repeats = (np.zeros(NUM_ENVS, int) for _ in range(3))
    highest = rollout.state.max_height[0]
    for t, done in enumerate(rollout.done):
        info = {name: values[t] for name, values in rollout.info.items()}
        length += 1
        placed += ~rollout.action.stop[t] & (info["num_repeats"] == repeats)
        highest = np.maximum(highest, info["final_height"])
        np.testing.assert_array_equal(info["episode_length"], length)
        np.testing.assert_array_equal(info["num_placed"], placed)
        np.testing.assert_array_equal(info["max_height"], highest)
        np.testing.assert_array_equal(info["is_stopped"], rollout.action.stop[t])
        repeats = np.where(done, 0, info["num_repeats"])
        length[done], placed[done] = 0, 0
        if t + 1 < NUM_STEPS:
            # The new start's highest origin is that of a cylinder: its s above the table.
            fresh = rollout.state.bodies.qpos[t + 1][done, 0, 2] - scene.TABLE_HEIGHT
            highest = highest.copy()
            highest[done] = fresh
    assert not rollout.info["has_failed"].any()
    np.testing.assert_array_equal(rollout.terminated, rollout.info["is_stopped"])


@pytest.mark.parametrize("max_actions", [0, 11])
def test_limits_that_the_pool_of_bodies_cannot_hold(max_actions: int) -> None:
    with pytest.raises(ValueError, match=f"max_actions={max_actions} must be 1 to 10"):
        ENV.max_episode_steps(PARAMS.replace(max_actions=max_actions))
