"""Where rays enter shapes: closed forms for every solid of the library.

A solid is what lies inside all of its planes and inside one quadric, without an opening (the
arch), together with two balls (the capsule's ends). P is the number of rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.solids import (
    ARCH_OPENING_RADIUS,
    CLASS_NAMES,
    DOME_AXIS_HEIGHT,
    NUM_CLASSES,
    flat_sided,
)

_MAX_PLANES = 6
# A quadric (a, b, c) is the set a . x^2 + 2 b z + c <= 0, x^2 by component.
_EVERYTHING = (0.0, 0.0, 0.0, 0.0, -1.0)
_NOTHING = (0.0, 0.0, 0.0, 0.0, 1.0)
# Rays within this of parallel to a plane (sine of the angle) or to a quadric's straight lines.
_PARALLEL = 1e-9

# Surfaces of a solid are numbered: its planes, its quadric, its opening, its balls.
_QUADRIC = _MAX_PLANES
_OPENING = _QUADRIC + 1
_BALLS = (_OPENING + 1, _OPENING + 2)
NUM_SURFACES = _BALLS[-1] + 1

# Vectors are three arrays, one per coordinate, and what happens to them is written out: XLA fuses
# elementwise code into one loop over the rays, which slices of [3, P] arrays and sums would cut up,
# and accelerators round matrix products coarsely.
Vector = tuple[jax.Array, jax.Array, jax.Array]
Interval = tuple[jax.Array, jax.Array]


@flax.struct.dataclass
class Bodies:
    """Shapes in the world; N is a free leading axis.

    Attributes:
      label: int32[N] index into `CLASS_NAMES`.
      s: f32[N] scale; a body of scale 0 is met by no ray.
      position: f32[N, 3] of the origins, m.
      rotation: f32[N, 3, 3] from the shapes' axes to the world's.
    """

    label: jax.Array
    s: jax.Array
    position: jax.Array
    rotation: jax.Array


@flax.struct.dataclass
class Hits:
    """The nearest surface along each ray.

    Attributes:
      distance: f32[P] from the ray's origin, m; inf where nothing is met.
      surface: int32[P] body * NUM_SURFACES + number of the surface, -1 for none of the bodies'.
    """

    distance: jax.Array
    surface: jax.Array

    @property
    def body(self) -> jax.Array:
        """int32[P] index of the body that is met, -1 for none."""
        return self.surface // NUM_SURFACES


@dataclass(frozen=True)
class _SolidTable:
    """All classes at s = 1.

    Attributes:
      planes: f32[16, 6, 4] outward normal n and offset d; inside is n . x <= d. Padding has n = 0
        and d = 1.
      quadrics, openings: f32[16, 5] (a, b, c) as above; an opening is taken away.
      balls: f32[16, 2, 5] quadrics that are added.
      gradients: f32[16, 10, 6] (a, g) of each surface: its outward normal at x is along a x + g.
    """

    planes: np.ndarray
    quadrics: np.ndarray
    openings: np.ndarray
    balls: np.ndarray
    gradients: np.ndarray


def nearest(bodies: Bodies, origins: Vector, directions: Vector, distance: jax.Array) -> Hits:
    """The nearest surface of any body, or none where something else is nearer.

    Bodies are looked at one after the other, so that memory does not grow with their number.

    Args:
      bodies: N bodies; the results number them 0..N-1.
      origins: f32[] or f32[P] each, m; not inside a body, but maybe in an arch's opening.
      directions: f32[P] each, unit vectors.
      distance: f32[P] to whatever else the rays meet, m.
    """

    def look(best: Hits, indexed: tuple[jax.Array, Bodies]) -> tuple[Hits, None]:
        index, body = indexed
        distance, surface = enter(body, origins, directions)
        is_nearer = distance < best.distance
        return Hits(
            distance=jnp.where(is_nearer, distance, best.distance),
            surface=jnp.where(is_nearer, index * NUM_SURFACES + surface, best.surface),
        ), None

    indices = jnp.arange(bodies.label.shape[0], dtype=jnp.int32)
    nothing = Hits(distance, jnp.full(distance.shape, -1, jnp.int32))
    return jax.lax.scan(look, nothing, (indices, bodies))[0]


def enter(body: Bodies, origins: Vector, directions: Vector) -> tuple[jax.Array, jax.Array]:
    """Where rays from outside enter one body.

    Args:
      body: a single one, without the axis N.
      origins: f32[] or f32[P] each, m.
      directions: f32[P] each, unit vectors.

    Returns:
      f32[P] distance, m, inf where the ray misses, and int32[P] number of the surface.
    """
    is_there = body.s > 0.0
    s = jnp.where(is_there, body.s, 1.0)
    # In the shape's own axes and units of s; the unit of distance along the ray is s, too.
    x, y, z = turn(body.rotation.T, _subtract(origins, body.position))
    distance, surface = _enter_solid(
        body.label, (x / s, y / s, z / s), turn(body.rotation.T, directions)
    )
    return jnp.where(is_there, distance * s, jnp.inf), surface


def normals(bodies: Bodies, hits: Hits, points: Vector) -> Vector:
    """Outward unit normals where rays met bodies; (0, 0, 1) elsewhere.

    Args:
      points: f32[P] each, where the rays met them, m; finite.
    """
    index = jnp.maximum(hits.body, 0)
    rotation = jnp.moveaxis(bodies.rotation[index], 0, -1)
    s = jnp.where(bodies.s > 0.0, bodies.s, 1.0)[index]
    x, y, z = turn(jnp.swapaxes(rotation, 0, 1), _subtract(points, bodies.position[index].T))
    gradients = jnp.asarray(_solid_table().gradients)
    row = gradients[bodies.label[index], jnp.maximum(hits.surface, 0) % NUM_SURFACES].T
    local = (row[0] * x / s + row[3], row[1] * y / s + row[4], row[2] * z / s + row[5])
    length = jnp.sqrt(jnp.maximum(dot(local, local), 1e-20))
    is_body = hits.surface >= 0
    a, b, c = turn(rotation, local)
    return (
        jnp.where(is_body, a / length, 0.0),
        jnp.where(is_body, b / length, 0.0),
        jnp.where(is_body, c / length, 1.0),
    )


def dot(a: Vector | jax.Array, b: Vector | jax.Array) -> jax.Array:
    """The product of two vectors; a coordinate is the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def turn(rotation: jax.Array, vectors: Vector) -> Vector:
    """Vectors turned by a matrix f32[3, 3], or by matrices f32[3, 3, P]."""
    return dot(rotation[0], vectors), dot(rotation[1], vectors), dot(rotation[2], vectors)


