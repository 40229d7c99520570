"""Shape Stacking: towers of shapes on a table (docs/shape_stacking.md)."""

from envs_mjx.shape_stacking.environment import (
    ShapeStacking,
    StackingParams,
    StackingSettings,
    StackingState,
)
from envs_mjx.shape_stacking.shapes import (
    Shape,
    ShapeLibrary,
    load_shapes,
    shape_library,
    shape_universe,
)
from envs_mjx.shape_stacking.splits import published_split

__all__ = [
    "Shape",
    "ShapeLibrary",
    "ShapeStacking",
    "StackingParams",
    "StackingSettings",
    "StackingState",
    "load_shapes",
    "published_split",
    "shape_library",
    "shape_universe",
]
