"""Grid World: navigation with five-move skills past a lava river (docs/grid_world.md)."""

from envs_mjx.grid_world.environment import (
    GridWorld,
    GridWorldParams,
    GridWorldSettings,
    GridWorldState,
)
from envs_mjx.grid_world.skills import load_skills, skill_universe

__all__ = [
    "GridWorld",
    "GridWorldParams",
    "GridWorldSettings",
    "GridWorldState",
    "load_skills",
    "skill_universe",
]
