"""MuJoCo's C engine: on the host, in threads, each world with its own shapes."""

from __future__ import annotations

import threading

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.engines.contract import (
    Settled,
    check_settle_steps,
    check_state,
    is_plausible,
)
from envs_mjx.shape_stacking.engines.mujoco_pool import Worlds
from envs_mjx.shape_stacking.scene import NUM_SLOTS
from envs_mjx.shape_stacking.shapes import NUM_SHAPES, Shape
from jaxnew.cores import available_cores

_CAPACITY = 256

# Programs may call from several threads. One run at a time has all cores, and a process has one
# handler of MuJoCo's warnings.
_LOCK = threading.Lock()

_Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


class MujocoC:
    """The engine of CPUs; see `engines.Engine` for what it promises.

    Spheres, capsules and cylinders collide as such, all other shapes by the hulls of the library
    (`solids.Solid.hull`). Two hulls touch in one point, as in the engine of the paper's runs, whose
    towers creep for that: docs/shape_stacking.md, "Reference figures", are those of one point. On
    the table a hull stands on up to four in either case.

    Numbers are f64 inside. On one machine a world's result is the same bits for every batch size,
    order of worlds and number of threads.

    Attributes:
      name: `mujoco_c`.
      settle_steps: physics steps of 0.01 s in one call.
      num_threads: worlds that are simulated at once.
      shapes: of the user's own, with ids from 810.
    """

    name = "mujoco_c"

    def __init__(
        self,
        settle_steps: int = scene.SETTLE_STEPS,
        num_threads: int = 0,
        has_multiple_contacts: bool = False,
        shapes: tuple[Shape, ...] = (),
    ) -> None:
        """
        Args:
          settle_steps: 1 to 100,000; 300 is the task's.
          num_threads: 1 to 1,000; 0 for one per core that this process may use.
          has_multiple_contacts: two hulls touch in several points where their faces or edges lie
            on each other, as in MuJoCo's present defaults and much as in MJX: steadier towers.
          shapes: of the user's own.

        Raises:
          ValueError: a number is out of its range.
        """
        check_settle_steps(settle_steps)
        if not 0 <= num_threads <= 1_000:
            raise ValueError(f"num_threads={num_threads} must be 0 (one per core) to 1,000.")
        self.settle_steps = settle_steps
        self.num_threads = num_threads or available_cores()
        self.shapes = shapes
        self._worlds = Worlds(_CAPACITY, self.num_threads, has_multiple_contacts, shapes)

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        """Simulates `settle_steps` physics steps; arrays as in `engines.Engine.settle`.

        Raises:
          ValueError: arrays that do not fit together. An id beyond the library is found on the
            host only, and jax raises its own error around this one.
          TypeError: wrong dtypes.
        """
        check_state(shape_ids, qpos, qvel)
        result = (
            jax.ShapeDtypeStruct(qpos.shape, jnp.float32),
            jax.ShapeDtypeStruct(qvel.shape, jnp.float32),
            jax.ShapeDtypeStruct(shape_ids.shape[:-1], jnp.bool_),
        )
        state = (shape_ids, qpos, qvel)
        return Settled(
            *jax.pure_callback(self.settle_host, result, *state, vmap_method="broadcast_all")
        )

    def settle_host(self, shape_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> _Arrays:
        """`settle` on NumPy arrays, outside of any program.

        Raises:
          ValueError: arrays that do not fit together, or ids beyond the library.
          TypeError: wrong dtypes.
        """
        shape_ids, qpos, qvel = np.asarray(shape_ids), np.asarray(qpos), np.asarray(qvel)
        check_state(shape_ids, qpos, qvel)
        num_shapes = NUM_SHAPES + len(self.shapes)
        if (shape_ids >= num_shapes).any():
            raise ValueError(
                f"shape_ids has {shape_ids.max()}; ids are 0..{num_shapes - 1}, or below 0 for "
                "unused bodies."
            )
        ids = shape_ids.reshape(-1, NUM_SLOTS)
        # Copies, which become the result: worlds that fail keep what was given.
        new_qpos = qpos.reshape(-1, NUM_SLOTS, 7).copy()
        new_qvel = qvel.reshape(-1, NUM_SLOTS, 6).copy()
        ok = np.zeros(len(ids), bool)
        with _LOCK:
            for first in range(0, len(ids), _CAPACITY):
                part = slice(first, first + _CAPACITY)
                ok[part] = self._settle_in_place(ids[part], new_qpos[part], new_qvel[part])
        batch = shape_ids.shape[:-1]
        return new_qpos.reshape(qpos.shape), new_qvel.reshape(qvel.shape), ok.reshape(batch)

    def _settle_in_place(
        self, shape_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> np.ndarray:
        """Overwrites the f32 state of the worlds that do not fail; returns which, bool[n]."""
        is_unused = (shape_ids < 0)[..., None]
        ids, parked = shape_ids, scene.parked_qpos()
        start_qpos = np.where(is_unused, parked, qpos).astype(np.float64)
        start_qvel = np.where(is_unused, 0.0, qvel).astype(np.float64)
        sound = np.flatnonzero(is_plausible(start_qpos, start_qvel))
        if not sound.size:
            return np.zeros(len(ids), bool)
        end_qpos, end_qvel, ran = self._worlds.run(
            ids[sound], start_qpos[sound], start_qvel[sound], self.settle_steps
        )
        end_qpos = np.where(is_unused[sound], parked, end_qpos)
        end_qvel = np.where(is_unused[sound], 0.0, end_qvel)
        is_sound = ran & is_plausible(end_qpos, end_qvel)
        sound = sound[is_sound]
        qpos[sound], qvel[sound] = end_qpos[is_sound], end_qvel[is_sound]
        ok = np.zeros(len(ids), bool)
        ok[sound] = True
        return ok
