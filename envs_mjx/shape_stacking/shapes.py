"""The 810 shapes, and a user's own: sixteen solids in many sizes, turned about the vertical.

See docs/shape_stacking.md, "Ids", "Solids", "Radius and mass", "Shapes of one's own". NumPy only.
"""

from __future__ import annotations

import colorsys
import csv
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from envs_mjx.shape_stacking.hulls import HullTable, hull_table
from envs_mjx.shape_stacking.solids import CLASS_NAMES, NUM_CLASSES, Solid, solids
from jaxnew.actions import ActionUniverse, read_text

DENSITY = 1000.0
# The published ones, whose ids come first.
NUM_SHAPES = 810
# Of a user's own shapes; the published ones have 0.08 to 0.64 m.
SCALES_M = (0.01, 1.0)
MAX_SHAPES = 10_000  # In a file.
FILE_HEADER = ("solid", "scale", "yaw_deg", "red", "green", "blue")
_FILE_LINE = "cube,0.25,33,0.9,0.2,0.1"

_SCALE_FACTOR = 0.8
_COLOR_SEED = 42
# Hue, saturation, value, then x and y of a parking place that nothing here uses.
_DRAW_LOW = (0.0, 0.5, 0.5, -0.5, -0.5)
_DRAW_HIGH = (1.0, 1.0, 1.0, 0.5, 0.0)


@dataclass(frozen=True)
class _Family:
    """The shapes of one class: evenly spaced scale values, ends included, times angles from 0.

    Attributes:
      scales: first and last scale value.
      num_scales: how many.
      turn: upper end of the angles, excluded, rad.
      num_angles: how many.
    """

    scales: tuple[float, float]
    num_scales: int
    turn: float = 0.0
    num_angles: int = 1


# In the order of `CLASS_NAMES`.
_FAMILIES = (
    _Family((0.1, 0.5), 6, math.pi, 10),
    _Family((0.1, 0.5), 6, math.pi, 10),
    _Family((0.1, 0.5), 6, 2.0 * math.pi, 10),
    _Family((0.1, 0.3), 6, 2.0 * math.pi, 10),
    _Family((0.1, 0.5), 6, math.pi, 10),
    _Family((0.2, 0.6), 6, math.pi, 10),
    _Family((0.1, 0.6), 30),
    _Family((0.1, 0.6), 30),
    _Family((0.1, 0.6), 10, math.pi / 4.0, 6),
    _Family((0.1, 0.5), 6, math.pi, 10),
    _Family((0.1, 0.3), 10, math.pi, 6),
    _Family((0.1, 0.6), 10, math.pi, 6),
    _Family((0.1, 0.6), 10, math.pi / 4.0, 6),
    _Family((0.1, 0.8), 30),
    _Family((0.1, 0.4), 30),
    _Family((0.1, 0.6), 30),
)


@dataclass(frozen=True)
class Shape:
    """A shape of the user's own: one of the sixteen solids in any size, yaw and colour.

    Attributes:
      solid: one of `solids.CLASS_NAMES`.
      scale: s, m, 0.01 to 1: every length of the solid at s = 1 is multiplied by it.
      yaw_deg: rotation about the vertical, degrees, -360 to 360.
      color: red, green and blue in [0, 1].

    Raises:
      ValueError: a value is none of what is allowed.
    """

    solid: str
    scale: float
    yaw_deg: float
    color: tuple[float, float, float]

    def __post_init__(self) -> None:
        if self.solid not in CLASS_NAMES:
            raise ValueError(f"solid={self.solid!r} is unknown; choose from {CLASS_NAMES}.")
        low, high = SCALES_M
        if not low <= self.scale <= high:
            raise ValueError(f"scale={self.scale} must be {low} to {high} m.")
        if not -360.0 <= self.yaw_deg <= 360.0:
            raise ValueError(f"yaw_deg={self.yaw_deg} must be -360 to 360 degrees.")
        if len(self.color) != 3 or not all(0.0 <= value <= 1.0 for value in self.color):
            raise ValueError(f"color={self.color} must be red, green and blue, each 0 to 1.")


