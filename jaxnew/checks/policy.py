"""Whether a policy keeps the promises that learner, rollout and evaluation rely on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.checks.forms import check_like, check_same_tree, compiled_quickly, form, shapes_of
from jaxnew.environment import Action, ActionSpec
from jaxnew.policy.method import PolicyMethod, distribution_and_value
from jaxnew.sampling import AvailableSet
from jaxnew.task.methods import MEMBERS
from jaxnew.task.places import UsageError

# States, actions in a set, and how many of them are no padding.
_NUM_STATES, _SET_SIZE, _NUM_REAL = 32, 8, 5
_NUM_DRAWS = 4096


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
    shapes = shapes_of(f"{name}.init", lambda key: method.init(key, one, size), jax.random.key(0))
    _check_method_forms(method, shapes, inputs, action_spec or ActionSpec(len(inputs.table)))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: _noise(rng, x), shapes)
    try:
        _check_looks(name, _looks(method, params, inputs), inputs)
    except UsageError:  # It may be that not all numbers make sense; those of `init` take longer.
        fresh = compiled_quickly(f"{name}.init", lambda key: method.init(key, one, size))(
            jax.random.key(0)
        )
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
    projected = shapes_of(f"{name}.project", method.project, params, inputs.table)
    if getattr(projected, "shape", ())[:1] != (num_actions,):
        raise UsageError(
            f"{name}.project gives {form(projected)} for f32{list(inputs.table.shape)}; it must "
            f"give a row for each action, f32[{num_actions}, p]."
        )
    value = shapes_of(f"{name}.value", method.value, params, inputs.obs)
    check_like(f"{name}.value", value, (n,), jnp.float32)
    for sets, what in (((n,), "sets [B, m]"), ((), "one set [m] for all states")):
        rows = jax.ShapeDtypeStruct((*sets, _SET_SIZE, *projected.shape[1:]), projected.dtype)
        mask = jax.ShapeDtypeStruct((*sets, _SET_SIZE), jnp.bool_)
        where = f"{name}.distribution of {what}"
        distribution = shapes_of(where, method.distribution, params, inputs.obs, rows, mask)
        forms = [form(x) for x in jax.tree.leaves(distribution)]
        if not forms or not all(f.partition("[")[2].startswith((f"{n},", f"{n}]")) for f in forms):
            raise UsageError(
                f"{where} holds {', '.join(forms) or 'no arrays'}; it must be a pytree "
                f"(flax.struct.dataclass) whose arrays begin with an axis of the {n} states."
            )
        key = jax.random.key(0)
        sample = shapes_of(f"{where}: sample", lambda d, key: d.sample(key), distribution, key)
        mode = shapes_of(f"{where}: mode", lambda d: d.mode(), distribution)
        check_same_tree(f"{where}: mode", mode, "sample", sample)
        log_prob = shapes_of(f"{where}: log_prob", lambda d, s: d.log_prob(s), distribution, sample)
        check_like(f"{where}: log_prob", log_prob, (n,), jnp.float32)
        entropy = shapes_of(f"{where}: entropy", lambda d, s: d.entropy(s), distribution, sample)
        check_like(f"{where}: entropy", entropy, (n,), jnp.float32)
        action = shapes_of(
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
        check_like(f"{name}.decode: id", action.id, (n,), jnp.int32)
        check_like(f"{name}.decode: position", action.position, (n, spec.position_dim), np.float32)
        check_like(f"{name}.decode: stop", action.stop, (n,), jnp.bool_)


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
    quick = compiled_quickly(f"{type(method).__name__}.distribution", look)
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
