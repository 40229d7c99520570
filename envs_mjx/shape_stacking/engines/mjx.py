"""MJX's JAX backend: inside the program, on any device; shapes are data (spec 11.2)."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.engines import Settled, _mjx_pool, _mjx_private, check_state
from envs_mjx.shape_stacking.engines._limits import is_plausible
from envs_mjx.shape_stacking.engines._mjx_pool import Limits
from envs_mjx.shape_stacking.scene import NUM_SLOTS
from envs_mjx.shape_stacking.shapes import NUM_SHAPES


class Mjx:
    """The engine of accelerators; see `engines.Engine` for what it promises."""

    name = "mjx"

    def __init__(
        self,
        settle_steps: int = scene.SETTLE_STEPS,
        num_slots: int = NUM_SLOTS,
        max_contacts: int = 48,
        solver: scene.Solver | None = None,
        limits: Limits | None = None,
        jacobian: str = "dense",
    ) -> None:
        if settle_steps < 1:
            raise ValueError(f"settle_steps={settle_steps} must be at least 1.")
        self.settle_steps = settle_steps
        self.num_slots = num_slots
        self._limits = limits or Limits()
        solver = solver or scene.Solver(iterations=8, ls_iterations=12)
        text = _scene_text(num_slots, solver, max_contacts, jacobian)
        model = mujoco.MjModel.from_xml_string(text)
        _mjx_private.check_version()
        self._model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        check_state(shape_ids, qpos, qvel)
        batch = shape_ids.shape[:-1]
        count = math.prod(batch)
        with jax.default_matmul_precision("highest"):
            if not batch:
                return self._settle_one(*map(jnp.asarray, (shape_ids, qpos, qvel)))
            flat = (jnp.reshape(x, (count, *x.shape[len(batch) :])) for x in (shape_ids, qpos, qvel))
            settled = jax.vmap(self._settle_one)(*flat)
        return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), settled)

    def _settle_one(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        is_unused = (shape_ids < 0)[:, None]
        parked = jnp.asarray(scene.parked_qpos())
        start_qpos = jnp.where(is_unused, parked, qpos)
        start_qvel = jnp.where(is_unused, 0.0, qvel)
        n = self.num_slots
        end_qpos, end_qvel = self._simulated(shape_ids[:n], start_qpos[:n], start_qvel[:n])
        end_qpos = jnp.where(is_unused, parked, start_qpos.at[:n].set(end_qpos))
        end_qvel = jnp.where(is_unused, 0.0, start_qvel.at[:n].set(end_qvel))
        is_possible = (shape_ids < NUM_SHAPES).all() & is_unused[n:].all()
        ok = is_possible & is_plausible(start_qpos, start_qvel) & is_plausible(end_qpos, end_qvel)
        return Settled(jnp.where(ok, end_qpos, qpos), jnp.where(ok, end_qvel, qvel), ok)

    def _simulated(
        self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        model = _mjx_pool.with_shapes(self._model, shape_ids)
        pool = _mjx_pool.pool(shape_ids)

        def find(data: Any) -> _mjx_private.Contacts:
            return _mjx_pool.find_contacts(pool, self._limits, data.xipos[1:], data.xmat[1:])

        def step(_: int, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            names = ("qpos", "qvel", "qacc_warmstart")
            data = self._data.replace(**dict(zip(names, state, strict=True)))
            data = _mjx_private.step(model, data, find)
            return tuple(getattr(data, name) for name in names)

        start = (qpos.ravel(), qvel.ravel(), jnp.zeros(qvel.size))
        end = jax.lax.fori_loop(0, self.settle_steps, step, start)
        return end[0].reshape(qpos.shape), end[1].reshape(qvel.shape)


def _scene_text(num_slots: int, solver: scene.Solver, max_contacts: int, jacobian: str) -> str:
    """Boxes stand for all shapes, since MJX keeps room for four contacts of each two of them."""
    inertial = scene.inertial_text(0)
    bodies = [
        scene.body_text(f"slot-{k}", inertial, ['<geom type="box" size="0.1 0.1 0.1"/>'], qpos)
        for k, qpos in enumerate(scene.parked_qpos()[:num_slots])
    ]
    extra = (
        f'<option jacobian="{jacobian}"><flag eulerdamp="disable"/></option>'
        f'<custom><numeric name="max_contact_points" data="{max_contacts}"/></custom>'
    )
    return scene.scene_text(bodies, solver=solver, extra=extra)
