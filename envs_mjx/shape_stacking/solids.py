"""The sixteen classes of shapes at s = 1: what each is, before scale and yaw.

Axes are a shape's own, the origin is its body's position, lengths are metres. NumPy only. See
docs/shape_stacking.md, "Solids".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from envs_mjx.shape_stacking import moments
from envs_mjx.shape_stacking.moments import Moments
from envs_mjx.shape_stacking.polyhedra import Polyhedron, box, prism, pyramid

# The order of the machine that wrote the published splits (docs/shape_stacking.md, "Ids").
CLASS_NAMES = (
    "middle_triangle",
    "hat",
    "triangle",
    "tall_triangle",
    "horizontal_rectangle",
    "dome",
    "cone-hires",
    "cone",
    "tetrahedron",
    "arch",
    "rectangle",
    "half_rectangle",
    "cube",
    "sphere",
    "capsule",
    "cylinder",
)
NUM_CLASSES = len(CLASS_NAMES)

ARCH_OPENING_RADIUS = 1.25
DOME_AXIS_HEIGHT = -0.5

_SQRT2 = float(np.sqrt(2.0))
_ROUND_SEGMENTS = 12
_DOME_SEGMENTS = 8
_BOX_HALF_SIZES = {
    "horizontal_rectangle": (2.0, 1.0, 1.0),
    "arch": (2.0, 1.0, 1.0),
    "rectangle": (1.0, 1.0, 2.0),
    "half_rectangle": (2.0, 1.0, 0.5),
    "cube": (1.0, 1.0, 1.0),
}
# Corners of the cross-section and the axis of the prism (0 = x, 1 = y).
_WEDGES = {
    "middle_triangle": ([(-1.0, -1.0), (1.0, -1.0), (0.0, 1.0)], 1),
    "hat": ([(-_SQRT2, 0.0), (_SQRT2, 0.0), (0.0, _SQRT2)], 0),
    "triangle": ([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)], 1),
    "tall_triangle": ([(-1.0, -2.0), (1.0, -2.0), (-1.0, 2.0)], 1),
}
_SQUARE = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
# What MuJoCo 4.0 finds for the original meshes.
_BOUNDING_RADII = {
    "middle_triangle": 1.943,
    "hat": 1.969,
    "triangle": 1.972,
    "tall_triangle": 3.096,
    "horizontal_rectangle": 2.449,
    "dome": 1.538,
    "cone-hires": 2.080,
    "cone": 2.079,
    "tetrahedron": 2.42,
    "arch": 2.498,
    "rectangle": 2.449,
    "half_rectangle": 2.291,
    "cube": 1.732,
    "sphere": 1.0,
    "capsule": 2.0,
    "cylinder": 1.414,
}
_HEIGHTS_WITHOUT_HULL = {"sphere": 1.0, "capsule": 2.0}


@dataclass(frozen=True)
class Solid:
    """One class of shapes at s = 1.

    Attributes:
      name: of `CLASS_NAMES`.
      base, top: lowest and highest z.
      bounding_radius: what the drop rule adds to heights; a constant of the original
        meshes, not of this solid.
      moments: of the true solid. Round sides are round, and the arch has its opening.
      hull: what the physics collides: the convex hull, flat-sided (12-gons of equal area for
        cylinder and cone, 8 chords for the dome's arc), a full box for the arch. None for sphere
        and capsule.
    """

    name: str
    base: float
    top: float
    bounding_radius: float
    moments: Moments
    hull: Polyhedron | None


@lru_cache(maxsize=1)
def solids() -> tuple[Solid, ...]:
    """All classes in the order of `CLASS_NAMES`."""
    return tuple(_solid(name) for name in CLASS_NAMES)


def flat_sided(name: str) -> Polyhedron | None:
    """The polyhedron that a class is (the arch: is cut from), or None if it has round sides."""
    if name in _BOX_HALF_SIZES:
        return box(_BOX_HALF_SIZES[name])
    if name in _WEDGES:
        section, axis = _WEDGES[name]
        return prism(np.array(section), axis)
    if name == "tetrahedron":
        return pyramid(np.array(_SQUARE))
    return None


def _solid(name: str) -> Solid:
    hull = _hull(name)
    if hull is None:
        top = _HEIGHTS_WITHOUT_HULL[name]
        base = -top
    else:
        base, top = float(hull.vertices[:, 2].min()), float(hull.vertices[:, 2].max())
    return Solid(name, base, top, _BOUNDING_RADII[name], _moments(name, hull), hull)


def _hull(name: str) -> Polyhedron | None:
    if name == "dome":
        return prism(_arc(), axis=1)
    if name in ("cone", "cone-hires"):
        return pyramid(_equal_area_polygon())
    if name == "cylinder":
        return prism(_equal_area_polygon(), axis=2)
    return flat_sided(name)


def _moments(name: str, hull: Polyhedron | None) -> Moments:
    if name == "arch":
        opening = moments.half_cylinder(ARCH_OPENING_RADIUS).raised(-1.0)
        return moments.polyhedron(box(_BOX_HALF_SIZES["arch"])) - opening
    if name == "dome":
        return moments.half_cylinder(1.0).raised(DOME_AXIS_HEIGHT)
    if name in ("cone", "cone-hires"):
        return moments.cone()
    round_ones = {
        "cylinder": moments.cylinder,
        "sphere": moments.sphere,
        "capsule": moments.capsule,
    }
    if name in round_ones:
        return round_ones[name]()
    assert hull is not None
    return moments.polyhedron(hull)


def _equal_area_polygon() -> np.ndarray:
    """f64[12, 2] corners of the regular 12-gon with the area of the unit circle.

    Its area is 6 R^2 sin(30 degrees) = 3 R^2, so R = sqrt(pi / 3) = 1.023.
    """
    angles = 2.0 * np.pi * np.arange(_ROUND_SEGMENTS) / _ROUND_SEGMENTS
    return np.sqrt(np.pi / 3.0) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _arc() -> np.ndarray:
    """f64[9, 2] corners (x, z) on the dome's arc, both ends and the summit included."""
    angles = np.linspace(0.0, np.pi, _DOME_SEGMENTS + 1)
    return np.stack([np.cos(angles), np.sin(angles) + DOME_AXIS_HEIGHT], axis=-1)
