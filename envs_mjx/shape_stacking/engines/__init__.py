"""Engines: what happens to the bodies in the 3 s after an action (spec shape_stacking 4, item 4).

`make_engine` makes one by its name. Each is a module of its own, since simulators take long to
import.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.scene import NUM_SLOTS

__all__ = ["PHYSICS", "Engine", "Settled", "check_state", "make_engine"]

PHYSICS = ("auto", "mjx", "mujoco")


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


def make_engine(physics: str = "auto", **options: Any) -> Engine:
    """An engine by its name.

    Args:
      physics: `mjx`: in the program, for accelerators. `mujoco`: MuJoCo's C engine, on the host's
        cores. `auto`: `mjx` where jax has an accelerator, else `mujoco`, which is many times
        faster on a CPU.
      options: arguments of `mjx.Mjx` or `mujoco_c.MujocoC`; both have `settle_steps`.

    Raises:
      ValueError: there is no such engine.
      TypeError: it has no such option.
      ImportError: as `mjx.Mjx`.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics={physics!r} is unknown; choose from {PHYSICS}.")
    if physics == "auto":
        physics = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if physics == "mjx":
        from envs_mjx.shape_stacking.engines.mjx import Mjx

        return Mjx(**options)
    from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC

    return MujocoC(**options)
