"""Where two convex hulls touch, with shapes as traced data of one padded size.

The hulls are apart, or their overlap is least along the normal of a face or across two edges
(separating axes). Faces touch in up to four corners of the area that they share, edges in a point.
An edge of one hull and one of the other can only be the nearest features where their arcs on the
sphere of normals cross; only such pairs count.

Coordinates come first in arrays, so that what is summed over them is one fused loop.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

# Distance of contacts that are none, m.
APART = 1.0

# Edges at a smaller angle (its sine, squared) count as parallel.
_PARALLEL = 1e-6
# An edge contact is taken only where it overlaps less than the faces do by this much, m.
_FACES_FIRST = 1e-4
# Of a side of a face, m: a corner on it is inside. Sides are not normalised, they are 0.1 to 2 m.
_ON_SIDE = 1e-6
# Slope that counts as none where the first two of four corners are chosen, and how far from a side
# of the face they are sought, so that no two corners of the usual shapes are equal.
_FLAT = 1e-3
_ASKEW = (0.92, 0.38)
# Faces that are steeper to each other (cosine) do not touch as faces.
_LEAST_SLOPE = 1e-3
# Corners that are nearer to each other, m, or to the line through two others, m^2, are the same.
_SAME = 1e-4


class Hull(NamedTuple):
    """A hull that is turned, but not moved: relative to its centre of mass, metres.

    Attributes:
      center: f32[3] where its centre of mass is.
      vertices: f32[3, V].
      normals: f32[3, F] outward.
      offsets: f32[F] of the faces' planes.
      corners: f32[F, P, 3] of each face, counter-clockwise, in the axes of the body.
      axes: f32[3, 3] columns are those axes.
      directions: f32[3, E] of the edges, unit vectors along (second x first normal).
      points: f32[3, E] one on each edge.
      firsts, seconds: f32[3, E] normals of the faces at each edge.
    """

    center: jax.Array
    vertices: jax.Array
    normals: jax.Array
    offsets: jax.Array
    corners: jax.Array
    axes: jax.Array
    directions: jax.Array
    points: jax.Array
    firsts: jax.Array
    seconds: jax.Array


def hull_hull(one: Hull, two: Hull) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Up to four contacts.

    Returns:
      Distances f32[4] (negative: overlap; `APART`: no contact), midpoints f32[4, 3] and the unit
      normal f32[3] from the first hull to the second.
    """
    shift = one.center - two.center
    gaps_one = _table(one.normals, two.vertices).min(axis=1) - shift @ one.normals - one.offsets
    gaps_two = _table(two.normals, one.vertices).min(axis=1) + shift @ two.normals - two.offsets
    gap_one, gap_two = gaps_one.max(), gaps_two.max()
    face_gap = jnp.maximum(gap_one, gap_two)
    edge_gap, edge_position, edge_normal = _edges(one, two, shift)

    is_first = gap_one >= gap_two - _FACES_FIRST
    faces = _faces(one, two, is_first, jnp.where(is_first, gaps_one.argmax(), gaps_two.argmax()))
    distance, position, normal = faces
    is_edge = edge_gap > face_gap + _FACES_FIRST
    edge_distance = jnp.full(4, APART).at[0].set(edge_gap)
    distance = jnp.where(is_edge, edge_distance, distance)
    position = jnp.where(is_edge, two.center + edge_position, position)
    normal = jnp.where(is_edge, edge_normal, jnp.where(is_first, normal, -normal))
    return distance, position, normal


