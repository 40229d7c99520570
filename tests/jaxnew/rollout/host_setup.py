"""A pool of toys with a policy on top, whose programs are compiled once for all tests."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.environment import ActionSpec
from jaxnew.policy import make_method
from jaxnew.policy.method import MethodContext
from jaxnew.rollout.contract import Policy, RolloutConfig
from jaxnew.rollout.host import HostRollout
from jaxnew.rollout.pool import HostEnvironments
from jaxnew.sampling import Actions
from jaxnew.storage.metrics import TIME_PREFIX
from tests import toy_host
from tests.jaxnew.policy import numpy_policy

N, T, M, PADDED, D, K, A = 8, 9, 4, 5, 3, 3, toy_host.NUM_ACTIONS
CONFIG = RolloutConfig(
    num_envs=N,
    num_steps=T,
    normalize_observations=False,
    normalize_rewards=False,
)
NO_OP = 22
TABLE = jnp.asarray(np.random.default_rng(0).normal(size=(A, D)), jnp.float32)
IDS, ALWAYS = np.arange(2, 23), np.array([NO_OP])
ACTIONS = Actions.of(TABLE, IDS, M, padded_size=PADDED, always_available=ALWAYS)
ALL_ACTIONS = Actions.of(TABLE, IDS, always_available=ALWAYS)
SEEN = jax.ShapeDtypeStruct((toy_host.SIZE, toy_host.SIZE, K), jnp.uint8)


@functools.cache
def method_of(name: str = "ours") -> Any:
    spec = ActionSpec(A, position_dim=2)
    return make_method(name, MethodContext(np.arange(A, dtype=np.int32), action_spec=spec))


@functools.cache
def params_of(name: str = "ours") -> Any:
    method = method_of(name)
    shapes = jax.eval_shape(lambda key, x: method.init(key, x, D), jax.random.key(0), SEEN)
    return numpy_policy.randomized(shapes, seed=3, scale=0.2)


def policy_of(name: str = "ours") -> Policy:
    return Policy(params_of(name))


def environments_of(num_envs: int = N, num_halves: int = 2, seed: int = 5) -> HostEnvironments:
    pool = functools.partial(toy_host.ToyPool, num_envs, num_halves, seed)
    return HostEnvironments(pool, toy_host.MAX_STEPS, stack_size=K)


@functools.cache
def compiled(config: RolloutConfig, name: str) -> HostRollout:
    """A rollout whose programs are compiled once, for all of `rollout_of`."""
    return HostRollout(environments_of(), method_of(name), config, SEEN, width=4)


def rollout_of(
    num_halves: int = 2,
    config: RolloutConfig = CONFIG,
    name: str = "ours",
    environments: HostEnvironments | None = None,
) -> HostRollout:
    first = compiled(config, name)
    environments = environments or environments_of(num_halves=num_halves)
    rollout = replace(first, environments=environments)
    for program in ("draw_next", "project", "act", "value"):
        rollout.__dict__[program] = getattr(first, program)
    rollout.__dict__["_player"] = player = copy.copy(first._player)
    player._environments = environments
    return rollout


def play(
    rollout: HostRollout, num_rollouts: int = 2, name: str = "ours", actions: Actions = ACTIONS
) -> Any:
    """States between rollouts, batches and sums, without the seconds that they took."""
    states, batches, sums = [rollout.init(jax.random.key(1), actions)], [], []
    for k in range(num_rollouts):
        key = jax.random.fold_in(jax.random.key(4), k)
        state, batch, total = rollout.collect(key, states[-1], params_of(name), actions, 0.9)
        states.append(state)
        batches.append(batch)
        sums.append({k: v for k, v in total.items() if not k.startswith(TIME_PREFIX)})
    return states, batches, sums


def assert_equal(first: Any, second: Any) -> None:
    for (path, one), two in zip(
        jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(second), strict=True
    ):
        np.testing.assert_array_equal(one, two, err_msg=jax.tree_util.keystr(path))