def load_shapes(path: str | Path) -> tuple[Shape, ...]:
    """Shapes of the user's own from a file, one a line.

    Args:
      path: of a text file with the header `solid,scale,yaw_deg,red,green,blue`.

    Raises:
      ValueError: it has another header, no shapes, or a line that is none.
    """
    shapes = []
    lines = csv.reader(read_text(path).splitlines())
    header = next(lines, [])
    if tuple(header) != FILE_HEADER:
        raise ValueError(
            f"{path}, line 1: the header is {','.join(header)!r} and must be "
            f"{','.join(FILE_HEADER)!r}."
        )
    for line in filter(None, lines):
        try:
            shapes.append(_shape(line))
        except ValueError as err:
            raise ValueError(f"{path}, line {lines.line_num}: {err}") from err
    if len(shapes) > MAX_SHAPES:
        raise ValueError(f"{path} has {len(shapes):,} shapes; {MAX_SHAPES:,} are the most.")
    if not shapes:
        raise ValueError(f"{path} has no shapes; give one a line, such as {_FILE_LINE}")
    return tuple(shapes)


def _shape(values: list[str]) -> Shape:
    solid, *numbers = values
    try:
        scale, yaw_deg, red, green, blue = map(float, numbers)
    except ValueError as err:
        given = ",".join(values)
        raise ValueError(
            f"{given!r} is not a solid and five numbers, such as {_FILE_LINE!r}."
        ) from err
    return Shape(solid, scale, yaw_deg, (red, green, blue))


@dataclass(frozen=True)
class ShapeLibrary:
    """All shapes in the order of ids, A = 810 and as many as the user's own.

    A shape's axes are those of its body before its yaw: put its body at rotation `quaternion`.
    Heights, centres and inertias are in these axes; lengths are metres, masses kilograms.

    Attributes:
      class_labels: int32[A] index into `solids.CLASS_NAMES`.
      scale_index: int32[A] index into the class's list of scales; new scales follow.
      s: f64[A] final scale: every length at s = 1 is multiplied by it.
      yaw: f64[A] rotation about the vertical, rad.
      quaternion: f64[A, 4] the same as (w, x, y, z).
      color: f64[A, 3] RGB in [0, 1].
      base, top: f64[A] lowest and highest z relative to the origin.
      volume: f64[A] of the true solid, m^3.
      center_of_mass: f64[A, 3] of the true solid, relative to the origin.
      mass: f64[A] 1000 kg/m^3 times the volume, the arch's without its opening.
      inertia: f64[A, 3, 3] about the centre of mass, kg m^2.
      principal_inertia: f64[A, 3] its eigenvalues, largest first.
      principal_quaternion: f64[A, 4] (w, x, y, z) rotation of the principal axes.
      bounding_radius: f64[A] what the drop rule adds to heights.
      hulls: the collision hull of each class at s = 1.
    """

    class_labels: np.ndarray
    scale_index: np.ndarray
    s: np.ndarray
    yaw: np.ndarray
    quaternion: np.ndarray
    color: np.ndarray
    base: np.ndarray
    top: np.ndarray
    volume: np.ndarray
    center_of_mass: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    principal_inertia: np.ndarray
    principal_quaternion: np.ndarray
    bounding_radius: np.ndarray
    hulls: HullTable


@lru_cache(maxsize=8)
def shape_library(extra: tuple[Shape, ...] = ()) -> ShapeLibrary:
    """The library, built once for equal arguments; its arrays are shared and read-only.

    Args:
      extra: shapes of the user's own, which follow the published ones: ids 810, 811, ...
    """
    labels, scale_index, s, yaw = _enumerate(extra)
    per_class = {key: value[labels] for key, value in _class_constants().items()}
    cubed, half_yaw, zero = s**3, yaw / 2.0, np.zeros(len(s))
    arrays = {
        "class_labels": labels,
        "scale_index": scale_index,
        "s": s,
        "yaw": yaw,
        "quaternion": np.stack([np.cos(half_yaw), zero, zero, np.sin(half_yaw)], axis=-1),
        "color": np.array([*_colors(), *(shape.color for shape in extra)]),
        "base": s * per_class["base"],
        "top": s * per_class["top"],
        "volume": cubed * per_class["volume"],
        "center_of_mass": s[:, None] * per_class["center"],
        "mass": DENSITY * cubed * per_class["volume"],
        "inertia": DENSITY * (s**5)[:, None, None] * per_class["inertia"],
        "principal_inertia": DENSITY * (s**5)[:, None] * per_class["principal_inertia"],
        "principal_quaternion": per_class["principal_quaternion"],
        "bounding_radius": s * per_class["bounding_radius"],
    }
    for array in arrays.values():
        array.setflags(write=False)
    return ShapeLibrary(**arrays, hulls=hull_table())


