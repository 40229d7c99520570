"""The Recommender keeps the promises of every environment, and those of its own documentation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.recommender import Recommender, environment, product_constants, product_vectors
from envs_mjx.recommender.environment import BANDIT, STOP
from jaxnew.checks.environment import check_forms
from jaxnew.environment import Action
from tests import contract

pytestmark = pytest.mark.contract

ENV = Recommender()
PARAMS = ENV.default_params
# Another legal value for each field: the products in reverse, so that each becomes another one.
CHANGES = {
    "product_vectors": PARAMS.product_vectors[::-1],
    "product_constants": PARAMS.product_constants[::-1],
    "max_recommendations": jnp.int32(20),
}
NUM_ENVS, NUM_STEPS = 256, 120


@pytest.fixture(autouse=True, scope="module")
def compile_quickly():
    """Compiling takes most of the time here, and no promise depends on how well it is done."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def simple_drift(monkeypatch: pytest.MonkeyPatch) -> Recommender:
    """An environment whose drift compiles in no time: what an id means does not depend on it."""

    def drift(key: jax.Array, omega: jax.Array, num_ticks: jax.Array) -> jax.Array:
        return omega + num_ticks * jax.random.normal(key, omega.shape)

    monkeypatch.setattr(environment, "_drift", drift)
    return Recommender()  # A new one, whose methods `jit` has not seen.


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
    assert ENV.observation_spec(PARAMS).shape == (16,)


def test_no_element_is_constant(rollout) -> None:
    contract.check_constant_elements(ENV, PARAMS, rollout)
    assert not ENV.observation_spec(PARAMS).constant.any()


def test_same_key_same_trajectory(run, rollout) -> None:
    contract.check_same_key_same_trajectory(rollout, run(jax.random.key(0), PARAMS))


def test_different_keys_different_starts(rollout) -> None:
    contract.check_different_keys_different_starts(rollout, min_distinct=NUM_ENVS)


def test_final_observation_is_the_real_one(rollout) -> None:
    contract.check_final_observation(rollout)


def test_episodes_end(rollout) -> None:
    assert ENV.max_episode_steps(PARAMS) == 100
    assert ENV.max_episode_steps(PARAMS.replace(**CHANGES)) == 20
    contract.check_episodes_end(ENV, PARAMS, rollout)


def test_a_changed_limit_ends_episodes(run) -> None:
    params = PARAMS.replace(max_recommendations=jnp.int32(20))
    changed = run(jax.random.key(1), params)
    contract.check_episodes_end(ENV, params, changed)
    assert (changed.info["episode_length"][changed.truncated] == 20).all()


def test_ends_are_never_merged(rollout) -> None:
    contract.check_flags_exclusive(rollout)


def test_rewards_stay_in_the_documented_range(rollout) -> None:
    contract.check_rewards(rollout, low=0.0, high=1.0)
    assert set(np.unique(rollout.reward)) == {0.0, 1.0}


def test_each_parameter_matters(run) -> None:
    contract.check_parameters_matter(run, PARAMS, CHANGES)


def test_default_products_are_the_published_ones() -> None:
    assert ENV.action_spec == type(ENV.action_spec)(num_actions=10_000)
    np.testing.assert_array_equal(PARAMS.product_vectors, product_vectors())
    np.testing.assert_array_equal(PARAMS.product_constants, product_constants())


def test_fixed_action_set(simple_drift) -> None:
    contract.check_fixed_action_set(simple_drift, PARAMS, np.array([6226, 0, 9999], np.int32))


def test_invalid_actions_are_counted(simple_drift) -> None:
    contract.check_invalid_actions_counted(simple_drift, PARAMS)


def test_invalid_ids_are_never_clicked(simple_drift, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where every product is clicked, those that do not exist still are not; time goes on."""
    monkeypatch.setattr(environment, "click_probability", jnp.ones_like)
    obs, state = simple_drift.reset_env(jax.random.key(3), PARAMS)
    for action_id, is_invalid in [
        (-1, True),
        (0, False),
        (9999, False),
        (10_000, True),
        (2**31 - 1, True),
        (-(2**31), True),
    ]:
        next_obs, next_state, reward, *_, info = simple_drift.step_env(
            jax.random.key(4), state, Action.of(action_id), PARAMS
        )
        assert bool(info["invalid_action"]) is is_invalid
        assert float(reward) == int(next_state.num_clicks) == int(not is_invalid)
        assert int(info["num_clicks"]) == float(info["click_through_rate"]) == float(reward)
        assert int(info["episode_length"]) == int(next_state.num_recommendations) == 1
        assert not np.array_equal(next_obs, obs)


def test_info_adds_up(rollout) -> None:
    """Clicks and length accumulate within an episode and start anew after it."""
    assert set(ENV.episode_metrics) | {"invalid_action"} == set(rollout.info)
    clicks, length = np.zeros(NUM_ENVS, int), np.zeros(NUM_ENVS, int)
    for t, done in enumerate(rollout.done):
        np.testing.assert_array_equal(rollout.state.num_recommendations[t], length)
        np.testing.assert_array_equal(rollout.state.num_clicks[t], clicks)
        clicks += rollout.reward[t] == 1
        length += 1
        np.testing.assert_array_equal(rollout.info["num_clicks"][t], clicks)
        np.testing.assert_array_equal(rollout.info["episode_length"][t], length)
        # One float32 division of a number of at most 1.
        rate = rollout.info["click_through_rate"][t]
        np.testing.assert_allclose(rate, clicks / length, atol=1e-7, rtol=0)
        clicks[done], length[done] = 0, 0
    assert not rollout.info["invalid_action"].any()


def test_modes_between_steps(rollout) -> None:
    """Nobody is left browsing, and those who have left are met at an episode's start only."""
    is_first = rollout.state.num_recommendations == 0
    assert set(np.unique(rollout.state.mode[is_first])) == {BANDIT, STOP}
    assert set(np.unique(rollout.state.mode[~is_first])) == {BANDIT}
    has_left = rollout.state.mode == STOP
    np.testing.assert_array_equal(rollout.terminated[has_left & (rollout.reward == 0)], True)
