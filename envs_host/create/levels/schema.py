"""What a level file holds, read and checked. Numbers only, no expressions.

A file is one JSON object:

    schema                  1
    name                    the level's name, letters and digits
    kind                    "marker" (a marker ball is to move the target) or "plain"
    step_limit              an episode has one action more (default 30)
    frame_walls             whether bars close the right, the left and the top (default false)
    marker_must_hit_target  marker levels: whether only a touch by the marker counts (default false)
    reward_overrides        {"goal": .., "subgoal": .., "target_hit": ..}, any of them
    target                  {"pos", "radius", "mass", "elasticity", "friction", "look"}
    goal                    {"kind": "star", "pos"}, {"kind": "ball", "pos", and as target} or
                            {"kind": "basket", "pos", "sensor_square"}
    subgoals                {"for_target": [pos, ..], "for_marker": [pos, ..]}
    noise                   list of groups; the members of a group share one random offset:
                            {"members": [..], "dx": [low, high], "dy": [low, high]} uniform, or
                            {"members": [..], "choice": [offset, ..]} one of them
    objects                 list of {"key", "type", "pos", parameters of the type}

Positions are normalised, [x, y] with the world in [-1, 1], y up; lengths are units of the 84-unit
world, angles degrees counter-clockwise. Members of noise groups are `target`, `goal` and keys of
objects. A marker level has one object of type `marker_ball`. `object_types` lists types, parameters
and the range of every number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from envs_host.create.geometry import Point
from envs_host.create.levels._reading import LevelError, Reader
from envs_host.create.levels.object_types import (
    ALL_TYPES,
    BALL,
    BASKET,
    REWARD,
    STAR,
    Parameter,
    Value,
    resolve,
)

SCHEMA = 1
MAX_STEPS = 10_000
KINDS = ("marker", "plain")
GOAL_KINDS = ("star", "ball", "basket")
LOOKS = ("target", "basketball")
REWARD_NAMES = ("goal", "subgoal", "target_hit")
MARKER_TYPE = "marker_ball"


@dataclass(frozen=True)
class BallSpec:
    """A dynamic ball: normalised position, radius in units, mass, surface, look."""

    pos: Point
    radius: float
    mass: float
    elasticity: float
    friction: float
    look: str


@dataclass(frozen=True)
class GoalSpec:
    """The goal: `kind` star (`size` circumradius), basket (`size` side) or ball (`ball` is set)."""

    kind: str
    pos: Point
    size: float
    ball: BallSpec | None = None


@dataclass(frozen=True)
class NoiseGroup:
    """Members that share one offset: uniform in `dx` x `dy`, or one of `choice` if it has any."""

    members: tuple[str, ...]
    dx: Point = (0.0, 0.0)
    dy: Point = (0.0, 0.0)
    choice: tuple[Point, ...] = ()


@dataclass(frozen=True)
class ObjectSpec:
    """An object of a level: key, basic type, normalised position, every parameter of the type."""

    key: str
    type: str
    pos: Point
    parameters: Mapping[str, Value]

    def number(self, name: str) -> float:
        value = self.parameters[name]
        assert isinstance(value, float)
        return value

    def text(self, name: str) -> str:
        value = self.parameters[name]
        assert isinstance(value, str)
        return value

    def pair(self, name: str) -> Point:
        value = self.parameters[name]
        assert isinstance(value, tuple)
        return value


@dataclass(frozen=True)
class Level:
    """A checked level; see the module's description of the file."""

    name: str
    kind: str
    target: BallSpec
    goal: GoalSpec
    objects: tuple[ObjectSpec, ...] = ()
    noise: tuple[NoiseGroup, ...] = ()
    subgoals_for_target: tuple[Point, ...] = ()
    subgoals_for_marker: tuple[Point, ...] = ()
    step_limit: int = 30
    frame_walls: bool = False
    marker_must_hit_target: bool = False
    reward_overrides: Mapping[str, float] = field(default_factory=dict)

    @property
    def has_marker(self) -> bool:
        return self.kind == "marker"


