"""World units and normalised coordinates."""

from __future__ import annotations

import math

WORLD_SIZE = 84.0

# Distances are reported in units of the longest one, the square's diagonal.
DIAGONAL = math.sqrt(8.0)

Point = tuple[float, float]


def to_units(position: Point) -> Point:
    """From [-1, 1]^2 to world units, origin bottom left."""
    return (position[0] + 1.0) / 2.0 * WORLD_SIZE, (position[1] + 1.0) / 2.0 * WORLD_SIZE


def to_normalised(position: Point) -> Point:
    """From world units to [-1, 1]^2; outside the world, outside of it."""
    return 2.0 * (position[0] / WORLD_SIZE) - 1.0, 2.0 * (position[1] / WORLD_SIZE) - 1.0


def clip(position: Point) -> Point:
    """The nearest position in [-1, 1]^2."""
    return min(max(position[0], -1.0), 1.0), min(max(position[1], -1.0), 1.0)


def is_in_bounds(position: Point) -> bool:
    """Whether a centre, in units, is strictly inside the world."""
    return 0.0 < position[0] < WORLD_SIZE and 0.0 < position[1] < WORLD_SIZE


def scaled_distance(first: Point, second: Point) -> float:
    """Distance of two positions in units: clipped, normalised, over sqrt(8)."""
    return math.dist(clip(to_normalised(first)), clip(to_normalised(second))) / DIAGONAL
