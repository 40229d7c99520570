"""The promises of every environment, as functions over any `Environment`.

A domain's contract test records one rollout and hands it to the `check_*` functions, so that a
whole list costs one or two compiles:

  rollout = contract.record_rollout(env, env.default_params, jax.random.key(0), 64, 40)
  contract.check_observations(env, env.default_params, rollout)
  contract.check_rewards(rollout, low=0.0, high=1.0)

Each check raises `AssertionError`, or the `UsageError` of `jaxnew.checks`, and says what broke.
Trees, shapes and dtypes are the business of `jaxnew.checks.environment.check_forms`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.checks.environment import check_values
from jaxnew.environment import Action, Environment, FixedActionSet

SampleAction = Callable[[jax.Array, Environment], Action]


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What `record_rollout` saw, as NumPy arrays.

    Attributes:
      first_obs: [N, ...] observations of the first reset.
      obs: [T, N, ...] returned observations (after an end: the next episode's first).
      final_obs: [T, N, ...] `info["final_observation"]`.
      raw_obs: [T, N, ...] what `step_env` says about the same state and action.
      reward: f32[T, N].
      terminated, truncated: bool[T, N].
      info: the other info entries, each [T, N, ...].
      action: the actions, leaves [T, N, ...].
      state: the states before each step, leaves [T, N, ...].
    """

    first_obs: np.ndarray
    obs: np.ndarray
    final_obs: np.ndarray
    raw_obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict[str, np.ndarray]
    action: Action
    state: Any

    @property
    def done(self) -> np.ndarray:
        return self.terminated | self.truncated


def sample_uniform(key: jax.Array, env: Environment) -> Action:
    """A uniform action; the stop bit, where there is one, is set one time in ten."""
    spec = env.action_spec
    key_id, key_position, key_stop = jax.random.split(key, 3)
    return Action(
        id=jax.random.randint(key_id, (), 0, spec.num_actions, jnp.int32),
        position=jax.random.uniform(key_position, (spec.position_dim,), minval=-1.0, maxval=1.0),
        stop=jax.random.bernoulli(key_stop, 0.1) & spec.has_stop,
    )


def rollout_function(
    env: Environment, num_envs: int, num_steps: int, sample_action: SampleAction = sample_uniform
) -> Callable[[jax.Array, Any], Rollout]:
    """A jitted `(key, params) -> Rollout`; call it again with other parameters at no compile."""

    @jax.jit
    def run(key: jax.Array, params: Any) -> dict[str, Any]:
        key_reset, key_scan = jax.random.split(key)
        first_obs, state = jax.vmap(env.reset, (0, None))(
            jax.random.split(key_reset, num_envs), params
        )

        def one(key: jax.Array, state: Any) -> tuple[Any, dict[str, Any]]:
            key_action, key_env = jax.random.split(key)
            action = sample_action(key_action, env)
            obs, next_state, reward, terminated, truncated, info = env.step(
                jax.random.clone(key_env), state, action, params
            )
            # The base class hands the first half of the same key to the raw step.
            raw_obs = env.step_env(jax.random.split(key_env)[0], state, action, params)[0]
            final_obs = info.pop("final_observation")
            record = {"obs": obs, "final_obs": final_obs, "raw_obs": raw_obs, "reward": reward}
            record |= {"terminated": terminated, "truncated": truncated, "info": info}
            return next_state, record | {"action": action, "state": state}

        def body(state: Any, key: jax.Array) -> tuple[Any, dict[str, Any]]:
            return jax.vmap(one)(jax.random.split(key, num_envs), state)

        _, record = jax.lax.scan(body, state, jax.random.split(key_scan, num_steps))
        return record | {"first_obs": first_obs}

    return lambda key, params: Rollout(**jax.tree.map(np.asarray, run(key, params)))


def record_rollout(
    env: Environment,
    params: Any,
    key: jax.Array,
    num_envs: int,
    num_steps: int,
    sample_action: SampleAction = sample_uniform,
) -> Rollout:
    """Plays `num_envs` auto-resetting environments for `num_steps` steps; consumes `key`."""
    return rollout_function(env, num_envs, num_steps, sample_action)(key, params)


