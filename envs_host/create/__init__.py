"""CREATE: physics puzzles solved by placing tools (docs/create.md). NumPy and pymunk, no jax.

Importing it registers the Gymnasium ids of `registration`.
"""

from envs_host.create.config import CreateConfig, PhysicsConfig, RewardConfig
from envs_host.create.environment import CreateEnv
from envs_host.create.levels import load_level, register_folder, register_level
from envs_host.create.registration import register_environments
from envs_host.create.tools import tool_universe
from envs_host.create.world import drop_test

__all__ = [
    "CreateConfig",
    "CreateEnv",
    "PhysicsConfig",
    "RewardConfig",
    "drop_test",
    "load_level",
    "register_environments",
    "register_folder",
    "register_level",
    "tool_universe",
]

register_environments()
