"""Bodies whose shapes are traced data, and where they touch: one program for all shapes.

A body is a hull (`hulls.HullTable`) or round: a capsule, of no length for a sphere. Bodies are
the slots of a world; MJX counts the world itself as body 0, hence the `+ 1`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.engines._mjx_private import Contacts, private
from envs_mjx.shape_stacking.engines.hull_contacts import APART, Hull, four_corners, hull_hull
from envs_mjx.shape_stacking.shapes import Shape, shape_library
from envs_mjx.shape_stacking.solids import CLASS_NAMES

# How many pairs of bodies are looked at closely (two hulls; a round body and a hull; two round
# bodies): those whose boxes overlap the deepest. In 60 episodes of random play on C the boxes
# (along the world's axes) of at most 25 pairs of hulls overlapped at a time, 23 in 99.9 % of 10,800
# moments; of 9 and 1 of the other kinds.
HULL_PAIRS, MIXED_PAIRS, ROUND_PAIRS = 24, 24, 12


class Pool(NamedTuple):
    """The shapes of n slots, in the axes of their bodies, about their centres of mass, metres.

    Attributes:
      is_hull, is_round: bool[n] neither for unused slots.
      is_sphere: bool[n].
      radius, half_length: f32[n] of round bodies.
      vertices: f32[n, V, 3]; this and the next four as in `hulls.HullTable`.
      face_vertices: f32[n, F, P, 3].
      face_normals: f32[n, F, 3].
      edges: int32[n, E, 2].
      edge_normals: f32[n, E, 2, 3].
      edge_directions: f32[n, E, 3] along (second x first normal).
      edge_points: f32[n, E, 3] one end of each edge.
    """

    is_hull: jax.Array
    is_round: jax.Array
    is_sphere: jax.Array
    radius: jax.Array
    half_length: jax.Array
    vertices: jax.Array
    face_vertices: jax.Array
    face_normals: jax.Array
    edges: jax.Array
    edge_normals: jax.Array
    edge_directions: jax.Array
    edge_points: jax.Array


@lru_cache(maxsize=8)
def _constants(shapes: tuple[Shape, ...] = ()) -> dict[str, np.ndarray]:
    """What `pool` and `with_shapes` look up, per shape or per class, f32 and int32."""
    library = shape_library(shapes)
    hulls = library.hulls
    values = {
        "label": library.class_labels,
        "s": library.s,
        "mass": library.mass,
        "center": library.center_of_mass,
        "inertia": library.principal_inertia,
        "axes": library.principal_quaternion,
        "has_hull": hulls.has_hull,
        "vertices": hulls.vertices,
        "face_vertices": hulls.face_vertices,
        "face_normals": hulls.face_normals,
        "edges": hulls.edges,
        "edge_normals": hulls.edge_normals,
        "edge_directions": _edge_directions(hulls.edge_normals),
        "edge_points": np.take_along_axis(hulls.vertices, hulls.edges[:, :, :1], axis=1),
    }
    return {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in values.items()}


def _edge_directions(edge_normals: np.ndarray) -> np.ndarray:
    vectors = np.cross(edge_normals[:, :, 1], edge_normals[:, :, 0])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def pool(shape_ids: jax.Array, shapes: tuple[Shape, ...] = ()) -> Pool:
    """The shapes of the slots; shape_ids int32[n], below 0 for unused ones, `shapes` from 810."""
    table = {name: jnp.asarray(value) for name, value in _constants(shapes).items()}
    label, s = table["label"][shape_ids], table["s"][shape_ids]
    is_used, has_hull = shape_ids >= 0, table["has_hull"][label]
    is_sphere = label == CLASS_NAMES.index("sphere")
    return Pool(
        is_hull=is_used & has_hull,
        is_round=is_used & ~has_hull,
        is_sphere=is_sphere,
        radius=s,
        half_length=jnp.where(is_sphere, 0.0, s),
        vertices=s[:, None, None] * table["vertices"][label],
        face_vertices=s[:, None, None, None] * table["face_vertices"][label],
        face_normals=table["face_normals"][label],
        edges=table["edges"][label],
        edge_normals=table["edge_normals"][label],
        edge_directions=table["edge_directions"][label],
        edge_points=s[:, None, None] * table["edge_points"][label],
    )


def with_shapes(model: Any, shape_ids: jax.Array, shapes: tuple[Shape, ...] = ()) -> Any:
    """`mjx.Model` whose bodies have the masses of these shapes, int32[n]; any for unused slots."""
    table = {name: jnp.asarray(value) for name, value in _constants(shapes).items()}
    mass, inertia = table["mass"][shape_ids], table["inertia"][shape_ids]
    # The inverse of what a contact has to move, which softness is relative to.
    inverse = jnp.stack([1.0 / mass, jnp.mean(1.0 / inertia, axis=-1)], axis=-1)
    values = {
        "body_mass": mass,
        "body_subtreemass": mass,
        "body_inertia": inertia,
        "body_ipos": table["center"][shape_ids],
        "body_iquat": table["axes"][shape_ids],
        "body_invweight0": inverse,
    }
    return model.replace(
        **{name: getattr(model, name).at[1:].set(value) for name, value in values.items()}
    )


def find_contacts(pool: Pool, centers: jax.Array, axes: jax.Array) -> Contacts:
    """Where bodies touch each other and the table.

    Args:
      pool: n slots.
      centers: f32[n, 3] centres of mass, m.
      axes: f32[n, 3, 3] columns are the axes of the bodies.
    """
    corners = centers[:, None] + jnp.einsum("nij,nvj->nvi", axes, pool.vertices)
    lengths = axes[:, :, 2] * pool.half_length[:, None]
    gaps = _gaps(pool, centers, corners, lengths)
    found = [
        _table_hulls(pool, corners),
        _table_rounds(pool, centers, lengths),
        _hull_pairs(pool, gaps, centers, axes),
        _mixed_pairs(pool, gaps, centers, axes),
        _round_pairs(pool, gaps, centers, lengths),
    ]
    return Contacts(*(jnp.concatenate(parts) for parts in zip(*found, strict=True)))


def _gaps(pool: Pool, centers: jax.Array, corners: jax.Array, lengths: jax.Array) -> jax.Array:
    """f32[n (n - 1) / 2] distance of the boxes around two bodies, below 0 where they overlap."""
    reach = jnp.abs(lengths) + pool.radius[:, None]
    is_hull = pool.is_hull[:, None]
    low = jnp.where(is_hull, corners.min(axis=1), centers - reach)
    high = jnp.where(is_hull, corners.max(axis=1), centers + reach)
    first, second = _pairs(len(centers))
    return jnp.maximum(low[first] - high[second], low[second] - high[first]).max(axis=-1)


def _pairs(num_slots: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(num_slots, 1)


def _nearest(is_candidate: jax.Array, gaps: jax.Array, limit: int) -> tuple[jax.Array, jax.Array]:
    """The pairs of one kind that overlap the deepest: indices int32[k], and which are any."""
    score = jnp.where(is_candidate, -gaps, -jnp.inf)
    overlap, chosen = jax.lax.top_k(score, min(limit, len(gaps)))
    return chosen, overlap >= 0.0


def _contacts(
    distance: jax.Array, position: jax.Array, normal: jax.Array, first: jax.Array, second: jax.Array
) -> Contacts:
    """From arrays [k, contacts, ...] of k pairs of bodies."""
    bodies = jnp.broadcast_to(jnp.stack([first, second], -1)[:, None], (*distance.shape, 2))
    return Contacts(
        distance.reshape(-1), position.reshape(-1, 3), normal.reshape(-1, 3), bodies.reshape(-1, 2)
    )


def _table_contacts(points: jax.Array, depth: jax.Array, is_one: jax.Array) -> Contacts:
    """The table's with points f32[n, k, 3] of the bodies, at depths f32[n, k] below its surface."""
    up = jnp.array([0.0, 0.0, 1.0])
    distance = jnp.where(is_one, -depth, APART)
    position = points + 0.5 * depth[..., None] * up
    second = jnp.arange(1, 1 + len(points))
    normal = jnp.broadcast_to(up, points.shape)
    return _contacts(distance, position, normal, jnp.zeros_like(second), second)


