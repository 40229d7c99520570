"""Whether a user's environment or policy is what the rest relies on; each mistake in one sentence.

    jaxnew.check_environment(MyEnvironment())
    jaxnew.check_method(MyMethod(jaxnew.MethodContext()))

`train` and `sweep` run them before they compile; of what an installed package brings, the forms.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec
from jaxnew.host_checks import check_host_environment
from jaxnew.policy.method import PolicyMethod, distribution_and_value
from jaxnew.rollout.contract import Rollout
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import AvailableSet
from jaxnew.task.domain import is_installed
from jaxnew.task.methods import MEMBERS
from jaxnew.task.places import UsageError
from jaxnew.task.task import Task

_NUM_ENVS, _NUM_STEPS = 16, 64
# Of a policy: states, actions in a set, and how many of them are no padding.
_NUM_STATES, _SET_SIZE, _NUM_REAL = 32, 8, 5
_NUM_DRAWS = 4096
# Classes of what was tried out.
_SOUND: weakref.WeakSet[type] = weakref.WeakSet()
_QUICK = {"xla_backend_optimization_level": 0}  # Compiling takes longer than what it compiles.


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
    _check_played(env, params, has_fixed_start)


def check_forms(env: Environment, params: Any) -> None:
    """The part of `check_environment` that plays nothing: trees, shapes, dtypes and names.

    Raises:
      UsageError: as `check_environment`.
    """
    name, spec = type(env).__name__, _specs(env, params)
    key, action = jax.random.key(0), jax.eval_shape(lambda: _some_action(env, jax.random.key(0)))
    first = _parts(f"{name}.reset_env", 2, "observation, state", env.reset_env, key, params)
    _check_like(f"{name}.reset_env: the observation", first[0], spec.shape, spec.dtype)
    _check_not_weak(f"{name}.reset_env", first)
    parts = "observation, state, reward, terminated, truncated, info"
    raw_info: Any = None
    for method in ("step_env", "step"):
        what = f"{name}.{method}"
        found = _parts(what, 6, parts, getattr(env, method), key, first[1], action, params)
        observation, state, reward, terminated, truncated, info = found
        _check_like(f"{what}: the observation", observation, spec.shape, spec.dtype)
        _check_same_tree(what, state, f"{name}.reset_env", first[1])
        _check_like(f"{what}: the reward", reward, (), jnp.float32)
        _check_like(f"{what}: terminated", terminated, (), jnp.bool_)
        _check_like(f"{what}: truncated", truncated, (), jnp.bool_)
        if not isinstance(info, dict):
            raise UsageError(f"{what}: info is a {type(info).__name__}; it must be a dict.")
        for metric in env.episode_metrics:
            if metric not in info:
                raise UsageError(f"{what}: info lacks {metric!r}, which episode_metrics names.")
            _check_like(f"{what}: info[{metric!r}]", info[metric], ())
        if "invalid_action" not in info:
            raise UsageError(
                f"{what}: info lacks 'invalid_action', bool[]: whether the id is none of the "
                "environment's."
            )
        _check_like(f"{what}: info['invalid_action']", info["invalid_action"], (), jnp.bool_)
        raw_info = raw_info or info
    if "final_observation" not in info:
        raise UsageError(
            f"{name}.step: info lacks 'final_observation', what the step produced before the next "
            "episode began."
        )
    final = info["final_observation"]
    _check_like(f"{name}.step: info['final_observation']", final, spec.shape, spec.dtype)
    changed = sorted(set(info) ^ {*raw_info, "final_observation"})
    if changed:
        raise UsageError(f"{name}.step and {name}.step_env: {changed} are in the info of one only.")


def _specs(env: Environment, params: Any) -> ObservationSpec:
    """What the environment says of itself, checked; returns that of its observations."""
    name = type(env).__name__
    for attribute, kind in (("name", str), ("episode_metrics", tuple), ("action_spec", ActionSpec)):
        found = _attempt(f"{name}.{attribute}", lambda a=attribute: getattr(env, a))
        if not isinstance(found, kind):
            raise UsageError(f"{name}.{attribute} is {found!r}; it must be a {kind.__name__}.")
    spec = _attempt(f"{name}.observation_spec", env.observation_spec, params)
    if not isinstance(spec, ObservationSpec):
        raise UsageError(f"{name}.observation_spec gives {spec!r}; it must be an ObservationSpec.")
    steps = _attempt(f"{name}.max_episode_steps", env.max_episode_steps, params)
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


def _check_played(env: Environment, params: Any, has_fixed_start: bool) -> None:
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
    first, state, is_one = _quick(f"{name}.reset_env", reset)(key)
    stepped = _quick(f"{name}.step", step)
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


def check_run(task: Task, rollout: Rollout, method: str, table: np.ndarray) -> None:
    """What `train` and `sweep` ask of the parts of a run before they compile.

    Of every environment inside jit its forms. Environments and policies that no installed package
    brings are tried out, too, once in a process.

    Args:
      task, rollout: of the run.
      method: its name.
      table: f32[A, d] representations.

    Raises:
      UsageError: one of them breaks a promise.
    """
    if isinstance(rollout, DeviceRollout):
        env, params = rollout.env, rollout.env_params
        check_forms(env, params)
        if not is_installed(task) and type(env) not in _SOUND:
            _check_played(env, params, has_fixed_start=True)
            _SOUND.add(type(env))
    own = rollout.method
    if ":" in method and type(own) not in _SOUND:
        spec, observation = task.action_spec, rollout.observation
        check_method(own, observation=observation, action_spec=spec, table=table)
        _SOUND.add(type(own))


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


def check_method(
    method: PolicyMethod,
    *,
    observation: jax.ShapeDtypeStruct | None = None,
    action_spec: ActionSpec | None = None,
    table: np.ndarray | None = None,
) -> None:
    """Refuses a policy that breaks a promise which learner, rollout and evaluation rely on.

    On random parameters, states and sets: shapes and dtypes, actions of the set only, the same
    whatever the order of the set and whatever stands in its padding, log-probabilities that are
    those of the samples. The last, and probabilities in any order, are seen where a sample is a
    place in the set; else the greedy actions are compared.

    Args:
      method: as its maker makes it.
      observation: of one state; None: f32[6].
      action_spec: of the domain; None: ids alone.
      table: f32[A, d] representations of at least 8 actions; None: random ones of 24.

    Raises:
      UsageError: it breaks one; the first that was found.
    """
    name = type(method).__name__
    lacking = [member for member in MEMBERS if not hasattr(method, member)]
    if lacking:
        raise UsageError(f"{name} lacks {', '.join(lacking)}; see jaxnew.PolicyMethod.")
    inputs = _Inputs(observation or jax.ShapeDtypeStruct((6,), jnp.float32), table)
    one = jnp.zeros(inputs.obs.shape[1:], inputs.obs.dtype)
    size = inputs.table.shape[1]
    shapes = _eval(f"{name}.init", lambda key: method.init(key, one, size), jax.random.key(0))
    _check_method_forms(method, shapes, inputs, action_spec or ActionSpec(len(inputs.table)))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: _noise(rng, x), shapes)
    try:
        _check_looks(name, _looks(method, params, inputs), inputs)
    except UsageError:  # It may be that not all numbers make sense; those of `init` take longer.
        fresh = _quick(f"{name}.init", lambda key: method.init(key, one, size))(jax.random.key(0))
        params = jax.tree.map(jnp.add, fresh, params)
        _check_looks(name, _looks(method, params, inputs), inputs)


class _Inputs:
    """What a policy is asked: states [B, ...], a table [A, d], sets [B, m] with padding."""

    def __init__(self, observation: jax.ShapeDtypeStruct, table: np.ndarray | None) -> None:
        rng = np.random.default_rng(0)
        shape = (_NUM_STATES, *observation.shape)
        is_real = np.issubdtype(observation.dtype, np.floating)
        drawn = rng.normal(size=shape) if is_real else rng.integers(0, 256, shape)
        self.obs = drawn.astype(observation.dtype)
        self.table = rng.normal(size=(24, 8)).astype(np.float32) if table is None else table
        rows = [rng.permutation(len(self.table))[:_SET_SIZE] for _ in range(_NUM_STATES)]
        self.mask = np.broadcast_to(np.arange(_SET_SIZE) < _NUM_REAL, (_NUM_STATES, _SET_SIZE))
        self.ids = np.array(rows, np.int32)
        self.order = rng.permutation(_SET_SIZE)
        others = rng.integers(0, len(self.table), self.ids.shape).astype(np.int32)
        self.repadded_ids = np.where(self.mask, self.ids, others)


def _noise(rng: np.random.Generator, like: jax.ShapeDtypeStruct) -> jax.Array:
    """Numbers of the size of parameters, so that whatever can be seen is."""
    is_real = jnp.issubdtype(like.dtype, jnp.floating)
    scale = 0.3 if is_real else 0.0
    return jnp.asarray(scale * rng.normal(size=like.shape), like.dtype)


def _check_method_forms(method: Any, params: Any, inputs: _Inputs, spec: ActionSpec) -> None:
    name, n, num_actions = type(method).__name__, _NUM_STATES, len(inputs.table)
    projected = _eval(f"{name}.project", method.project, params, inputs.table)
    if getattr(projected, "shape", ())[:1] != (num_actions,):
        raise UsageError(
            f"{name}.project gives {_form(projected)} for f32{list(inputs.table.shape)}; it must "
            f"give a row for each action, f32[{num_actions}, p]."
        )
    value = _eval(f"{name}.value", method.value, params, inputs.obs)
    _check_like(f"{name}.value", value, (n,), jnp.float32)
    for sets, what in (((n,), "sets [B, m]"), ((), "one set [m] for all states")):
        rows = jax.ShapeDtypeStruct((*sets, _SET_SIZE, *projected.shape[1:]), projected.dtype)
        mask = jax.ShapeDtypeStruct((*sets, _SET_SIZE), jnp.bool_)
        where = f"{name}.distribution of {what}"
        distribution = _eval(where, method.distribution, params, inputs.obs, rows, mask)
        forms = [_form(x) for x in jax.tree.leaves(distribution)]
        if not forms or not all(f.partition("[")[2].startswith((f"{n},", f"{n}]")) for f in forms):
            raise UsageError(
                f"{where} holds {', '.join(forms) or 'no arrays'}; it must be a pytree "
                f"(flax.struct.dataclass) whose arrays begin with an axis of the {n} states."
            )
        key = jax.random.key(0)
        sample = _eval(f"{where}: sample", lambda d, key: d.sample(key), distribution, key)
        mode = _eval(f"{where}: mode", lambda d: d.mode(), distribution)
        _check_same_tree(f"{where}: mode", mode, "sample", sample)
        log_prob = _eval(f"{where}: log_prob", lambda d, s: d.log_prob(s), distribution, sample)
        _check_like(f"{where}: log_prob", log_prob, (n,), jnp.float32)
        entropy = _eval(f"{where}: entropy", lambda d, s: d.entropy(s), distribution, sample)
        _check_like(f"{where}: entropy", entropy, (n,), jnp.float32)
        action = _eval(
            f"{name}.decode",
            lambda s, ids, mask: method.decode(
                s, AvailableSet(ids, mask), jnp.asarray(inputs.table)
            ),
            sample,
            jax.ShapeDtypeStruct(mask.shape, jnp.int32),
            mask,
        )
        if not isinstance(action, Action):
            raise UsageError(f"{name}.decode gives a {type(action).__name__}, not a jaxnew.Action.")
        _check_like(f"{name}.decode: id", action.id, (n,), jnp.int32)
        _check_like(f"{name}.decode: position", action.position, (n, spec.position_dim), np.float32)
        _check_like(f"{name}.decode: stop", action.stop, (n,), jnp.bool_)


def _looks(method: Any, params: Any, inputs: _Inputs) -> list[dict[str, Any]]:
    """What the policy does with sets, with the same permuted, and with other padding."""
    obs, table = jnp.asarray(inputs.obs), jnp.asarray(inputs.table)

    def look(params: Any, available: AvailableSet) -> dict[str, Any]:
        rows = method.project(params, table)[available.ids]
        distribution, value = distribution_and_value(method, params, obs, rows, available.mask)

        def id_of(sample: Any) -> jax.Array:
            return method.decode(sample, available, table).id

        samples = jax.vmap(distribution.sample)(jax.random.split(jax.random.key(2), 16))
        sample = jax.tree.map(lambda x: x[0], samples)
        found = {
            "drawn": jax.vmap(id_of)(samples),
            "greedy": id_of(distribution.mode()),
            "greedy_log_prob": distribution.log_prob(distribution.mode()),
            "log_prob": distribution.log_prob(sample),
            "entropy": distribution.entropy(sample),
            "value": value,
        }
        leaves = jax.tree.leaves(sample)
        if [(x.shape, x.dtype) for x in leaves] == [((_NUM_STATES,), jnp.int32)]:
            # It may be a place in the set.
            places = jnp.arange(_SET_SIZE, dtype=jnp.int32)[:, None]
            places = jnp.broadcast_to(places, (_SET_SIZE, _NUM_STATES))
            places = jax.tree.map(lambda _: places, sample)
            found["ids at places"] = jax.vmap(id_of)(places).T
            found["probabilities"] = jnp.exp(jax.vmap(distribution.log_prob)(places)).T
            of_one = jax.tree.map(
                lambda x: jnp.broadcast_to(x[:1], (_NUM_DRAWS, *x.shape[1:])), distribution
            )
            found["many"] = jax.tree.leaves(of_one.sample(jax.random.key(3)))[0]
        return found

    order = inputs.order
    mask = jnp.asarray(inputs.mask)
    plain = AvailableSet(jnp.asarray(inputs.ids), mask)
    permuted = AvailableSet(plain.ids[:, order], mask[:, order])
    repadded = AvailableSet(jnp.asarray(inputs.repadded_ids), mask)
    quick = _quick(f"{type(method).__name__}.distribution", look)
    return [jax.device_get(quick(params, sets)) for sets in (plain, permuted, repadded)]


def _check_looks(name: str, looks: Sequence[dict[str, Any]], inputs: _Inputs) -> None:
    """What is wrong with what `_looks` found."""
    plain, permuted, repadded = looks
    for what in ("value", "entropy", "log_prob"):
        if not np.isfinite(plain[what]).all():
            raise UsageError(f"{name}: {what} is not finite on random parameters and states.")
    available = np.where(inputs.mask, inputs.ids, -1)
    for ids, what in ((plain["drawn"], "a sample"), (plain["greedy"], "the mode")):
        if not (ids[..., None] == available).any(axis=-1).all():
            raise UsageError(
                f"{name} acts outside its set: {what} is decoded to an action that is not "
                "available; give masked entries a probability of zero (Categorical.masked)."
            )
    compared = ("value", "entropy", "log_prob", "greedy", "probabilities")
    if not all(_is_close(plain[key], repadded[key]) for key in compared if key in plain):
        raise UsageError(
            f"{name}.distribution depends on the padding of a set, on what stands where mask is "
            "false; leave it out with jnp.where."
        )
    has_places = np.array_equal(plain.get("ids at places", ()), inputs.ids)
    if has_places:
        of_places = plain["probabilities"]
        is_free = _is_close(of_places[:, inputs.order], permuted["probabilities"])
    else:
        key = "greedy_log_prob"  # Where several actions are best, the first is taken.
        is_other = plain["greedy"] != permuted["greedy"]
        is_free = _is_close(plain[key][is_other], permuted[key][is_other])
    if not is_free or not _is_close(plain["value"], permuted["value"]):
        raise UsageError(
            f"{name}.distribution depends on the order of the set: permuting the actions must "
            "permute their probabilities and change nothing else."
        )
    if has_places:
        _check_log_probs(name, of_places, plain["many"])


def _check_log_probs(name: str, probabilities: np.ndarray, many: np.ndarray) -> None:
    """Probabilities f32[B, m] of places against each other, and draws int32[n] of the first row."""
    total = probabilities.sum(axis=1)
    share = np.bincount(many, minlength=_SET_SIZE) / len(many)
    spread = probabilities[0] * (1.0 - probabilities[0])
    deviation = np.sqrt(np.maximum(spread, 0.0) / len(many))
    # Six standard deviations: with 8 numbers, once in tens of millions of sound policies.
    is_drawn_so = (np.abs(share - probabilities[0]) <= 6.0 * deviation + 1e-3).all()
    if not np.allclose(total, 1.0, atol=1e-3) or not is_drawn_so:
        raise UsageError(
            f"{name}.distribution: log_prob is not that of sample: in one state the "
            f"{_SET_SIZE} choices were drawn with shares {share.round(3).tolist()}, and exp(log_"
            f"prob) says {probabilities[0].round(3).tolist()}."
        )


def _is_close(one: Any, other: Any) -> bool:
    """Of float32 sums of some tens of products in another order."""
    return np.allclose(one, other, rtol=1e-3, atol=1e-4)


def _attempt(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a user's function gives.

    Raises:
      UsageError: it failed; in one sentence.
    """
    try:
        return function(*arguments)
    except Exception as err:
        raise UsageError(f"{what} fails: {type(err).__name__}: {_line(err)}") from err