def shape_name(shape_id: int, extra: tuple[Shape, ...] = ()) -> str:
    """Class, scale in metres and yaw in degrees, such as `cube 0.302 m, 0 deg`.

    Raises:
      ValueError: there is no such shape.
    """
    library = shape_library(extra)
    if not 0 <= shape_id < len(library.s):
        raise ValueError(f"shape_id={shape_id} is not a shape; ids are 0..{len(library.s) - 1}.")
    name = CLASS_NAMES[library.class_labels[shape_id]]
    yaw_deg = math.degrees(library.yaw[shape_id])
    return f"{name} {library.s[shape_id]:.3f} m, {yaw_deg:g} deg"


@lru_cache(maxsize=8)
def shape_universe(extra: tuple[Shape, ...] = ()) -> ActionUniverse:
    """All shapes as an action universe, the user's own (`extra`) last.

    The primary parameter is the scale s in metres. The content is class, s, yaw and colour,
    f32[A, 6]. `cone-hires` and `cone` are the same solid: equal scales of the two are shapes
    that differ in colour only, and the published splits part some of these pairs.
    Engineered vector:

    * `gt21` f32[A, 21]: s, the axis of the rotation (0, 0, 1), its angle in radians, and the
      class as one-hot in the order of `solids.CLASS_NAMES`.
    """
    library = shape_library(extra)
    labels, s, yaw = library.class_labels, library.s[:, None], library.yaw[:, None]
    axis = np.tile([0.0, 0.0, 1.0], (len(s), 1))
    gt21 = np.concatenate([s, axis, yaw, np.eye(NUM_CLASSES)[labels]], axis=1)
    content = np.concatenate([labels[:, None], s, yaw, library.color], axis=1)
    return ActionUniverse(
        name="ShapeStacking-v0",
        class_labels=labels,
        class_names=CLASS_NAMES,
        primary_parameter=library.s,
        action_names=tuple(shape_name(shape_id, extra) for shape_id in range(len(s))),
        content=content.astype(np.float32),
        engineered={"gt21": gt21.astype(np.float32)},
    )


def _enumerate(
    extra: tuple[Shape, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Class, scale index, s and yaw of every id: classes, scales and angles, then `extra`."""
    rows = []
    for label, family in enumerate(_FAMILIES):
        scales = _SCALE_FACTOR * np.linspace(*family.scales, family.num_scales)
        angles = np.linspace(0.0, family.turn, family.num_angles, endpoint=False)
        rows += [(label, index, s, yaw) for index, s in enumerate(scales) for yaw in angles]
    index_of = {(label, s): index for label, index, s, _ in rows}
    for shape in extra:
        label = CLASS_NAMES.index(shape.solid)
        num_scales = sum(other == label for other, _ in index_of)
        index = index_of.setdefault((label, shape.scale), num_scales)
        rows.append((label, index, shape.scale, math.radians(shape.yaw_deg)))
    labels, indices, s, yaw = np.array(rows).T
    return labels.astype(np.int32), indices.astype(np.int32), s, yaw


def _colors() -> np.ndarray:
    """f64[810, 3] RGB; five draws per shape in the order of ids."""
    draws = np.random.RandomState(_COLOR_SEED).uniform(_DRAW_LOW, _DRAW_HIGH, (NUM_SHAPES, 5))
    return np.array([colorsys.hsv_to_rgb(*row) for row in draws[:, :3]])


def _class_constants() -> dict[str, np.ndarray]:
    """What scales with s, per class at s = 1 and density 1."""
    rows = [_constants(solid) for solid in solids()]
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def _constants(solid: Solid) -> dict[str, np.ndarray | float]:
    inertia = solid.moments.inertia
    values, axes = np.linalg.eigh(inertia)
    axes = axes[:, ::-1]
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    return {
        "base": solid.base,
        "top": solid.top,
        "volume": solid.moments.volume,
        "center": solid.moments.center,
        "inertia": inertia,
        "principal_inertia": values[::-1],
        "principal_quaternion": _quaternion(axes),
        "bounding_radius": solid.bounding_radius,
    }


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """f64[4] (w, x, y, z) of a rotation matrix, w >= 0.

    The outer product of the quaternion with itself is the sum of squares and products in the
    matrix; its longest column is the quaternion up to length and sign.
    """
    r = rotation
    xx, yy, zz = np.diag(r)
    products = np.array(
        [
            [1 + xx + yy + zz, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + xx - yy - zz, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - xx + yy - zz, r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - xx - yy + zz],
        ]
    )
    longest = products[:, np.argmax(np.diag(products))]
    quaternion = longest / np.linalg.norm(longest)
    return quaternion if quaternion[0] >= 0.0 else -quaternion
