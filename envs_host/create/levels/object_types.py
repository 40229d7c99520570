"""The objects that a level may contain, their parameters and defaults.

A *basic* type lists its parameters; one without a default must be given. A *preset* is a basic type
with other defaults; every parameter can still be given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from envs_host.create.geometry import WORLD_SIZE

Value = float | str | tuple[float, float]

TONES = ("scenery", "frame", "black", "marker", "tool", "bouncy_tool")
WEIGHT_SIDES = ("right", "left")


@dataclass(frozen=True)
class Parameter:
    """One parameter: "number", "pair" (of numbers) or "choice", its range, its default.

    Attributes:
      kind: which of the three.
      default: used if the level says nothing; None: the level has to say.
      low, high: numbers lie in [low, high], those of a pair each.
      choices: of a "choice".
    """

    kind: str
    default: Value | None = None
    low: float = 0.0
    high: float = 0.0
    choices: tuple[str, ...] = ()

    @property
    def allowed(self) -> str:
        """The legal values in words."""
        if self.kind == "choice":
            return f"one of {self.choices}"
        what = "a number" if self.kind == "number" else "two numbers [x, y], each"
        return f"{what} from {self.low:,.9g} to {self.high:,.9g}"


def _length(default: float | None = None) -> Parameter:
    """Units: a radius, a side, a length. From a pixel to twice the side of the world."""
    return Parameter("number", default, 1.0, 2.0 * WORLD_SIZE)


def _mass(default: float | None = None) -> Parameter:
    return Parameter("number", default, 0.01, 10_000.0)


def _elasticity(default: float) -> Parameter:
    """Of two that touch, the product counts; above 1 they part faster than they met."""
    return Parameter("number", default, 0.0, 2.0)


def _friction(default: float) -> Parameter:
    return Parameter("number", default, 0.0, 100.0)


def _angle(default: float | None = None) -> Parameter:
    return Parameter("number", default, -360.0, 360.0)


def _push(default: float | None = None) -> Parameter:
    """An impulse or a force."""
    return Parameter("number", default, -10_000.0, 10_000.0)


def _velocity(default: tuple[float, float]) -> Parameter:
    return Parameter("pair", default, -1_000.0, 1_000.0)


def _tone(default: str) -> Parameter:
    return Parameter("choice", default, choices=TONES)


def _ladder_velocity(speed: float) -> tuple[float, float]:
    """(4 v cos 95 deg, v sin 95 deg) units/s."""
    return 4.0 * speed * math.cos(math.radians(95.0)), speed * math.sin(math.radians(95.0))


# Of positions and their offsets, normalised: a world's width beyond its edges.
POSITION = Parameter("pair", None, -3.0, 3.0)
REWARD = Parameter("number", None, -1e6, 1e6)

_PLANK_FRICTION = Parameter("number", 1.0, low=1.0, high=2.0)
_MAX_ANGLE = Parameter("number", None, low=0.1, high=90.0)
BALL = {
    "radius": _length(4.0),
    "mass": _mass(10.0),
    "elasticity": _elasticity(1.0),
    "friction": _friction(1.0),
}
STAR = {"circumradius": _length(4.0)}
BASKET = {"sensor_square": _length(10.0)}
_CATCHER = {"angle_deg": _angle(0.0), "circumradius": _length()}

BASIC_TYPES: Mapping[str, Mapping[str, Parameter]] = {
    "bar": {
        "angle_deg": _angle(0.0),
        "length": _length(16.0),
        "thickness": _length(2.0),
        "elasticity": _elasticity(0.5),
        "friction": _friction(1.0),
        "tone": _tone("scenery"),
    },
    "trampoline": {
        "angle_deg": _angle(0.0),
        "length": _length(16.0),
        "elasticity": _elasticity(1.2),
        "friction": _friction(1.0),
    },
    "marker_ball": {**BALL, "tone": _tone("marker")},
    "dynamic_ball": {**BALL, "tone": _tone("black")},
    "dynamic_box": {
        "size": _length(5.0),
        "mass": _mass(10.0),
        "elasticity": _elasticity(0.1),
        "friction": _friction(1.0),
    },
    "disc": {
        "radius": _length(),
        "elasticity": _elasticity(0.5),
        "friction": _friction(0.0),
        "tone": _tone("tool"),
    },
    "polygon": {
        "sides": Parameter("number", None, low=3.0, high=12.0),
        "circumradius": _length(),
        "angle_deg": _angle(0.0),
        "elasticity": _elasticity(0.5),
        "friction": _friction(1.0),
        "tone": _tone("tool"),
    },
    "lever": {"length": _length(), "friction": _PLANK_FRICTION},
    "limited_see_saw": {
        "length": _length(),
        "max_angle_deg": _MAX_ANGLE,
        "friction": _PLANK_FRICTION,
    },
    "see_saw": {
        "length": _length(),
        "max_angle_deg": _MAX_ANGLE,
        "weight_side": Parameter("choice", choices=WEIGHT_SIDES),
        "weight_mass": _mass(),
    },
    "cannon": {"angle_deg": _angle(), "impulse": _push()},
    "fan": {"angle_deg": _angle(), "force": _push()},
    "belt": {"length": _length(20.0), "velocity": _velocity((5.0, 0.0))},
    "ladder": {
        "angle_deg": _angle(95.0),
        "length": _length(20.0),
        "velocity": _velocity(_ladder_velocity(4.0)),
    },
    "funnel": _CATCHER,
    "bucket": _CATCHER,
}


def _ramps() -> dict[str, tuple[str, dict[str, Value]]]:
    """Ramps and the livelier bumps of 30, 45 and 60 degrees, rising to the right or to the left."""
    presets: dict[str, tuple[str, dict[str, Value]]] = {}
    for name, elasticity in (("ramp", 0.5), ("bump", 0.8)):
        for angle_deg in (30, 45, 60):
            both = {f"{name}_{angle_deg}": angle_deg, f"{name}_{angle_deg}_reversed": -angle_deg}
            for full_name, signed in both.items():
                presets[full_name] = (
                    "bar",
                    {"angle_deg": float(signed), "length": 16.0, "elasticity": elasticity},
                )
    return presets


PRESETS: Mapping[str, tuple[str, Mapping[str, Value]]] = {
    "long_floor": ("bar", {"length": 24.0}),
    "medium_floor": ("bar", {"length": 16.0}),
    "short_floor": ("bar", {"length": 8.0}),
    "very_short_floor": ("bar", {"length": 4.0}),
    "floor": ("bar", {"length": 16.0}),
    "wall": ("bar", {"length": 16.0, "angle_deg": 90.0}),
    "elastic_wall": ("bar", {"length": 16.0, "angle_deg": 90.0, "elasticity": 0.8}),
    **_ramps(),
    "trampoline_45": ("trampoline", {"angle_deg": 45.0}),
    "trampoline_45_reversed": ("trampoline", {"angle_deg": -45.0}),
    "trampoline_vertical": ("trampoline", {"angle_deg": 90.0}),
    "ball": ("dynamic_ball", {}),
    "box": ("dynamic_box", {}),
    "right_belt": ("belt", {"velocity": (-4.0, 0.0)}),
    "down_ladder": ("ladder", {"velocity": _ladder_velocity(-4.0)}),
    "fast_ladder": ("ladder", {"length": 15.0}),
}

ALL_TYPES = (*BASIC_TYPES, *PRESETS)


def resolve(type_name: str) -> tuple[str, dict[str, Parameter]]:
    """The basic type behind a name, and its parameters with the defaults of that name.

    Raises:
      KeyError: there is no such type.
    """
    basic, overrides = PRESETS.get(type_name, (type_name, {}))
    parameters = dict(BASIC_TYPES[basic])
    for name, default in overrides.items():
        parameters[name] = replace(parameters[name], default=default)
    return basic, parameters
