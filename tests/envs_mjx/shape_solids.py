"""Shape Stacking's solids as NumPy knows them, written from the spec's table (2.2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Inside = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

SQRT2 = float(np.sqrt(2.0))

# name: (half-sizes of a box around the origin that holds the solid, is (x, y, z) inside).
SOLIDS: dict[str, tuple[tuple[float, float, float], Inside]] = {
    "middle_triangle": ((1, 1, 1), lambda x, y, z: (z <= 1 - 2 * np.abs(x)) & _slab(y, z)),
    "hat": (
        (1, SQRT2, SQRT2),
        lambda x, y, z: (np.abs(x) <= 1) & (z >= 0) & (z + np.abs(y) <= SQRT2),
    ),
    "triangle": ((1, 1, 1), lambda x, y, z: (x + z <= 0) & (x >= -1) & _slab(y, z)),
    "tall_triangle": (
        (1, 1, 2),
        lambda x, y, z: (2 * x + z <= 0) & (x >= -1) & (np.abs(y) <= 1) & (z >= -2),
    ),
    "horizontal_rectangle": ((2, 1, 1), lambda x, y, z: _box(x, y, z, 2, 1, 1)),
    "dome": (
        (1, 1, 0.5),
        lambda x, y, z: (np.abs(y) <= 1) & (x**2 + (z + 0.5) ** 2 <= 1) & (z >= -0.5),
    ),
    "cone-hires": ((1, 1, 1), lambda x, y, z: _cone(x, y, z)),
    "cone": ((1, 1, 1), lambda x, y, z: _cone(x, y, z)),
    "tetrahedron": (
        (1, 1, 1),
        lambda x, y, z: (z >= -1) & (np.maximum(np.abs(x), np.abs(y)) <= (1 - z) / 2),
    ),
    "arch": (
        (2, 1, 1),
        lambda x, y, z: _box(x, y, z, 2, 1, 1) & (x**2 + (z + 1) ** 2 >= 1.25**2),
    ),
    "rectangle": ((1, 1, 2), lambda x, y, z: _box(x, y, z, 1, 1, 2)),
    "half_rectangle": ((2, 1, 0.5), lambda x, y, z: _box(x, y, z, 2, 1, 0.5)),
    "cube": ((1, 1, 1), lambda x, y, z: _box(x, y, z, 1, 1, 1)),
    "sphere": ((1, 1, 1), lambda x, y, z: x**2 + y**2 + z**2 <= 1),
    "capsule": (
        (1, 1, 2),
        lambda x, y, z: x**2 + y**2 + np.maximum(np.abs(z) - 1, 0) ** 2 <= 1,
    ),
    "cylinder": ((1, 1, 1), lambda x, y, z: (x**2 + y**2 <= 1) & (np.abs(z) <= 1)),
}


def _box(x: np.ndarray, y: np.ndarray, z: np.ndarray, *half: float) -> np.ndarray:
    return (np.abs(x) <= half[0]) & (np.abs(y) <= half[1]) & (np.abs(z) <= half[2])


def _slab(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return (np.abs(y) <= 1) & (z >= -1)


def _cone(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return (np.hypot(x, y) <= (1 - z) / 2) & (z >= -1)
