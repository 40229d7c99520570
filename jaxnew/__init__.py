"""JAX implementation of "Generalization to New Actions in Reinforcement Learning" (ICML 2020).

Importing this package imports nothing else; the names below are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "Action": "jaxnew.environment",
    "ActionObservations": "jaxnew.observations",
    "ActionPool": "jaxnew.sampling",
    "ActionSplit": "jaxnew.actions",
    "ActionUniverse": "jaxnew.actions",
    "AvailableSet": "jaxnew.sampling",
    "Environment": "jaxnew.environment",
    "Evaluator": "jaxnew.evaluation",
    "FixedActionSet": "jaxnew.environment",
    "Hyperparameters": "jaxnew.ppo",
    "Learner": "jaxnew.ppo",
    "PPOConfig": "jaxnew.ppo",
    "RepresentationLearner": "jaxnew.representation.learner",
    "RepresentationTable": "jaxnew.representation.table",
    "Task": "jaxnew.task",
    "draw_sets": "jaxnew.sampling",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxnew' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
