"""Gymnasium ids: `jaxnew/CreatePush-v1` with noise, `jaxnew/CreatePushDet-v1` without."""

from __future__ import annotations

import gymnasium

from envs_host.create.config import VERSION
from envs_host.create.levels.registry import BUILT_IN_NAMES

_ENTRY_POINT = "envs_host.create.environment:CreateEnv"


def register_environments() -> tuple[str, ...]:
    """Registers the twelve tasks and GoalTest, each with and without noise; may be called again.

    Returns:
      the ids.
    """
    ids = []
    for name in BUILT_IN_NAMES:
        for suffix, deterministic in (("", False), ("Det", True)):
            env_id = f"jaxnew/Create{name}{suffix}-v{VERSION}"
            ids.append(env_id)
            if env_id not in gymnasium.registry:
                gymnasium.register(
                    env_id,
                    entry_point=_ENTRY_POINT,
                    kwargs={"level": name, "deterministic": deterministic},
                )
    return tuple(ids)
