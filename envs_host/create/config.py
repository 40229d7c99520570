"""Settings of CREATE, checked; the defaults made the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from envs_host.create.levels.object_types import REWARD
from envs_host.create.levels.schema import MAX_STEPS
from envs_host.create.tools import no_op_id, published_split
from envs_host.create.tools.catalogue import ANALYSIS_SPACING_DEG, DEFAULT_SPACING_DEG
from envs_host.create.tools.splits import analysis_split
from jaxnew.actions import ActionSplit

FanFrame = Literal["body", "world"]
FrameWalls = Literal["level", "on", "off"]
Split = Literal["default", "full", "analysis"]
SplitPart = Literal["train", "validation", "test", "all"]
ActionIds = Literal["set", "universe"]
Observation = Literal["gray", "rgb", "none"]

# Of the environments. Raised by what may move a learning curve (CHANGELOG.md, "Errata").
VERSION = 1
MAX_PIXELS = 4096  # Of the side of a picture.


@dataclass(frozen=True)
class PhysicsConfig:
    """Physics of the world (docs/create.md, "World").

    Attributes:
      gravity: units/s^2 downwards, 0 to 1000.
      substeps: `Space.step` calls of 1/30 s in one action, 1 to 10,000.
      fan_frame: frame of a fan's force: "body" turns with the object (the release that made the
        paper's numbers), "world" does not (the later release).
      bucket_zeroes_velocity: whether a caught object's velocity is zeroed on every substep (the
        later release) or grows (the paper's).

    Raises:
      ValueError: a value is not as above.
    """

    gravity: float = 2.0
    substeps: int = 40
    fan_frame: FanFrame = "body"
    bucket_zeroes_velocity: bool = False

    def __post_init__(self) -> None:
        _check_range(self, "gravity", 0, 1_000)
        _check_range(self, "substeps", 1, MAX_STEPS)
        _check_choice(self, "fan_frame", FanFrame)


@dataclass(frozen=True)
class RewardConfig:
    """Rewards (docs/create.md, "Rewards"). A level may override goal, subgoal and target_hit.

    Attributes:
      alive: every action.
      goal, subgoal: less `per_tool_discount` for every tool placed so far; subgoals not below 0.
      target_hit: once, in marker levels.
      blocked, invalid, no_op: added when a placement is blocked, out of range, or the no-op.
      marker_lost: added when the marker leaves the world before the target was hit.
      per_tool_discount: of the release; the paper does not speak of it.
      with_subgoals: False sets subgoal and target-hit rewards to 0 in every level.
      dense_scale: s of the dense variant, 0 for none; the release's "dense" is 0.1. While the goal
        is not credited, each action adds s times the decrease, since the episode's start, of the
        distance target-goal if the target is armed, and of target-marker in marker levels.

    Raises:
      ValueError: a reward is beyond a million, or `per_tool_discount` or `dense_scale` is negative.
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

    def __post_init__(self) -> None:
        for each in fields(self):
            is_size = each.name in ("per_tool_discount", "dense_scale")
            _check_range(self, each.name, 0 if is_size else REWARD.low, REWARD.high)


@dataclass(frozen=True)
class CreateRules:
    """What a run may set of the environment: how a level plays.

    Attributes:
      physics: see `PhysicsConfig`.
      rewards: see `RewardConfig`.
      step_limit: an episode has one action more; 0: the level's limit.
      stop_speed: units/s; an action at whose end all are slower is quiet, the second one ends.
      min_tool_distance: normalised distance up to which a placed tool blocks the next.
      move_threshold: displacement of the target, over sqrt(8), that counts as hit; at most 1, the
        world's diagonal.
      directional_target_hit: whether it must go towards the goal's side.
      end_on_goal: whether reaching the goal ends the episode: the paper's text, not its release.
      frame_walls: "level": as the level says; "on" or "off".
      task_id: 0 or more: freezes the noise of the level, a layout per id; -1: new noise in every
        episode.

    Raises:
      ValueError: a value is no choice, or out of its range.
    """

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    step_limit: int = 0
    stop_speed: float = 0.05
    min_tool_distance: float = 0.3
    move_threshold: float = 0.03
    directional_target_hit: bool = False
    end_on_goal: bool = False
    frame_walls: FrameWalls = "level"
    task_id: int = -1

    def __post_init__(self) -> None:
        _check_choice(self, "frame_walls", FrameWalls)
        for name, low, high in (
            ("step_limit", 0, MAX_STEPS),
            ("stop_speed", 0, 1e9),
            ("min_tool_distance", 0, 1e9),
            ("move_threshold", 0, 1),
            ("task_id", -1, 2**32 - 1),
        ):
            _check_range(self, name, low, high)


@dataclass(frozen=True)
class CreateConfig(CreateRules):
    """All settings of the environment but the level.

    Attributes:
      split, split_part: which tools action sets are drawn from.
      action_set_size: entries of a set, the no-op included.
      action_ids: "set": an action's index is a place in this episode's set. "universe": it is a
        tool's id and no set is drawn (the rollout owns the sets).
      observation: "gray" uint8[84, 84], "rgb" uint8[84, 84, 3], or "none" (physics only).
      render_size: pixels of an observation's side, 1 to 4096.

    Raises:
      ValueError: a value is no choice, or out of its range.
    """

    split: Split = "default"
    split_part: SplitPart = "train"
    action_set_size: int = 50
    action_ids: ActionIds = "set"
    observation: Observation = "gray"
    render_size: int = 84

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, choices in (
            ("split", Split),
            ("split_part", SplitPart),
            ("action_ids", ActionIds),
            ("observation", Observation),
        ):
            _check_choice(self, name, choices)
        for name, low, high in (("action_set_size", 2, 100_000), ("render_size", 1, MAX_PIXELS)):
            _check_range(self, name, low, high)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> CreateConfig:
        """The config of nested dictionaries, as `dataclasses.asdict` gives them.

        Raises:
          TypeError: there is no such field.
          ValueError: a value is out of its range.
        """
        physics = PhysicsConfig(**plain.get("physics", {}))
        rewards = RewardConfig(**plain.get("rewards", {}))
        return cls(**{**plain, "physics": physics, "rewards": rewards})

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


def _check_choice(config: object, name: str, choices: Any) -> None:
    value = getattr(config, name)
    if value not in get_args(choices):
        raise ValueError(f"{name}={value!r} must be one of {get_args(choices)}.")


def _check_range(config: object, name: str, low: float, high: float) -> None:
    value = getattr(config, name)
    if not low <= value <= high:  # NaN neither.
        raise ValueError(f"{name}={value} must be from {low:,.9g} to {high:,.9g}.")
