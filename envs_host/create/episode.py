"""The rules of one episode: what an action earns, when it is over (docs/create.md, "Actions")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from envs_host.create.config import CreateConfig
from envs_host.create.geometry import Point, clip, is_in_bounds, scaled_distance
from envs_host.create.layout import Layout
from envs_host.create.tools import Tool
from envs_host.create.world import Placement, Positions, World

_QUIET_ACTIONS_ALLOWED = 1


class End(StrEnum):
    """Why an episode is over."""

    STEP_LIMIT = "step_limit"
    TARGET_OUT = "target_out"
    STILL = "still"
    MARKER_OUT = "marker_out"
    GOAL = "goal"


@dataclass
class Summary:
    """Totals of an episode so far.

    Attributes:
      length: actions.
      goal_hit, target_hit: 0 or 1.
      reward: undiscounted return; `subgoal_reward` and `dense_reward` are parts of it.
      num_placed, num_no_op, num_blocked, num_invalid: outcomes of the actions.
    """

    length: int = 0
    goal_hit: int = 0
    target_hit: int = 0
    reward: float = 0.0
    subgoal_reward: float = 0.0
    dense_reward: float = 0.0
    num_placed: int = 0
    num_no_op: int = 0
    num_blocked: int = 0
    num_invalid: int = 0


@dataclass(frozen=True)
class Outcome:
    """What one action brought: its reward, and why the episode ends now (nothing: it goes on)."""

    reward: float
    placement: Placement
    ends: tuple[End, ...] = field(default=())

    @property
    def terminated(self) -> bool:
        return any(end != End.STEP_LIMIT for end in self.ends)

    @property
    def truncated(self) -> bool:
        return End.STEP_LIMIT in self.ends


class Episode:
    """An episode under way. An action is `simulate`, then (after drawing) `judge`.

    The picture of an action still shows the subgoals that `judge` then removes.

    A copy (`copy.deepcopy`, `pickle`) plays the actions that were judged again: the engine's memory
    of what touches what, on which the last digits depend, cannot be copied.
    """

    def __init__(self, layout: Layout, config: CreateConfig) -> None:
        self._layout = layout
        self._actions: list[tuple[Tool, Point]] = []
        self.config = config
        self.level = layout.level
        self.step_limit = config.step_limit or self.level.step_limit
        walls = self.level.frame_walls if config.frame_walls == "level" else None
        has_walls = config.frame_walls == "on" if walls is None else walls
        self.world = World(layout, config.physics, has_walls, config.min_tool_distance)
        self.summary = Summary()
        self._start = self.world.positions
        self._num_quiet = 0
        self._placement = Placement.NO_OP
        self._rewards = {
            name: self.level.reward_overrides.get(name, getattr(config.rewards, name))
            for name in ("goal", "subgoal", "target_hit")
        }
        if not config.rewards.with_subgoals:
            self._rewards.update(subgoal=0.0, target_hit=0.0)

    def step(self, tool: Tool, position: Point) -> Outcome:
        """One whole action; `position` is normalised and clipped to [-1, 1]."""
        self.simulate(tool, position)
        return self.judge()

    def simulate(
        self,
        tool: Tool,
        position: Point,
        watch: Callable[[World], None] | None = None,
        watch_every: int = 4,
    ) -> None:
        """Tries to place the tool and runs the world."""
        self._action = tool, position
        self._placement = self.world.place(tool, clip(position))
        self.world.run(self.config.physics.substeps, watch, watch_every)

    def judge(self) -> Outcome:
        """Rewards and ends of the action just simulated."""
        self._actions.append(self._action)
        summary = self.summary
        reward = self.config.rewards.alive + self._placement_reward()
        summary.length += 1
        now = self.world.positions
        ends = self._common_ends(now)
        is_armed = summary.target_hit == 1 or not self.level.has_marker
        dense = self._dense_reward(now, is_armed)
        if is_armed and summary.goal_hit == 0 and self.world.has_touched_goal:
            summary.goal_hit = 1
            reward += self._rewards["goal"] - self._discount()
            if self.config.end_on_goal:
                ends.append(End.GOAL)
        subgoals = self.world.take_reached_subgoals() * max(
            0.0, self._rewards["subgoal"] - self._discount()
        )
        if self.level.has_marker:
            reward += self._judge_marker(now, ends)
        reward += subgoals + dense
        summary.reward += reward
        summary.subgoal_reward += subgoals
        summary.dense_reward += dense
        return Outcome(reward, self._placement, tuple(ends))

    def __reduce__(self) -> tuple[Callable[..., Episode], tuple[Any, ...]]:
        return _replayed, (self._layout, self.config, self._actions)

    def _placement_reward(self) -> float:
        """Counts the outcome of the placement and gives its reward."""
        name = self._placement.value
        setattr(self.summary, f"num_{name}", getattr(self.summary, f"num_{name}") + 1)
        return 0.0 if name == "placed" else getattr(self.config.rewards, name)

    def _discount(self) -> float:
        """How much less a goal or subgoal is worth by now: 0.1 per placed tool."""
        return self.config.rewards.per_tool_discount * self.summary.num_placed

    def _common_ends(self, now: Positions) -> list[End]:
        """The ends that every kind of level has."""
        ends = []
        if self.summary.length > self.step_limit:
            ends.append(End.STEP_LIMIT)
        if not is_in_bounds(now.target):
            ends.append(End.TARGET_OUT)
        # Never reset: the second quiet action ends, consecutive or not.
        self._num_quiet += self.world.is_still(self.config.stop_speed)
        if self._num_quiet > _QUIET_ACTIONS_ALLOWED:
            ends.append(End.STILL)
        return ends

    def _judge_marker(self, now: Positions, ends: list[End]) -> float:
        """The target's first hit, then the marker's bounds."""
        reward = 0.0
        if self.summary.target_hit == 0 and self._is_target_hit(now.target):
            self.summary.target_hit = 1
            reward += self._rewards["target_hit"]
        assert now.marker is not None
        if self.summary.target_hit == 0 and not is_in_bounds(now.marker):
            ends.append(End.MARKER_OUT)
            reward += self.config.rewards.marker_lost
        return reward

    def _is_target_hit(self, now: Point) -> bool:
        """Whether the target, now here, has moved, and by the marker if it must."""
        start = self._start.target
        has_moved = scaled_distance(start, now) > self.config.move_threshold
        if self.level.marker_must_hit_target:
            has_moved = has_moved and self.world.has_marker_hit_target
        if self.config.directional_target_hit:
            towards_goal = self._start.goal[0] - start[0]
            has_moved = has_moved and (now[0] - start[0]) * towards_goal > 0.0
        return has_moved

    def _dense_reward(self, now: Positions, is_armed: bool) -> float:
        """The dense variant's part, before this action's goal is credited."""
        scale = self.config.rewards.dense_scale
        if scale == 0.0 or self.summary.goal_hit == 1:
            return 0.0
        start, gain = self._start, 0.0
        if is_armed:
            gain += scaled_distance(start.target, start.goal)
            gain -= scaled_distance(now.target, now.goal)
        if start.marker is not None and now.marker is not None:
            gain += scaled_distance(start.target, start.marker)
            gain -= scaled_distance(now.target, now.marker)
        return scale * gain


def _replayed(
    layout: Layout, config: CreateConfig, actions: Sequence[tuple[Tool, Point]]
) -> Episode:
    """An episode in which these actions were done."""
    episode = Episode(layout, config)
    for action in actions:
        episode.step(*action)
    return episode
