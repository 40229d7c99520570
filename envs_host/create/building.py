"""From tools and from the objects of a level to things in the world."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from envs_host.create import things
from envs_host.create.geometry import Point
from envs_host.create.sprites import Tone
from envs_host.create.things import Thing
from envs_host.create.tools.catalogue import POLYGON_SIDES, Tool, ToolClass

if TYPE_CHECKING:
    from envs_host.create.levels.schema import ObjectSpec

RAMP_THICKNESS = 2.0
_DISC_FRICTION = 0.0  # Never set in the release.
_SOLID_FRICTION = 1.0


def build_tool(tool: Tool, position: Point) -> Thing:
    """The thing that a tool puts into the world, at a position in units.

    Raises:
      ValueError: the tool is the no-op, which puts nothing there.
    """
    if tool.tool_class == ToolClass.NO_OP:
        raise ValueError(f"Tool {tool.id} is the no-op; it places nothing.")
    build = _TOOL_BUILDERS.get(tool.tool_class, _build_polygon)
    return build(tool, position)


def build_object(spec: ObjectSpec, position: Point) -> Thing:
    """The thing of a level's object, at a position in units."""
    return _OBJECT_BUILDERS[spec.type](spec, position)


def _tone(tool: Tool) -> Tone:
    return Tone.BOUNCY_TOOL if tool.tool_class.value.startswith("bouncy") else Tone.TOOL


def _angle(tool: Tool) -> float:
    return math.radians(_number(tool.angle_deg))


def _number(value: float | None) -> float:
    """A parameter that the tool's class always has."""
    assert value is not None
    return value


def _build_ramp(tool: Tool, position: Point) -> Thing:
    return things.bar(
        position,
        _angle(tool),
        _number(tool.size),
        RAMP_THICKNESS,
        _number(tool.elasticity),
        _SOLID_FRICTION,
        Tone.TOOL,
    )


def _build_trampoline(tool: Tool, position: Point) -> Thing:
    length, elasticity = _number(tool.size), _number(tool.elasticity)
    return things.trampoline(position, _angle(tool), length, elasticity)


def _build_disc(tool: Tool, position: Point) -> Thing:
    radius, elasticity = _number(tool.size), _number(tool.elasticity)
    return things.disc(position, radius, elasticity, _DISC_FRICTION, _tone(tool))


def _build_box(tool: Tool, position: Point) -> Thing:
    side, elasticity = _number(tool.size), _number(tool.elasticity)
    return things.static_box(position, side, elasticity, _SOLID_FRICTION, _tone(tool))


def _build_polygon(tool: Tool, position: Point) -> Thing:
    return things.polygon(
        position,
        POLYGON_SIDES[tool.tool_class],
        _number(tool.size),
        _angle(tool),
        _number(tool.elasticity),
        _SOLID_FRICTION,
        _tone(tool),
    )


def _build_lever(tool: Tool, position: Point) -> Thing:
    return things.lever(position, _number(tool.size), _number(tool.friction))


def _build_limited_seesaw(tool: Tool, position: Point) -> Thing:
    max_angle = math.radians(_number(tool.max_angle_deg))
    return things.limited_seesaw(position, _number(tool.size), max_angle, _number(tool.friction))


def _build_weighted_seesaw(tool: Tool, position: Point) -> Thing:
    max_angle = math.radians(_number(tool.max_angle_deg))
    length, mass = _number(tool.size), _number(tool.weight_mass)
    return things.weighted_seesaw(position, length, max_angle, str(tool.weight_side), mass)


def _build_cannon(tool: Tool, position: Point) -> Thing:
    return things.cannon(position, _angle(tool), _number(tool.force))


def _build_fan(tool: Tool, position: Point) -> Thing:
    return things.fan(position, _angle(tool), _number(tool.force))


def _build_belt(tool: Tool, position: Point) -> Thing:
    return things.belt(position, _number(tool.size), (_number(tool.velocity), 0.0))


def _build_funnel(tool: Tool, position: Point) -> Thing:
    return things.funnel(position, _angle(tool), _number(tool.size))


def _build_bucket(tool: Tool, position: Point) -> Thing:
    return things.bucket(position, _angle(tool), _number(tool.size))


_TOOL_BUILDERS: dict[ToolClass, Callable[[Tool, Point], Thing]] = {
    ToolClass.RAMP: _build_ramp,
    ToolClass.TRAMPOLINE: _build_trampoline,
    ToolClass.BALL: _build_disc,
    ToolClass.BOUNCY_BALL: _build_disc,
    ToolClass.BOX: _build_box,
    ToolClass.BOUNCY_BOX: _build_box,
    ToolClass.LEVER: _build_lever,
    ToolClass.LIMITED_SEESAW: _build_limited_seesaw,
    ToolClass.WEIGHTED_SEESAW: _build_weighted_seesaw,
    ToolClass.CANNON: _build_cannon,
    ToolClass.FAN: _build_fan,
    ToolClass.BELT: _build_belt,
    ToolClass.FUNNEL: _build_funnel,
    ToolClass.BUCKET: _build_bucket,
}


