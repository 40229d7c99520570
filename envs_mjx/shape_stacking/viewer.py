"""An interactive page of a tower: Brax's viewer with the shapes of the library.

Lengths are metres. Imports Brax, by its adapter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from envs_mjx import brax_adapter
from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.camera import TABLE_COLOR, TABLE_HALF_SIZES
from envs_mjx.shape_stacking.shapes import Shape, shape_library
from envs_mjx.shape_stacking.solids import ARCH_OPENING_RADIUS, CLASS_NAMES, solids

# Where a body waits for its first frame: above its first place, beyond the viewer's fog (60 m).
WAITING_HEIGHT = 70.0

_ARCH_SEGMENTS = 32

Geom = dict[str, Any]


def tower_html(
    shape_ids: jax.Array | np.ndarray,
    qpos: jax.Array | np.ndarray,
    seconds_per_frame: float = 0.5,
    shapes: tuple[Shape, ...] = (),
) -> str:
    """A page that plays the bodies of an episode; the mouse turns the view.

    Bodies are drawn as they collide in MuJoCo's C engine: spheres, capsules and cylinders as such,
    all others as the flat-sided hulls of the library. Only the arch, whose hull is a full box, is
    drawn with its opening, as in the agent's images. Between frames the viewer moves bodies evenly.
    A body that still waits for its turn comes down from the sky within one frame.

    Args:
      shape_ids: int32[12] shape of each body at the end, below 0 for unused ones: the last
        `Bodies.shape_ids` of an episode.
      qpos: f32[T, 12, 7] `Bodies.qpos` at each moment: position and quaternion (w, x, y, z). A body
        waits where it is at its place of `scene.parked_qpos`.
      seconds_per_frame: on the viewer's clock, s.
      shapes: of the user's own, with ids from 810.

    Returns:
      HTML text, to be written to a file. See `brax_adapter.render_page` for what it loads.

    Raises:
      ValueError: arrays that do not fit together or are not finite, unknown ids, no body at all, or
        a time that is not positive.
    """
    shape_ids, qpos = np.asarray(shape_ids), np.asarray(qpos)
    _check(shape_ids, qpos, seconds_per_frame, len(shape_library(shapes).s))
    slots = np.flatnonzero(shape_ids >= 0)
    geoms: dict[str, list[Geom]] = {"world": [_table()]}
    for link, slot in enumerate(slots):
        geom = body_geom(int(shape_ids[slot]), shapes) | {"link_idx": link}
        geoms[_body_name(int(slot), int(shape_ids[slot]), shapes)] = [geom]
    poses = np.stack([_with_waiting(int(slot), qpos[:, slot]) for slot in slots], axis=1)
    frames = [{"pos": p[:, :3].tolist(), "rot": p[:, 3:].tolist()} for p in poses]
    return brax_adapter.render_page(
        {"opt": {"timestep": float(seconds_per_frame)}, "geoms": geoms, "states": {"x": frames}}
    )


def body_geom(shape_id: int, shapes: tuple[Shape, ...] = ()) -> Geom:
    """What the viewer draws for a shape, in the axes of its body.

    Args:
      shape_id: of the library.
      shapes: of the user's own, with ids from 810.

    Returns:
      Brax's entry of a geometry without `link_idx`: `name` (`Sphere`, `Capsule`, `Cylinder` or
      `Mesh`), `pos`, `rot` (w, x, y, z), `rgba`, `size` (radius, half-length) and, of meshes,
      `vert` [n, 3] and `face` [m, 3], counter-clockwise seen from outside.
    """
    all_forms, form_of = scene.forms(shapes)
    form = all_forms[form_of[shape_id]]
    color = shape_library(shapes).color[shape_id]
    geom: Geom = {
        "name": form.kind.capitalize(),
        "pos": [0.0, 0.0, 0.0],
        "rot": [1.0, 0.0, 0.0, 0.0],
        "rgba": [*color.tolist(), 1.0],
        # Radius 1 and half-length 1 at s = 1.
        "size": [form.s, 0.0 if form.kind == "sphere" else form.s, 0.0],
    }
    if form.kind == "mesh":
        geom |= _mesh([form.s * polygon for polygon in _polygons(form.class_label)])
    return geom


def _check(
    shape_ids: np.ndarray, qpos: np.ndarray, seconds_per_frame: float, num_shapes: int
) -> None:
    num_slots = scene.NUM_SLOTS
    if shape_ids.shape != (num_slots,) or qpos.shape[1:] != (num_slots, 7) or not len(qpos):
        raise ValueError(
            f"shape_ids and qpos have the shapes {shape_ids.shape} and {qpos.shape}; give "
            f"({num_slots},) and (T, {num_slots}, 7) with at least one frame."
        )
    if (shape_ids >= num_shapes).any() or (shape_ids < 0).all():
        raise ValueError(
            f"shape_ids={shape_ids.tolist()}: give ids 0..{num_shapes - 1}, or below 0 for unused "
            "bodies, and at least one body."
        )
    if not np.isfinite(qpos[:, shape_ids >= 0]).all():
        raise ValueError("qpos holds numbers that are not finite; give the poses of a sound world.")
    if not 0.0 < seconds_per_frame < np.inf:
        raise ValueError(
            f"seconds_per_frame={seconds_per_frame} must be positive, for example 0.5."
        )


def _body_name(slot: int, shape_id: int, shapes: tuple[Shape, ...]) -> str:
    """Such as `02_cube_690`: the viewer lists bodies by it, and allows no blanks and no dots."""
    return f"{slot:02d}_{CLASS_NAMES[shape_library(shapes).class_labels[shape_id]]}_{shape_id}"


def _table() -> Geom:
    """The viewer's planes have whole sizes (MuJoCo's: half), and show their upper face only."""
    x, y = TABLE_HALF_SIZES
    return {
        "name": "Plane",
        "link_idx": -1,
        "pos": [0.0, 0.0, scene.TABLE_HEIGHT],
        "rot": [1.0, 0.0, 0.0, 0.0],
        "rgba": [*[TABLE_COLOR] * 3, 1.0],
        "size": [2.0 * x, 2.0 * y, 1.0],
    }


def _with_waiting(slot: int, poses: np.ndarray) -> np.ndarray:
    """f64[T, 7] poses of a body, with those at its parking place put above its first other one."""
    is_waiting = (poses == scene.parked_qpos()[slot]).all(axis=-1)
    poses = poses.astype(np.float64)
    first = poses[np.argmin(is_waiting)].copy()
    first[2] += WAITING_HEIGHT
    return np.where(is_waiting[:, None], first, poses)


def _polygons(class_label: int) -> list[np.ndarray]:
    """Convex faces f64[k, 3] of a flat-sided class at s = 1, counter-clockwise from outside."""
    solid = solids()[class_label]
    if solid.name == "arch":
        return _arch()
    assert solid.hull is not None
    return [solid.hull.vertices[list(face)] for face in solid.hull.faces]


def _arch() -> list[np.ndarray]:
    """The box (2, 1, 1) with its opening, cut into columns along x.

    The opening is drawn with 32 chords, which make it 0.2 % smaller.
    """
    angles = np.linspace(np.pi, 0.0, _ARCH_SEGMENTS + 1)
    x, z = ARCH_OPENING_RADIUS * np.cos(angles), ARCH_OPENING_RADIUS * np.sin(angles) - 1.0
    below = np.concatenate([[(-2.0, -1.0)], np.stack([x, z], axis=-1), [(2.0, -1.0)]])
    above = np.stack([below[:, 0], np.ones(len(below))], axis=-1)

    def sheet(corners: Sequence[np.ndarray], y: Sequence[float]) -> np.ndarray:
        return np.array([(x, depth, z) for (x, z), depth in zip(corners, y, strict=True)])

    front, back, across = (-1.0,) * 4, (1.0,) * 4, (-1.0, -1.0, 1.0, 1.0)
    faces = []
    for i in range(len(below) - 1):
        a, b, c, d = below[i], below[i + 1], above[i + 1], above[i]
        faces += [
            sheet((a, b, c, d), front),
            sheet((d, c, b, a), back),
            sheet((b, a, a, b), across),
            sheet((d, c, c, d), across),
        ]
    faces.append(sheet((below[0], above[0], above[0], below[0]), across))
    faces.append(sheet((above[-1], below[-1], below[-1], above[-1]), across))
    return faces


def _mesh(polygons: Sequence[np.ndarray]) -> Geom:
    """Triangles of convex polygons. They share no corner, so that the viewer keeps the edges."""
    starts = np.cumsum([0, *map(len, polygons)])
    faces = [
        [int(start), int(start) + i, int(start) + i + 1]
        for start, polygon in zip(starts, polygons, strict=False)
        for i in range(1, len(polygon) - 1)
    ]
    return {"vert": np.concatenate(polygons).tolist(), "face": faces}