def walk(start: Vector, distance: jax.Array, along: Vector) -> Vector:
    """The points at distances along rays."""
    return (
        start[0] + distance * along[0],
        start[1] + distance * along[1],
        start[2] + distance * along[2],
    )


def _subtract(a: Vector, b: jax.Array) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _enter_solid(label: jax.Array, start: Vector, along: Vector) -> tuple[jax.Array, jax.Array]:
    """`enter` in the axes of a solid at s = 1."""
    table = _solid_table()
    first, last, surface = _cross_planes(jnp.asarray(table.planes)[label], start, along)
    round_first, round_last = _cross_quadric(jnp.asarray(table.quadrics)[label], start, along)
    surface = jnp.where(round_first > first, _QUADRIC, surface)
    first, last = jnp.maximum(first, round_first), jnp.minimum(last, round_last)

    open_first, open_last = _cross_quadric(jnp.asarray(table.openings)[label], start, along)
    # Also for rays that start in the opening, as shadows of an arch on itself do.
    begin = jnp.maximum(first, 0.0)
    is_through = (open_first < begin) & (begin < open_last)
    surface = jnp.where(is_through, _OPENING, surface)
    first = jnp.where(is_through, open_last, first)

    distance = jnp.where((first < last) & (first > 0.0), first, jnp.inf)
    for number, ball in zip(_BALLS, jnp.asarray(table.balls)[label], strict=True):
        first, last = _cross_quadric(ball, start, along)
        is_nearer = (first < last) & (first > 0.0) & (first < distance)
        surface = jnp.where(is_nearer, number, surface)
        distance = jnp.where(is_nearer, first, distance)
    return distance, surface


