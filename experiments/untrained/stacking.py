"""What policies without training reach in Shape Stacking (spec shape_stacking 10).

They play the episodes of `evaluate`: the same starts and the same available sets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.shape_stacking import ShapeStacking, StackingParams, StackingState, shape_library
from envs_mjx.shape_stacking.camera import FRAME_SIZE
from envs_mjx.shape_stacking.engines import Engine
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.training import EVALUATION_SEED
from experiments.reports.anchors import Summary
from experiments.untrained.towers import FLAT_TOPPED
from jaxnew.environment import Action, Transition
from jaxnew.evaluation import Evaluator, summarize
from jaxnew.policy import Categorical
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool, AvailableSet

EPISODES = 500
METRICS = ("final_height", "reward")

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
class Move:
    """What a policy does.

    Attributes:
      choice: int32[...] index into the available set, or -1 for nothing.
      position: f32[..., k] m.
      stop: bool[...].
    """

    choice: jax.Array
    position: jax.Array
    stop: jax.Array


@struct.dataclass
class RandomMoves:
    """Uniform choices and positions, and a stop with a probability.

    Attributes:
      choice: of the available actions.
      stop_probability, position_dim: see `StackingAnchor`.
    """

    choice: Categorical
    stop_probability: float = struct.field(pytree_node=False)
    position_dim: int = struct.field(pytree_node=False)

    def sample(self, key: jax.Array) -> Move:
        """One draw; consumes `key`."""
        key_choice, key_position, key_stop = jax.random.split(key, 3)
        return Move(
            self.choice.sample(key_choice),
            jax.random.uniform(key_position, (self.position_dim,), minval=-1.0, maxval=1.0),
            jax.random.bernoulli(key_stop, self.stop_probability),
        )


@struct.dataclass
class ScriptedMoves:
    """The flat-topped shapes by decreasing s, all on the left cylinder; then nothing more.

    Attributes:
      obs: f32[..., 2] of `OpenStacking`.
      sizes: f32[..., m] s of flat-topped shapes, 0 for all others.
      position_dim: see `StackingAnchor`.
    """

    obs: jax.Array
    sizes: jax.Array
    position_dim: int = struct.field(pytree_node=False)

    def sample(self, key: jax.Array) -> Move:
        """Nothing is drawn."""
        del key
        left_x, number = self.obs[0], self.obs[1].astype(jnp.int32)
        order = jnp.argsort(-self.sizes)
        choice = order[jnp.minimum(number, len(order) - 1)]
        is_there = (number < len(order)) & (self.sizes[choice] > 0.0)
        return Move(
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
    ) -> RandomMoves | ScriptedMoves:
        """What it does, given rows f32[..., m, 1] of `flat_sizes`."""
        del params
        sizes = jnp.where(mask, projected[..., 0], 0.0)
        if self.name == SCRIPTED:
            return ScriptedMoves(obs, sizes, self._position_dim)
        uniform = Categorical.masked(jnp.zeros_like(sizes), mask)
        return RandomMoves(uniform, RANDOM[self.name], self._position_dim)

    def decode(self, sample: Move, available: AvailableSet, table: jax.Array) -> Action:
        """The action; an id of -1 places nothing."""
        del table
        ids = available.id_of(jnp.maximum(sample.choice, 0))
        return Action(jnp.where(sample.choice < 0, -1, ids), sample.position, sample.stop)


def flat_sizes() -> np.ndarray:
    """f32[810, 1] s of every flat-topped shape, 0 of the others."""
    library = shape_library()
    is_flat = np.isin(library.class_labels, [CLASS_NAMES.index(name) for name in FLAT_TOPPED])
    return np.where(is_flat, library.s, 0.0).astype(np.float32)[:, None]


def play(
    engine: Engine, position_dim: int, ids: np.ndarray, name: str, set_size: int, episodes: int
) -> dict[str, np.ndarray]:
    """Episode metrics f32[episodes] of one anchor.

    Args:
      engine: simulates.
      position_dim: of the variant, see `ShapeStacking`.
      ids: int32[n] shapes that sets are drawn from.
      name: of `NAMES`.
      set_size: shapes in a set.
      episodes: how many.
    """
    env = OpenStacking(engine, position_dim)
    # One action is the whole episode of what stops at once.
    is_short = RANDOM.get(name) == 1.0
    params = StackingParams(jnp.int32(1)) if is_short else env.default_params
    method: Any = StackingAnchor(name, position_dim)
    evaluator = Evaluator(env, params, method, set_size, normalize_observations=False)
    table = jnp.asarray(flat_sizes())
    pool = ActionPool.of(ids, capacity=len(table))
    key = jax.random.key(EVALUATION_SEED)
    return evaluator.run({}, RunningStatistics.zeros((2,)), table, pool, key, episodes)


def summaries(
    domain: Domain, engine: Engine, parts: Sequence[str], set_size: int, episodes: int
) -> Iterator[tuple[str, str, Summary]]:
    """Final heights and rewards of every anchor on parts of a split.

    Args:
      domain: the task, whose variant says how shapes are placed, and the split.
      engine: simulates.
      parts: of the split.
      set_size: shapes in a set.
      episodes: of each anchor on each part.

    Yields:
      Anchor, part and metrics with their intervals, as they are measured.
    """
    position_dim = domain.task.action_spec.position_dim
    for name in NAMES:
        for part in parts:
            ids = domain.split.ids(part)
            found = summarize(play(engine, position_dim, ids, name, set_size, episodes))
            yield name, part, {metric: found[metric] for metric in METRICS}
