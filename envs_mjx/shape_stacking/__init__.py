"""Shape Stacking: towers of shapes on a table (docs/shape_stacking.md)."""

from envs_mjx.shape_stacking.environment import (
    ShapeStacking,
    StackingParams,
    StackingSettings,
    StackingState,
)
from envs_mjx.shape_stacking.shapes import ShapeLibrary, shape_library, shape_universe
from envs_mjx.shape_stacking.splits import published_split

__all__ = [
    "ShapeLibrary",
    "ShapeStacking",
    "StackingParams",
    "StackingSettings",
    "StackingState",
    "published_split",
    "shape_library",
    "shape_universe",
]
