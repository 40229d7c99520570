"""Volume, centre of mass and inertia of solids, in closed form. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs_mjx.shape_stacking.polyhedra import Polyhedron


@dataclass(frozen=True)
class Moments:
    """Integrals over a solid of density 1.

    Attributes:
      volume: m^3.
      first: f64[3] integral of the position.
      second: f64[3, 3] integral of the outer product of the position with itself.
    """

    volume: float
    first: np.ndarray
    second: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """f64[3] the centre of mass."""
        return self.first / self.volume

    @property
    def inertia(self) -> np.ndarray:
        """f64[3, 3] inertia about the centre of mass, at density 1."""
        central = self.second - np.outer(self.first, self.first) / self.volume
        return np.trace(central) * np.eye(3) - central

    def __add__(self, other: Moments) -> Moments:
        return Moments(
            self.volume + other.volume, self.first + other.first, self.second + other.second
        )

    def __sub__(self, other: Moments) -> Moments:
        return Moments(
            self.volume - other.volume, self.first - other.first, self.second - other.second
        )

    def raised(self, height: float) -> Moments:
        """The moments of the solid moved up along z."""
        offset = np.array([0.0, 0.0, height])
        crossed = np.outer(self.first, offset)
        return Moments(
            self.volume,
            self.first + self.volume * offset,
            self.second + crossed + crossed.T + self.volume * np.outer(offset, offset),
        )


def polyhedron(solid: Polyhedron) -> Moments:
    """Sums signed tetrahedra between the origin and the triangles of every face."""
    total = _symmetric(0.0, 0.0, (0.0, 0.0, 0.0))
    for face in solid.faces:
        for i in range(1, len(face) - 1):
            corners = solid.vertices[[face[0], face[i], face[i + 1]]]
            volume = float(np.linalg.det(corners)) / 6.0
            summed = corners.sum(axis=0)
            second = volume / 20.0 * (np.outer(summed, summed) + corners.T @ corners)
            total += Moments(volume, volume / 4.0 * summed, second)
    return total


def sphere() -> Moments:
    """Radius 1 around the origin."""
    return _symmetric(4.0 / 3.0 * np.pi, 0.0, (0.2, 0.2, 0.2))


def cylinder() -> Moments:
    """Radius 1, half-height 1, axis z."""
    return _symmetric(2.0 * np.pi, 0.0, (0.25, 0.25, 1.0 / 3.0))


def capsule() -> Moments:
    """Radius 1, half-length of the straight part 1, axis z: a cylinder and two half spheres.

    The height above the middle of a half sphere set upon z = 1 has the mean square
    1/5 + 2 * 3/8 + 1 (its centre of mass is 3/8 above its flat side).
    """
    caps = _symmetric(4.0 / 3.0 * np.pi, 0.0, (0.2, 0.2, 0.2 + 0.75 + 1.0))
    return cylinder() + caps


def cone() -> Moments:
    """Base of radius 1 at z = -1, apex (0, 0, 1); mean square heights 3/80 * 2^2 + 0.5^2."""
    return _symmetric(2.0 / 3.0 * np.pi, -0.5, (0.15, 0.15, 0.4))


def half_cylinder(radius: float) -> Moments:
    """The upper half, z >= 0, of a cylinder along y with half-length 1."""
    across = radius**2 / 4.0
    height = 4.0 * radius / (3.0 * np.pi)
    return _symmetric(np.pi * radius**2, height, (across, 1.0 / 3.0, across))


def _symmetric(volume: float, height: float, squares: tuple[float, float, float]) -> Moments:
    """A solid with x and y as planes of symmetry: its centre's z and its mean squares."""
    return Moments(volume, np.array([0.0, 0.0, volume * height]), volume * np.diag(squares))
