"""Convex polyhedra: prisms and pyramids with faces, edges and normals. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Polyhedron:
    """A convex solid with flat faces.

    Attributes:
      vertices: f64[n, 3].
      faces: vertex indices of each face, counter-clockwise seen from outside.
    """

    vertices: np.ndarray
    faces: tuple[tuple[int, ...], ...]

    @property
    def face_normals(self) -> np.ndarray:
        """f64[faces, 3] unit vectors that point outwards."""
        normals = [_unit_normal(self.vertices[list(face)]) for face in self.faces]
        return np.array(normals)

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges, and the two faces that meet at each.

        Returns:
          int32[e, 2] vertex indices, the smaller first, and int32[e, 2] face indices.
        """
        faces_of: dict[tuple[int, int], list[int]] = {}
        for number, face in enumerate(self.faces):
            for start, end in zip(face, (*face[1:], face[0]), strict=True):
                faces_of.setdefault((min(start, end), max(start, end)), []).append(number)
        return np.array(list(faces_of), np.int32), np.array(list(faces_of.values()), np.int32)


def prism(section: np.ndarray, axis: int, half_length: float = 1.0) -> Polyhedron:
    """A prism along one coordinate axis, centred there.

    Args:
      section: f64[k, 2] corners of a convex polygon in order, in the other two coordinates.
      axis: 0, 1 or 2.
      half_length: of the prism along `axis`.
    """
    count = len(section)
    ends = [np.insert(section, axis, side * half_length, axis=1) for side in (-1.0, 1.0)]
    sides = [(i, (i + 1) % count, count + (i + 1) % count, count + i) for i in range(count)]
    faces = [tuple(range(count)), tuple(range(count, 2 * count)), *sides]
    return _outward(np.concatenate(ends), faces)


def pyramid(base: np.ndarray) -> Polyhedron:
    """A pyramid on the plane z = -1 with its apex at (0, 0, 1).

    Args:
      base: f64[k, 2] corners (x, y) of a convex polygon around the origin, in order.
    """
    count = len(base)
    vertices = np.concatenate([np.insert(base, 2, -1.0, axis=1), [[0.0, 0.0, 1.0]]])
    sides = [(i, (i + 1) % count, count) for i in range(count)]
    return _outward(vertices, [tuple(range(count)), *sides])


def box(half_sizes: tuple[float, float, float]) -> Polyhedron:
    """The box of these half-sizes around the origin."""
    x, y, z = half_sizes
    return prism(np.array([(-x, -z), (x, -z), (x, z), (-x, z)]), axis=1, half_length=y)


def _outward(vertices: np.ndarray, faces: list[tuple[int, ...]]) -> Polyhedron:
    """The polyhedron with every face turned so that its normal points away from the middle."""
    middle = vertices.mean(axis=0)
    turned = []
    for face in faces:
        corners = vertices[list(face)]
        is_outward = _unit_normal(corners) @ (corners[0] - middle) > 0.0
        turned.append(face if is_outward else face[::-1])
    return Polyhedron(vertices, tuple(turned))


def _unit_normal(corners: np.ndarray) -> np.ndarray:
    normal = np.cross(corners[1] - corners[0], corners[-1] - corners[0])
    return normal / np.linalg.norm(normal)