def four_corners(
    points: jax.Array, gaps: jax.Array, is_one: jax.Array, normal: jax.Array, along: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Four of many points that touch a plane: the lowest, and three that span an area with it.

    Where bodies lie flat on each other and the area that they share is symmetric about its middle,
    so is the choice: an impact tips nothing over.

    Args:
      points: f32[n, 3] m.
      gaps: f32[n] heights above the plane, m.
      is_one: bool[n] which points there are.
      normal: f32[3] of the plane.
      along: f32[3] a direction in the plane, of a length of about 1; decides where gaps are equal.

    Returns:
      Indices int32[4], and which of them are points, bool[4].
    """
    askew = _ASKEW[0] * along + _ASKEW[1] * _cross(normal, along)
    heights = gaps + _FLAT * (points @ askew)
    a = jnp.argmin(jnp.where(is_one, heights, jnp.inf))
    b = jnp.argmax(jnp.where(is_one, heights, -jnp.inf))
    offsets = points - points[a]
    sides = jnp.where(is_one, offsets @ _cross(normal, offsets[b]), 0.0)
    c, d = jnp.argmax(sides), jnp.argmin(sides)
    has_two = (offsets[b] ** 2).sum() > _SAME**2
    are_new = jnp.array([True, has_two, sides[c] > _SAME**2, sides[d] < -(_SAME**2)])
    return jnp.stack([a, b, c, d]), are_new & is_one.any()


def _edges(one: Hull, two: Hull, shift: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The pair of edges that overlaps least: distance, midpoint relative to `two`, normal."""
    d1, d2 = one.directions, two.directions
    sides_of_one = _table(d1, two.firsts), _table(d1, two.seconds)
    sides_of_two = _table(one.firsts, d2), _table(one.seconds, d2)
    cross = (
        (sides_of_one[0] * sides_of_one[1] < 0.0)
        & (sides_of_two[0] * sides_of_two[1] < 0.0)
        & (sides_of_one[0] * sides_of_two[1] < 0.0)
    )
    sine_squared = 1.0 - _table(d1, d2) ** 2
    # (d1 x d2) . p = d2 . (p x d1) = d1 . (d2 x p)
    own = jnp.cross(one.points, d1, axis=0)
    moved = jnp.cross(one.points + shift[:, None], d1, axis=0)
    across = _table(d1, jnp.cross(d2, two.points, axis=0)) - _table(moved, d2)
    outward = jnp.where(_table(own, d2) > 0.0, 1.0, -1.0)
    inverse = jax.lax.rsqrt(jnp.maximum(sine_squared, _PARALLEL))
    gaps = jnp.where(cross & (sine_squared > _PARALLEL), outward * across * inverse, -jnp.inf)
    i = gaps.max(axis=1).argmax()
    j = gaps[i].argmax()
    normal = outward[i, j] * inverse[i, j] * _cross(d1[:, i], d2[:, j])
    # Nearest points of the two lines: p1 + t1 d1 and p2 + t2 d2.
    p1, p2 = one.points[:, i] + shift, two.points[:, j]
    between, cosine = p2 - p1, d1[:, i] @ d2[:, j]
    along_1, along_2 = between @ d1[:, i], between @ d2[:, j]
    scale = inverse[i, j] ** 2
    near_1 = p1 + scale * (along_1 - cosine * along_2) * d1[:, i]
    near_2 = p2 + scale * (cosine * along_1 - along_2) * d2[:, j]
    return gaps[i, j], 0.5 * (near_1 + near_2), normal


def _faces(
    one: Hull, two: Hull, is_first: jax.Array, index: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts at the face `index` of the first hull, if `is_first`, or of the second.

    Returns:
      Distances f32[4], positions f32[4, 3], and the outward normal f32[3] of that face.
    """

    def ours(own: jax.Array, other: jax.Array) -> jax.Array:
        return jnp.where(is_first, own, other)

    center = ours(one.center, two.center)
    shift = ours(two.center, one.center) - center
    normal = ours(one.normals[:, index], two.normals[:, index])
    offset = ours(one.offsets[index], two.offsets[index])
    face = ours(_face(one, index), _face(two, index))
    steepness = ours(normal @ two.normals, normal @ one.normals)
    facing_index = steepness.argmin()
    facing_normal = ours(two.normals[:, facing_index], one.normals[:, facing_index])
    facing = shift + ours(_face(two, facing_index), _face(one, facing_index))

    # Their corners and sides, cut by our sides. All is relative to our centre.
    sides, steps = jnp.roll(face, -1, axis=0) - face, jnp.roll(facing, -1, axis=0) - facing
    gaps = facing @ normal - offset
    rises = jnp.roll(gaps, -1) - gaps
    enters, leaves, is_inside = _cut(_outside(facing, face, sides, normal))
    # Our corners that lie within their face, seen along our normal.
    slope = jnp.minimum(steepness[facing_index], -_LEAST_SLOPE)
    heights = (facing[0] - face) @ facing_normal / slope
    raised = face + heights[:, None] * normal
    is_covered = (_outside(raised, facing, steps, facing_normal) <= _ON_SIDE).all(axis=1)

    points = [facing + enters[:, None] * steps, facing + leaves[:, None] * steps, raised]
    all_points = jnp.concatenate(points)
    all_gaps = jnp.concatenate([gaps + enters * rises, gaps + leaves * rises, heights])
    touches = jnp.concatenate([is_inside, is_inside, is_covered]) & (all_gaps < 0.0)
    chosen, are_new = four_corners(all_points, all_gaps, touches, normal, sides[0])
    distance = all_gaps[chosen]
    position = center + all_points[chosen] - 0.5 * distance[:, None] * normal
    return jnp.where(are_new, distance, APART), position, normal


def _face(hull: Hull, index: jax.Array) -> jax.Array:
    """f32[P, 3] turned corners."""
    return hull.corners[index] @ hull.axes.T


def _outside(
    points: jax.Array, polygon: jax.Array, sides: jax.Array, normal: jax.Array
) -> jax.Array:
    """f32[n, P] how far points f32[n, 3] are outside of each side of a polygon f32[P, 3].

    In units of a side's length.
    """
    away = _cross(sides, normal)
    return _table(points.T, away.T) - (polygon * away).sum(axis=-1)


def _cut(outside: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The parts of a polygon's sides that are inside another polygon.

    Args:
      outside: f32[P, Q] how far corner p is outside of side q, in any unit of that side.

    Returns:
      Where each side p -> p + 1 enters and leaves, f32[P] in [0, 1], and whether it does, bool[P].
    """
    start, end = outside, jnp.roll(outside, -1, axis=0)
    crosses = start / jnp.where(start == end, 1.0, start - end)
    enters = jnp.where((start > 0.0) & (end <= 0.0), crosses, 0.0).max(axis=1)
    leaves = jnp.where((start <= 0.0) & (end > 0.0), crosses, 1.0).min(axis=1)
    is_out = ((start > _ON_SIDE) & (end > _ON_SIDE)).any(axis=1)
    return enters, leaves, ~is_out & (enters <= leaves)


def _table(rows: jax.Array, columns: jax.Array) -> jax.Array:
    """f32[m, n] inner products of f32[3, m] and f32[3, n]."""
    x, y, z = (rows[k][:, None] * columns[k] for k in range(3))
    return x + y + z


def _cross(one: jax.Array, two: jax.Array) -> jax.Array:
    """Vector products of f32[..., 3]."""
    (a, b, c), (x, y, z) = jnp.moveaxis(one, -1, 0), jnp.moveaxis(two, -1, 0)
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)
