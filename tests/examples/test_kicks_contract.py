"""The environment of the example keeps the promises of every environment, and its own."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from examples.kicks import Kicks, KicksState, kick_universe
from jaxnew.checks.environment import check_forms
from jaxnew.environment import Action
from tests import contract

pytestmark = pytest.mark.contract

ENV = Kicks()
PARAMS = ENV.default_params
CHANGES = {
    "max_kicks": 3,
    "goal_radius": 0.3,
    "goal_reward": 2.0,
    "progress_reward": 0.0,
}
NUM_ENVS, NUM_STEPS = 256, 40


@pytest.fixture(autouse=True, scope="module")
def compile_quickly():
    """Compiling takes most of the time here, and no promise depends on how well it is done."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


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
    contract.check_constant_elements(ENV, PARAMS, rollout)


def test_keys(run, rollout) -> None:
    contract.check_same_key_same_trajectory(rollout, run(jax.random.key(0), PARAMS))
    contract.check_different_keys_different_starts(rollout, min_distinct=NUM_ENVS)


def test_ends(rollout) -> None:
    contract.check_final_observation(rollout)
    contract.check_episodes_end(ENV, PARAMS, rollout)
    contract.check_flags_exclusive(rollout)
    assert (rollout.info["episode_length"][rollout.truncated] == 8).all()


def test_rewards_stay_in_the_documented_range(rollout) -> None:
    contract.check_rewards(rollout, low=-0.7, high=1.7)


def test_each_parameter_matters(run) -> None:
    contract.check_parameters_matter(run, PARAMS, CHANGES)


def test_fixed_action_set() -> None:
    contract.check_fixed_action_set(ENV, PARAMS, np.array([299, 0, 7], np.int32))


def test_invalid_actions_are_counted_and_move_nothing() -> None:
    contract.check_invalid_actions_counted(ENV, PARAMS)
    obs, state = ENV.reset_env(jax.random.key(1), PARAMS)
    next_obs, next_state, reward, *_, info = ENV.step_env(
        jax.random.key(2), state, Action.of(300), PARAMS
    )
    assert np.array_equal(next_obs, obs)
    assert (int(next_state.num_kicks), float(reward), bool(info["invalid_action"])) == (1, 0, True)


def test_a_fall_on_the_way_is_no_success() -> None:
    """A curve that leaves the table on the right by half of `bulge` and comes back to the goal."""
    x = kick_universe().content[:, :, 0]
    bulge = x.max(axis=1) - x[:, -1]
    kick = int(bulge.argmax())
    assert bulge[kick] > 0.1
    puck = jnp.array([1.0 + bulge[kick] / 2 - x[kick].max(), 0.0])
    goal = puck + kick_universe().content[kick, -1]
    assert goal[0] < 1.0
    state = KicksState(puck, goal, jnp.int32(0))
    _, _, reward, terminated, _, info = ENV.step_env(
        jax.random.key(0), state, Action.of(kick), PARAMS
    )
    assert not info["is_success"]
    assert info["is_off_table"]
    assert terminated
    assert reward == 0.0


@pytest.mark.oracle
def test_kicks_by_hand(rollout) -> None:
    """Every step of the rollout again, one at a time, in float64."""
    paths = kick_universe().content.astype(np.float64)
    actions, state = rollout.action.id.ravel(), rollout.state
    pucks, goals = state.puck.reshape(-1, 2), state.goal.reshape(-1, 2)
    numbers = state.num_kicks.ravel() + 1
    got = zip(
        rollout.final_obs.reshape(-1, 4),
        rollout.reward.ravel(),
        rollout.terminated.ravel(),
        rollout.truncated.ravel(),
        rollout.info["is_success"].ravel(),
        rollout.info["is_off_table"].ravel(),
        strict=True,
    )
    seen = set()
    for action, puck, goal, number, values in zip(actions, pucks, goals, numbers, got, strict=True):
        xs, ys = (puck + paths[action]).T
        is_off = max(*xs, *ys) > 1.0 or min(*xs, *ys) < -1.0
        left = np.hypot(goal[0] - xs[-1], goal[1] - ys[-1])
        is_success = left <= 0.1 and not is_off
        reward = 0.0 if is_off else np.hypot(*(goal - puck)) - left + (1.0 if is_success else 0.0)
        ends = (is_off or is_success, number == 8 and not (is_off or is_success))
        obs = (xs[-1], ys[-1], goal[0] - xs[-1], goal[1] - ys[-1])
        # A few float32 roundings of numbers of order one.
        np.testing.assert_allclose(values[0], obs, atol=1e-6)
        np.testing.assert_allclose(values[1], reward, atol=1e-6)
        assert tuple(map(bool, values[2:])) == (*ends, is_success, is_off)
        seen.add((*ends, is_success))
    assert seen == {(False,) * 3, (True, False, True), (True, False, False), (False, True, False)}
