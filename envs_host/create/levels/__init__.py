"""The levels of CREATE: twelve tasks, a smoke level, the user's own (docs/create.md, "Levels")."""

from envs_host.create.levels.registry import (
    TASK_NAMES,
    level_names,
    load_level,
    parse_level,
    register_folder,
    register_level,
)
from envs_host.create.levels.schema import (
    BallSpec,
    GoalSpec,
    Level,
    LevelError,
    NoiseGroup,
    ObjectSpec,
)

__all__ = [
    "TASK_NAMES",
    "BallSpec",
    "GoalSpec",
    "Level",
    "LevelError",
    "NoiseGroup",
    "ObjectSpec",
    "level_names",
    "load_level",
    "parse_level",
    "register_folder",
    "register_level",
]
