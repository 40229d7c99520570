"""Shape Stacking: towers of shapes on a table (spec shape_stacking)."""

from envs_mjx.shape_stacking.shapes import ShapeLibrary, shape_library, shape_universe

__all__ = ["ShapeLibrary", "shape_library", "shape_universe"]
