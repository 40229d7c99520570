"""What every engine promises, and what it is given."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.scene import NUM_SLOTS
from envs_mjx.shape_stacking.shapes import Shape

# What no world of this task can come to. In a settling of 3 s a body falls at most 44 m and reaches
# 29 m/s; the smallest sphere would then roll at 370 rad/s. Parking ends at x = 53 and z = 100.
MAX_DISTANCE_M = 200.0
MAX_SPEED = 50.0
MAX_SPIN = 1000.0


class Settled(NamedTuple):
    """The bodies after settling.

    Attributes:
      qpos: f32[..., 12, 7] position of each body's origin, m, and quaternion (w, x, y, z).
      qvel: f32[..., 12, 6] linear velocity in world axes, m/s, and angular in the body's, rad/s.
      ok: bool[...] false where the simulation left the finite or plausible numbers; qpos and qvel
        are then those that were given.
    """

    qpos: jax.Array
    qvel: jax.Array
    ok: jax.Array


class Engine(Protocol):
    """A physics engine as a pure function of its arguments.

    It may be jitted, vmapped and scanned; nothing is kept from call to call (solvers start cold).
    A world's result depends on its own numbers only, not on the batch around it.

    Attributes:
      name: short, such as `mujoco_c`.
      settle_steps: physics steps of 0.01 s in one call.
      shapes: of the user's own, with ids from 810.
    """

    name: str
    settle_steps: int
    shapes: tuple[Shape, ...]

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        """Simulates `settle_steps` physics steps.

        Args:
          shape_ids: int32[..., 12] shape of each body; below 0 for an unused body, whose state is
            ignored and comes back as its parking place, at rest.
          qpos: f32[..., 12, 7] as in `Settled`.
          qvel: f32[..., 12, 6] as in `Settled`.
        """
        ...


def check_settle_steps(settle_steps: int) -> None:
    """Refuses fewer than 1 physics step, and more than 100,000.

    Raises:
      ValueError: it is one of these.
    """
    if not 1 <= settle_steps <= 100_000:
        raise ValueError(f"settle_steps={settle_steps} must be 1 to 100,000.")


def check_state(
    shape_ids: jax.Array | np.ndarray, qpos: jax.Array | np.ndarray, qvel: jax.Array | np.ndarray
) -> None:
    """Refuses arrays of a state that do not fit together.

    Raises:
      ValueError: wrong shapes.
      TypeError: wrong dtypes.
    """
    shapes = tuple(x.shape for x in (shape_ids, qpos, qvel))
    batch = shapes[0][:-1]
    if shapes != ((*batch, NUM_SLOTS), (*batch, NUM_SLOTS, 7), (*batch, NUM_SLOTS, 6)):
        raise ValueError(
            f"shape_ids, qpos and qvel have the shapes {shapes[0]}, {shapes[1]}, {shapes[2]}; give "
            f"(..., {NUM_SLOTS}), (..., {NUM_SLOTS}, 7) and (..., {NUM_SLOTS}, 6) with the same "
            "leading axes."
        )
    if shape_ids.dtype != jnp.int32 or qpos.dtype != jnp.float32 or qvel.dtype != jnp.float32:
        raise TypeError(
            f"shape_ids, qpos and qvel are {shape_ids.dtype}, {qpos.dtype}, {qvel.dtype}; "
            "give int32, float32 and float32."
        )


def is_plausible(qpos: Any, qvel: Any) -> Any:
    """bool[...] worlds with finite numbers whose bodies are neither too far nor too fast.

    Args:
      qpos: f[..., n, 7] of n bodies, of NumPy or jax.
      qvel: f[..., n, 6].
    """
    # Comparisons with NaN are false.
    is_near = (abs(qpos) < MAX_DISTANCE_M).all(axis=(-2, -1))
    is_slow = (abs(qvel[..., :3]) < MAX_SPEED).all(axis=(-2, -1))
    return is_near & is_slow & (abs(qvel[..., 3:]) < MAX_SPIN).all(axis=(-2, -1))
