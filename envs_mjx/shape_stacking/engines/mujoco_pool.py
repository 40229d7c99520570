"""Compiled MuJoCo models of the scene, and worlds that share one of them.

A compiled model cannot give a geom another type, so a body of the pool holds four geoms: sphere,
capsule, cylinder and mesh. In each world at most one of the four collides; the others have their
collision bits off. All hulls of the library are assets of the one model, and a world's mesh geom
points at the hull that it needs. `shapes` are those of the user's own, with ids from 810.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.scene import NUM_SLOTS, PRIMITIVES
from envs_mjx.shape_stacking.shapes import Shape

GEOM_KINDS = (*PRIMITIVES, "mesh")

_BODY_FIELDS = (
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_invweight0",
)
_GEOM_FIELDS = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb")
_COLLISION_BITS = ("geom_contype", "geom_conaffinity")

# Contacts and their constraint rows live there; if it were full, the engine would say so.
_MEMORY = '<size memory="16M"/>'


def _options(has_multiple_contacts: bool) -> str:
    # The mid-phase would search trees of the geoms as compiled, not as a world has them.
    multiccd = "enable" if has_multiple_contacts else "disable"
    return f'{_MEMORY}<option><flag midphase="disable" multiccd="{multiccd}"/></option>'


@lru_cache(maxsize=4)
def pool_model(
    has_multiple_contacts: bool = False, shapes: tuple[Shape, ...] = ()
) -> mujoco.MjModel:
    """The model behind all worlds: the table, twelve bodies of four geoms, every hull."""
    forms, _ = scene.forms(shapes)
    # Its centre of mass is not its origin; for bodies that are centred the compiler takes
    # shortcuts, which the other shapes of a slot could not follow.
    example = next(form for form in forms if form.kind == "mesh")
    geoms = [f'<geom type="{kind}" size="0.1 0.1"/>' for kind in PRIMITIVES]
    geoms.append(scene.geom_text(example))
    inertial = scene.inertial_text(example.shape_id)
    bodies = [
        scene.body_text(f"slot-{k}", inertial, geoms, qpos)
        for k, qpos in enumerate(scene.parked_qpos())
    ]
    return _compiled(bodies, _hulls(forms), has_multiple_contacts)


def catalogue_model(shapes: tuple[Shape, ...] = ()) -> mujoco.MjModel:
    """Every form as a free body with its one geom; form k is body k + 1 and geom k + 1."""
    forms, _ = scene.forms(shapes)
    origin = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    bodies = [
        scene.body_text(
            form.name, scene.inertial_text(form.shape_id, shapes), [scene.geom_text(form)], origin
        )
        for form in forms
    ]
    return _compiled(bodies, _hulls(forms), False)


def world_model(shape_ids: np.ndarray, has_multiple_contacts: bool = False) -> mujoco.MjModel:
    """One world as a model of its own, which the pool stands for.

    Args:
      shape_ids: int[12] below 0 for unused bodies, which have no geom.
      has_multiple_contacts: as in `MujocoC`.
    """
    forms, form_of = scene.forms()
    chosen = [forms[form_of[i]] if i >= 0 else None for i in shape_ids]
    bodies = [
        scene.body_text(
            f"slot-{k}",
            scene.inertial_text(form.shape_id if form else 0),
            [scene.geom_text(form)] if form else [],
            qpos,
        )
        for k, (form, qpos) in enumerate(zip(chosen, scene.parked_qpos(), strict=True))
    ]
    needed = tuple(dict.fromkeys(form for form in chosen if form))
    return _compiled(bodies, _hulls(needed), has_multiple_contacts)


def _hulls(forms: tuple[scene.Form, ...]) -> list[str]:
    return [scene.hull_text(form) for form in forms if form.kind == "mesh"]


def _compiled(bodies: list[str], assets: list[str], has_multiple_contacts: bool) -> mujoco.MjModel:
    text = scene.scene_text(bodies, assets, extra=_options(has_multiple_contacts))
    return mujoco.MjModel.from_xml_string(text)


@lru_cache(maxsize=4)
def _slot_values(shapes: tuple[Shape, ...]) -> dict[str, np.ndarray]:
    """What a slot's rows of each field are, per form: {field: [forms + 1, rows, ...]}.

    The last entry is the unused body: as form 0, but nothing collides.
    """
    catalogue, pool = catalogue_model(shapes), pool_model(False, shapes)
    forms, _ = scene.forms(shapes)
    used = np.array([GEOM_KINDS.index(form.kind) for form in forms])
    is_used = used[:, None] == np.arange(len(GEOM_KINDS))
    values = {name: getattr(catalogue, name)[1:, None] for name in _BODY_FIELDS}
    values["dof_invweight0"] = catalogue.dof_invweight0.reshape(len(forms), 6)
    for name in _GEOM_FIELDS:
        rows = np.repeat(getattr(pool, name)[None, 1 : 1 + len(GEOM_KINDS)], len(forms), axis=0)
        rows[is_used] = getattr(catalogue, name)[1:]
        values[name] = rows
    values |= {name: is_used.astype(np.int32) for name in _COLLISION_BITS}
    values = {name: np.concatenate([rows, rows[:1]]) for name, rows in values.items()}
    for name in _COLLISION_BITS:
        values[name][-1] = 0
    return values


@contextlib.contextmanager
def _no_log() -> Iterator[None]:
    """Keeps MuJoCo from writing its warnings into a file of the working directory.

    They are counted all the same. The handler belongs to the process, as does the log.
    """
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


class Worlds:
    """Scratch space for up to `capacity` worlds; a run overwrites all that its results hang on."""

    def __init__(
        self,
        capacity: int,
        num_threads: int,
        has_multiple_contacts: bool,
        shapes: tuple[Shape, ...] = (),
    ) -> None:
        self._made_of = capacity, num_threads, has_multiple_contacts, shapes
        self._values = _slot_values(shapes)
        _, self._form_of = scene.forms(shapes)
        model = pool_model(has_multiple_contacts, shapes)
        self._batch = mujoco_batch.Batch(model, capacity, num_threads)
        self._fields = {name: self._batch.expand(name) for name in self._values}
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._warmstart = self._batch.bind("qacc_warmstart")

    def __reduce__(self) -> tuple[type[Worlds], tuple[Any, ...]]:
        return Worlds, self._made_of

    def run(
        self, shape_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, num_steps: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps at most `capacity` worlds from a cold start.

        Args:
          shape_ids: int[n, 12] below 0 for unused bodies.
          qpos: f64[n, 12, 7].
          qvel: f64[n, 12, 6].
          num_steps: physics steps.

        Returns:
          qpos and qvel after them, and bool[n]: the engine had nothing to complain of. Where it
          had (numbers that are not finite, a full arena), the state means nothing.
        """
        count = len(shape_ids)
        self._set_shapes(shape_ids)
        self._warmstart[:count] = 0.0
        self._qpos[:count] = qpos.reshape(count, -1)
        self._qvel[:count] = qvel.reshape(count, -1)
        self._batch.warning[:count] = 0
        failed: list[int] = []
        try:
            with _no_log():
                if count:
                    self._batch.step(np.arange(count), nstep=num_steps)
        except mujoco_batch.SimulationError as err:
            failed = list(err.ids)
        ran = ~self._batch.warning[:count].reshape(count, -1).any(axis=1)
        ran[failed] = False
        return (
            self._qpos[:count].reshape(count, NUM_SLOTS, 7),
            self._qvel[:count].reshape(count, NUM_SLOTS, 6),
            ran,
        )

    def model(self, index: int) -> mujoco.MjModel:
        """The model of one world as the last run had it."""
        return self._batch.get_model(index)

    def _set_shapes(self, shape_ids: np.ndarray) -> None:
        """Gives the first `len(shape_ids)` worlds their shapes."""
        selected = np.where(shape_ids < 0, -1, self._form_of[shape_ids])
        for name, values in self._values.items():
            field, rows = self._fields[name], values[selected]  # [n, 12, rows of a slot, ...].
            num_fixed = field.shape[1] - NUM_SLOTS * rows.shape[2]  # Of the world and the table.
            field[: len(selected), num_fixed:] = rows.reshape(len(selected), -1, *rows.shape[3:])
