"""Grid World keeps the promises of every environment, and those of its own documentation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld
from jaxnew.checks.environment import check_forms
from jaxnew.environment import Action, Environment
from tests import contract

pytestmark = pytest.mark.contract

ENV = GridWorld()
PARAMS = ENV.default_params
# Another legal value for each field.
CHANGES = {
    "max_moves": 20,
    "subgoal_reward": 0.25,
    "goal_reward": 2.0,
    "time_penalty": 0.5,
    "fixed_layout": 10,  # V4/4
}


def sample_towards_goal(key: jax.Array, env: Environment) -> Action:
    """Random skills of which four moves in five go right or down, so that some reach the goal."""
    key_direction, key_move = jax.random.split(key)
    is_away = jax.random.bernoulli(key_direction, 0.2, (5,))
    moves = jax.random.randint(key_move, (5,), 0, 2) + 2 * is_away
    return Action.of(jnp.sum(moves * 4 ** jnp.arange(5)))


@pytest.fixture(scope="module")
def run():
    return contract.rollout_function(ENV, 512, 40, sample_towards_goal)


@pytest.fixture(scope="module")
def rollout(run) -> contract.Rollout:
    return run(jax.random.key(0), PARAMS)


def test_one_trace_serves_every_key_id_and_parameter() -> None:
    contract.check_traces_once(ENV, PARAMS, PARAMS.replace(**CHANGES))


def test_trees_match() -> None:
    check_forms(ENV, PARAMS)


def test_observations_are_as_declared(rollout) -> None:
    contract.check_observations(ENV, PARAMS, rollout)
    assert set(np.unique(rollout.final_obs)) == {1, 2, 8, 9, 10, 11}


def test_only_walls_are_constant(rollout) -> None:
    contract.check_constant_elements(ENV, PARAMS, rollout)
    assert ENV.observation_spec(PARAMS).constant.sum() == 32


def test_same_key_same_trajectory(run, rollout) -> None:
    contract.check_same_key_same_trajectory(rollout, run(jax.random.key(0), PARAMS))


def test_different_keys_different_starts(rollout) -> None:
    # 512 draws, and thousands of restarts, miss one of 42 layouts with probability 2e-4.
    contract.check_different_keys_different_starts(rollout, min_distinct=42)


def test_final_observation_is_the_real_one(rollout) -> None:
    contract.check_final_observation(rollout)


def test_episodes_end(rollout) -> None:
    assert ENV.max_episode_steps(PARAMS) == 10
    assert ENV.max_episode_steps(PARAMS.replace(max_moves=51)) == 11
    contract.check_episodes_end(ENV, PARAMS, rollout)


def test_ends_are_never_merged(rollout) -> None:
    contract.check_flags_exclusive(rollout)


def test_rewards_stay_in_the_documented_range(rollout) -> None:
    contract.check_rewards(rollout, low=0.0, high=0.884)


def test_each_parameter_matters(run) -> None:
    contract.check_parameters_matter(run, PARAMS, CHANGES)


def test_parameters_enter_the_reward_as_documented() -> None:
    """V4/4, skills 21, 320, 1012: the goal on move 12 of 20."""
    params = PARAMS.replace(**CHANGES)
    _, state = ENV.reset(jax.random.key(0), params)
    step_env, rewards = jax.jit(ENV.step_env), []
    for skill in (21, 320, 1012):
        _, state, reward, *_ = step_env(jax.random.key(0), state, Action.of(skill), params)
        rewards.append(float(reward))
    # 2.0 - 0.5 * 12 / 20 = 1.7; float32.
    np.testing.assert_allclose(rewards, [0.0, 0.25, 1.7], atol=1e-6, rtol=0)


def test_fixed_layout_is_clipped() -> None:
    def layout(fixed_layout: int) -> int:
        state = ENV.reset(jax.random.key(0), PARAMS.replace(fixed_layout=fixed_layout))[1]
        return int(state.layout)

    assert [layout(i) for i in (0, 41, 42, 1000)] == [0, 41, 41, 41]
    assert layout(-5) == layout(-1)


def test_fixed_action_set() -> None:
    contract.check_fixed_action_set(ENV, PARAMS, np.array([21, 320, 1012, 5], np.int32))


def test_invalid_actions_take_five_moves_without_effect() -> None:
    contract.check_invalid_actions_counted(ENV, PARAMS)
    params = PARAMS.replace(max_moves=12)
    obs, state = ENV.reset(jax.random.key(3), params)
    step_env, moves = jax.jit(ENV.step_env), []
    for action_id, is_invalid in [(-1, True), (1024, True), (2048 + 21, True)]:
        next_obs, state, reward, terminated, truncated, info = step_env(
            jax.random.key(0), state, Action.of(action_id), params
        )
        assert np.array_equal(next_obs, obs)
        assert (float(reward), bool(terminated)) == (0.0, False)
        assert bool(info["invalid_action"]) is is_invalid
        moves.append((int(info["episode_length"]), bool(truncated)))
    assert moves == [(5, False), (10, False), (12, True)]


def test_info_adds_up(rollout) -> None:
    """Return and length accumulate within an episode and start anew after it."""
    total, length = np.zeros(512), np.zeros(512, int)
    for t, done in enumerate(rollout.done):
        total += rollout.reward[t]
        # Two rewards an episode at most, both float32 and below 1.
        np.testing.assert_allclose(rollout.info["episode_return"][t], total, atol=1e-6, rtol=0)
        moved = rollout.info["episode_length"][t] - length
        assert (moved[~done] == 5).all()
        assert ((moved >= 1) & (moved <= 5)).all()
        length += moved
        total[done], length[done] = 0.0, 0
    at_goal = rollout.final_obs[..., 70] == 10
    assert at_goal.any()
    assert np.array_equal(rollout.info["is_success"], at_goal)
    assert not rollout.info["invalid_action"].any()


def test_step_is_the_raw_step_with_a_reset_from_its_key() -> None:
    """The override saves an observation and nothing else."""
    num_envs = 256
    keys = jax.random.split(jax.random.key(5), num_envs)
    ids = jax.random.randint(jax.random.key(6), (num_envs,), 0, 1024)

    @jax.jit
    @jax.vmap
    def both(key: jax.Array, action_id: jax.Array) -> tuple:
        key_start, key = jax.random.split(key)
        _, state = ENV.reset(key_start, PARAMS)
        raw = ENV.step_env(key, state, Action.of(action_id), PARAMS)
        first = ENV.reset_env(jax.random.clone(key), PARAMS)
        return raw, first, ENV.step(key, state, Action.of(action_id), PARAMS)

    raw, first, stepped = jax.device_get(both(keys, ids))
    done = raw[3] | raw[4]
    assert 0 < done.sum() < num_envs
    expected = jax.tree.map(
        lambda new, old: np.where(done.reshape(-1, *[1] * (new.ndim - 1)), new, old), first, raw[:2]
    )
    jax.tree.map(np.testing.assert_array_equal, stepped[:2], expected)
    jax.tree.map(np.testing.assert_array_equal, stepped[2:5], raw[2:5])
    final_observation = stepped[5].pop("final_observation")
    np.testing.assert_array_equal(final_observation, raw[0])
    jax.tree.map(np.testing.assert_array_equal, stepped[5], raw[5])