def check_traces_once(env: Environment, params: Any, other_params: Any, num_envs: int = 3) -> None:
    """jit(vmap(.)) works, and new keys, ids and parameter values cause no second trace."""
    num_traces = {"reset": 0, "step": 0}

    def reset(key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        num_traces["reset"] += 1
        return jax.vmap(env.reset, (0, None))(jax.random.split(key, num_envs), params)

    def step(key: jax.Array, state: Any, params: Any) -> Any:
        num_traces["step"] += 1
        keys_action, keys_env = jax.random.split(key, (2, num_envs))
        action = jax.vmap(sample_uniform, (0, None))(keys_action, env)
        return jax.vmap(env.step, (0, 0, 0, None))(keys_env, state, action, params)

    jitted_reset, jitted_step = jax.jit(reset), jax.jit(step)
    for seed, episode_params in enumerate([params, params, other_params]):
        _, state = jitted_reset(jax.random.key(seed), episode_params)
        for t in range(3):
            _, state, *_ = jitted_step(jax.random.key(100 + t), state, episode_params)
    assert num_traces == {"reset": 1, "step": 1}, num_traces


def check_observations(env: Environment, params: Any, rollout: Rollout) -> None:
    """Every observation has the declared shape and dtype, is finite and within the bounds."""
    spec = env.observation_spec(params)
    for name in ("first_obs", "obs", "final_obs"):
        obs = getattr(rollout, name)
        assert obs.shape[-len(spec.shape) :] == spec.shape, (name, obs.shape, spec.shape)
        assert obs.dtype == np.dtype(spec.dtype), (name, obs.dtype, spec.dtype)
        check_values(name, spec, obs)


def check_constant_elements(env: Environment, params: Any, rollout: Rollout) -> None:
    """Exactly the declared elements are constant; final observations count."""
    spec = env.observation_spec(params)
    rank = len(spec.shape)
    seen = [
        obs.reshape(-1, *obs.shape[obs.ndim - rank :])
        for obs in (rollout.first_obs, rollout.obs, rollout.final_obs)
    ]
    every = np.concatenate(seen)
    is_constant = (every == every[:1]).all(axis=0)
    declared = np.zeros(spec.shape, bool) if spec.constant is None else spec.constant
    assert declared.shape == spec.shape, (declared.shape, spec.shape)
    unexpected = np.argwhere(is_constant & ~declared).tolist()
    assert not unexpected, f"Elements {unexpected} never changed and are not declared constant."
    changing = np.argwhere(~is_constant & declared).tolist()
    assert not changing, f"Elements {changing} are declared constant and changed."


def check_same_key_same_trajectory(one: Rollout, again: Rollout) -> None:
    """Two rollouts from the same key are bit for bit the same."""
    first, second = dataclasses.asdict(one), dataclasses.asdict(again)
    for (path, a), (_, b) in zip(
        *(jax.tree_util.tree_leaves_with_path(tree) for tree in (first, second)), strict=True
    ):
        assert np.array_equal(a, b, equal_nan=True), jax.tree_util.keystr(path)


def check_different_keys_different_starts(rollout: Rollout, min_distinct: int = 2) -> None:
    """The first observations differ between environments, and those after an auto-reset too."""
    num_envs = len(rollout.first_obs)
    distinct = len(np.unique(rollout.first_obs.reshape(num_envs, -1), axis=0))
    assert distinct >= min_distinct, f"{num_envs} resets gave {distinct} distinct starts."
    restarts = rollout.obs[rollout.done]
    assert len(restarts) >= min_distinct, f"Only {len(restarts)} episodes ended; play longer."
    distinct = len(np.unique(restarts.reshape(len(restarts), -1), axis=0))
    assert distinct >= min_distinct, f"{len(restarts)} auto-resets gave {distinct} starts."


def check_final_observation(rollout: Rollout) -> None:
    """`final_observation` is the raw step's, and at an end it is not the returned one."""
    assert rollout.done.any(), "No episode ended; play longer."
    is_raw = np.array_equal(rollout.final_obs, rollout.raw_obs)
    assert is_raw, "final_observation is not what the raw step observed."
    is_returned = np.array_equal(rollout.final_obs[~rollout.done], rollout.obs[~rollout.done])
    assert is_returned, "Where no episode ended, final_observation is not the returned one."
    at_end = rollout.final_obs[rollout.done], rollout.obs[rollout.done]
    is_same = (at_end[0] == at_end[1]).reshape(len(at_end[0]), -1).all(axis=1)
    assert not is_same.all(), "At every end the final observation equals the next episode's first."


def check_episodes_end(env: Environment, params: Any, rollout: Rollout) -> None:
    """No episode outlives `max_episode_steps`, which the rollout must be longer than."""
    limit = env.max_episode_steps(params)
    assert len(rollout.done) > limit, f"Play more than {limit} steps."
    running = np.zeros(rollout.done.shape[1], int)
    for done in rollout.done:
        running += 1
        assert running.max() <= limit, (
            f"An episode ran {running.max()} steps; the limit is {limit}."
        )
        running[done] = 0


def check_flags_exclusive(rollout: Rollout) -> None:
    """A natural end is never reported as a time limit too; both kinds were seen."""
    assert rollout.terminated.any(), "No episode terminated."
    assert rollout.truncated.any(), "No episode was truncated."
    both = (rollout.terminated & rollout.truncated).sum()
    assert both == 0, f"{both} ends are called both terminated and truncated."


def check_rewards(rollout: Rollout, low: float, high: float) -> None:
    """Rewards are finite, within [low, high] and not all the same."""
    assert np.isfinite(rollout.reward).all(), "A reward is not finite."
    lowest, highest = rollout.reward.min(), rollout.reward.max()
    assert lowest >= low, f"Lowest reward {lowest}, documented {low}."
    assert highest <= high, f"Highest reward {highest}, documented {high}."
    assert len(np.unique(rollout.reward)) > 1, "Every reward is the same."


def check_parameters_matter(
    run: Callable[[jax.Array, Any], Rollout], params: Any, changes: Mapping[str, Any]
) -> None:
    """Changing each field alone changes observations, rewards or ends of the same rollout.

    Args:
      run: from `rollout_function`, with actions that reach whatever the fields govern.
      params: the parameters that are changed.
      changes: a different legal value for every field.
    """
    fields = {field.name for field in dataclasses.fields(params)}
    assert set(changes) == fields, f"Say how to change each of {sorted(fields)}."
    visible = ("first_obs", "obs", "reward", "terminated", "truncated")
    base = run(jax.random.key(7), params)
    for name, value in changes.items():
        changed = run(jax.random.key(7), dataclasses.replace(params, **{name: value}))
        is_same = [np.array_equal(getattr(base, v), getattr(changed, v)) for v in visible]
        assert not all(is_same), f"{name}={value} changes nothing."


def check_invalid_actions_counted(env: Environment, params: Any) -> None:
    """Ids outside the universe set `info["invalid_action"]`; the ids at its edges do not."""
    last = env.action_spec.num_actions - 1
    ids = jnp.array([-1, 0, last, last + 1, 2**31 - 1, -(2**31)], jnp.int32)

    @jax.jit
    @jax.vmap
    def first_step(key: jax.Array, action_id: jax.Array) -> Any:
        key_action, key_reset, key_env = jax.random.split(key, 3)
        action = sample_uniform(key_action, env).replace(id=action_id)
        _, state = env.reset(key_reset, params)
        return env.step(key_env, state, action, params)

    obs, _, reward, *_, info = first_step(jax.random.split(jax.random.key(0), len(ids)), ids)
    flags = info["invalid_action"].tolist()
    expected = [True, False, False, True, True, True]
    assert flags == expected, f"invalid_action of ids {ids.tolist()} is {flags}."
    assert np.isfinite(np.asarray(obs, np.float64)).all(), "An observation is not finite."
    assert np.isfinite(reward).all(), "A reward is not finite."


def check_fixed_action_set(env: Environment, params: Any, ids: np.ndarray) -> None:
    """`FixedActionSet` plays `ids` by index, describes its spaces and refuses bad lists."""
    fixed = FixedActionSet(env, ids)
    space, obs_space = fixed.action_space(params), fixed.observation_space(params)
    assert (fixed.num_actions, space.n, space.shape) == (len(ids), len(ids), ())
    assert fixed.name == env.name
    assert obs_space.shape == env.observation_spec(params).shape
    key_reset, key_sample, key = jax.random.split(jax.random.key(0), 3)
    obs, state = fixed.reset(key_reset, params)
    assert bool(obs_space.contains(obs))
    assert bool(space.contains(space.sample(key_sample)))
    fixed_step, step = jax.jit(fixed.step), jax.jit(env.step)
    for index in (0, len(ids) - 1):
        by_index = fixed_step(jax.random.clone(key), state, jnp.int32(index), params)
        by_id = step(jax.random.clone(key), state, Action.of(int(ids[index])), params)
        for a, b in zip(jax.tree.leaves(by_index), jax.tree.leaves(by_id), strict=True):
            assert np.array_equal(a, b), f"Index {index} did not do what id {ids[index]} does."
    for index in (-1, len(ids)):
        info = fixed_step(jax.random.clone(key), state, jnp.int32(index), params)[-1]
        assert bool(info["invalid_action"]), f"Index {index} was accepted."
    for bad in ([], [-1], [env.action_spec.num_actions], [[0, 1]]):
        try:
            FixedActionSet(env, np.array(bad))
        except ValueError:
            continue
        raise AssertionError(f"FixedActionSet accepted {bad}.")
