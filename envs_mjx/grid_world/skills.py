"""The 1024 skills of Grid World: every sequence of five moves (docs/grid_world.md, "Skills")."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

from jaxnew.actions import ActionUniverse, read_text

NUM_MOVES = 5
NUM_SKILLS = 4**NUM_MOVES
MOVE_NAMES = "RDLU"
STAY = "."  # A move of a user's own skills only.

Array = TypeVar("Array", np.ndarray, jax.Array)

# By sign of the net displacement; y grows downwards, so dy > 0 is south.
QUADRANT_NAMES = ("south-east", "south-west", "north-west", "north-east")


def moves_of(ids: Array) -> Array:
    """The moves of each skill: base 4, first move in the least significant digit.

    Args:
      ids: integer[...] skill ids in 0..1023, NumPy or JAX (also traced). Ids outside are not
        refused: their lowest ten bits are read.

    Returns:
      int32[..., 5] move ids in execution order, 0 right, 1 down, 2 left, 3 up; an array of the same
      library as `ids`.
    """
    shifts = 2 * np.arange(NUM_MOVES, dtype=np.int32)
    return (ids.astype(np.int32)[..., None] >> shifts) & 3


def direction_of(moves: Array) -> tuple[Array, Array]:
    """The displacement of single moves, by arithmetic instead of a table look-up.

    Args:
      moves: integer[...] move ids in 0..3, NumPy or JAX; any other is to stay.

    Returns:
      (dx, dy), each int32[...] in {-1, 0, 1} cells; x grows to the right, y grows downwards.
    """
    dx = (moves == 0).astype(np.int32) - (moves == 2).astype(np.int32)
    dy = (moves == 1).astype(np.int32) - (moves == 3).astype(np.int32)
    return dx, dy


def skill_name(skill_id: int) -> str:
    """Five letters of R, D, L, U in execution order, such as `RDDLU`.

    Args:
      skill_id: 0..1023.

    Raises:
      ValueError: there is no such skill.
    """
    if not 0 <= skill_id < NUM_SKILLS:
        raise ValueError(f"skill_id={skill_id} is not a skill; ids are 0..{NUM_SKILLS - 1}.")
    return "".join(MOVE_NAMES[move] for move in moves_of(np.asarray(skill_id)))


def load_skills(path: Path | str) -> tuple[str, ...]:
    """Skills of a user's own: a text file with five letters of R, D, L, U and `.` (stay) per line.

    Raises:
      ValueError: the file holds something else, a skill twice, or none.
    """
    names = tuple(read_text(path).split())
    for number, name in enumerate(names):
        wrong = len(name) != NUM_MOVES or set(name) - set(MOVE_NAMES + STAY)
        if wrong or name in names[:number]:
            raise ValueError(
                f"{path}: {name!r} is not a skill, or stands there twice; a skill is {NUM_MOVES} "
                f"letters of {', '.join(MOVE_NAMES)} and {STAY!r}, such as 'RR.DD', once."
            )
    if not names:
        raise ValueError(f"{path} holds no skill.")
    return names


@lru_cache(maxsize=8)
def skill_moves(extra: tuple[str, ...] = ()) -> np.ndarray:
    """int32[1024 + n, 5] moves of every skill and then of `extra` ones; 4 is to stay."""
    own = [[(MOVE_NAMES + STAY).index(letter) for letter in name] for name in extra]
    moves = np.concatenate(
        [moves_of(np.arange(NUM_SKILLS)), np.array(own, np.int32).reshape(-1, NUM_MOVES)]
    )
    moves.setflags(write=False)
    return moves


def net_displacement(extra: tuple[str, ...] = ()) -> np.ndarray:
    """int32[1024 + n, 2] (dx, dy) in cells that each skill travels where no wall is near.

    36 distinct values, |dx| + |dy| odd and at most 5; more with `extra` skills.
    """
    return move_displacements(extra).reshape(-1, NUM_MOVES, 2).sum(axis=1, dtype=np.int32)


def move_displacements(extra: tuple[str, ...] = ()) -> np.ndarray:
    """int32[1024 + n, 10] the per-move coordinates (dx_1, dy_1, ..., dx_5, dy_5) in cells.

    A linear map explains 0.40 of them (R2) from the vectors of the released HVAE.
    """
    directions = direction_of(skill_moves(extra))
    return np.stack(directions, axis=-1).reshape(-1, 2 * NUM_MOVES)


def quadrant_of(displacement: np.ndarray) -> np.ndarray:
    """The quadrant of net displacements.

    Every quadrant holds the half-axis at its start, turning clockwise on the screen from due east:
    due east counts as south-east, due south as south-west, and so on. Only a rule that turns with
    the grid gives 256 skills to each. (The release's figures swap the arrow glyphs of the second
    and the fourth quadrant; these labels are the right ones.)

    Args:
      displacement: integer[..., 2] (dx, dy), not (0, 0); y grows downwards.

    Returns:
      int32[...] index into `QUADRANT_NAMES`.
    """
    dx, dy = displacement[..., 0], displacement[..., 1]
    conditions = [(dx > 0) & (dy >= 0), (dx <= 0) & (dy > 0), (dx < 0) & (dy <= 0)]
    return np.select(conditions, [0, 1, 2], default=3).astype(np.int32)


@lru_cache(maxsize=8)
def skill_universe(extra: tuple[str, ...] = ()) -> ActionUniverse:
    """All skills as an action universe, and behind them `extra` ones, see `load_skills`.

    Classes are quadrants of the net displacement (256 skills each; extra ones that end where they
    began count as north-east); the primary parameter is the direction of the net displacement in
    degrees, 0 = east, clockwise on the screen, in [0, 360). The content is the move sequence,
    uint8[A, 5]. Engineered vectors:

    * `gt12` f32[A, 12]: net displacement, then the five moves, all with the mirrored signs of
      the release (right is (-1, 0), down is (0, -1));
    * `gt5` f32[A, 5]: the five move ids 0..4 as -1.5, -0.5, 0.5, 1.5, 2.5.
    """
    moves = skill_moves(extra)
    displacement = net_displacement(extra)
    angle_deg = np.degrees(np.arctan2(displacement[:, 1], displacement[:, 0])) % 360.0
    # Negated as integers, so that no -0.0 appears.
    gt12 = -np.concatenate([displacement, move_displacements(extra)], axis=1)
    return ActionUniverse(
        name="GridWorld-v0",
        class_labels=quadrant_of(displacement),
        class_names=QUADRANT_NAMES,
        primary_parameter=angle_deg.astype(np.float64),
        action_names=(*(skill_name(skill_id) for skill_id in range(NUM_SKILLS)), *extra),
        content=moves.astype(np.uint8),
        engineered={
            "gt12": gt12.astype(np.float32),
            "gt5": (moves - 1.5).astype(np.float32),
        },
    )