def _eval(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Shapes and dtypes of what it gives; see `_attempt`."""
    return _attempt(what, jax.eval_shape, function, *arguments)


def _quick(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """It, compiled as quickly as possible; random keys are watched. See `_attempt`."""
    jitted = jax.jit(function, compiler_options=_QUICK)

    def run(*arguments: Any) -> Any:
        with jax.debug_key_reuse(True):
            return _attempt(what, jitted, *arguments)

    return run


def _parts(what: str, count: int, names: str, function: Callable[..., Any], *args: Any) -> Any:
    """Shapes of the parts of a tuple."""
    found = _eval(what, function, *args)
    if not isinstance(found, tuple) or len(found) != count:
        size = f"{len(found)} parts" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise UsageError(f"{what} gives {size}; it must give {count}: {names}.")
    return found


def _check_like(what: str, found: Any, shape: Sequence[int], dtype: Any = None) -> None:
    is_like = getattr(found, "shape", None) == tuple(shape)
    if not is_like or (dtype is not None and found.dtype != dtype):
        wanted = f"{list(shape)}" if dtype is None else f"{np.dtype(dtype).name}{list(shape)}"
        raise UsageError(f"{what} is {_form(found)}; it must be {wanted}.")


def _check_same_tree(what: str, found: Any, where: str, wanted: Any) -> None:
    """Refuses a tree that a scan could not carry from `where` to `what`."""
    trees = [str(jax.tree.structure(tree)) for tree in (found, wanted)]
    if trees[0] != trees[1]:
        raise UsageError(f"{what} gives {trees[0]}, and {where} {trees[1]}: not the same tree.")
    pairs = zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(wanted), strict=True)
    for (path, one), other in pairs:
        place = jax.tree_util.keystr(path).lstrip(".") or "it"
        if (one.shape, one.dtype) != (other.shape, other.dtype):
            raise UsageError(
                f"{what}: {place} is {_form(one)}, and {where} gives {_form(other)}; they must be "
                "the same."
            )


def _check_not_weak(what: str, tree: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if leaf.weak_type:
            raise UsageError(
                f"{what}: {jax.tree_util.keystr(path[1:]).lstrip('.') or 'the observation'} is a "
                f"Python number, whose dtype is weak; write jnp.{leaf.dtype}(...)."
            )


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _form(found: Any) -> str:
    """Such as `float32[3, 4]`."""
    if hasattr(found, "shape") and hasattr(found, "dtype"):
        return f"{found.dtype}{list(found.shape)}"
    return f"a {type(found).__name__}"


def _line(err: object) -> str:
    return str(err).strip().partition("\n")[0]
