"""What every engine promises, and what it is given."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.scene import NUM_SLOTS


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
    """

    name: str
    settle_steps: int

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        """Simulates `settle_steps` physics steps.

        Args:
          shape_ids: int32[..., 12] shape of each body; below 0 for an unused body, whose state is
            ignored and comes back as its parking place, at rest.
          qpos: f32[..., 12, 7] as in `Settled`.
          qvel: f32[..., 12, 6] as in `Settled`.
        """
        ...


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
