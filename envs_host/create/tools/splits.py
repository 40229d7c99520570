"""Which tools are trained with and which are new (docs/create.md, "Splits" and "Analysis").

The no-op belongs to no part: it is `always_available`, and entry 0 of every action set.
"""

from __future__ import annotations

import json
from functools import lru_cache
from importlib import resources

import numpy as np

from envs_host.create.tools.catalogue import (
    ANALYSIS_SPACING_DEG,
    POLYGON_SIDES,
    Tool,
    ToolClass,
    all_tools,
    no_op_id,
)
from envs_host.create.tools.universe import tool_universe
from jaxnew.actions import ActionSplit, mixture_ids

PUBLISHED_SPLITS = ("default", "full")
ANALYSIS_ANGLES_DEG = (15, 12, 9, 6, 3)
ANALYSIS_DISTANCES = tuple(step / 2 for step in range(1, 11))
ANALYSIS_UNSEEN_RATIOS = (0.0, 0.2, 0.4, 0.6, 0.8)
MIX_DISTANCE = 3.0

_ANGLE_TOLERANCE_DEG = 1e-6
_TRAIN_SPACING_DEG = 30.0
_ANALYSIS_CLASSES = (
    ToolClass.RAMP,
    ToolClass.TRAMPOLINE,
    ToolClass.TRIANGLE,
    ToolClass.BOUNCY_TRIANGLE,
    ToolClass.LIMITED_SEESAW,
    ToolClass.WEIGHTED_SEESAW,
    ToolClass.CANNON,
    ToolClass.FAN,
    ToolClass.FUNNEL,
    ToolClass.BUCKET,
)
_FIRST_SEESAW_ANGLE_DEG = 5.0


@lru_cache(maxsize=2)
def published_split(name: str = "default") -> ActionSplit:
    """A split of the 15-degree tools as published; it cannot be drawn again, as its order is lost.

    Args:
      name: "default" (1,097 / 507 / 506 tools; train and evaluation differ by angle within each
        class) or "full" (938 / 400 / 399; they differ by class).

    Raises:
      ValueError: there is no such split.
    """
    if name not in PUBLISHED_SPLITS:
        raise ValueError(f"split={name!r} is not published; choose one of {PUBLISHED_SPLITS}.")
    file = resources.files("envs_host.create.tools") / "published_splits.json"
    record = json.loads(file.read_text())
    parts = record["splits"][name]
    return ActionSplit(
        train=_ids(parts["train"]),
        validation=_ids(parts["validation"]),
        test=_ids(parts["test"]),
        universe_hash=tool_universe().hash,
        always_available=np.array([no_op_id()], np.int32),
    )


@lru_cache(maxsize=1)
def analysis_split() -> ActionSplit:
    """The 3-degree tools of the analysis (paper figure 9).

    Train: the 761 tools whose angle is a multiple of 30 degrees (5 + 30 k for see-saws). Test: the
    6,023 tools at least 3 degrees from every training angle, classes pooled: the union of all angle
    test sets. Validation, of which the paper says nothing: the 771 new tools that are in no angle
    test set, because some other class trains with an angle nearby.
    """
    unseen = np.setdiff1d(analysis_ids(), analysis_train_ids())
    test = angle_test_ids(min(ANALYSIS_ANGLES_DEG))
    return ActionSplit(
        train=analysis_train_ids(),
        validation=np.setdiff1d(unseen, test),
        test=test,
        universe_hash=tool_universe(ANALYSIS_SPACING_DEG).hash,
        always_available=np.array([no_op_id(ANALYSIS_SPACING_DEG)], np.int32),
    )


def full_ids() -> np.ndarray:
    """int32[1737] all tools of the full split; with the no-op, the release's "all" list."""
    return published_split("full").ids("all")


@lru_cache(maxsize=1)
def analysis_ids() -> np.ndarray:
    """int32[7555] ids in the 3-degree list of the analysis's classes, without the no-op."""
    tools = all_tools(ANALYSIS_SPACING_DEG)
    return np.array([tool.id for tool in tools if tool.tool_class in _ANALYSIS_CLASSES], np.int32)


@lru_cache(maxsize=1)
def analysis_train_ids() -> np.ndarray:
    """int32[761] ids in the 3-degree list of the analysis's training tools (paper: 762)."""
    tools = all_tools(ANALYSIS_SPACING_DEG)
    kept = [i for i in analysis_ids().tolist() if _is_on_coarse_grid(tools[i])]
    return np.array(kept, np.int32)


def angle_test_ids(min_difference_deg: float, per_class: bool = False) -> np.ndarray:
    """Analysis tools that are at least so many degrees from what was trained with.

    Args:
      min_difference_deg: theta; the paper uses 15, 12, 9, 6 and 3.
      per_class: False, the released rule: plain differences to the training angles of all classes
        pooled (0, 30, ..., 330 and 5, 35, 65), so that 345 counts as far from 0. True: circular
        differences, with the period of the shape, to the training angles of the tool's class.

    Returns:
      int32[n] ascending ids in the 3-degree list; never a training tool when theta > 0.

    Raises:
      ValueError: `min_difference_deg` is not positive.
    """
    if not min_difference_deg > 0.0:
        raise ValueError(f"min_difference_deg={min_difference_deg} must be above 0 degrees.")
    ids = analysis_ids()
    differences = angle_differences(per_class)
    return ids[differences >= min_difference_deg - _ANGLE_TOLERANCE_DEG]


