"""Where a level's things start: as written, or with noise (docs/create.md, "Levels")."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from envs_host.create.geometry import Point
from envs_host.create.levels.schema import Level


@dataclass(frozen=True)
class Layout:
    """A level and the offset of each member of its noise groups (normalised)."""

    level: Level
    offsets: dict[str, Point] = field(default_factory=dict)

    def place(self, member: str, position: Point) -> Point:
        """The normalised position of a member in this episode."""
        dx, dy = self.offsets.get(member, (0.0, 0.0))
        return position[0] + dx, position[1] + dy


def draw_layout(level: Level, rng: np.random.Generator) -> Layout:
    """A layout with noise: one offset per group, shared by its members.

    Args:
      level: its groups say which offsets are possible.
      rng: consumed; two numbers per uniform group, one per choice, in the level's order.
    """
    offsets: dict[str, Point] = {}
    for group in level.noise:
        if group.choice:
            offset = group.choice[int(rng.integers(len(group.choice)))]
        else:
            offset = (float(rng.uniform(*group.dx)), float(rng.uniform(*group.dy)))
        offsets.update(dict.fromkeys(group.members, offset))
    return Layout(level, offsets)
