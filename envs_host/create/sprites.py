"""What a world looks like, without a single pixel: the list that a renderer draws.

Draw order: target, goal, placed tools in the order of placement, level objects as listed in the
level (the marker of a marker task is the first of them), subgoals of the marker, subgoals of the
target, frame walls (right, left, top). Later sprites cover earlier ones.
`World.sprites()` yields them in this order; a renderer draws them one after another on a white
ground and sorts nothing. Reached subgoals are no longer yielded.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Kind(StrEnum):
    """The form of a sprite; `Sprite` says what its numbers mean for each of them."""

    DISC = "disc"
    STAR = "star"
    BAR = "bar"
    POLYGON = "polygon"
    PLANK = "plank"
    PIVOT = "pivot"
    TRAMPOLINE = "trampoline"
    CANNON = "cannon"
    FAN = "fan"
    BELT = "belt"
    FUNNEL = "funnel"
    BUCKET = "bucket"
    LADDER = "ladder"
    BASKET_GOAL = "basket_goal"
    BASKETBALL = "basketball"
    BOX = "box"
    SUBGOAL = "subgoal"


class Tone(StrEnum):
    """What a sprite is coloured as; gray levels and colours are the renderer's."""

    TARGET = "target"
    MARKER = "marker"
    GOAL = "goal"
    SUBGOAL = "subgoal"
    TOOL = "tool"
    BOUNCY_TOOL = "bouncy_tool"
    PLANK = "plank"
    SCENERY = "scenery"
    FRAME = "frame"
    BLACK = "black"
    PICTURE = "picture"


class Sprite(NamedTuple):
    """One thing to draw, in world units (the world is an 84 x 84 square, y up, x right).

    The picture mirrors x; that is the renderer's business, here nothing is mirrored.

    What the numbers mean, by kind ((x, y) is the centre and `width`, `sides` are 0 unless said):

    * disc: `angle` of the body, `size` radius. Tones target, marker, goal, black (heavy balls),
      tool, bouncy_tool, plank (the weight of a see-saw, radius 1).
    * star: one vertex straight up, `size` outer radius, `width` inner radius, 5 `sides`; goal.
    * bar: `angle` direction, `size` length, `width` thickness (drawn floor(thickness) wide, at
      least 1); tool (ramps), scenery, frame.
    * polygon: filled; vertices at `angle` + 2 pi k / `sides` on a circle of radius `size`; tool,
      bouncy_tool. Static boxes come as 4 sides with angle pi / 4.
    * plank: `angle` direction, `size` length, one pixel wide; plank.
    * pivot: a filled triangle; (x, y) is its tip, which is the pivot, `size` the width of its base
      (5), `width` its height (2), the base below the tip; 3 `sides`; plank.
    * trampoline: `angle` direction in radians of the bar (above pi / 2 the picture is flipped),
      `size` length, `width` thickness (2); picture.
    * cannon: `angle` aim, `size` 7.3, `width` 10: a rectangle that, turned by 10 rad and not by the
      aim, has the bounding box of the picture; picture.
    * fan: `angle` blowing direction, `size` 6.7 along it, `width` 10 across; picture.
    * belt: `angle` 0 (it runs to +x) or pi (to -x), `size` length, `width` thickness (2);
      picture.
    * funnel: vertices at `angle` + 150, 270 (the tip), 30 degrees, `size` circumradius, 3 `sides`;
      picture.
    * bucket: vertices at `angle` + 45, 135, 225, 315 degrees, open between the first two; `size`
      circumradius, 4 `sides`; picture.
    * ladder: `angle` direction of its bar (95 degrees), `size` length, `width` thickness (2);
      picture.
    * basket_goal: axis-aligned square, `size` side; picture.
    * basketball: `angle` of the body, `size` radius; picture.
    * box: `angle` of the body, `size` side; picture.
    * subgoal: `size` radius; subgoal.

    Attributes:
      kind: form, see above.
      x, y: position in units, never clipped: sprites may lie outside the square.
      angle: radians, counter-clockwise, not reduced to one turn.
      size, width: units.
      sides: number of corners, where it matters.
      tone: which tone; `picture` for things that are more than one tone.
    """

    kind: Kind
    x: float
    y: float
    angle: float
    size: float
    tone: Tone
    width: float = 0.0
    sides: int = 0