def _table_hulls(pool: Pool, corners: jax.Array) -> Contacts:
    """Up to four corners of each hull, the lowest among them."""
    gaps = corners[..., 2] - scene.TABLE_HEIGHT
    is_one = (gaps < 0.0) & pool.is_hull[:, None]
    up, along = jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    choose = jax.vmap(four_corners, (0, 0, 0, None, None))
    chosen, are_new = choose(corners, gaps, is_one, up, along)
    points = jnp.take_along_axis(corners, chosen[..., None], axis=1)
    return _table_contacts(points, -jnp.take_along_axis(gaps, chosen, axis=1), are_new)


def _table_rounds(pool: Pool, centers: jax.Array, lengths: jax.Array) -> Contacts:
    """Both ends of each capsule, the one point of each sphere."""
    radius = pool.radius[:, None]
    ends = jnp.stack([centers + lengths, centers - lengths], axis=1)
    points = ends - jnp.array([0.0, 0.0, 1.0]) * radius[..., None]
    depth = scene.TABLE_HEIGHT - points[..., 2]
    is_one = pool.is_round[:, None] & ~(pool.is_sphere[:, None] & jnp.array([False, True]))
    return _table_contacts(points, depth, is_one)


def _hull_pairs(pool: Pool, gaps: jax.Array, centers: jax.Array, axes: jax.Array) -> Contacts:
    """Up to four contacts of two hulls."""
    i, j = _pairs(len(centers))
    chosen, is_near = _nearest(pool.is_hull[i] & pool.is_hull[j], gaps, HULL_PAIRS)
    first, second = jnp.asarray(i)[chosen], jnp.asarray(j)[chosen]
    turned = _turned(pool, centers, axes)
    one, two = (jax.tree.map(lambda x, which=which: x[which], turned) for which in (first, second))
    distance, position, normal = jax.vmap(hull_hull)(one, two)
    normal = jnp.broadcast_to(normal[:, None], position.shape)
    distance = jnp.where(is_near[:, None], distance, APART)
    return _contacts(distance, position, normal, first + 1, second + 1)


