"""The Recommender keeps the promises of style 34, and those of its own documentation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.recommender import Recommender, environment, product_constants, product_vectors
from envs_mjx.recommender.environment import BANDIT, STOP
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


@pytest.fixture(scope="module")
def run():
    return contract.rollout_function(ENV, NUM_ENVS, NUM_STEPS)


@pytest.fixture(scope="module")
def rollout(run) -> contract.Rollout:
    return run(jax.random.key(0), PARAMS)


def test_one_trace_serves_every_key_id_and_parameter() -> None:
    contract.check_traces_once(ENV, PARAMS, PARAMS.replace(**CHANGES))


def test_trees_match() -> None:
    contract.check_trees_match(ENV, PARAMS)


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


def test_products_enter_by_their_row(run, rollout) -> None:
    """With vectors and constants both reversed and ids too, every user sees the same products."""

    def sample_reversed(key: jax.Array, env: Recommender) -> Action:
        action = contract.sample_uniform(key, env)
        return action.replace(id=env.action_spec.num_actions - 1 - action.id)

    params = PARAMS.replace(**CHANGES).replace(max_recommendations=PARAMS.max_recommendations)
    reverse = contract.record_rollout(
        ENV, params, jax.random.key(0), NUM_ENVS, NUM_STEPS, sample_reversed
    )
    np.testing.assert_array_equal(reverse.action.id, 9999 - rollout.action.id)
    np.testing.assert_array_equal(reverse.reward, rollout.reward)
    np.testing.assert_array_equal(reverse.terminated, rollout.terminated)
    # Unit vectors; a dozen roundings of float32 may differ between two programs.
    np.testing.assert_allclose(reverse.obs, rollout.obs, atol=1e-6, rtol=0)


def test_default_products_are_the_published_ones() -> None:
    assert ENV.action_spec == type(ENV.action_spec)(num_actions=10_000)
    np.testing.assert_array_equal(PARAMS.product_vectors, product_vectors())
    np.testing.assert_array_equal(PARAMS.product_constants, product_constants())


def test_fixed_action_set() -> None:
    contract.check_fixed_action_set(ENV, PARAMS, np.array([6226, 0, 9999, 17], np.int32))


def test_invalid_actions_are_counted() -> None:
    contract.check_invalid_actions_counted(ENV, PARAMS)


def test_invalid_ids_are_never_clicked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where every product is clicked, those that do not exist still are not; time goes on."""
    monkeypatch.setattr(environment, "click_probability", jnp.ones_like)
    obs, state = ENV.reset_env(jax.random.key(3), PARAMS)
    for action_id, is_invalid in [
        (-1, True),
        (0, False),
        (9999, False),
        (10_000, True),
        (2**31 - 1, True),
        (-(2**31), True),
    ]:
        # Not jitted: `jit` could hand back a trace from before the patch.
        next_obs, next_state, reward, *_, info = ENV.step_env(
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
