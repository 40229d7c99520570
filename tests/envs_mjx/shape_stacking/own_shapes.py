"""Shapes of a user's own, and worlds in which shapes rest; for several test modules."""

from __future__ import annotations

import math

import numpy as np

from envs_mjx.shape_stacking import Shape, scene, shape_library
from envs_mjx.shape_stacking.solids import CLASS_NAMES

PUBLISHED = (77, 500, 690, 735, 764)  # A turned hat, an arch, a cube, a sphere, a capsule.


def copy_of(shape_id: int) -> Shape:
    library = shape_library()
    return Shape(
        CLASS_NAMES[library.class_labels[shape_id]],
        float(library.s[shape_id]),
        math.degrees(library.yaw[shape_id]),
        tuple(map(float, library.color[shape_id])),
    )


CUBE = Shape("cube", 0.25, 33.0, (0.5, 0.125, 0.25))
OWN = (
    *map(copy_of, PUBLISHED),
    CUBE,
    Shape("cube", 0.25, 0.0, (1.0, 1.0, 1.0)),
    Shape("cylinder", 0.3, 0.0, (0.2, 0.4, 0.6)),
)
COPIES = np.arange(810, 815)
TURNED, STRAIGHT, CYLINDER = 815, 816, 817
NUM_SHAPES = 818


def resting(
    ids: np.ndarray, shapes: tuple[Shape, ...] = OWN
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Worlds of one shape each, upright with its yaw, 1 mm above the table."""
    library, count = shape_library(shapes), len(ids)
    shape_ids = np.full((count, 12), -1, np.int32)
    qpos = np.tile(scene.parked_qpos(), (count, 1, 1))
    inside = np.minimum(ids, len(library.s) - 1)
    shape_ids[:, 1] = ids
    qpos[:, 1, :2] = 0.0
    qpos[:, 1, 2] = scene.TABLE_HEIGHT - library.base[inside] + 0.001
    qpos[:, 1, 3:] = library.quaternion[inside]
    return shape_ids, qpos, np.zeros((count, 12, 6), np.float32)
