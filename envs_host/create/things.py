"""The objects of a world: bodies, shapes, what they do and how they look (docs/create.md, "World").

Lengths are world units, angles radians, positions world units unless a name says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import pymunk

from envs_host.create.geometry import Point
from envs_host.create.handlers import (
    BucketLaw,
    CannonLaw,
    Contact,
    ConveyorLaw,
    FanLaw,
    FunnelLaw,
    Law,
    PlankLaw,
)
from envs_host.create.sprites import Kind, Sprite, Tone

TRAMPOLINE_THICKNESS = 2.0
_STAR_INNER_SHARE = 0.5
_CANNON_SIZE = (7.3, 10.0)
_CANNON_TURN = 10.0  # Radians, for every aim: a slip of the release that shaped all data.
_CANNON_MUZZLE = (5.0, 3.65)
_FAN_SIZE = (6.7, 10.0)
_PLANK_MASS = 10.0
_PLANK_MOMENT = 10000.0
_WEIGHT_ARM_SHARE = 3.0 / 8.0
_WEIGHT_RADIUS = 1.0
_PIVOT_SIZE = (5.0, 2.0)
_CATCHER_ELASTICITY = 0.5


@dataclass(eq=False, frozen=True, slots=True)
class Thing:
    """An object in the world.

    Attributes:
      body: the body whose position and speed count.
      shape: the shape that takes part in overlap tests.
      looks: what is drawn, each with the body that it follows or None if it stands still. With a
        body, the sprite's position is ignored and its angle is added to the body's.
      law: what the thing does to moving objects, if anything.
      others: further bodies and constraints.
    """

    body: pymunk.Body
    shape: pymunk.Shape
    looks: tuple[tuple[pymunk.Body | None, Sprite], ...]
    law: Law | None = None
    others: tuple[pymunk.Body | pymunk.Constraint, ...] = ()

    @property
    def parts(self) -> tuple:
        return self.body, self.shape, *self.others

    @property
    def is_dynamic(self) -> bool:
        return self.body.body_type == pymunk.Body.DYNAMIC

    def sprites(self) -> Iterator[Sprite]:
        """How the thing looks now."""
        for body, sprite in self.looks:
            if body is None:
                yield sprite
            else:
                x, y = body.position
                # Written out, because `_replace` is slow.
                kind, size, tone = sprite.kind, sprite.size, sprite.tone
                angle = body.angle + sprite.angle
                yield Sprite(kind, x, y, angle, size, tone, sprite.width, sprite.sides)


def ball(
    position: Point,
    radius: float,
    mass: float,
    tone: Tone,
    elasticity: float = 1.0,
    friction: float = 1.0,
    kind: Kind = Kind.DISC,
) -> Thing:
    """A dynamic disc at rest."""
    body = pymunk.Body(mass, pymunk.moment_for_circle(mass, 0.0, radius))
    body.position = position
    shape = _surface(pymunk.Circle(body, radius), elasticity, friction, Contact.MOVING)
    return Thing(body, shape, ((body, Sprite(kind, 0.0, 0.0, 0.0, radius, tone)),))


def dynamic_box(
    position: Point, side: float, mass: float, elasticity: float, friction: float
) -> Thing:
    """A dynamic square at rest."""
    body = pymunk.Body(mass, pymunk.moment_for_box(mass, (side, side)))
    body.position = position
    shape = pymunk.Poly.create_box(body, (side, side))
    _surface(shape, elasticity, friction, Contact.MOVING)
    return Thing(body, shape, ((body, Sprite(Kind.BOX, 0.0, 0.0, 0.0, side, Tone.PICTURE)),))


def star(position: Point, radius: float) -> Thing:
    """A fixed goal: a sensor with the hull of a five-pointed star."""
    body = _static(position)
    corners = _corners(5, radius, math.pi / 2.0)
    shape = _sensor(pymunk.Poly(body, corners), Contact.GOAL)
    inner = _STAR_INNER_SHARE * radius
    sprite = Sprite(Kind.STAR, *position, 0.0, radius, Tone.GOAL, width=inner, sides=5)
    return Thing(body, shape, ((None, sprite),))


def basket(position: Point, side: float) -> Thing:
    """The square sensor of the Basket task."""
    body = _static(position)
    shape = _sensor(pymunk.Poly.create_box(body, (side, side)), Contact.GOAL)
    sprite = Sprite(Kind.BASKET_GOAL, *position, 0.0, side, Tone.PICTURE)
    return Thing(body, shape, ((None, sprite),))


def subgoal(position: Point, radius: float) -> Thing:
    """A sensor disc."""
    body = _static(position)
    shape = _sensor(pymunk.Circle(body, radius), Contact.SUBGOAL)
    return Thing(body, shape, ((None, Sprite(Kind.SUBGOAL, *position, 0.0, radius, Tone.SUBGOAL)),))


def bar(
    position: Point,
    angle: float,
    length: float,
    thickness: float,
    elasticity: float,
    friction: float,
    tone: Tone,
    kind: Kind = Kind.BAR,
) -> Thing:
    """A static segment whose collision radius is floor(thickness / 2)."""
    body = _static(position)
    shape = _segment(body, angle, length, math.floor(thickness / 2.0))
    _surface(shape, elasticity, friction, Contact.PLAIN)
    sprite = Sprite(kind, *position, angle, length, tone, width=thickness)
    return Thing(body, shape, ((None, sprite),))


def trampoline(
    position: Point, angle: float, length: float, elasticity: float, friction: float = 1.0
) -> Thing:
    """A bar that looks like a trampoline."""
    thickness, kind = TRAMPOLINE_THICKNESS, Kind.TRAMPOLINE
    return bar(position, angle, length, thickness, elasticity, friction, Tone.PICTURE, kind)


def disc(position: Point, radius: float, elasticity: float, friction: float, tone: Tone) -> Thing:
    """A static disc."""
    body = _static(position)
    shape = _surface(pymunk.Circle(body, radius), elasticity, friction, Contact.PLAIN)
    return Thing(body, shape, ((None, Sprite(Kind.DISC, *position, 0.0, radius, tone)),))


def polygon(
    position: Point,
    sides: int,
    radius: float,
    angle: float,
    elasticity: float,
    friction: float,
    tone: Tone,
) -> Thing:
    """A static regular polygon of circumradius `radius`."""
    body = _static(position)
    shape = pymunk.Poly(body, _corners(sides, radius, angle))
    _surface(shape, elasticity, friction, Contact.PLAIN)
    sprite = Sprite(Kind.POLYGON, *position, angle, radius, tone, sides=sides)
    return Thing(body, shape, ((None, sprite),))


def static_box(
    position: Point, side: float, elasticity: float, friction: float, tone: Tone
) -> Thing:
    """A static axis-aligned square, given by its side."""
    body = _static(position)
    shape = pymunk.Poly.create_box(body, (side, side))
    _surface(shape, elasticity, friction, Contact.PLAIN)
    radius = side / math.sqrt(2.0)
    sprite = Sprite(Kind.POLYGON, *position, math.pi / 4.0, radius, tone, sides=4)
    return Thing(body, shape, ((None, sprite),))


def cannon(position: Point, aim: float, impulse: float) -> Thing:
    """A region that shoots what enters it."""
    body = _static(position)
    shape = _sensor(pymunk.Poly(body, _rectangle(_CANNON_SIZE, _CANNON_TURN)), Contact.CANNON)
    along = (math.cos(aim), math.sin(aim))
    muzzle = tuple(
        centre + offset * part
        for centre, offset, part in zip(position, _CANNON_MUZZLE, along, strict=True)
    )
    law = CannonLaw((muzzle[0], muzzle[1]), (impulse * along[0], impulse * along[1]))
    size, width = _CANNON_SIZE
    sprite = Sprite(Kind.CANNON, *position, aim, size, Tone.PICTURE, width=width)
    return Thing(body, shape, ((None, sprite),), law)


def fan(position: Point, angle: float, force: float) -> Thing:
    """A region in which a force acts."""
    body = _static(position)
    shape = _sensor(pymunk.Poly(body, _rectangle(_FAN_SIZE, angle)), Contact.FAN)
    law = FanLaw((force * math.cos(angle), force * math.sin(angle)))
    size, width = _FAN_SIZE
    sprite = Sprite(Kind.FAN, *position, angle, size, Tone.PICTURE, width=width)
    return Thing(body, shape, ((None, sprite),), law)


def belt(position: Point, length: float, velocity: Point) -> Thing:
    """A horizontal bar that carries what touches it."""
    direction = 0.0 if velocity[0] >= 0.0 else math.pi
    return _conveyor(position, 0.0, length, velocity, Kind.BELT, direction)


def ladder(position: Point, angle: float, length: float, velocity: Point) -> Thing:
    """An upright bar that carries what touches it."""
    return _conveyor(position, angle, length, velocity, Kind.LADDER, angle)


def funnel(position: Point, angle: float, radius: float) -> Thing:
    """A triangle that lets through to its tip what comes from above."""
    body = _static(position)
    degrees = (150.0, 270.0, 30.0)
    offsets = [_on_circle(radius, math.radians(degree) + angle) for degree in degrees]
    shape = _surface(pymunk.Poly(body, offsets), _CATCHER_ELASTICITY, 1.0, Contact.FUNNEL)
    left, tip, right = (_sum(position, offset) for offset in offsets)
    sprite = Sprite(Kind.FUNNEL, *position, angle, radius, Tone.PICTURE, sides=3)
    return Thing(body, shape, ((None, sprite),), FunnelLaw(tip, (left, right)))


def bucket(position: Point, angle: float, radius: float) -> Thing:
    """A square that holds what comes from above."""
    body = _static(position)
    degrees = (135.0, 225.0, 315.0, 45.0)
    offsets = [_on_circle(radius, math.radians(degree) + angle) for degree in degrees]
    shape = _surface(pymunk.Poly(body, offsets), _CATCHER_ELASTICITY, 1.0, Contact.BUCKET)
    corners = [_sum(position, offset) for offset in offsets]
    law = BucketLaw(position, upper=(corners[0], corners[3]), lower=(corners[1], corners[2]))
    sprite = Sprite(Kind.BUCKET, *position, angle, radius, Tone.PICTURE, sides=4)
    return Thing(body, shape, ((None, sprite),), law)


def lever(position: Point, length: float, friction: float) -> Thing:
    """A plank that turns freely about its middle."""
    return _plank(position, length, friction, start_angle=0.0, max_angle=None)


def limited_seesaw(position: Point, length: float, max_angle: float, friction: float) -> Thing:
    """A plank with a soft stop."""
    return _plank(position, length, friction, start_angle=0.0, max_angle=max_angle)


def weighted_seesaw(
    position: Point, length: float, max_angle: float, weight_side: str, weight_mass: float
) -> Thing:
    """A plank with a stop and a weight, which starts with the weight down."""
    sign = 1.0 if weight_side == "right" else -1.0
    start_angle = -sign * max_angle
    plank = _plank(position, length, 1.0, start_angle, max_angle)
    weight = pymunk.Body(weight_mass, weight_mass)
    weight.position = _sum(position, _on_circle(sign * _WEIGHT_ARM_SHARE * length, start_angle))
    tie = pymunk.PivotJoint(plank.body, weight, weight.position)
    gear = pymunk.GearJoint(plank.body, weight, 0.0, 1.0)
    look = weight, Sprite(Kind.DISC, 0.0, 0.0, 0.0, _WEIGHT_RADIUS, Tone.PLANK)
    return replace(plank, looks=(*plank.looks, look), others=(*plank.others, weight, tie, gear))


def _plank(
    position: Point, length: float, friction: float, start_angle: float, max_angle: float | None
) -> Thing:
    """The plank, its pivot and, if it has one, its stop.

    The pivot is a pin joint of length zero, as in the release. The stop is a rope of one unit's
    arm, between the plank and a point left of the pivot, so it is soft.
    """
    body = pymunk.Body(_PLANK_MASS, _PLANK_MOMENT)
    body.position = position
    shape = _surface(_segment(body, start_angle, length, 0.0), 0.0, 0.0, Contact.PLANK)
    anchor = _static(position)
    joints = [pymunk.PinJoint(body, anchor)]
    if max_angle is not None:
        on_plank = (-math.cos(start_angle), -math.sin(start_angle))
        reach = 2.0 * math.sin(max_angle / 2.0)
        joints.append(pymunk.SlideJoint(body, anchor, on_plank, (-1.0, 0.0), 0.0, reach))
    width, height = _PIVOT_SIZE
    plank_sprite = Sprite(Kind.PLANK, 0.0, 0.0, start_angle, length, Tone.PLANK)
    pivot_sprite = Sprite(Kind.PIVOT, *position, 0.0, width, Tone.PLANK, width=height, sides=3)
    looks = ((body, plank_sprite), (None, pivot_sprite))
    return Thing(body, shape, looks, PlankLaw(2.0 - friction), (anchor, *joints))


def _conveyor(
    position: Point, angle: float, length: float, velocity: Point, kind: Kind, look_angle: float
) -> Thing:
    body = _static(position)
    shape = _sensor(_segment(body, angle, length, 1.0), Contact.CONVEYOR)
    sprite = Sprite(kind, *position, look_angle, length, Tone.PICTURE, width=2.0)
    return Thing(body, shape, ((None, sprite),), ConveyorLaw(velocity))


def _static(position: Point) -> pymunk.Body:
    body = pymunk.Body(body_type=pymunk.Body.STATIC)
    body.position = position
    return body


def _segment(body: pymunk.Body, angle: float, length: float, radius: float) -> pymunk.Segment:
    x, y = _on_circle(length / 2.0, angle)
    return pymunk.Segment(body, (-x, -y), (x, y), radius)


def _surface(
    shape: pymunk.Shape, elasticity: float, friction: float, contact: Contact
) -> pymunk.Shape:
    shape.elasticity = elasticity
    shape.friction = friction
    shape.collision_type = contact
    return shape


def _sensor(shape: pymunk.Shape, contact: Contact) -> pymunk.Shape:
    shape.sensor = True
    shape.collision_type = contact
    return shape


def _corners(sides: int, radius: float, angle: float) -> list[Point]:
    """Vertices at angle + 2 pi k / n, k = 1..n."""
    return [_on_circle(radius, angle + 2.0 * math.pi * k / sides) for k in range(1, sides + 1)]


def _rectangle(size: tuple[float, float], angle: float) -> list[Point]:
    """Corners of a rectangle about the origin, turned by `angle`."""
    x, y = size[0] / 2.0, size[1] / 2.0
    cos, sin = math.cos(angle), math.sin(angle)
    corners = ((-x, -y), (x, -y), (x, y), (-x, y))
    return [(cos * a - sin * b, sin * a + cos * b) for a, b in corners]


def _on_circle(radius: float, angle: float) -> Point:
    return radius * math.cos(angle), radius * math.sin(angle)


def _sum(first: Point, second: Point) -> Point:
    return first[0] + second[0], first[1] + second[1]