def _cross_planes(
    planes: jax.Array, start: Vector, along: Vector
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The part of each line inside all planes, and the number of the one where it begins."""
    first = jnp.full(along[0].shape, -jnp.inf, jnp.float32)
    last, surface = -first, jnp.zeros(first.shape, jnp.int32)
    for number, plane in enumerate(planes):
        speed = dot(plane, along)
        room = plane[3] - dot(plane, start)
        is_parallel = jnp.abs(speed) < _PARALLEL
        at = room / jnp.where(is_parallel, 1.0, speed)
        # A parallel line is inside everywhere or nowhere.
        never = jnp.where(room < 0.0, jnp.float32(jnp.inf), -jnp.inf)
        entry = jnp.where(is_parallel, never, jnp.where(speed < 0.0, at, -jnp.inf))
        surface = jnp.where(entry > first, number, surface)
        first = jnp.maximum(first, entry)
        last = jnp.minimum(last, jnp.where((speed > 0.0) & ~is_parallel, at, jnp.inf))
    return first, last, surface


def _cross_quadric(quadric: jax.Array, start: Vector, along: Vector) -> Interval:
    """The part of each line inside a quadric; (inf, -inf) where there is none.

    Of a double cone that part is meant which a line meets below its apex: planes cut off the rest.
    """
    slope, constant = quadric[3], quadric[4]
    # Measured from the point nearest to the solid's origin: otherwise the discriminant is a small
    # difference of large numbers.
    middle = -dot(start, along)
    point = walk(start, middle, along)
    stretched = (quadric[0] * along[0], quadric[1] * along[1], quadric[2] * along[2])
    a = dot(stretched, along)
    a = jnp.where(jnp.abs(a) < _PARALLEL, _PARALLEL, a)
    b = dot(stretched, point) + slope * along[2]
    c = constant + 2.0 * slope * point[2]
    c += quadric[0] * point[0] ** 2 + quadric[1] * point[1] ** 2 + quadric[2] * point[2] ** 2
    discriminant = b**2 - a * c
    # The larger root first, the other from their product: no cancellation, also for small `a`.
    sign = jnp.where(b < 0.0, jnp.float32(-1.0), 1.0)
    larger = -(b + sign * jnp.sqrt(jnp.maximum(discriminant, 0.0)))
    root, other = larger / a, c / jnp.where(larger == 0.0, 1.0, larger)
    low, high = jnp.minimum(root, other), jnp.maximum(root, other)

    is_missed = (a > 0.0) & (discriminant < 0.0)
    is_steep = a < 0.0  # Steeper than a cone's side: inside from one crossing to infinity.
    is_down = along[2] < 0.0
    first = jnp.where(is_steep, jnp.where(is_down, high, -jnp.inf), low)
    last = jnp.where(is_steep, jnp.where(is_down, jnp.inf, low), high)
    return (
        jnp.where(is_missed, jnp.inf, first + middle),
        jnp.where(is_missed, -jnp.inf, last + middle),
    )


@lru_cache(maxsize=1)
def _solid_table() -> _SolidTable:
    planes = np.tile([0.0, 0.0, 0.0, 1.0], (NUM_CLASSES, _MAX_PLANES, 1))
    quadrics, openings = np.tile(_EVERYTHING, (NUM_CLASSES, 1)), np.tile(_NOTHING, (NUM_CLASSES, 1))
    balls = np.tile(_NOTHING, (NUM_CLASSES, 2, 1))
    for label, name in enumerate(CLASS_NAMES):
        rows = _planes(name)
        planes[label, : len(rows)] = rows
        quadrics[label] = _QUADRICS.get(name, _EVERYTHING)
    openings[CLASS_NAMES.index("arch")] = _lying_cylinder(ARCH_OPENING_RADIUS, -1.0)
    balls[CLASS_NAMES.index("capsule")] = [(1.0, 1.0, 1.0, -z, z**2 - 1.0) for z in (-1.0, 1.0)]
    gradients = np.zeros((NUM_CLASSES, NUM_SURFACES, 6))
    gradients[:, :_MAX_PLANES, 3:] = planes[..., :3]
    gradients[:, _QUADRIC] = _gradients(quadrics)
    gradients[:, _OPENING] = -_gradients(openings)
    gradients[:, _BALLS] = _gradients(balls)
    arrays = (planes, quadrics, openings, balls, gradients)
    return _SolidTable(*(array.astype(np.float32) for array in arrays))


def _gradients(quadrics: np.ndarray) -> np.ndarray:
    """f64[..., 6] (a, g) with half the gradient a x + g."""
    rows = np.zeros((*quadrics.shape[:-1], 6))
    rows[..., :3], rows[..., 5] = quadrics[..., :3], quadrics[..., 3]
    return rows


def _lying_cylinder(radius: float, height: float) -> tuple[float, ...]:
    """The quadric x^2 + (z - height)^2 <= radius^2."""
    return (1.0, 0.0, 1.0, -height, height**2 - radius**2)


_UPRIGHT_CYLINDER = (1.0, 1.0, 0.0, 0.0, -1.0)
_CONE = (1.0, 1.0, -0.25, 0.25, -0.25)  # x^2 + y^2 <= ((1 - z) / 2)^2
_QUADRICS = {
    "sphere": (1.0, 1.0, 1.0, 0.0, -1.0),
    "capsule": _UPRIGHT_CYLINDER,
    "cylinder": _UPRIGHT_CYLINDER,
    "cone": _CONE,
    "cone-hires": _CONE,
    "dome": _lying_cylinder(1.0, DOME_AXIS_HEIGHT),
}
_ENDS = [(0.0, 0.0, 1.0, 1.0), (0.0, 0.0, -1.0, 1.0)]
_ROUND_PLANES = {
    "capsule": _ENDS,
    "cylinder": _ENDS,
    "cone": _ENDS,  # The upper one cuts off the double cone's other half.
    "cone-hires": _ENDS,
    "dome": [(0.0, 0.0, -1.0, -DOME_AXIS_HEIGHT), (0.0, 1.0, 0.0, 1.0), (0.0, -1.0, 0.0, 1.0)],
    "sphere": [],
}


def _planes(name: str) -> np.ndarray:
    """f64[n, 4] outward normal and offset of each flat side."""
    solid = flat_sided(name)
    if solid is None:
        return np.array(_ROUND_PLANES[name]).reshape(-1, 4)
    normals = solid.face_normals
    corners = solid.vertices[[face[0] for face in solid.faces]]
    return np.concatenate([normals, (normals * corners).sum(1, keepdims=True)], axis=1)
