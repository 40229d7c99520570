"""Collision hulls of all classes in one padded format, so that shapes are data.

NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from envs_mjx.shape_stacking.polyhedra import Polyhedron
from envs_mjx.shape_stacking.solids import NUM_CLASSES, Solid, solids

MAX_VERTICES = 24
MAX_FACES = 14
MAX_FACE_VERTICES = 12
MAX_EDGES = 36

# What stands in the rows of classes without a hull; their engines shrink it to nothing.
_STAND_IN = "cube"


@dataclass(frozen=True)
class HullTable:
    """The hull of each class at s = 1, in its own axes, **relative to its centre of mass**.

    Multiply `vertices` by s and put s * `centers` into the position of the collision geometry;
    normals stay. Padding never changes a hull: vertices beyond `num_vertices` are the centre of
    mass (never a support point), faces beyond `num_faces` repeat face 0, a face with fewer corners
    repeats its last, edges beyond `num_edges` repeat edge 0. V = 24, F = 14, P = 12, E = 36.

    Attributes:
      has_hull: bool[16] false for sphere and capsule, whose rows hold the cube's hull.
      centers: f64[16, 3] centre of mass of the true solid relative to the shape's origin, m.
      vertices: f64[16, V, 3] m.
      faces: int32[16, F, P] vertex indices, counter-clockwise seen from outside.
      face_normals: f64[16, F, 3] outward unit vectors.
      edges: int32[16, E, 2] vertex indices, the smaller first.
      edge_normals: f64[16, E, 2, 3] normals of the two faces at each edge.
      num_vertices, num_faces, num_edges: int32[16] rows that are not padding.
    """

    has_hull: np.ndarray
    centers: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    face_normals: np.ndarray
    edges: np.ndarray
    edge_normals: np.ndarray
    num_vertices: np.ndarray
    num_faces: np.ndarray
    num_edges: np.ndarray

    @property
    def face_vertices(self) -> np.ndarray:
        """f64[16, F, P, 3] the corners of each face, m."""
        classes = np.arange(NUM_CLASSES)[:, None, None]
        return self.vertices[classes, self.faces]


@lru_cache(maxsize=1)
def hull_table() -> HullTable:
    """The hulls of all classes, in the order of `solids.CLASS_NAMES`."""
    rows = [_row(solid) for solid in solids()]
    return HullTable(**{key: np.stack([row[key] for row in rows]) for key in rows[0]})


def _row(solid: Solid) -> dict[str, np.ndarray]:
    center = solid.moments.center
    hull = solid.hull
    if hull is None:
        hull = next(other.hull for other in solids() if other.name == _STAND_IN)
    assert hull is not None
    edges, faces_at_edges = hull.edges()
    normals = hull.face_normals
    return {
        "has_hull": np.array(solid.hull is not None),
        "centers": center,
        "vertices": _pad(hull.vertices - center, MAX_VERTICES, np.zeros(3)),
        "faces": _padded_faces(hull),
        "face_normals": _pad(normals, MAX_FACES, normals[0]),
        "edges": _pad(edges, MAX_EDGES, edges[0]),
        "edge_normals": _pad(normals[faces_at_edges], MAX_EDGES, normals[faces_at_edges[0]]),
        "num_vertices": np.array(len(hull.vertices), np.int32),
        "num_faces": np.array(len(hull.faces), np.int32),
        "num_edges": np.array(len(edges), np.int32),
    }


def _padded_faces(hull: Polyhedron) -> np.ndarray:
    rows = [(*face, *[face[-1]] * (MAX_FACE_VERTICES - len(face))) for face in hull.faces]
    faces = np.array(rows, np.int32)
    return _pad(faces, MAX_FACES, faces[0])


def _pad(rows: np.ndarray, length: int, filler: np.ndarray) -> np.ndarray:
    """`rows` followed by copies of `filler` up to `length` rows."""
    missing = np.broadcast_to(filler, (length - len(rows), *rows.shape[1:]))
    return np.concatenate([rows, missing])
