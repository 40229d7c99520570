"""Grid World: cross a lava river to the goal with five-move skills (docs/grid_world.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.grid_world.skills import (
    NUM_MOVES,
    NUM_SKILLS,
    direction_of,
    moves_of,
    skill_moves,
)
from jaxnew.environment import (
    Action,
    ActionSpec,
    Environment,
    Info,
    ObservationSpec,
    Transition,
)

GRID_SIZE = 9
NUM_LAYOUTS = 42
FIRST_CELL, LAST_CELL = 1, GRID_SIZE - 2  # interior coordinates, inclusive

EMPTY, WALL, GOAL, LAVA, AGENT, SUBGOAL = 1, 2, 8, 9, 10, 11

Array = TypeVar("Array", int, np.ndarray, jax.Array)


@dataclass(frozen=True)
class GridWorldSettings:
    """What a run may set; the defaults are the published task.

    Attributes:
      max_moves: moves after which an episode is truncated, 1 or more; also the number that the time
        penalty is relative to.
      subgoal_reward: of the first visit to the opening; finite.
      goal_reward: of the goal before the time penalty; finite.
      time_penalty: subtracted at the goal, times `num_moves / max_moves`; finite.
      fixed_layout: 0..41 plays this layout always; -1 draws one of the 42 at every reset.

    Raises:
      ValueError: a number is out of its range.
    """

    max_moves: int = 50
    subgoal_reward: float = 0.1
    goal_reward: float = 1.0
    time_penalty: float = 0.9
    fixed_layout: int = -1

    def __post_init__(self) -> None:
        if self.max_moves < 1:
            raise ValueError(f"max_moves={self.max_moves} must be 1 or more.")
        if not -1 <= self.fixed_layout < NUM_LAYOUTS:
            raise ValueError(
                f"fixed_layout={self.fixed_layout} must be 0 to {NUM_LAYOUTS - 1}, or -1 to draw a "
                "layout at every reset."
            )
        for name in ("subgoal_reward", "goal_reward", "time_penalty"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name}={getattr(self, name)} must be a finite number.")


@struct.dataclass
class GridWorldParams:
    """Rules of the task; every field is traced, and means what it means in `GridWorldSettings`.

    Attributes:
      max_moves: int32[] >= 1.
      subgoal_reward, goal_reward, time_penalty: f32[].
      fixed_layout: int32[]; above 41 means 41, and any negative number draws.
    """

    max_moves: int | jax.Array = GridWorldSettings.max_moves
    subgoal_reward: float | jax.Array = GridWorldSettings.subgoal_reward
    goal_reward: float | jax.Array = GridWorldSettings.goal_reward
    time_penalty: float | jax.Array = GridWorldSettings.time_penalty
    fixed_layout: int | jax.Array = GridWorldSettings.fixed_layout


@struct.dataclass
class GridWorldState:
    """An episode in progress.

    Attributes:
      layout: int32[] 0..41, see `decode_layout`.
      agent_xy: int32[2] cell (x, y) of the agent, each 1..7; x is the column, y the row, downwards.
      num_moves: int32[] 0..max_moves, moves executed so far, wall bumps included.
      has_reached_subgoal: bool[] the opening was entered in this episode; not observable.
      episode_return: f32[] sum of the rewards so far.
    """

    layout: jax.Array
    agent_xy: jax.Array
    num_moves: jax.Array
    has_reached_subgoal: jax.Array
    episode_return: jax.Array


def decode_layout(layout: Array) -> tuple[Array, Array, Array]:
    """What a layout id means (docs/grid_world.md, "Layouts").

    Args:
      layout: integer[...] in 0..41, Python, NumPy or JAX.

    Returns:
      (is_horizontal bool[...], position int[...] in 3..5: the column x of a vertical or the row y
      of a horizontal river, opening int[...] in 1..7: the cell along the river without lava).
    """
    return layout >= NUM_LAYOUTS // 2, 3 + layout // 7 % 3, 1 + layout % 7


def encode_layout(is_horizontal: bool, position: int, opening: int) -> int:
    """The layout id of a river; inverse of `decode_layout`.

    Raises:
      ValueError: position is not in 3..5 or opening not in 1..7.
    """
    if not 3 <= position <= 5 or not FIRST_CELL <= opening <= LAST_CELL:
        raise ValueError(
            f"No river at position {position} with opening {opening}; positions are 3..5, "
            f"openings {FIRST_CELL}..{LAST_CELL}."
        )
    return 21 * int(is_horizontal) + 7 * (position - 3) + opening - 1


def is_wall() -> np.ndarray:
    """bool[9, 9] the outer ring, indexed [x, y]; the same in every layout."""
    x, y = np.ogrid[:GRID_SIZE, :GRID_SIZE]
    return (np.minimum(x, y) < FIRST_CELL) | (np.maximum(x, y) > LAST_CELL)


class GridWorld(Environment[GridWorldState, GridWorldParams]):
    """A 9 x 9 grid with a lava river between start and goal.

    Observation: f32[81], the object id of cell (x, y) in element `9 * x + y`, each in 1..11: 1
      empty, 2 wall, 8 goal, 9 lava, 10 agent (hides what is below it), 11 opening (sub-goal). The
      32 wall elements never change. The goal's element changes in `final_observation` only.
    Action: `Action.id` int32[] in 0..1023 (and those of `extra`), five moves (`skills.moves_of`);
      moves after the end of the episode are not executed. Any other id is invalid: it takes five
      moves without effect and sets `info["invalid_action"]`. Position (k = 0) and stop bit are
      ignored.
    Reward: f32[], the sum over executed moves: 0.1 on the first visit to the opening,
      `1 - 0.9 * num_moves / 50` at the goal, else 0; in [0, 0.884] per step and per
      episode.
    Start: agent on (1, 1), one of 42 layouts, uniformly.
    End: terminated on the goal (success) or on lava; truncated after 50 moves, wall bumps counted,
      without either.
    Parameters: `GridWorldParams`.
    Info: `is_success` bool[], `has_reached_subgoal` bool[], `episode_length` int32[] (moves so
      far), `episode_return` f32[] (raw), `invalid_action` bool[]; from `step` also
      `final_observation` f32[81].

    Example:
      env = GridWorld()
      obs, state = env.reset(jax.random.key(0), env.default_params)
      obs, state, reward, terminated, truncated, info = env.step(
          jax.random.key(1), state, Action.of(21), env.default_params)
    """

    name = "GridWorld-v0"
    episode_metrics = ("is_success", "has_reached_subgoal", "episode_length", "episode_return")

    def __init__(
        self,
        max_moves: int = GridWorldSettings.max_moves,
        subgoal_reward: float = GridWorldSettings.subgoal_reward,
        goal_reward: float = GridWorldSettings.goal_reward,
        time_penalty: float = GridWorldSettings.time_penalty,
        fixed_layout: int = GridWorldSettings.fixed_layout,
        extra: tuple[str, ...] = (),
    ) -> None:
        """Takes the fields of `GridWorldSettings`, which become `default_params`.

        Args:
          max_moves, subgoal_reward, goal_reward, time_penalty, fixed_layout: see
            `GridWorldSettings`.
          extra: skills with the ids 1024.., see `skills.load_skills`.

        Raises:
          ValueError: a number is out of its range.
        """
        self._extra = extra
        self._settings = GridWorldSettings(
            max_moves, subgoal_reward, goal_reward, time_penalty, fixed_layout
        )

    @property
    def default_params(self) -> GridWorldParams:
        """The task as it was set; the published one if nothing was."""
        return GridWorldParams(**vars(self._settings))

    @property
    def action_spec(self) -> ActionSpec:
        """1024 skills and the extra ones, no position, no stop bit."""
        return ActionSpec(num_actions=NUM_SKILLS + len(self._extra))

    def observation_spec(self, params: GridWorldParams) -> ObservationSpec:
        """f32[81] in 1..11; the ring of walls is constant."""
        del params
        return ObservationSpec(
            shape=(GRID_SIZE * GRID_SIZE,),
            dtype=jnp.float32,
            low=float(EMPTY),
            high=float(SUBGOAL),
            constant=is_wall().reshape(-1),
        )

    def max_episode_steps(self, params: GridWorldParams) -> int:
        """`ceil(max_moves / 5)` skills; `params` must be concrete."""
        return -(-int(params.max_moves) // NUM_MOVES)

    def reset_env(
        self, key: jax.Array, params: GridWorldParams
    ) -> tuple[jax.Array, GridWorldState]:
        """Draws a layout; consumes `key`. Returns (obs f32[81], state)."""
        state = _first_state(key, params)
        return _observe(state), state

    def step_env(
        self, key: jax.Array, state: GridWorldState, action: Action, params: GridWorldParams
    ) -> Transition:
        """Executes one skill without auto-reset; deterministic, `key` is not used.

        Args:
          state: an episode in progress; what follows an end is undefined.
          action: only `action.id` int32[] is read.

        Returns:
          (obs f32[81], state, reward f32[], terminated bool[], truncated bool[], info).
        """
        del key
        state, reward, terminated, truncated, info = _transition(state, action, params, self._extra)
        return _observe(state), state, reward, terminated, truncated, info

    def step(
        self, key: jax.Array, state: GridWorldState, action: Action, params: GridWorldParams
    ) -> Transition:
        """As the base class, but only one observation is built where nobody reads the final one.

        Consumes `key` for the next episode's layout.
        """
        state, reward, terminated, truncated, info = _transition(state, action, params, self._extra)
        first_state = _first_state(key, params)
        done = terminated | truncated
        next_state = jax.tree.map(lambda new, old: jnp.where(done, new, old), first_state, state)
        info = {**info, "final_observation": _observe(state)}
        return _observe(next_state), next_state, reward, terminated, truncated, info


def _first_state(key: jax.Array, params: GridWorldParams) -> GridWorldState:
    """The start of an episode; consumes `key`."""
    # Paid at every step of an auto-resetting rollout, where `jax.random.randint` (three more
    # hashes) nearly doubles the cost of the environment. The price: 4 layouts of 42 are drawn with
    # a probability that is larger by 2**-32.
    drawn = (jax.random.bits(key, (), jnp.uint32) % NUM_LAYOUTS).astype(jnp.int32)
    fixed = jnp.minimum(jnp.asarray(params.fixed_layout, jnp.int32), NUM_LAYOUTS - 1)
    return GridWorldState(
        layout=jnp.where(fixed < 0, drawn, fixed),
        agent_xy=jnp.full((2,), FIRST_CELL, jnp.int32),
        num_moves=jnp.int32(0),
        has_reached_subgoal=jnp.bool_(False),
        episode_return=jnp.float32(0.0),
    )


def _observe(state: GridWorldState) -> jax.Array:
    """f32[81] object ids with the agent on top.

    Compares each cell with the few numbers that make a layout: measured faster than a gather from
    a bank of the 42 layouts.
    """
    index = np.arange(GRID_SIZE * GRID_SIZE, dtype=np.int32)
    x, y = np.divmod(index, GRID_SIZE)
    wall = is_wall().reshape(-1)
    goal = (x == LAST_CELL) & (y == LAST_CELL)
    without_river = np.where(wall, WALL, np.where(goal, GOAL, EMPTY)).astype(np.int32)

    is_horizontal, position, opening = decode_layout(state.layout)
    line = jnp.where(is_horizontal, y, x)
    opening_index = jnp.where(
        is_horizontal, GRID_SIZE * opening + position, GRID_SIZE * position + opening
    )
    agent_index = GRID_SIZE * state.agent_xy[0] + state.agent_xy[1]
    cells = jnp.where((line == position) & ~wall, LAVA, without_river)
    cells = jnp.where(index == opening_index, SUBGOAL, cells)
    return jnp.where(index == agent_index, AGENT, cells).astype(jnp.float32)


def _transition(
    state: GridWorldState, action: Action, params: GridWorldParams, extra: tuple[str, ...]
) -> tuple[GridWorldState, jax.Array, jax.Array, jax.Array, Info]:
    """One skill, move by move: (state, reward, terminated, truncated, info)."""
    chex.assert_shape(state.agent_xy, (2,))
    chex.assert_rank(action.id, 0)
    is_valid = (action.id >= 0) & (action.id < NUM_SKILLS + len(extra))
    moves = jnp.asarray(skill_moves(extra))[action.id] if extra else moves_of(action.id)
    dxs, dys = direction_of(moves)
    max_moves = jnp.asarray(params.max_moves, jnp.int32)
    is_horizontal, position, opening = decode_layout(state.layout)

    def move(t: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        x, y, num_moves, reaches_subgoal, is_success, is_dead, is_running = carry
        num_moves += is_running.astype(jnp.int32)
        moves_agent = is_running & is_valid
        # Walls hold the agent; where it stays is neither lava, nor goal, nor an unvisited opening.
        x = jnp.where(moves_agent, jnp.clip(x + dxs[t], FIRST_CELL, LAST_CELL), x)
        y = jnp.where(moves_agent, jnp.clip(y + dys[t], FIRST_CELL, LAST_CELL), y)
        along, across = jnp.where(is_horizontal, x, y), jnp.where(is_horizontal, y, x)
        is_on_river, is_at_opening = across == position, along == opening
        reaches_subgoal |= is_on_river & is_at_opening
        is_dead |= is_on_river & ~is_at_opening
        is_success |= (x == LAST_CELL) & (y == LAST_CELL)
        is_running &= ~(is_dead | is_success) & (num_moves < max_moves)
        return x, y, num_moves, reaches_subgoal, is_success, is_dead, is_running

    # A loop and not five copies: XLA fuses the copies into whatever reads the state and computes
    # them again there, once per observed cell (ten times slower at 32 environments).
    false, true = jnp.bool_(False), jnp.bool_(True)
    carry = (*state.agent_xy, state.num_moves, false, false, false, true)
    x, y, num_moves, reaches_subgoal, is_success, is_dead, is_running = jax.lax.fori_loop(
        0, NUM_MOVES, move, carry
    )

    is_first_visit = reaches_subgoal & ~state.has_reached_subgoal
    relative_time = num_moves.astype(jnp.float32) / max_moves.astype(jnp.float32)
    goal_reward = params.goal_reward - params.time_penalty * relative_time
    subgoal_reward = jnp.asarray(params.subgoal_reward, jnp.float32)
    reward = jnp.where(is_first_visit, subgoal_reward, 0.0) + jnp.where(
        is_success, goal_reward, 0.0
    )
    reward = reward.astype(jnp.float32)
    terminated = is_success | is_dead
    next_state = GridWorldState(
        layout=state.layout,
        agent_xy=jnp.stack([x, y]),
        num_moves=num_moves,
        has_reached_subgoal=state.has_reached_subgoal | reaches_subgoal,
        episode_return=state.episode_return + reward,
    )
    info = {
        "is_success": is_success,
        "has_reached_subgoal": next_state.has_reached_subgoal,
        "episode_length": num_moves,
        "episode_return": next_state.episode_return,
        "invalid_action": ~is_valid,
    }
    return next_state, reward, terminated, ~terminated & ~is_running, info
