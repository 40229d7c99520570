"""Draws scenes of shapes with MuJoCo's own renderer; run as `python -m`, since it needs GL.

Reads scenes as JSON from standard input and writes their pictures as an .npz file. A scene has
`shapes`, rows of (id, position, quaternion), `has_table`, `has_shadows` and `cameras`, rows of
(position, right, up).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import sys
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from envs_mjx.shape_stacking import shape_library
from envs_mjx.shape_stacking.solids import CLASS_NAMES

SIDES = (-1.0, 1.0)
WEDGES = {
    "middle_triangle": ([(-1, -1), (1, -1), (0, 1)], 1),
    "hat": ([(-(2**0.5), 0), (2**0.5, 0), (0, 2**0.5)], 0),
    "triangle": ([(-1, -1), (1, -1), (-1, 1)], 1),
    "tall_triangle": ([(-1, -2), (1, -2), (-1, 2)], 1),
}
BOXES = {
    "horizontal_rectangle": (2, 1, 1),
    "rectangle": (1, 1, 2),
    "half_rectangle": (2, 1, 0.5),
    "cube": (1, 1, 1),
}


def pieces(name: str) -> list[np.ndarray]:
    """Corners of convex pieces that make up a class at s = 1, round sides in many chords."""
    turn, half_turn = np.linspace(0, 2 * np.pi, 97)[:-1], np.linspace(0, np.pi, 97)
    if name in BOXES:
        return [np.array(list(itertools.product(SIDES, repeat=3))) * BOXES[name]]
    if name in WEDGES:
        section, axis = WEDGES[name]
        return [np.array([np.insert(corner, axis, y) for corner in section for y in SIDES], float)]
    if name == "tetrahedron":
        return [np.array([*itertools.product(SIDES, SIDES, (-1.0,)), (0, 0, 1)])]
    if name in ("cone", "cone-hires"):
        return [np.array([*((np.cos(a), np.sin(a), -1) for a in turn), (0, 0, 1)])]
    if name == "dome":
        return [np.array([(np.cos(a), y, np.sin(a) - 0.5) for a in half_turn for y in SIDES])]
    arc = [(1.25 * np.cos(a), 1.25 * np.sin(a) - 1) for a in half_turn]
    pairs = [((2, -1), (1.25, -1)), *itertools.pairwise(arc), ((-1.25, -1), (-2, -1))]
    return [
        np.array([(x, y, z) for x, low in pair for z in (low, 1) for y in SIDES]) for pair in pairs
    ]


def faces(points: np.ndarray) -> list[int]:
    hull = ConvexHull(points)
    indices: list[int] = []
    for corners, plane in zip(hull.simplices, hull.equations, strict=True):
        a, b, c = points[corners]
        is_outward = np.cross(b - a, c - a) @ plane[:3] > 0
        indices += list(corners if is_outward else corners[::-1])
    return indices


def text(values: Any) -> str:
    return " ".join(str(value) for value in np.ravel(values))


def scene_xml(scene: dict[str, Any]) -> str:
    """Table, colours, camera and lights of the task as a model; one picture element per pixel."""
    library, assets, world = shape_library(), "", ""
    for k, (i, position, quaternion) in enumerate(scene["shapes"]):
        name, s = CLASS_NAMES[library.class_labels[i]], library.s[i]
        look = f"material='shape' rgba='{text(library.color[i])} 1'"
        geoms = ""
        if name in ("sphere", "capsule", "cylinder"):
            geoms = f"<geom type='{name}' size='{s} {s}' {look}/>"
        else:
            for j, points in enumerate(pieces(name)):
                assets += f"<mesh name='{k}-{j}' inertia='exact' vertex='{text(s * points)}' "
                assets += f"face='{text(faces(points))}'/>"
                geoms += f"<geom type='mesh' mesh='{k}-{j}' {look}/>"
        world += f"<body pos='{text(position)}' quat='{text(quaternion)}'>{geoms}</body>"
    if scene["has_table"]:
        world += "<geom type='plane' pos='0 0 -.5' size='4 2 .1' rgba='.9 .9 .9 1'/>"
    for k, (position, right, up) in enumerate(scene["cameras"]):
        axes = text([*right, *up])
        world += f"<camera name='{k}' pos='{text(position)}' xyaxes='{axes}' fovy='45'/>"
    for z in (4, 1):
        world += f"<light type='spot' pos='0 4 {z}' dir='0 -1 0' diffuse='1.5 1.5 1.5'/>"
    return (
        "<mujoco><visual><quality offsamples='0'/></visual><asset>"
        f"<material name='shape' emission='.25' specular='0' shininess='0'/>{assets}</asset>"
        f"<worldbody>{world}</worldbody></mujoco>"
    )


def main() -> None:
    import mujoco

    pictures = {}
    for k, scene in enumerate(json.load(sys.stdin)):
        model = mujoco.MjModel.from_xml_string(scene_xml(scene))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer = mujoco.Renderer(model, 84, 84)
        for j in range(len(scene["cameras"])):
            renderer.update_scene(data, str(j))
            flags = renderer.scene.flags
            flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene["has_shadows"]
            flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
            pictures[f"{k}-{j}"] = renderer.render().copy()
        # Two contexts at once would mix their pictures; closing the last fails on some machines.
        with contextlib.suppress(Exception):
            renderer.close()
    np.savez(sys.argv[1], **pictures)
    os._exit(0)


if __name__ == "__main__":
    main()
