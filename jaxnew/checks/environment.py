"""Whether an environment keeps the promises of its contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.checks.forms import (
    attempt,
    check_like,
    check_same_tree,
    compiled_quickly,
    shapes_of,
)
from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec
from jaxnew.host_checks import check_host_environment
from jaxnew.task.places import UsageError

_NUM_ENVS, _NUM_STEPS = 16, 64


def check_environment(env: Any, params: Any = None, *, has_fixed_start: bool = False) -> None:
    """Refuses an environment that breaks a promise of its contract.

    Trees, shapes and dtypes are compared, and some random episodes are played: numbers are finite
    and in their bounds, keys matter and are used once, ids that do not exist are told, episodes
    end.

    Args:
      env: an `Environment`, or one for the pool (`envs_host.protocol.HostEnvironment`).
      params: of an `Environment`; None for its default.
      has_fixed_start: every episode may begin in the same way.

    Raises:
      UsageError: it breaks one; the first that was found.
    """
    if not isinstance(env, Environment):
        try:
            check_host_environment(env, has_fixed_start)
        except ValueError as err:
            raise UsageError(str(err)) from err
        return
    params = env.default_params if params is None else params
    check_forms(env, params)
    check_played(env, params, has_fixed_start)


def check_forms(env: Environment, params: Any) -> None:
    """The part of `check_environment` that plays nothing: trees, shapes, dtypes and names.

    Raises:
      UsageError: as `check_environment`.
    """
    name, spec = type(env).__name__, _specs(env, params)
    key, action = jax.random.key(0), jax.eval_shape(lambda: _some_action(env, jax.random.key(0)))
    first = _parts(f"{name}.reset_env", 2, "observation, state", env.reset_env, key, params)
    check_like(f"{name}.reset_env: the observation", first[0], spec.shape, spec.dtype)
    _check_not_weak(f"{name}.reset_env", first)
    parts = "observation, state, reward, terminated, truncated, info"
    raw_info: Any = None
    for method in ("step_env", "step"):
        what = f"{name}.{method}"
        found = _parts(what, 6, parts, getattr(env, method), key, first[1], action, params)
        observation, state, reward, terminated, truncated, info = found
        check_like(f"{what}: the observation", observation, spec.shape, spec.dtype)
        check_same_tree(what, state, f"{name}.reset_env", first[1])
        check_like(f"{what}: the reward", reward, (), jnp.float32)
        check_like(f"{what}: terminated", terminated, (), jnp.bool_)
        check_like(f"{what}: truncated", truncated, (), jnp.bool_)
        if not isinstance(info, dict):
            raise UsageError(f"{what}: info is a {type(info).__name__}; it must be a dict.")
        for metric in env.episode_metrics:
            if metric not in info:
                raise UsageError(f"{what}: info lacks {metric!r}, which episode_metrics names.")
            check_like(f"{what}: info[{metric!r}]", info[metric], ())
        if "invalid_action" not in info:
            raise UsageError(
                f"{what}: info lacks 'invalid_action', bool[]: whether the id is none of the "
                "environment's."
            )
        check_like(f"{what}: info['invalid_action']", info["invalid_action"], (), jnp.bool_)
        raw_info = raw_info or info
    if "final_observation" not in info:
        raise UsageError(
            f"{name}.step: info lacks 'final_observation', what the step produced before the next "
            "episode began."
        )
    final = info["final_observation"]
    check_like(f"{name}.step: info['final_observation']", final, spec.shape, spec.dtype)
    changed = sorted(set(info) ^ {*raw_info, "final_observation"})
    if changed:
        raise UsageError(f"{name}.step and {name}.step_env: {changed} are in the info of one only.")


def _specs(env: Environment, params: Any) -> ObservationSpec:
    """What the environment says of itself, checked; returns that of its observations."""
    name = type(env).__name__
    for attribute, kind in (("name", str), ("episode_metrics", tuple), ("action_spec", ActionSpec)):
        found = attempt(f"{name}.{attribute}", lambda a=attribute: getattr(env, a))
        if not isinstance(found, kind):
            raise UsageError(f"{name}.{attribute} is {found!r}; it must be a {kind.__name__}.")
    spec = attempt(f"{name}.observation_spec", env.observation_spec, params)
    if not isinstance(spec, ObservationSpec):
        raise UsageError(f"{name}.observation_spec gives {spec!r}; it must be an ObservationSpec.")
    steps = attempt(f"{name}.max_episode_steps", env.max_episode_steps, params)
    if not isinstance(steps, int) or steps < 1:
        raise UsageError(f"{name}.max_episode_steps gives {steps!r}; it must be 1 or more, an int.")
    return spec


def _some_action(env: Environment, key: jax.Array) -> Action:
    """A random action that exists; it does not stop."""
    spec = env.action_spec
    key_id, key_position = jax.random.split(key)
    return Action(
        jax.random.randint(key_id, (), 0, spec.num_actions, jnp.int32),
        jax.random.uniform(key_position, (spec.position_dim,), jnp.float32, -1.0, 1.0),
        jnp.bool_(False),
    )


def check_played(env: Environment, params: Any, has_fixed_start: bool) -> None:
    """The part of `check_environment` that plays.

    Raises:
      UsageError: as `check_environment`.
    """
    name, spec = type(env).__name__, env.observation_spec(params)
    num_actions, limit = env.action_spec.num_actions, env.max_episode_steps(params)

    def reset(key: jax.Array) -> Any:
        obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, _NUM_ENVS), params)
        leaves = [jax.random.key_data(x) if _is_key(x) else x for x in jax.tree.leaves(state)]
        return obs, state, jnp.stack([jnp.all(x == x[:1]) for x in (obs, *leaves)]).all()

    def one(key: jax.Array, state: Any, edge: jax.Array) -> Any:
        key_action, key_env = jax.random.split(key)
        action = _some_action(env, key_action)
        action = replace(action, id=jnp.where(edge < -1, action.id, edge))
        obs, state, reward, terminated, truncated, info = env.step(key_env, state, action, params)
        final, is_invalid = info["final_observation"], info["invalid_action"]
        return obs, state, reward, terminated | truncated, final, is_invalid

    def step(key: jax.Array, state: Any, edges: jax.Array) -> Any:
        return jax.vmap(one)(jax.random.split(key, _NUM_ENVS), state, edges)

    # First ids at and beyond the ends of the list, then any; below -1 means any.
    edges = np.full(_NUM_ENVS, -2, np.int32)
    any_ids = jnp.asarray(edges)
    edges[:4] = -1, 0, num_actions - 1, num_actions
    key, *keys = jax.random.split(jax.random.key(0), 1 + min(limit, _NUM_STEPS))
    first, state, is_one = compiled_quickly(f"{name}.reset_env", reset)(key)
    stepped = compiled_quickly(f"{name}.step", step)
    check_values(f"{name}.reset_env: the observation", spec, np.asarray(first))
    has_ended = np.zeros(_NUM_ENVS, bool)
    for t, key in enumerate(keys):
        found = stepped(key, state, any_ids if t else jnp.asarray(edges))
        obs, state, reward, done, final, is_invalid = found
        obs, reward, done, final, flags = jax.device_get((obs, reward, done, final, is_invalid))
        check_values(f"{name}.step: the observation", spec, obs)
        check_values(f"{name}.step: info['final_observation']", spec, final)
        if not np.isfinite(reward).all():
            raise UsageError(f"{name}.step: a reward is {reward[~np.isfinite(reward)][0]}.")
        if t == 0 and flags[:4].tolist() != [True, False, False, True]:
            raise UsageError(
                f"{name}.step: info['invalid_action'] is {flags[:4].tolist()} for the ids "
                f"{edges[:4].tolist()} of {num_actions} actions; it must be true for the first "
                "and the last. JAX clamps indices without a word, so look at the id yourself."
            )
        if not np.array_equal(obs[~done], final[~done]):
            raise UsageError(
                f"{name}.step: info['final_observation'] is not the observation that is returned, "
                "where no episode ended."
            )
        has_ended |= done
    if not has_fixed_start and is_one:
        raise UsageError(
            f"{name}.reset_env: {_NUM_ENVS} keys gave one and the same start; draw it from the "
            "key, or say has_fixed_start=True."
        )
    if limit <= _NUM_STEPS and not has_ended.all():
        raise UsageError(
            f"{name}.step: an episode did not end within max_episode_steps, {limit}; truncate it."
        )


def check_values(what: str, spec: ObservationSpec, values: np.ndarray) -> None:
    """Refuses observations that are not finite, or beyond their bounds.

    Raises:
      UsageError: they are; it begins with `what`.
    """
    if not np.isfinite(np.asarray(values, np.float64)).all():
        raise UsageError(f"{what} is not finite; the environment must never give NaN or infinity.")
    low, high = values.min(), values.max()
    if low < spec.low or high > spec.high:
        raise UsageError(
            f"{what} has numbers from {low} to {high}; observation_spec says {spec.low} to "
            f"{spec.high}."
        )


def _parts(what: str, count: int, names: str, function: Callable[..., Any], *args: Any) -> Any:
    """Shapes of the parts of a tuple."""
    found = shapes_of(what, function, *args)
    if not isinstance(found, tuple) or len(found) != count:
        size = f"{len(found)} parts" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise UsageError(f"{what} gives {size}; it must give {count}: {names}.")
    return found


def _check_not_weak(what: str, tree: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if leaf.weak_type:
            raise UsageError(
                f"{what}: {jax.tree_util.keystr(path[1:]).lstrip('.') or 'the observation'} is a "
                f"Python number, whose dtype is weak; write jnp.{leaf.dtype}(...)."
            )


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
