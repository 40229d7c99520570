"""The auto-reset of the base class, on an environment that ends as it is told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from jaxnew.checks.environment import check_forms
from jaxnew.environment import (
    Action,
    ActionSpec,
    Environment,
    FixedActionSet,
    ObservationSpec,
    Transition,
)
from jaxnew.task.places import UsageError
from tests import contract

pytestmark = pytest.mark.contract


@struct.dataclass
class EndsState:
    """count int32[] steps so far; noise f32[] drawn at the reset."""

    count: jax.Array
    noise: jax.Array


@struct.dataclass
class EndsParams:
    """scale f32[] multiplies the noise in the observation."""

    scale: float | jax.Array = 1.0


class Ends(Environment[EndsState, EndsParams]):
    """Bit 0 of the id terminates, bit 1 truncates; observation: (steps so far, noise)."""

    name = "Ends-v0"

    @property
    def default_params(self) -> EndsParams:
        return EndsParams()

    @property
    def action_spec(self) -> ActionSpec:
        return ActionSpec(num_actions=4, position_dim=self.position_dim)

    position_dim = 0

    def observation_spec(self, params: EndsParams) -> ObservationSpec:
        return ObservationSpec((2,), jnp.float32, 0.0, 100.0)

    def max_episode_steps(self, params: EndsParams) -> int:
        return 100

    def reset_env(self, key: jax.Array, params: EndsParams) -> tuple[jax.Array, EndsState]:
        state = EndsState(jnp.int32(0), jax.random.uniform(key))
        return self._observe(state, params), state

    def step_env(
        self, key: jax.Array, state: EndsState, action: Action, params: EndsParams
    ) -> Transition:
        state = state.replace(count=state.count + 1)
        info: dict[str, Any] = {"invalid_action": (action.id < 0) | (action.id > 3)}
        ends = (action.id & 1) > 0, (action.id & 2) > 0
        reward = state.count.astype(jnp.float32)
        return self._observe(state, params), state, reward, *ends, info

    def _observe(self, state: EndsState, params: EndsParams) -> jax.Array:
        return jnp.stack([state.count.astype(jnp.float32), params.scale * state.noise])


@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_all_four_flag_combinations(terminated: bool, truncated: bool) -> None:
    env, params = Ends(), EndsParams()
    first_obs, state = env.reset(jax.random.key(0), params)
    action = Action.of(int(terminated) + 2 * int(truncated))
    obs, state, reward, *flags, info = env.step(jax.random.key(1), state, action, params)
    assert [bool(flag) for flag in flags] == [terminated, truncated]
    assert float(reward) == 1.0
    assert info["final_observation"].tolist() == [1.0, float(first_obs[1])]
    if terminated or truncated:
        expected_obs, expected_state = env.reset_env(jax.random.split(jax.random.key(1))[1], params)
        assert np.array_equal(obs, expected_obs)
        assert obs[0] == 0
        assert obs[1] != first_obs[1]
        assert state.count == expected_state.count
        assert state.noise == expected_state.noise
    else:
        assert np.array_equal(obs, info["final_observation"])
        assert state.count == 1


@pytest.fixture(scope="module")
def run():
    return contract.rollout_function(Ends(), 8, 12)


@pytest.fixture(scope="module")
def rollout(run) -> contract.Rollout:
    return run(jax.random.key(0), EndsParams())


def test_checks_pass_on_a_sound_environment(run, rollout) -> None:
    env, params = Ends(), EndsParams()
    contract.check_traces_once(env, params, EndsParams(scale=2.0))
    check_forms(env, params)
    contract.check_observations(env, params, rollout)
    contract.check_constant_elements(env, params, rollout)
    contract.check_same_key_same_trajectory(rollout, run(jax.random.key(0), params))
    contract.check_different_keys_different_starts(rollout, min_distinct=8)
    contract.check_final_observation(rollout)
    contract.check_rewards(rollout, 1.0, 12.0)
    contract.check_parameters_matter(run, params, {"scale": 2.0})
    contract.check_invalid_actions_counted(env, params)
    contract.check_fixed_action_set(env, params, np.array([3, 1]))


class Careless(Ends):
    """Carries a weakly typed number, accepts every id, understates its observations and limit."""

    def reset_env(self, key: jax.Array, params: EndsParams) -> tuple[jax.Array, EndsState]:
        obs, state = super().reset_env(key, params)
        return obs, state.replace(count=jnp.asarray(0))

    def step_env(self, *args: Any) -> Transition:
        *transition, _ = super().step_env(*args)
        return *transition, {"invalid_action": jnp.bool_(False)}

    def observation_spec(self, params: EndsParams) -> ObservationSpec:
        return ObservationSpec((2,), jnp.float32, 0.0, 0.5, np.array([False, True]))

    def max_episode_steps(self, params: EndsParams) -> int:
        return 2


def test_checks_fail_on_a_careless_environment(rollout) -> None:
    env, params = Careless(), EndsParams()
    for broken, message in [
        (lambda: check_forms(env, params), "count is a Python number"),
        (lambda: contract.check_invalid_actions_counted(env, params), "invalid_action of"),
        (lambda: contract.check_observations(env, params, rollout), "says 0.0 to 0.5"),
        (lambda: contract.check_constant_elements(env, params, rollout), "and changed"),
        (lambda: contract.check_episodes_end(env, params, rollout), "limit is 2"),
        (lambda: contract.check_flags_exclusive(rollout), "both terminated and truncated"),
    ]:
        with pytest.raises((AssertionError, UsageError), match=message):
            broken()


def test_checks_fail_on_doctored_rollouts(rollout) -> None:
    env, params = Ends(), EndsParams()
    one_start = replace(rollout, first_obs=0 * rollout.first_obs)
    one_restart = replace(rollout, obs=0 * rollout.obs)
    no_final = replace(rollout, final_obs=rollout.obs)
    still = replace(one_start, obs=0 * rollout.obs, final_obs=0 * rollout.obs)
    shifted = replace(rollout, obs=rollout.obs + 1)
    not_finite = replace(rollout, reward=rollout.reward * np.nan)

    def ignores_params(key: jax.Array, params: EndsParams) -> contract.Rollout:
        return rollout

    for broken, message in [
        (lambda: contract.check_different_keys_different_starts(one_start), "8 resets gave 1"),
        (lambda: contract.check_different_keys_different_starts(one_restart), "auto-resets gave 1"),
        (lambda: contract.check_final_observation(no_final), "raw step"),
        (lambda: contract.check_final_observation(shifted), "not the returned one"),
        (lambda: contract.check_constant_elements(env, params, still), "never changed"),
        (lambda: contract.check_same_key_same_trajectory(rollout, no_final), "final_obs"),
        (lambda: contract.check_rewards(rollout, 0.0, 1.0), "Highest reward"),
        (lambda: contract.check_rewards(rollout, 2.0, 12.0), "Lowest reward"),
        (lambda: contract.check_rewards(not_finite, 0.0, 12.0), "not finite"),
        (
            lambda: contract.check_parameters_matter(ignores_params, params, {"scale": 2.0}),
            "changes nothing",
        ),
        (lambda: contract.check_parameters_matter(ignores_params, params, {}), "Say how"),
    ]:
        with pytest.raises(AssertionError, match=message):
            broken()


def test_a_second_trace_is_noticed() -> None:
    """Parameters of another dtype are the usual cause."""
    env = Ends()
    with pytest.raises(AssertionError, match="step"):
        contract.check_traces_once(env, EndsParams(scale=1.0), EndsParams(scale=jnp.ones(1)[0]))


def test_fixed_action_set_refuses_actions_with_a_position() -> None:
    env = Ends()
    env.position_dim = 2
    with pytest.raises(ValueError, match="not one integer"):
        FixedActionSet(env, np.array([0]))