def _mixed_pairs(pool: Pool, gaps: jax.Array, centers: jax.Array, axes: jax.Array) -> Contacts:
    """Up to two contacts of a round body, which is the first, and a hull."""
    i, j = _pairs(len(centers))
    is_swapped = pool.is_hull[i] & pool.is_round[j]
    chosen, is_near = _nearest(is_swapped | (pool.is_round[i] & pool.is_hull[j]), gaps, MIXED_PAIRS)
    first = jnp.where(is_swapped, j, i)[chosen]
    second = jnp.where(is_swapped, i, j)[chosen]
    size = jnp.stack([pool.radius, pool.half_length, pool.half_length], axis=-1)
    capsule = private().GeomInfo(centers[first], axes[first], size[first])
    distance, position, normal = jax.vmap(private().capsule_convex)(
        capsule, _hull(pool, second, centers, axes)
    )
    is_twin = pool.is_sphere[first][:, None] & jnp.array([False, True])
    distance = jnp.where(is_near[:, None] & ~is_twin, distance, APART)
    return _contacts(distance, position, normal, first + 1, second + 1)


def _round_pairs(pool: Pool, gaps: jax.Array, centers: jax.Array, lengths: jax.Array) -> Contacts:
    """One contact of two round bodies."""
    i, j = _pairs(len(centers))
    chosen, is_near = _nearest(pool.is_round[i] & pool.is_round[j], gaps, ROUND_PAIRS)
    first, second = jnp.asarray(i)[chosen], jnp.asarray(j)[chosen]
    ends = (centers - lengths, centers + lengths)
    one, other = jax.vmap(private().closest_segment_to_segment_points)(
        *(end[first] for end in ends), *(end[second] for end in ends)
    )
    apart = jnp.linalg.norm(other - one, axis=-1)
    normal = (other - one) / jnp.maximum(apart, 1e-9)[:, None]
    distance = apart - pool.radius[first] - pool.radius[second]
    position = one + normal * (pool.radius[first] + 0.5 * distance)[:, None]
    distance = jnp.where(is_near, distance, APART)
    return _contacts(distance[:, None], position[:, None], normal[:, None], first + 1, second + 1)


def _turned(pool: Pool, centers: jax.Array, axes: jax.Array) -> Hull:
    """All hulls, with a leading axis."""

    def turn(vectors: jax.Array) -> jax.Array:
        return jnp.einsum("nij,nkj->nik", axes, vectors)

    return Hull(
        center=centers,
        vertices=turn(pool.vertices),
        normals=turn(pool.face_normals),
        offsets=(pool.face_normals * pool.face_vertices[:, :, 0]).sum(axis=-1),
        corners=pool.face_vertices,
        axes=axes,
        directions=turn(pool.edge_directions),
        points=turn(pool.edge_points),
        firsts=turn(pool.edge_normals[:, :, 0]),
        seconds=turn(pool.edge_normals[:, :, 1]),
    )


def _hull(pool: Pool, which: jax.Array, centers: jax.Array, axes: jax.Array) -> Any:
    """MJX's description of hulls; which int32[k]."""
    return private().ConvexInfo(
        pos=centers[which],
        mat=axes[which],
        size=jnp.zeros((len(which), 3)),
        vert=pool.vertices[which],
        face=pool.face_vertices[which],
        face_normal=pool.face_normals[which],
        edge=pool.edges[which],
        edge_face_normal=pool.edge_normals[which],
    )
