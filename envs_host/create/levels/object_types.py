"""The objects that a level may contain, their parameters and defaults.

A *basic* type lists its parameters; one without a default must be given. A *preset* is a basic type
with other defaults; every parameter can still be given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

Value = float | str | tuple[float, float]

TONES = ("scenery", "frame", "black", "marker", "tool", "bouncy_tool")
WEIGHT_SIDES = ("right", "left")


@dataclass(frozen=True)
class Parameter:
    """One parameter: "number", "pair" (of numbers) or "choice", its range, its default.

    Attributes:
      kind: which of the three.
      default: used if the level says nothing; None: the level has to say.
      low, high: numbers lie in [low, high]; with `is_open`, above `low`.
      choices: of a "choice".
    """

    kind: str
    default: Value | None = None
    low: float = -math.inf
    high: float = math.inf
    is_open: bool = False
    choices: tuple[str, ...] = ()

    @property
    def allowed(self) -> str:
        """The legal values in words."""
        if self.kind == "choice":
            return f"one of {self.choices}"
        what = "a number" if self.kind == "number" else "two numbers [x, y]"
        low = f" above {self.low:g}" if self.is_open else f" of at least {self.low:g}"
        low = "" if math.isinf(self.low) else low
        high = "" if math.isinf(self.high) else f", at most {self.high:g}"
        return f"{what}{low}{high}"


def _positive(default: float | None = None) -> Parameter:
    return Parameter("number", default, low=0.0, is_open=True)


def _at_least_zero(default: float | None = None) -> Parameter:
    return Parameter("number", default, low=0.0)


def _number(default: float | None = None) -> Parameter:
    return Parameter("number", default)


def _tone(default: str) -> Parameter:
    return Parameter("choice", default, choices=TONES)


def _ladder_velocity(speed: float) -> tuple[float, float]:
    """(4 v cos 95 deg, v sin 95 deg) units/s."""
    return 4.0 * speed * math.cos(math.radians(95.0)), speed * math.sin(math.radians(95.0))


_ELASTICITY = _at_least_zero(0.5)
_FRICTION = _at_least_zero(1.0)
_PLANK_FRICTION = Parameter("number", 1.0, low=1.0, high=2.0)
_MAX_ANGLE = Parameter("number", None, low=0.0, high=90.0, is_open=True)
_BALL = {
    "radius": _positive(4.0),
    "mass": _positive(10.0),
    "elasticity": _at_least_zero(1.0),
    "friction": _FRICTION,
}
_CATCHER = {"angle_deg": _number(0.0), "circumradius": _positive()}

BASIC_TYPES: Mapping[str, Mapping[str, Parameter]] = {
    "bar": {
        "angle_deg": _number(0.0),
        "length": _positive(16.0),
        "thickness": _positive(2.0),
        "elasticity": _ELASTICITY,
        "friction": _FRICTION,
        "tone": _tone("scenery"),
    },
    "trampoline": {
        "angle_deg": _number(0.0),
        "length": _positive(16.0),
        "elasticity": _at_least_zero(1.2),
        "friction": _FRICTION,
    },
    "marker_ball": {**_BALL, "tone": _tone("marker")},
    "dynamic_ball": {**_BALL, "tone": _tone("black")},
    "dynamic_box": {
        "size": _positive(5.0),
        "mass": _positive(10.0),
        "elasticity": _at_least_zero(0.1),
        "friction": _FRICTION,
    },
    "disc": {
        "radius": _positive(),
        "elasticity": _ELASTICITY,
        "friction": _at_least_zero(0.0),
        "tone": _tone("tool"),
    },
    "polygon": {
        "sides": Parameter("number", None, low=3.0, high=12.0),
        "circumradius": _positive(),
        "angle_deg": _number(0.0),
        "elasticity": _ELASTICITY,
        "friction": _FRICTION,
        "tone": _tone("tool"),
    },
    "lever": {"length": _positive(), "friction": _PLANK_FRICTION},
    "limited_see_saw": {
        "length": _positive(),
        "max_angle_deg": _MAX_ANGLE,
        "friction": _PLANK_FRICTION,
    },
    "see_saw": {
        "length": _positive(),
        "max_angle_deg": _MAX_ANGLE,
        "weight_side": Parameter("choice", choices=WEIGHT_SIDES),
        "weight_mass": _positive(),
    },
    "cannon": {"angle_deg": _number(), "impulse": _number()},
    "fan": {"angle_deg": _number(), "force": _number()},
    "belt": {"length": _positive(20.0), "velocity": Parameter("pair", (5.0, 0.0))},
    "ladder": {
        "angle_deg": _number(95.0),
        "length": _positive(20.0),
        "velocity": Parameter("pair", _ladder_velocity(4.0)),
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
