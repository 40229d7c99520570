"""The tools of CREATE: their list, their action universe, splits (docs/create.md, "Tools")."""

from envs_host.create.tools.catalogue import (
    CLASS_ORDER,
    POLYGON_SIDES,
    Tool,
    ToolClass,
    all_tools,
    no_op_id,
)
from envs_host.create.tools.splits import (
    ANALYSIS_ANGLES_DEG,
    ANALYSIS_DISTANCES,
    ANALYSIS_UNSEEN_RATIOS,
    analysis_ids,
    analysis_split,
    analysis_train_ids,
    angle_differences,
    angle_test_ids,
    embedding_test_ids,
    full_ids,
    mix_ids,
    published_split,
    squared_train_distances,
)
from envs_host.create.tools.universe import tool_universe

__all__ = [
    "ANALYSIS_ANGLES_DEG",
    "ANALYSIS_DISTANCES",
    "ANALYSIS_UNSEEN_RATIOS",
    "CLASS_ORDER",
    "POLYGON_SIDES",
    "Tool",
    "ToolClass",
    "all_tools",
    "analysis_ids",
    "analysis_split",
    "analysis_train_ids",
    "angle_differences",
    "angle_test_ids",
    "embedding_test_ids",
    "full_ids",
    "mix_ids",
    "no_op_id",
    "published_split",
    "squared_train_distances",
    "tool_universe",
]
