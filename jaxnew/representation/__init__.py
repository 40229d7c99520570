"""Stage 1: recordings of an action -> its representation.

Importing this package imports nothing else; the names below are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "Modality": "jaxnew.representation.modality",
    "RepresentationConfig": "jaxnew.representation.config",
    "RepresentationLearner": "jaxnew.representation.learner",
    "RepresentationState": "jaxnew.representation.learner",
    "RepresentationTable": "jaxnew.representation.table",
    "engineered_table": "jaxnew.representation.table",
    "image_modality": "jaxnew.representation.modality",
    "one_hot_modality": "jaxnew.representation.modality",
    "vector_modality": "jaxnew.representation.modality",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxnew.representation' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
