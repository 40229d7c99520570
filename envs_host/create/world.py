"""A level's world: its objects, the tools placed in it, who has touched what.

`drop_test` is the smallest world of all: one tool, one ball.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import pymunk

from envs_host.create import things
from envs_host.create.building import build_object, build_tool
from envs_host.create.config import PhysicsConfig
from envs_host.create.geometry import Point, to_units
from envs_host.create.layout import Layout
from envs_host.create.levels.schema import MARKER_TYPE, BallSpec, GoalSpec
from envs_host.create.sprites import Kind, Sprite, Tone
from envs_host.create.stage import Stage
from envs_host.create.things import Thing
from envs_host.create.tools import Tool, ToolClass, all_tools

SUBGOAL_RADIUS = 3.0
PROBE_RADIUS = 4.0
PROBE_MASS = 10.0
DROP_TOOL_POSITION = (42.0, 42.0)

_FRAME_LENGTH = 90.0
_FRAME_THICKNESS = 2.0
_FRAME_ELASTICITY = 0.5
_FRAME = (((1.0, 0.0), 90.0), ((-1.0, 0.0), 90.0), ((0.0, 1.0), 0.0))


class Placement(StrEnum):
    """What became of an attempt to place a tool."""

    PLACED = "placed"
    NO_OP = "no_op"
    BLOCKED = "blocked"
    INVALID = "invalid"


class Positions(NamedTuple):
    """Centres in world units; `marker` is None in plain levels."""

    target: Point
    marker: Point | None
    goal: Point


class World:
    """The physical world of one episode.

    Attributes:
      stage: the space and what has been touched in it.
      target, goal: always there. marker: the marker ball of a marker level, else None.
      tools: what has been placed, in order; `tool_positions` are their normalised centres.
      objects: level objects as listed.
      marker_subgoals, target_subgoals: those that have not been removed.
      frame: the walls, if any.
    """

    def __init__(
        self,
        layout: Layout,
        physics: PhysicsConfig,
        frame_walls: bool,
        min_tool_distance: float,
    ) -> None:
        """Builds the world in a fixed order, on which the engine's last digits depend.

        Args:
          layout: a level and this episode's offsets.
          physics: gravity, variants.
          frame_walls: whether the right, left and top edges are closed.
          min_tool_distance: normalised distance of centres up to which a placed tool blocks.
        """
        level = layout.level
        self.stage = Stage(physics)
        self.min_tool_distance = min_tool_distance
        self.tools: list[Thing] = []
        self.tool_positions: list[Point] = []
        self.target = _ball(level.target, to_units(layout.place("target", level.target.pos)))
        self.goal = _goal(level.goal, to_units(layout.place("goal", level.goal.pos)))
        self.objects = [
            build_object(spec, to_units(layout.place(spec.key, spec.pos))) for spec in level.objects
        ]
        markers = [place for place, o in enumerate(level.objects) if o.type == MARKER_TYPE]
        self.marker = self.objects[markers[0]] if markers else None
        self.marker_subgoals = [_subgoal(position) for position in level.subgoals_for_marker]
        self.target_subgoals = [_subgoal(position) for position in level.subgoals_for_target]
        self.frame = _frame() if frame_walls else []
        # Not in the order of drawing: target and goal come after the level's objects.
        subgoals = (*self.marker_subgoals, *self.target_subgoals)
        for thing in (*self.objects, self.target, self.goal, *subgoals, *self.frame):
            self.stage.add(thing)
        # What may move, of the things whose speed counts.
        self._movers = [
            thing.body for thing in (self.target, self.goal, *self.objects) if thing.is_dynamic
        ]

    @property
    def positions(self) -> Positions:
        """Where target, marker and goal are now, in units."""
        marker = None if self.marker is None else tuple(self.marker.body.position)
        return Positions(tuple(self.target.body.position), marker, tuple(self.goal.body.position))

    def check_placement(self, tool: Tool, position: Point) -> Placement:
        """What `place` would answer, without doing it."""
        return self._try(tool, position)[0]

    def place(self, tool: Tool, position: Point) -> Placement:
        """Places a tool if it may be placed (docs/create.md, "Placement").

        Args:
          tool: any tool.
          position: normalised centre. Tools may lie partly outside the picture.
        """
        placement, thing = self._try(tool, position)
        if thing is not None:
            self.stage.add(thing)
            self.tools.append(thing)
            if thing.is_dynamic:
                self._movers.append(thing.body)
            self.tool_positions.append(position)
        return placement

    def run(
        self, num_substeps: int, watch: Callable[[World], None] | None = None, watch_every: int = 4
    ) -> None:
        """Advances the world; `watch` sees it after every `watch_every` substeps (films)."""
        if watch is None:
            self.stage.run(num_substeps)
            return
        for done in range(0, num_substeps, watch_every):
            self.stage.run(min(watch_every, num_substeps - done))
            watch(self)

    @property
    def has_touched_goal(self) -> bool:
        """Whether target and goal have begun to touch in any substep so far."""
        return self.stage.have_met(self.target, self.goal)

    @property
    def has_marker_hit_target(self) -> bool:
        """Whether marker and target have begun to touch in any substep so far."""
        return self.marker is not None and self.stage.have_met(self.marker, self.target)

    def take_reached_subgoals(self) -> int:
        """Removes the subgoals that are touched now by who must touch them; how many."""
        num_reached = 0
        for who, subgoals in (
            (self.marker, self.marker_subgoals),
            (self.target, self.target_subgoals),
        ):
            for disc in list(subgoals):
                if who is not None and self.stage.is_inside(who, disc):
                    subgoals.remove(disc)
                    self.stage.remove(disc)
                    num_reached += 1
        return num_reached

    def is_still(self, stop_speed: float) -> bool:
        """Whether the bodies of target, goal, tools and objects are slower than `stop_speed`.

        Only the linear speed of the main body counts; what is static is slow enough.
        """
        return all(math.hypot(*body.velocity) < stop_speed for body in self._movers)

    def sprites(self) -> Iterator[Sprite]:
        """What to draw, in drawing order."""
        for thing in self._things():
            yield from thing.sprites()

    def _things(self) -> Iterator[Thing]:
        yield self.target
        yield self.goal
        for group in (
            self.tools,
            self.objects,
            self.marker_subgoals,
            self.target_subgoals,
            self.frame,
        ):
            yield from group

    def _try(self, tool: Tool, position: Point) -> tuple[Placement, Thing | None]:
        """The verdict on a placement and, if it is allowed, the thing to add."""
        if not all(-1.0 <= coordinate <= 1.0 for coordinate in position):
            return Placement.INVALID, None
        if tool.tool_class == ToolClass.NO_OP:
            return Placement.NO_OP, None
        for other in self.tool_positions:
            if math.dist(position, other) <= self.min_tool_distance:
                return Placement.BLOCKED, None
        thing = build_tool(tool, to_units(position))
        if not self.stage.is_free(thing):
            return Placement.BLOCKED, None
        return Placement.PLACED, thing


def drop_test(
    tool_id: int,
    ball_position: Point,
    num_substeps: int,
    tool_position: Point = DROP_TOOL_POSITION,
    physics: PhysicsConfig | None = None,
) -> tuple[np.ndarray, int | None]:
    """Releases a probe ball (radius 4, mass 10) at rest near one tool in an empty world.

    Args:
      tool_id: a tool of the 15-degree list.
      ball_position: centre of the ball, units.
      num_substeps: substeps of 1/30 s.
      tool_position: centre of the tool, units.
      physics: default: the paper's.

    Returns:
      f64[num_substeps, 4] ball (x, y, vx, vy) in units and units/s after each substep, and the
      first substep (from 1) in which the shapes touched, or None.
    """
    tools = all_tools()
    if not 0 <= tool_id < len(tools):
        raise ValueError(f"tool_id={tool_id} is not in 0..{len(tools) - 1}.")
    stage = Stage(physics or PhysicsConfig())
    probe = probe_ball(ball_position)
    watch = ContactWatch(stage)
    if tools[tool_id].tool_class != ToolClass.NO_OP:
        stage.add(build_tool(tools[tool_id], tool_position))
    stage.add(probe)
    states = np.empty((num_substeps, 4))
    first_contact = None
    for substep in range(num_substeps):
        stage.run(1)
        states[substep] = *probe.body.position, *probe.body.velocity
        if first_contact is None and watch.has_seen_contact:
            first_contact = substep + 1
    return states, first_contact


def probe_ball(position: Point) -> Thing:
    """The ball of drop tests and recordings, at a position in units."""
    return things.ball(position, PROBE_RADIUS, PROBE_MASS, Tone.MARKER)


class ContactWatch:
    """Whether anything in a space has begun to touch anything else."""

    def __init__(self, stage: Stage) -> None:
        self.has_seen_contact = False
        stage.space.on_collision(None, None, begin=self._see)

    def _see(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
        self.has_seen_contact = True


def _ball(spec: BallSpec, position: Point) -> Thing:
    kind = Kind.BASKETBALL if spec.look == "basketball" else Kind.DISC
    tone = Tone.PICTURE if kind == Kind.BASKETBALL else Tone.TARGET
    return things.ball(position, spec.radius, spec.mass, tone, spec.elasticity, spec.friction, kind)


def _goal(spec: GoalSpec, position: Point) -> Thing:
    if spec.kind == "star":
        return things.star(position, spec.size)
    if spec.kind == "basket":
        return things.basket(position, spec.size)
    ball = spec.ball
    assert ball is not None
    return things.ball(position, ball.radius, ball.mass, Tone.GOAL, ball.elasticity, ball.friction)


def _subgoal(position: Point) -> Thing:
    return things.subgoal(to_units(position), SUBGOAL_RADIUS)


def _frame() -> list[Thing]:
    """Walls at the right, the left and the top edge; the bottom is open."""
    return [
        things.bar(
            to_units(position),
            math.radians(angle_deg),
            _FRAME_LENGTH,
            _FRAME_THICKNESS,
            _FRAME_ELASTICITY,
            1.0,
            Tone.FRAME,
        )
        for position, angle_deg in _FRAME
    ]
