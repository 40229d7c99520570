"""The 1024 skills of Grid World: every sequence of five moves (docs/grid_world.md, "Skills")."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import jax
import numpy as np

from jaxnew.actions import ActionUniverse

NUM_MOVES = 5
NUM_SKILLS = 4**NUM_MOVES
MOVE_NAMES = "RDLU"

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
      moves: integer[...] move ids in 0..3, NumPy or JAX.

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


def net_displacement() -> np.ndarray:
    """int32[1024, 2] (dx, dy) in cells that each skill travels where no wall is near.

    36 distinct values, |dx| + |dy| odd and at most 5.
    """
    return move_displacements().reshape(NUM_SKILLS, NUM_MOVES, 2).sum(axis=1, dtype=np.int32)


def move_displacements() -> np.ndarray:
    """int32[1024, 10] the per-move coordinates (dx_1, dy_1, ..., dx_5, dy_5) in cells.

    A linear map explains 0.40 of them (R2) from the vectors of the released HVAE.
    """
    directions = direction_of(moves_of(np.arange(NUM_SKILLS)))
    return np.stack(directions, axis=-1).reshape(NUM_SKILLS, 2 * NUM_MOVES)


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


@lru_cache(maxsize=1)
def skill_universe() -> ActionUniverse:
    """All skills as an action universe.

    Classes are quadrants of the net displacement (256 skills each); the primary parameter is the
    direction of the net displacement in degrees, 0 = east, clockwise on the screen, in [0, 360).
    The content is the move sequence, uint8[1024, 5]. Engineered vectors:

    * `gt12` f32[1024, 12]: net displacement, then the five moves, all with the mirrored signs of
      the release (right is (-1, 0), down is (0, -1));
    * `gt5` f32[1024, 5]: the five move ids 0..3 as -1.5, -0.5, 0.5, 1.5.
    """
    moves = moves_of(np.arange(NUM_SKILLS))
    displacement = net_displacement()
    angle_deg = np.degrees(np.arctan2(displacement[:, 1], displacement[:, 0])) % 360.0
    # Negated as integers, so that no -0.0 appears.
    gt12 = -np.concatenate([displacement, move_displacements()], axis=1)
    return ActionUniverse(
        name="GridWorld-v0",
        class_labels=quadrant_of(displacement),
        class_names=QUADRANT_NAMES,
        primary_parameter=angle_deg.astype(np.float64),
        action_names=tuple(skill_name(skill_id) for skill_id in range(NUM_SKILLS)),
        content=moves.astype(np.uint8),
        engineered={
            "gt12": gt12.astype(np.float32),
            "gt5": (moves - 1.5).astype(np.float32),
        },
    )