def _build_level_bar(spec: ObjectSpec, position: Point) -> Thing:
    return things.bar(
        position,
        math.radians(spec.number("angle_deg")),
        spec.number("length"),
        spec.number("thickness"),
        spec.number("elasticity"),
        spec.number("friction"),
        Tone(spec.text("tone")),
    )


def _build_level_trampoline(spec: ObjectSpec, position: Point) -> Thing:
    angle = math.radians(spec.number("angle_deg"))
    length, elasticity = spec.number("length"), spec.number("elasticity")
    return things.trampoline(position, angle, length, elasticity, spec.number("friction"))


def _build_level_ball(spec: ObjectSpec, position: Point) -> Thing:
    return things.ball(
        position,
        spec.number("radius"),
        spec.number("mass"),
        Tone(spec.text("tone")),
        spec.number("elasticity"),
        spec.number("friction"),
    )


def _build_level_box(spec: ObjectSpec, position: Point) -> Thing:
    side, mass = spec.number("size"), spec.number("mass")
    return things.dynamic_box(
        position, side, mass, spec.number("elasticity"), spec.number("friction")
    )


def _build_level_disc(spec: ObjectSpec, position: Point) -> Thing:
    radius, elasticity = spec.number("radius"), spec.number("elasticity")
    return things.disc(
        position, radius, elasticity, spec.number("friction"), Tone(spec.text("tone"))
    )


def _build_level_polygon(spec: ObjectSpec, position: Point) -> Thing:
    return things.polygon(
        position,
        int(spec.number("sides")),
        spec.number("circumradius"),
        math.radians(spec.number("angle_deg")),
        spec.number("elasticity"),
        spec.number("friction"),
        Tone(spec.text("tone")),
    )


def _build_level_lever(spec: ObjectSpec, position: Point) -> Thing:
    return things.lever(position, spec.number("length"), spec.number("friction"))


def _build_level_limited_seesaw(spec: ObjectSpec, position: Point) -> Thing:
    max_angle = math.radians(spec.number("max_angle_deg"))
    return things.limited_seesaw(
        position, spec.number("length"), max_angle, spec.number("friction")
    )


def _build_level_weighted_seesaw(spec: ObjectSpec, position: Point) -> Thing:
    max_angle = math.radians(spec.number("max_angle_deg"))
    side, mass = spec.text("weight_side"), spec.number("weight_mass")
    return things.weighted_seesaw(position, spec.number("length"), max_angle, side, mass)


def _build_level_cannon(spec: ObjectSpec, position: Point) -> Thing:
    return things.cannon(position, math.radians(spec.number("angle_deg")), spec.number("impulse"))


def _build_level_fan(spec: ObjectSpec, position: Point) -> Thing:
    return things.fan(position, math.radians(spec.number("angle_deg")), spec.number("force"))


def _build_level_belt(spec: ObjectSpec, position: Point) -> Thing:
    return things.belt(position, spec.number("length"), spec.pair("velocity"))


def _build_level_ladder(spec: ObjectSpec, position: Point) -> Thing:
    angle = math.radians(spec.number("angle_deg"))
    return things.ladder(position, angle, spec.number("length"), spec.pair("velocity"))


def _build_level_funnel(spec: ObjectSpec, position: Point) -> Thing:
    angle = math.radians(spec.number("angle_deg"))
    return things.funnel(position, angle, spec.number("circumradius"))


def _build_level_bucket(spec: ObjectSpec, position: Point) -> Thing:
    angle = math.radians(spec.number("angle_deg"))
    return things.bucket(position, angle, spec.number("circumradius"))


_OBJECT_BUILDERS: dict[str, Callable[[ObjectSpec, Point], Thing]] = {
    "bar": _build_level_bar,
    "trampoline": _build_level_trampoline,
    "marker_ball": _build_level_ball,
    "dynamic_ball": _build_level_ball,
    "dynamic_box": _build_level_box,
    "disc": _build_level_disc,
    "polygon": _build_level_polygon,
    "lever": _build_level_lever,
    "limited_see_saw": _build_level_limited_seesaw,
    "see_saw": _build_level_weighted_seesaw,
    "cannon": _build_level_cannon,
    "fan": _build_level_fan,
    "belt": _build_level_belt,
    "ladder": _build_level_ladder,
    "funnel": _build_level_funnel,
    "bucket": _build_level_bucket,
}