def read_level(record: object, source: str) -> Level:
    """A level from parsed JSON.

    Args:
      record: what `json.loads` gave.
      source: where it is from, named in errors.

    Raises:
      LevelError: a field is missing, unknown or wrong; the message names source, field and what is
        allowed.
    """
    reader = Reader(record, source)
    reader.choice("schema", (SCHEMA,))
    name = reader.text("name")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*", name):
        raise reader.error("name", name, "letters and digits, a letter first")
    subgoals = reader.child("subgoals", optional=True)
    kind = reader.choice("kind", KINDS)
    level = Level(
        name=name,
        kind=kind,
        step_limit=reader.whole("step_limit", default=30, low=1, high=MAX_STEPS),
        frame_walls=reader.flag("frame_walls"),
        marker_must_hit_target=reader.flag("marker_must_hit_target"),
        reward_overrides=_read_rewards(reader.child("reward_overrides", optional=True)),
        target=_read_ball(reader.child("target")),
        goal=_read_goal(reader.child("goal")),
        subgoals_for_target=subgoals.points("for_target"),
        subgoals_for_marker=subgoals.points("for_marker"),
        objects=tuple(_read_object(child) for child in reader.children("objects")),
        noise=tuple(_read_noise(child) for child in reader.children("noise")),
    )
    subgoals.finish()
    reader.finish()
    _check_together(level, reader)
    return level


def _read_rewards(reader: Reader) -> dict[str, float]:
    rewards = _numbers(reader, {n: REWARD for n in REWARD_NAMES if n in reader.record})
    reader.finish()
    return rewards


def _read_ball(reader: Reader) -> BallSpec:
    ball = BallSpec(
        reader.point("pos"),
        look=reader.choice("look", LOOKS, default="target"),
        **_numbers(reader, BALL),
    )
    reader.finish()
    return ball


def _read_goal(reader: Reader) -> GoalSpec:
    kind = reader.choice("kind", GOAL_KINDS)
    if kind == "ball":
        ball = _read_ball(reader)
        return GoalSpec(kind, ball.pos, ball.radius, ball)
    (size,) = _numbers(reader, STAR if kind == "star" else BASKET).values()
    goal = GoalSpec(kind, reader.point("pos"), size)
    reader.finish()
    return goal


def _numbers(reader: Reader, parameters: Mapping[str, Parameter]) -> dict[str, float]:
    values = {name: reader.parameter(name, p) for name, p in parameters.items()}
    return {name: value for name, value in values.items() if isinstance(value, float)}


def _read_object(reader: Reader) -> ObjectSpec:
    type_name = reader.choice("type", ALL_TYPES)
    basic, parameters = resolve(type_name)
    values = {name: reader.parameter(name, p) for name, p in parameters.items()}
    spec = ObjectSpec(reader.text("key"), basic, reader.point("pos"), values)
    if basic == "polygon" and not spec.number("sides").is_integer():
        raise reader.error("sides", values["sides"], "a whole number")
    reader.finish()
    return spec


def _read_noise(reader: Reader) -> NoiseGroup:
    members = reader.texts("members")
    if "choice" in reader.record:
        group = NoiseGroup(members, choice=reader.points("choice"))
        if not group.choice:
            raise reader.error("choice", [], "a list of at least one offset [x, y]")
    else:
        group = NoiseGroup(members, dx=reader.interval("dx"), dy=reader.interval("dy"))
    reader.finish()
    return group


def _check_together(level: Level, reader: Reader) -> None:
    """What no single field shows: markers, keys, members."""
    keys = [spec.key for spec in level.objects]
    reserved = ("target", "goal")
    for place, key in enumerate(keys):
        if key in keys[:place] or key in reserved:
            raise reader.error(f"objects[{place}].key", key, "a key that is used only once")
    markers = [spec.key for spec in level.objects if spec.type == MARKER_TYPE]
    wanted = 1 if level.has_marker else 0
    if len(markers) != wanted:
        raise reader.error("objects", markers, f"{wanted} {MARKER_TYPE} in a {level.kind} level")
    if not level.has_marker and (level.marker_must_hit_target or level.subgoals_for_marker):
        raise reader.error("kind", level.kind, "marker, as the level speaks of a marker")
    taken: set[str] = set()
    for place, group in enumerate(level.noise):
        for member in group.members:
            if member not in (*reserved, *keys):
                allowed = f"members among {(*reserved, *keys)}"
                raise reader.error(f"noise[{place}].members", member, allowed)
            if member in taken:
                raise reader.error(f"noise[{place}].members", member, "a member of one group only")
            taken.add(member)


__all__ = [
    "BallSpec",
    "GoalSpec",
    "Level",
    "LevelError",
    "NoiseGroup",
    "ObjectSpec",
    "read_level",
]