@lru_cache(maxsize=2)
def angle_differences(per_class: bool = False) -> np.ndarray:
    """f64[7555] degrees from each of `analysis_ids` to the nearest training angle; see above."""
    tools = [all_tools(ANALYSIS_SPACING_DEG)[i] for i in analysis_ids().tolist()]
    trained = [all_tools(ANALYSIS_SPACING_DEG)[i] for i in analysis_train_ids().tolist()]
    pooled = np.unique([tool.primary_parameter for tool in trained])
    own = {
        tool_class: np.unique([t.primary_parameter for t in trained if t.tool_class == tool_class])
        for tool_class in _ANALYSIS_CLASSES
    }
    differences = []
    for tool in tools:
        references = own[tool.tool_class] if per_class else pooled
        gaps = np.abs(tool.primary_parameter - references)
        period = _period_deg(tool.tool_class)
        if per_class and period is not None:
            gaps = np.minimum(gaps, period - gaps)
        differences.append(gaps.min())
    return np.array(differences)


def embedding_test_ids(table: np.ndarray, min_squared_distance: float) -> np.ndarray:
    """Analysis tools whose representation is far from every training tool's.

    The release compares the *squared* Euclidean distance with 0.5, 1.0, ..., 5.0.

    Args:
      table: f32[10877, d] representation of every tool of the 3-degree list.
      min_squared_distance: the distance to every training tool exceeds it.

    Returns:
      int32[n] ascending ids in the 3-degree list.

    Raises:
      ValueError: the table has other rows.
    """
    return analysis_ids()[squared_train_distances(table) > min_squared_distance]


def squared_train_distances(table: np.ndarray) -> np.ndarray:
    """f64[7555] squared distance of each of `analysis_ids` to the nearest training tool.

    Args:
      table: f32[10877, d] representation of every tool of the 3-degree list.

    Raises:
      ValueError: the table has other rows.
    """
    num_tools = len(all_tools(ANALYSIS_SPACING_DEG))
    if table.ndim != 2 or len(table) != num_tools:
        raise ValueError(
            f"The table has shape {table.shape}; it needs a row for each of the {num_tools} tools "
            f"of the {ANALYSIS_SPACING_DEG}-degree list."
        )
    trained = np.asarray(table[analysis_train_ids()], np.float64)
    nearest = [
        ((np.asarray(row, np.float64) - trained) ** 2).sum(axis=1).min()
        for row in table[analysis_ids()]
    ]
    return np.array(nearest)


def mix_ids(table: np.ndarray, unseen_ratio: float, seed: int) -> np.ndarray:
    """A pool with about the given share of new tools (paper figure 9c).

    New are the tools at a squared distance above 3.0, in an order shuffled by `seed`. The first
    share `x` of them is taken, and the first share `1 - x` of the training list, shuffled too.

    Args:
      table: f32[10877, d] representation of every tool of the 3-degree list.
      unseen_ratio: x in [0, 1]; the paper uses 0, 0.2, 0.4, 0.6 and 0.8.
      seed: of the two shuffles; pools of one seed and growing x are nested.

    Returns:
      int32[n] ids in the 3-degree list, new ones first.

    Raises:
      ValueError: the ratio or the table does not fit.
    """
    rng = np.random.default_rng(seed)
    unseen = rng.permutation(embedding_test_ids(table, MIX_DISTANCE))
    seen = rng.permutation(analysis_train_ids())
    return mixture_ids(seen, unseen, unseen_ratio)


def _ids(ranges: str) -> np.ndarray:
    """int32[n] ids of `0-1,7,9-10`; both ends of a range belong to it."""
    ids: list[int] = []
    for word in ranges.split(","):
        first, _, last = word.partition("-")
        ids.extend(range(int(first), int(last or first) + 1))
    return np.array(ids, np.int32)


def _is_on_coarse_grid(tool: Tool) -> bool:
    is_seesaw = tool.max_angle_deg is not None
    offset = tool.primary_parameter - (_FIRST_SEESAW_ANGLE_DEG if is_seesaw else 0.0)
    return offset % _TRAIN_SPACING_DEG == 0.0


def _period_deg(tool_class: ToolClass) -> float | None:
    """After how many degrees a shape looks the same; None where angles do not wrap around."""
    if tool_class in (ToolClass.LIMITED_SEESAW, ToolClass.WEIGHTED_SEESAW):
        return None
    if tool_class in (ToolClass.RAMP, ToolClass.TRAMPOLINE):
        return 180.0
    return 360.0 / POLYGON_SIDES.get(tool_class, 1)
