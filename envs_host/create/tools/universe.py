"""The tools as an action universe, with the hand-made vectors (docs/create.md, "Tools")."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from envs_host.create.tools.catalogue import CLASS_ORDER, DEFAULT_SPACING_DEG, Tool, all_tools
from jaxnew.actions import ActionUniverse

NUM_CLASSES = len(CLASS_ORDER)
NUM_PARAMETERS = 9


@lru_cache(maxsize=8)
def tool_universe(angle_spacing: int = DEFAULT_SPACING_DEG) -> ActionUniverse:
    """All tools of one angular spacing as an action universe.

    Classes are the 23 of `CLASS_ORDER`, the primary parameter is `Tool.primary_parameter`. The
    content is the class label and nine parameters, f64[A, 10]. Engineered vectors:

    * `gt32` f32[A, 32]: one-hot class (in the order of `CLASS_ORDER`; the release's order differed
      from run to run), then nine parameters standardised over the list.

    Args:
      angle_spacing: whole degrees; 15 (the paper's tools) or 3 (its analysis).

    Raises:
      ValueError: see `all_tools`.
    """
    tools = all_tools(angle_spacing)
    labels = np.array([tool.tool_class.label for tool in tools], np.int32)
    parameters = np.array([_parameters(tool) for tool in tools], np.float64)
    suffix = "" if angle_spacing == DEFAULT_SPACING_DEG else f"-{angle_spacing}deg"
    return ActionUniverse(
        # The version of the list of tools; that of the environments is `config.VERSION`.
        name=f"Create{suffix}-v0",
        class_labels=labels,
        class_names=tuple(tool_class.value for tool_class in CLASS_ORDER),
        primary_parameter=np.array([tool.primary_parameter for tool in tools], np.float64),
        action_names=tuple(tool.name for tool in tools),
        content=np.concatenate([labels[:, None].astype(np.float64), parameters], axis=1),
        engineered={"gt32": _engineered(labels, parameters)},
    )


def _parameters(tool: Tool) -> list[float]:
    """The nine parameters of the hand-made vector, 0 where the tool has none; angles in radians."""
    numbers = (
        tool.elasticity,
        None if tool.angle_deg is None else np.deg2rad(tool.angle_deg),
        tool.size,
        tool.friction,
        None if tool.max_angle_deg is None else np.deg2rad(tool.max_angle_deg),
        tool.weight_mass,
        float(tool.weight_side == "right"),
        tool.force,
        tool.velocity,
    )
    return [0.0 if number is None else float(number) for number in numbers]


def _engineered(labels: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """f32[A, 32] one-hot class and standardised parameters (population deviation)."""
    one_hot = np.eye(NUM_CLASSES)[labels]
    standardised = (parameters - parameters.mean(axis=0)) / parameters.std(axis=0)
    return np.concatenate([one_hot, standardised], axis=1).astype(np.float32)
