"""Which shapes are trained with and which are new: docs/shape_stacking.md, "Splits". NumPy only."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from envs_mjx.shape_stacking.shapes import shape_library, shape_universe
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from jaxnew.actions import ActionSplit

PUBLISHED_SPLITS = ("default", "full")

# Indices into each class's list of scales.
_DEFAULT_TRAIN_SCALES = {
    "middle_triangle": (2, 4, 5),
    "hat": (3, 4, 5),
    "triangle": (0, 3, 5),
    "tall_triangle": (0, 1, 5),
    "horizontal_rectangle": (0, 1, 4),
    "dome": (0, 3, 4),
    "cone-hires": (2, 4, 8, 9, 11, 12, 15, 16, 17, 20, 22, 23, 25, 26, 28),
    "cone": (0, 3, 4, 5, 7, 8, 15, 17, 18, 19, 21, 24, 26, 27, 28),
    "tetrahedron": (0, 3, 6, 7, 8),
    "arch": (1, 4, 5),
    "rectangle": (1, 4, 5, 8, 9),
    "half_rectangle": (0, 1, 3, 4, 8),
    "cube": (0, 2, 3, 6, 9),
    "sphere": (0, 1, 2, 3, 6, 8, 11, 12, 15, 16, 20, 22, 24, 27, 29),
    "capsule": (0, 1, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20, 27, 28),
    "cylinder": (1, 2, 5, 7, 8, 11, 14, 15, 19, 20, 22, 23, 25, 27, 28),
}
_FULL_TRAIN_CLASSES = (
    "dome",
    "rectangle",
    "half_rectangle",
    "capsule",
    "triangle",
    "tall_triangle",
    "arch",
    "sphere",
)
_HALVES_SEED = 41


@lru_cache(maxsize=2)
def published_split(name: str = "default") -> ActionSplit:
    """A split with the published training shapes.

    What is held out is cut in two as the original does it: shuffled with `RandomState(41)`, the
    first half is for validation. The order that the original shuffled from is not known; here it is
    that of the ids, so that the members of the two halves are ours.

    Args:
      name: "default" (405 / 202 / 203 shapes; train and evaluation differ by scale within each
        class, all angles follow their scale) or "full" (420 / 195 / 195; they differ by class).

    Raises:
      ValueError: there is no such split.
    """
    if name not in PUBLISHED_SPLITS:
        raise ValueError(f"split={name!r} is not published; choose one of {PUBLISHED_SPLITS}.")
    is_train = _is_default_train() if name == "default" else _is_full_train()
    held_out = np.flatnonzero(~is_train)
    np.random.RandomState(_HALVES_SEED).shuffle(held_out)
    half = len(held_out) // 2
    return ActionSplit(
        train=np.flatnonzero(is_train),
        validation=held_out[:half],
        test=held_out[half:],
        universe_hash=shape_universe().hash,
    )


def _is_default_train() -> np.ndarray:
    """bool[810]"""
    library = shape_library()
    trained = [_DEFAULT_TRAIN_SCALES[name] for name in CLASS_NAMES]
    pairs = zip(library.class_labels, library.scale_index, strict=True)
    return np.array([index in trained[label] for label, index in pairs])


def _is_full_train() -> np.ndarray:
    """bool[810]"""
    labels = [CLASS_NAMES.index(name) for name in _FULL_TRAIN_CLASSES]
    return np.isin(shape_library().class_labels, labels)
