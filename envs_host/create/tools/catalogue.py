"""Every tool of CREATE: ids, classes and parameters (docs/create.md, "Tools")."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

DEFAULT_SPACING_DEG = 15
ANALYSIS_SPACING_DEG = 3

_DULL = (0.1, 0.3, 0.5)
_BOUNCY = (0.8, 1.0, 1.2)
_DULL_FINE = (0.1, 0.2, 0.3, 0.4, 0.5)
_BOUNCY_FINE = (0.8, 0.9, 1.0, 1.1, 1.2)
_BAR_LENGTHS = (6.0, 10.0, 14.0, 18.0, 22.0)
_SEESAW_LENGTHS = (12.0, 14.0, 16.0, 18.0, 20.0)
_POLYGON_RADII = (3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
_CATCHER_RADII = (3.0, 5.0, 7.0, 9.0, 11.0)
_DISC_RADII = (3.0, 5.0, 7.0, 9.0)
_BOX_SIDES = (5.0, 8.0, 11.0, 14.0)
_FIRST_SEESAW_ANGLE_DEG = 5


class ToolClass(StrEnum):
    """The 23 classes in the order of their ids; `ToolClass.label` is the index of each."""

    RAMP = "ramp"
    TRAMPOLINE = "trampoline"
    BALL = "ball"
    BOUNCY_BALL = "bouncy ball"
    BOX = "box"
    BOUNCY_BOX = "bouncy box"
    TRIANGLE = "triangle"
    BOUNCY_TRIANGLE = "bouncy triangle"
    SQUARE = "square"
    BOUNCY_SQUARE = "bouncy square"
    PENTAGON = "pentagon"
    BOUNCY_PENTAGON = "bouncy pentagon"
    HEXAGON = "hexagon"
    BOUNCY_HEXAGON = "bouncy hexagon"
    LEVER = "lever"
    LIMITED_SEESAW = "limited see-saw"
    WEIGHTED_SEESAW = "weighted see-saw"
    CANNON = "cannon"
    FAN = "fan"
    BELT = "belt"
    FUNNEL = "funnel"
    BUCKET = "bucket"
    NO_OP = "no-op"

    @property
    def label(self) -> int:
        return CLASS_ORDER.index(self)


CLASS_ORDER = tuple(ToolClass)

POLYGON_SIDES = {
    ToolClass.TRIANGLE: 3,
    ToolClass.BOUNCY_TRIANGLE: 3,
    ToolClass.SQUARE: 4,
    ToolClass.BOUNCY_SQUARE: 4,
    ToolClass.PENTAGON: 5,
    ToolClass.BOUNCY_PENTAGON: 5,
    ToolClass.HEXAGON: 6,
    ToolClass.BOUNCY_HEXAGON: 6,
}


@dataclass(frozen=True, slots=True)
class Tool:
    """One tool. A parameter that its class does not have is None.

    Attributes:
      id: place in the list.
      tool_class: one of the 23 classes.
      elasticity: share of the impact speed that an elastic ball keeps.
      angle_deg: orientation, counter-clockwise; aim of cannons and fans.
      size: units: length of bars, planks and belts, radius of balls, side of boxes, circumradius of
        polygons, funnels and buckets.
      friction: of ramps and planks; a plank's 1.00..1.10 damps what touches it.
      max_angle_deg: how far a see-saw may turn to either side.
      weight_mass: of a weighted see-saw.
      weight_side: "right" or "left", the low end of a weighted see-saw.
      force: impulse of a cannon (mass units * units/s), force of a fan (mass units * units/s^2).
      velocity: of a belt, units/s, positive to the right.
    """

    id: int
    tool_class: ToolClass
    elasticity: float | None = None
    angle_deg: float | None = None
    size: float | None = None
    friction: float | None = None
    max_angle_deg: float | None = None
    weight_mass: float | None = None
    weight_side: str | None = None
    force: float | None = None
    velocity: float | None = None

    @property
    def primary_parameter(self) -> float:
        """What the class's tools are told apart by in splits.

        The angle, and the maximal angle for see-saws, in degrees. Classes of which the splits say
        nothing: elasticity of balls and boxes, length of levers, velocity of belts; 0 for the
        no-op.
        """
        for value in (self.angle_deg, self.max_angle_deg, self.velocity, self.elasticity):
            if value is not None:
                return value
        return self.size if self.size is not None else 0.0

    @property
    def name(self) -> str:
        """Such as `ramp e=0.3 a=30 L=14`: class, then the parameters that it has."""
        letters = {
            "e": self.elasticity,
            "a": self.angle_deg,
            "s": self.size,
            "f": self.friction,
            "max": self.max_angle_deg,
            "w": self.weight_mass,
            "F": self.force,
            "v": self.velocity,
        }
        parts = [f"{letter}={value:g}" for letter, value in letters.items() if value is not None]
        side = [self.weight_side] if self.weight_side else []
        return " ".join([self.tool_class.value, *parts, *side])


@lru_cache(maxsize=8)
def all_tools(angle_spacing: int = DEFAULT_SPACING_DEG) -> tuple[Tool, ...]:
    """Every tool in the order of ids; the no-op is the last.

    Args:
      angle_spacing: degrees between neighbouring orientations; 15 gives the paper's 2,366 tools, 3
        gives the 10,877 of the analysis.

    Raises:
      ValueError: not a whole number of degrees in 1..90.
    """
    if isinstance(angle_spacing, bool) or angle_spacing not in range(1, 91):
        raise ValueError(
            f"angle_spacing={angle_spacing!r} is not a whole number of degrees in 1..90; the paper "
            f"uses {DEFAULT_SPACING_DEG} and, for its analysis, {ANALYSIS_SPACING_DEG}."
        )
    return tuple(
        Tool(tool_id, tool_class, **parameters)
        for tool_id, (tool_class, parameters) in enumerate(_rows(int(angle_spacing)))
    )


def no_op_id(angle_spacing: int = DEFAULT_SPACING_DEG) -> int:
    """Id of the tool that places nothing: the last one."""
    return len(all_tools(angle_spacing)) - 1


Row = tuple[ToolClass, dict]


def _rows(gap: int) -> Iterator[Row]:
    """Class and parameters of every tool, in the order of ids."""
    yield from _grid(ToolClass.RAMP, elasticity=_DULL, angle_deg=_turn(180, gap), size=_BAR_LENGTHS,
                     friction=(1.0,))  # fmt: skip
    yield from _grid(ToolClass.TRAMPOLINE, elasticity=_BOUNCY, angle_deg=_turn(180, gap),
                     size=_BAR_LENGTHS)  # fmt: skip
    yield from _grid(ToolClass.BALL, elasticity=_DULL_FINE, size=_DISC_RADII)
    yield from _grid(ToolClass.BOUNCY_BALL, elasticity=_BOUNCY_FINE, size=_DISC_RADII)
    yield from _grid(ToolClass.BOX, elasticity=_DULL_FINE, size=_BOX_SIDES)
    yield from _grid(ToolClass.BOUNCY_BOX, elasticity=_BOUNCY_FINE, size=_BOX_SIDES)
    for tool_class, sides in POLYGON_SIDES.items():
        angles = _turn(360 // sides, gap)
        if sides == 4:
            angles = [angle for angle in angles if angle != 45]  # It would be a box.
        bounces = _BOUNCY if tool_class.value.startswith("bouncy") else _DULL
        yield from _grid(tool_class, angle_deg=angles, elasticity=bounces, size=_POLYGON_RADII)
    yield from _planks(gap)
    yield from _grid(ToolClass.CANNON, angle_deg=_turn(360, gap), force=_steps(60, 120, 10))
    yield from _grid(ToolClass.FAN, angle_deg=_turn(360, gap), force=_steps(30, 120, 15))
    speeds = _steps(1, 6, 1)
    velocities = [*speeds, *(-speed for speed in speeds)]
    yield from _grid(ToolClass.BELT, size=_steps(6, 24, 2), velocity=velocities)
    yield from _grid(ToolClass.FUNNEL, angle_deg=_turn(360, gap), size=_CATCHER_RADII)
    yield from _grid(ToolClass.BUCKET, angle_deg=_turn(360, gap), size=_CATCHER_RADII)
    yield ToolClass.NO_OP, {}


def _planks(gap: int) -> Iterator[Row]:
    first = _FIRST_SEESAW_ANGLE_DEG
    frictions = [1.0 + hundredths / 100.0 for hundredths in range(11)]
    yield from _grid(ToolClass.LEVER, size=_steps(6, 30, 6), friction=frictions)
    yield from _grid(ToolClass.LIMITED_SEESAW, size=_SEESAW_LENGTHS,
                     max_angle_deg=_steps(first, 90, gap), friction=(1.0, 1.05, 1.1))  # fmt: skip
    yield from _grid(ToolClass.WEIGHTED_SEESAW, size=_SEESAW_LENGTHS,
                     max_angle_deg=_steps(first, 60, gap), weight_side=("right", "left"),
                     weight_mass=(2.0, 6.0, 10.0, 14.0), friction=(1.0,))  # fmt: skip


def _grid(tool_class: ToolClass, **values: Sequence) -> Iterator[Row]:
    """Every combination of values; the last parameter changes fastest."""
    for combination in itertools.product(*values.values()):
        yield tool_class, dict(zip(values, combination, strict=True))


def _turn(period_deg: int, gap: int) -> list[float]:
    """0, gap, 2 gap, ... below the angle after which the shape looks the same."""
    return [float(angle) for angle in range(0, period_deg, gap)]


def _steps(first: int, last: int, step: int) -> list[float]:
    """first, first + step, ... up to and including `last`."""
    return [float(value) for value in range(first, last + 1, step)]
