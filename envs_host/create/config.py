"""Settings of CREATE (spec create 10); the defaults made the paper's numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

from envs_host.create.stage import PhysicsConfig
from envs_host.create.tools import no_op_id, published_split
from envs_host.create.tools.catalogue import ANALYSIS_SPACING_DEG, DEFAULT_SPACING_DEG
from envs_host.create.tools.splits import PUBLISHED_SPLITS, analysis_split
from jaxnew.actions import SPLIT_NAMES, ActionSplit

OBSERVATIONS = ("gray", "rgb", "none")
ACTION_IDS = ("set", "universe")
SPLITS = (*PUBLISHED_SPLITS, "analysis")
SPLIT_PARTS = (*SPLIT_NAMES, "all")


@dataclass(frozen=True)
class RewardConfig:
    """Rewards (spec create 6.1). A level may override goal, subgoal and target_hit.

    Attributes:
      alive: every action.
      goal, subgoal: less `per_tool_discount` for every tool placed so far; subgoals not below 0.
      target_hit: once, in marker levels.
      blocked, invalid, no_op: added when a placement is blocked, out of range, or the no-op.
      marker_lost: added when the marker leaves the world before the target was hit.
      per_tool_discount: not in the paper (A3).
      with_subgoals: False sets subgoal and target-hit rewards to 0 in every level (6.6).
      dense_scale: s of the dense variant (6.6), 0 for none; the release's "dense" is 0.1. While
        the goal is not credited, each action adds s times the decrease, since the episode's start,
        of the distance target-goal if the target is armed, and of target-marker in marker levels.
    """

    alive: float = 0.01
    goal: float = 10.0
    subgoal: float = 2.0
    target_hit: float = 1.0
    blocked: float = -0.01
    invalid: float = -0.01
    no_op: float = 0.0
    marker_lost: float = 0.0
    per_tool_discount: float = 0.1
    with_subgoals: bool = True
    dense_scale: float = 0.0


@dataclass(frozen=True)
class CreateConfig:
    """All settings of the environment but the level.

    Attributes:
      physics: see `PhysicsConfig`.
      rewards: see `RewardConfig`.
      step_limit: an episode has one action more; 0: the level's limit (A1).
      stop_speed: units/s; an action at whose end all are slower is quiet, the second one ends.
      min_tool_distance: normalised distance up to which a placed tool blocks the next.
      move_threshold: displacement of the target, over sqrt(8), that counts as hit.
      directional_target_hit: whether it must go towards the goal's side (6.6).
      end_on_goal: whether reaching the goal ends the episode (A2).
      frame_walls: "level": as the level says; "on" or "off".
      split, split_part: which tools action sets are drawn from.
      action_set_size: entries of a set, the no-op included (8.2).
      action_ids: "set": an action's index is a place in this episode's set. "universe": it is a
        tool's id and no set is drawn (the rollout owns the sets).
      observation: "gray" uint8[84, 84], "rgb" uint8[84, 84, 3], or "none" (physics only).
      render_size: pixels of an observation's side.
      task_id: 0 or more: freezes the noise of the level, a layout per id; -1: new noise in every
        episode.
    """

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    step_limit: int = 0
    stop_speed: float = 0.05
    min_tool_distance: float = 0.3
    move_threshold: float = 0.03
    directional_target_hit: bool = False
    end_on_goal: bool = False
    frame_walls: str = "level"
    split: str = "default"
    split_part: str = "train"
    action_set_size: int = 50
    action_ids: str = "set"
    observation: str = "gray"
    render_size: int = 84
    task_id: int = -1

    def __post_init__(self) -> None:
        for name, choices in (
            ("frame_walls", ("level", "on", "off")),
            ("split", SPLITS),
            ("split_part", SPLIT_PARTS),
            ("action_ids", ACTION_IDS),
            ("observation", OBSERVATIONS),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}={getattr(self, name)!r} must be one of {choices}.")
        for name, low in (
            ("step_limit", 0),
            ("stop_speed", 0),
            ("min_tool_distance", 0),
            ("move_threshold", 0),
            ("action_set_size", 2),
            ("render_size", 1),
            ("task_id", -1),
        ):
            if getattr(self, name) < low:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {low}.")

    @property
    def angle_spacing(self) -> int:
        """Degrees between orientations in the tool list that the split belongs to."""
        return ANALYSIS_SPACING_DEG if self.split == "analysis" else DEFAULT_SPACING_DEG

    @property
    def no_op_id(self) -> int:
        return no_op_id(self.angle_spacing)

    def action_split(self) -> ActionSplit:
        """The split by name; ids belong to the list of `angle_spacing`."""
        return analysis_split() if self.split == "analysis" else published_split(self.split)
