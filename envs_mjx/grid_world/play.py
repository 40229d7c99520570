"""Grid World's play environment: what each skill does in a large empty room.

See docs/grid_world.md, "Play data".
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from envs_mjx.grid_world.skills import NUM_MOVES, direction_of, moves_of, skill_moves

PLAY_SIZE = 80
NUM_POSITIONS = NUM_MOVES + 1


@partial(jax.jit, static_argnames=("num_recordings", "has_border", "extra"))
def record(
    key: jax.Array,
    skill_ids: jax.Array,
    num_recordings: int,
    has_border: bool = True,
    extra: tuple[str, ...] = (),
) -> jax.Array:
    """Plays every skill from random cells of the 80 x 80 room.

    With the border, free cells are 1..78 in both coordinates, starts are uniform over all of them
    but the goal's cell (78, 78), and each move is stopped by the walls. Without it no wall is ever
    met: starts are uniform over 5..74, so that every trajectory stays within 0..79.

    A skill's recordings depend on `key` and on its id, not on what else is in the list.

    Args:
      key: PRNG key, consumed.
      skill_ids: int32[n] ids in 0..1023; ids outside are not refused, see `skills.moves_of`.
      num_recordings: S, trajectories per skill.
      has_border: whether walls surround the room (the release) or not (the paper's prose).
      extra: skills with the ids 1024.., see `skills.load_skills`.

    Returns:
      uint8[n, S, 6, 2] cells (x, y) before the first and after each of the five moves.
    """
    ids = jnp.asarray(skill_ids, jnp.int32)
    moves = jnp.asarray(skill_moves(extra))[ids] if extra else moves_of(ids)
    return jax.vmap(partial(_record_skill, key, num_recordings, has_border))(ids, moves)


def _record_skill(
    key: jax.Array, num_recordings: int, has_border: bool, skill_id: jax.Array, moves: jax.Array
) -> jax.Array:
    """uint8[S, 6, 2] trajectories of one skill."""
    margin = 1 if has_border else NUM_MOVES
    width = PLAY_SIZE - 2 * margin
    # The goal's cell is the last in the count, so leaving it out is one cell less to draw from.
    num_starts = width * width - int(has_border)
    key = jax.random.fold_in(key, skill_id)
    cell = jax.random.randint(key, (num_recordings,), 0, num_starts, jnp.int32)
    start_xy = margin + jnp.stack([cell // width, cell % width], axis=-1)
    return _walk(start_xy, moves, has_border).astype(jnp.uint8)


def trajectory(start_xy: jax.Array, skill_id: jax.Array, has_border: bool = True) -> jax.Array:
    """The cells that one skill visits.

    Args:
      start_xy: int32[..., 2] cells (x, y).
      skill_id: int32[] in 0..1023.
      has_border: whether the walls at 0 and 79 stop each move; without them only the edge of the
        room does.

    Returns:
      int32[..., 6, 2] the start and the cell after each move.
    """
    return _walk(start_xy, moves_of(jnp.asarray(skill_id)), has_border)


def _walk(start_xy: jax.Array, moves: jax.Array, has_border: bool) -> jax.Array:
    """`trajectory` of moves int32[5]."""
    low, high = (1, PLAY_SIZE - 2) if has_border else (0, PLAY_SIZE - 1)
    steps = jnp.stack(direction_of(moves), axis=-1)
    positions = [jnp.asarray(start_xy, jnp.int32)]
    for t in range(NUM_MOVES):
        positions.append(jnp.clip(positions[-1] + steps[t], low, high))
    return jnp.stack(positions, axis=-2)


def featurize_xy(stored: jax.Array) -> jax.Array:
    """Raw coordinates, unscaled (`xy`).

    Args:
      stored: uint8[..., 6, 2] from `record`.

    Returns:
      f32[..., 6, 2] in 0..79.
    """
    return jnp.asarray(stored).astype(jnp.float32)


def featurize_relative(stored: jax.Array) -> jax.Array:
    """Coordinates relative to the start: what a skill does, without where it was done.

    Not in the paper. From raw coordinates an HVAE learns for tens of thousands of steps to predict
    where on the 80 x 80 grid the next cell is, before it learns what tells skills apart; from these
    it learns that within minutes.

    Args:
      stored: uint8[..., 6, 2] from `record`.

    Returns:
      f32[..., 6, 2] in -5..5; the first step is (0, 0).
    """
    coordinates = featurize_xy(stored)
    return coordinates - coordinates[..., :1, :]


def featurize_onehot(stored: jax.Array) -> jax.Array:
    """One-hot coordinates (`onehot`): 80 numbers for x, then 80 for y.

    Args:
      stored: uint8[..., 6, 2] from `record`, values in 0..79.

    Returns:
      f32[..., 6, 160], two ones per time step.
    """
    onehot = jax.nn.one_hot(jnp.asarray(stored), PLAY_SIZE, dtype=jnp.float32)
    return onehot.reshape(*onehot.shape[:-2], 2 * PLAY_SIZE)
