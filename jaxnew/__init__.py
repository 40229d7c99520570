"""JAX implementation of "Generalization to New Actions in Reinforcement Learning" (ICML 2020).

Importing this package imports nothing else; the names below are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.3.0"

_HOMES = {
    "Action": "jaxnew.environment",
    "ActionPool": "jaxnew.sampling",
    "ActionSplit": "jaxnew.actions",
    "ActionUniverse": "jaxnew.actions",
    "Actions": "jaxnew.sampling",
    "AvailableSet": "jaxnew.sampling",
    "Comparison": "jaxnew.comparison",
    "DeviceRollout": "jaxnew.rollout.device",
    "Domain": "jaxnew.task.domain",
    "Encoder": "jaxnew.embedding",
    "Environment": "jaxnew.environment",
    "Episode": "jaxnew.rollout.contract",
    "Evaluation": "jaxnew.results",
    "FixedActionSet": "jaxnew.environment",
    "HostRollout": "jaxnew.rollout.host",
    "Hyperparameters": "jaxnew.ppo",
    "Learner": "jaxnew.ppo",
    "MethodContext": "jaxnew.policy.method",
    "NetworkConfig": "jaxnew.policy.config",
    "PPOConfig": "jaxnew.ppo",
    "Policy": "jaxnew.rollout.contract",
    "PolicyMethod": "jaxnew.policy.method",
    "Recordings": "jaxnew.observations",
    "RepresentationConfig": "jaxnew.representation.config",
    "RepresentationLearner": "jaxnew.representation.learner",
    "RepresentationTable": "jaxnew.representation.table",
    "Rollout": "jaxnew.rollout.contract",
    "RolloutConfig": "jaxnew.rollout.contract",
    "Run": "jaxnew.run",
    "Runs": "jaxnew.runs",
    "Task": "jaxnew.task.task",
    "Trainer": "jaxnew.trainer",
    "check_environment": "jaxnew.checks.environment",
    "check_method": "jaxnew.checks.policy",
    "collect": "jaxnew.recording",
    "compare": "jaxnew.comparison",
    "draw_sets": "jaxnew.sampling",
    "embed": "jaxnew.embedding",
    "finetune": "jaxnew.training",
    "load_task": "jaxnew.task.domain",
    "make_method": "jaxnew.policy.method",
    "record": "jaxnew.recording",
    "sweep": "jaxnew.sweeping",
    "train": "jaxnew.training",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxnew' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
