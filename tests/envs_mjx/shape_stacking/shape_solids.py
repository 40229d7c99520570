"""Shape Stacking's solids as NumPy knows them, by the table of docs/shape_stacking.md, "Solids".

Each is a function that is negative inside, zero on the surface and positive outside.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Outside = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

SQRT2 = float(np.sqrt(2.0))


def box(half_x: float, half_y: float, half_z: float) -> Outside:
    return lambda x, y, z: most(np.abs(x) - half_x, np.abs(y) - half_y, np.abs(z) - half_z)


def cone(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return most(np.hypot(x, y) - (1 - z) / 2, -1 - z)


def most(*values: np.ndarray) -> np.ndarray:
    """Inside of all: the largest of the values decides."""
    return np.max(np.broadcast_arrays(*values), axis=0)


# name: (half-sizes of a box around the origin that holds the solid, the function).
SOLIDS: dict[str, tuple[tuple[float, float, float], Outside]] = {
    "middle_triangle": (
        (1, 1, 1),
        lambda x, y, z: most(z - 1 + 2 * np.abs(x), np.abs(y) - 1, -1 - z),
    ),
    "hat": (
        (1, SQRT2, SQRT2),
        lambda x, y, z: most(np.abs(x) - 1, -z, z + np.abs(y) - SQRT2),
    ),
    "triangle": ((1, 1, 1), lambda x, y, z: most(x + z, -1 - x, np.abs(y) - 1, -1 - z)),
    "tall_triangle": ((1, 1, 2), lambda x, y, z: most(2 * x + z, -1 - x, np.abs(y) - 1, -2 - z)),
    "horizontal_rectangle": ((2, 1, 1), box(2, 1, 1)),
    "dome": (
        (1, 1, 0.5),
        lambda x, y, z: most(np.abs(y) - 1, np.hypot(x, z + 0.5) - 1, -0.5 - z),
    ),
    "cone-hires": ((1, 1, 1), cone),
    "cone": ((1, 1, 1), cone),
    "tetrahedron": (
        (1, 1, 1),
        lambda x, y, z: most(-1 - z, np.abs(x) - (1 - z) / 2, np.abs(y) - (1 - z) / 2),
    ),
    "arch": (
        (2, 1, 1),
        lambda x, y, z: most(box(2, 1, 1)(x, y, z), 1.25 - np.hypot(x, z + 1)),
    ),
    "rectangle": ((1, 1, 2), box(1, 1, 2)),
    "half_rectangle": ((2, 1, 0.5), box(2, 1, 0.5)),
    "cube": ((1, 1, 1), box(1, 1, 1)),
    "sphere": ((1, 1, 1), lambda x, y, z: np.sqrt(x**2 + y**2 + z**2) - 1),
    "capsule": (
        (1, 1, 2),
        lambda x, y, z: np.sqrt(x**2 + y**2 + np.maximum(np.abs(z) - 1, 0) ** 2) - 1,
    ),
    "cylinder": ((1, 1, 1), lambda x, y, z: most(np.hypot(x, y) - 1, np.abs(z) - 1)),
}
