"""MJX's JAX backend: inside the program, on any device; shapes are data."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.engines import _mjx_private, mjx_pool
from envs_mjx.shape_stacking.engines.contract import (
    Settled,
    check_settle_steps,
    check_state,
    is_plausible,
)
from envs_mjx.shape_stacking.scene import NUM_SLOTS
from envs_mjx.shape_stacking.shapes import NUM_SHAPES, Shape

# Line searches always take all their steps here. With 8 and 12 towers end no nearer to C's; with 2
# and 3 a cube that tips off an edge ends 5 cm from where it should (docs/shape_stacking.md,
# "Reference figures", 14): results/shape_stacking/mjx_speed.md.
SOLVER = scene.Solver(iterations=3, ls_iterations=5)
MAX_CONTACTS = 48  # Of a world; the deepest are kept.


class Mjx:
    """The engine of accelerators; see `engines.Engine` for what it promises.

    Shapes are data: one compiled program per batch size serves all worlds and action sets. Spheres
    and capsules collide as such, all other shapes by the hulls of the library, cylinders among
    them, as 12-gons. Two hulls touch in up to four points, so towers do not creep; compare with
    `MujocoC(has_multiple_contacts=True)`. Contacts are found by this project; their forces and the
    motion are MJX's.

    Numbers are f32. A world's result depends on the batch around it, the device and the program it
    is part of by rounding only, which impacts magnify. Ids beyond the library cannot raise errors
    inside a program; such worlds are not `ok`.

    Attributes:
      name: `mjx`.
      settle_steps: physics steps of 0.01 s in one call.
      num_slots: bodies that are simulated.
      shapes: of the user's own, with ids from 810.
    """

    name = "mjx"

    def __init__(
        self,
        settle_steps: int = scene.SETTLE_STEPS,
        num_slots: int = NUM_SLOTS,
        shapes: tuple[Shape, ...] = (),
    ) -> None:
        """
        Args:
          settle_steps: 1 to 100,000; 300 is the task's.
          num_slots: 2 to 12. Arrays have 12 rows whatever it is; with fewer slots, which is
            cheaper, worlds that use a body beyond them are not `ok`.
          shapes: of the user's own.

        Raises:
          ValueError: a number is out of its range.
          ImportError: another version of mujoco-mjx than this was written for.
        """
        check_settle_steps(settle_steps)
        if not 2 <= num_slots <= NUM_SLOTS:
            raise ValueError(f"num_slots={num_slots} must be 2 to {NUM_SLOTS}.")
        _mjx_private.check_version()
        self.settle_steps = settle_steps
        self.num_slots = num_slots
        self.shapes = shapes
        model = mujoco.MjModel.from_xml_string(_scene_text(num_slots))
        with _mjx_private.in_32_bits():
            self._model = _mjx_private.mjx.put_model(model, impl="jax")
            self._data = _mjx_private.mjx.make_data(model, impl="jax")
        self._jitted = jax.jit(self._settle_flat)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_jitted"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy has a program of its own, so that its `settle_steps` may be changed."""
        vars(self).update(state)
        self._jitted = jax.jit(self._settle_flat)

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        """Simulates `settle_steps` physics steps; arrays as in `engines.Engine.settle`.

        Raises:
          ValueError: arrays that do not fit together.
          TypeError: wrong dtypes.
        """
        check_state(shape_ids, qpos, qvel)
        batch = shape_ids.shape[:-1]
        state = (shape_ids, qpos, qvel)
        flat = [jnp.reshape(x, (math.prod(batch), *x.shape[len(batch) :])) for x in state]
        return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), self._jitted(*flat))

    def _settle_flat(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        # Accelerators would multiply matrices in less than f32.
        with _mjx_private.in_32_bits(), jax.default_matmul_precision("highest"):
            return jax.vmap(self._settle_one)(shape_ids, qpos, qvel)

    def _settle_one(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        n, is_unused = self.num_slots, (shape_ids < 0)[:, None]
        parked = jnp.asarray(scene.parked_qpos())
        start_qpos = jnp.where(is_unused, parked, qpos)
        start_qvel = jnp.where(is_unused, 0.0, qvel)
        end_qpos, end_qvel = self._simulated(shape_ids[:n], start_qpos[:n], start_qvel[:n])
        end_qpos = jnp.where(is_unused, parked, start_qpos.at[:n].set(end_qpos))
        end_qvel = jnp.where(is_unused, 0.0, start_qvel.at[:n].set(end_qvel))
        num_shapes = NUM_SHAPES + len(self.shapes)
        is_possible = (shape_ids < num_shapes).all() & is_unused[n:].all()
        ok = is_possible & is_plausible(start_qpos, start_qvel) & is_plausible(end_qpos, end_qvel)
        return Settled(jnp.where(ok, end_qpos, qpos), jnp.where(ok, end_qvel, qvel), ok)

    def _simulated(
        self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """One world from a cold start; arrays [num_slots, ...]."""
        step = partial(
            _step,
            mjx_pool.with_shapes(self._model, shape_ids, self.shapes),
            self._data,
            mjx_pool.pool(shape_ids, self.shapes),
        )
        start = (qpos.ravel(), qvel.ravel(), jnp.zeros(qvel.size))
        end = jax.lax.fori_loop(0, self.settle_steps, lambda _, state: step(state), start)
        return end[0].reshape(qpos.shape), end[1].reshape(qvel.shape)


_State = tuple[jax.Array, jax.Array, jax.Array]


def _step(model: Any, data: Any, pool: mjx_pool.Pool, state: _State) -> _State:
    """One physics step of qpos, qvel and the last accelerations, flat."""

    def find(data: Any) -> _mjx_private.Contacts:
        return mjx_pool.find_contacts(pool, data.xipos[1:], data.xmat[1:])

    qpos, qvel, acceleration = state
    data = data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=acceleration)
    data = _mjx_private.step(model, data, find)
    return data.qpos, data.qvel, data.qacc_warmstart


def _scene_text(num_slots: int) -> str:
    """A box stands for every shape, since MJX keeps room for four contacts of each two boxes."""
    inertial, box = scene.inertial_text(0), ['<geom type="box" size="0.1 0.1 0.1"/>']
    bodies = [
        scene.body_text(f"slot-{k}", inertial, box, qpos)
        for k, qpos in enumerate(scene.parked_qpos()[:num_slots])
    ]
    # Nothing here has damping, which Euler's method would invert the masses once more for.
    extra = (
        '<option jacobian="dense"><flag eulerdamp="disable"/></option>'
        f'<custom><numeric name="max_contact_points" data="{MAX_CONTACTS}"/></custom>'
    )
    return scene.scene_text(bodies, solver=SOLVER, extra=extra)
