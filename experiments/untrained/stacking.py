"""What policies without training reach in Shape Stacking (docs/shape_stacking.md, "Anchors")."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.shape_stacking import (
    ShapeStacking,
    StackingParams,
    StackingSettings,
    StackingState,
    shape_library,
)
from envs_mjx.shape_stacking.camera import FRAME_SIZE
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from experiments.reports.anchors import Line
from jaxnew.environment import Action, Transition
from jaxnew.evaluation import measure, summarize
from jaxnew.policy import Categorical
from jaxnew.rollout.contract import Policy, RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions, AvailableSet
from jaxnew.task.domain import Domain

EPISODES = 500
METRICS = ("final_height", "reward")

# Classes that others can stand on.
FLAT_TOPPED = (
    "horizontal_rectangle",
    "arch",
    "rectangle",
    "half_rectangle",
    "cube",
    "cylinder",
)

# Policies by name; of those that play at random, the probability of a stop in each action.
SCRIPTED = "scripted"
RANDOM = {
    "stop at once": 1.0,
    "random, stops with probability 0.5": 0.5,
    "random, never stops": 0.0,
}
NAMES = (*RANDOM, SCRIPTED)


@struct.dataclass
class OpenState:
    """An episode, and what the script knows of it.

    Attributes:
      stacking: the episode.
      left_x: f32[] x of the left cylinder at the start, m.
    """

    stacking: StackingState
    left_x: jax.Array


class OpenStacking(ShapeStacking):
    """Shape Stacking with (`left_x`, number of actions so far) as observation, f32[2].

    Its episode metrics have the reward, too.
    """

    episode_metrics = (*ShapeStacking.episode_metrics, "reward")  # type: ignore[assignment]

    def reset_env(self, key: jax.Array, params: StackingParams) -> tuple[jax.Array, Any]:
        _, stacking = super().reset_env(key, params)
        state = OpenState(stacking, stacking.bodies.qpos[0, 0])
        return _seen(state), state

    def picture(self, bodies: Bodies, num_bodies: int = 0) -> jax.Array:
        """Black: nobody looks at it."""
        del bodies, num_bodies
        return jnp.zeros((FRAME_SIZE, FRAME_SIZE), jnp.uint8)

    def step_env(
        self, key: jax.Array, state: Any, action: Action, params: StackingParams
    ) -> Transition:
        _, stacking, reward, *ends, info = super().step_env(key, state.stacking, action, params)
        state = state.replace(stacking=stacking)
        return (_seen(state), state, reward, *ends, {**info, "reward": reward})


def _seen(state: OpenState) -> jax.Array:
    return jnp.stack([state.left_x, state.stacking.num_actions.astype(jnp.float32)])


@struct.dataclass
class Moves:
    """What a policy may do.

    Attributes:
      obs: f32[..., 2] of `OpenStacking`.
      sizes: f32[..., m] s of flat-topped shapes, 0 for all others.
      mask: bool[..., m] true for a real entry of the set.
      name, position_dim: see `StackingAnchor`.
    """

    obs: jax.Array
    sizes: jax.Array
    mask: jax.Array
    name: str = struct.field(pytree_node=False)
    position_dim: int = struct.field(pytree_node=False)

    def sample(self, key: jax.Array) -> Action:
        """What it does, its `id` an index into the available set, or -1; consumes `key`."""
        if self.name == SCRIPTED:
            return self._scripted()
        key_choice, key_position, key_stop = jax.random.split(key, 3)
        return Action(
            Categorical.masked(jnp.zeros_like(self.sizes), self.mask).sample(key_choice),
            jax.random.uniform(key_position, (self.position_dim,), minval=-1.0, maxval=1.0),
            jax.random.bernoulli(key_stop, RANDOM[self.name]),
        )

    def _scripted(self) -> Action:
        """The flat-topped shapes by decreasing s, all on the left cylinder; then nothing more."""
        left_x, number = self.obs[0], self.obs[1].astype(jnp.int32)
        sizes = jnp.where(self.mask, self.sizes, 0.0)
        order = jnp.argsort(-sizes)
        choice = order[jnp.minimum(number, len(order) - 1)]
        is_there = (number < len(order)) & (sizes[choice] > 0.0)
        return Action(
            jnp.where(is_there, choice, -1),
            jnp.stack([left_x, jnp.float32(0.0)])[: self.position_dim],
            jnp.bool_(False),
        )


class StackingAnchor:
    """A policy without parameters.

    Args:
      name: of `NAMES`.
      position_dim: k, coordinates of a position.
    """

    def __init__(self, name: str, position_dim: int) -> None:
        self.name, self._position_dim = name, position_dim

    def project(self, params: Any, representations: jax.Array) -> jax.Array:
        """The rows themselves."""
        del params
        return representations

    def distribution(
        self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Moves:
        """What it may do, given rows f32[..., m, 1] of `flat_sizes`."""
        del params
        return Moves(obs, projected[..., 0], mask, self.name, self._position_dim)

    def decode(self, sample: Action, available: AvailableSet, table: jax.Array) -> Action:
        """The action; an id of -1 places nothing."""
        del table
        ids = available.id_of(jnp.maximum(sample.id, 0))
        return Action(jnp.where(sample.id < 0, -1, ids), sample.position, sample.stop)


def flat_sizes() -> np.ndarray:
    """f32[810, 1] s of every flat-topped shape, 0 of the others."""
    library = shape_library()
    is_flat = np.isin(library.class_labels, [CLASS_NAMES.index(name) for name in FLAT_TOPPED])
    return np.where(is_flat, library.s, 0.0).astype(np.float32)[:, None]


def play(
    env: OpenStacking, name: str, ids: np.ndarray, set_size: int, episodes: int
) -> dict[str, np.ndarray]:
    """Episode metrics f32[episodes] of one of `NAMES`, on sets of the shapes int32[n] `ids`."""
    # One action is the whole episode of what stops at once.
    params = StackingParams(jnp.int32(1)) if RANDOM.get(name) == 1.0 else env.default_params
    config = RolloutConfig(normalize_observations=False, normalize_rewards=False)
    method: Any = StackingAnchor(name, env.position_dim)
    # On the host, more worlds at a time gain nothing, and the last batch plays some for nothing.
    width = 20 if jax.default_backend() == "cpu" else 128
    rollout = DeviceRollout(env, params, method, config, width)
    return measure(rollout, Policy({}), Actions.of(flat_sizes(), ids, set_size), episodes)


def measure_anchors(
    domain: Domain,
    parts: Sequence[str],
    set_sizes: Sequence[int],
    episodes: int,
    settings: StackingSettings,
) -> Iterator[Line]:
    """The lines of all anchors as they are measured; see `Line`."""
    env = OpenStacking(position_dim=domain.task.action_spec.position_dim, **asdict(settings))
    episodes = episodes or EPISODES
    for size in set_sizes or (domain.task.budget("paper").sets.size,):
        for name in NAMES:
            for part in parts:
                found = summarize(play(env, name, domain.split.ids(part), size, episodes))
                summary = {metric: found[metric] for metric in METRICS}
                yield Line(name, part, size, episodes, env.engine.name, summary)
