"""What tools do to moving objects that touch them (docs/create.md, "What a tool does").

Every callback is registered for (moving object, tool), so `arbiter.shapes` comes in that order
whatever the engine found first. pymunk keeps `process_collision` until it is set again, so
`catch_in_funnel` and `catch_in_bucket` set it on every call.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import pymunk

from envs_host.create.geometry import Point


class Contact(IntEnum):
    """Collision types. Planks are dynamic, yet no moving objects: nothing below acts on them."""

    PLAIN = 0
    MOVING = 1
    CANNON = 2
    FAN = 3
    CONVEYOR = 4
    FUNNEL = 5
    BUCKET = 6
    PLANK = 7
    GOAL = 8
    SUBGOAL = 9


@dataclass(frozen=True, slots=True)
class CannonLaw:
    """Where a shot starts (units), and the impulse that it gets (mass * units/s)."""

    muzzle: Point
    impulse: Point


@dataclass(frozen=True, slots=True)
class FanLaw:
    """Force on what touches the region (mass * units/s^2)."""

    force: Point


@dataclass(frozen=True, slots=True)
class ConveyorLaw:
    """Velocity of whatever touches a belt or a ladder (units/s)."""

    velocity: Point


@dataclass(frozen=True, slots=True)
class FunnelLaw:
    """Corners of a funnel (units)."""

    tip: Point
    upper: tuple[Point, Point]


@dataclass(frozen=True, slots=True)
class BucketLaw:
    """Centre and corners of a bucket (units)."""

    centre: Point
    upper: tuple[Point, Point]
    lower: tuple[Point, Point]


@dataclass(frozen=True, slots=True)
class PlankLaw:
    """Factor on a ball's velocities after each substep of contact, 2 - friction."""

    damping: float


Law = CannonLaw | FanLaw | ConveyorLaw | FunnelLaw | BucketLaw | PlankLaw


@dataclass
class Ledger:
    """What callbacks need to know and to remember about the shapes of one space.

    Attributes:
      zeroes_velocity: whether buckets zero the velocity of what they hold on every substep.
      laws: what the shape of a tool does to moving objects.
      caught: shapes that a bucket has caught; the mark is never cleared.
      met: pairs of shapes that have begun to touch: goal with moving, moving with moving.
      inside: (moving, subgoal) shapes that touch now.
    """

    zeroes_velocity: bool = False
    laws: dict[pymunk.Shape, Any] = field(default_factory=dict)  # Any: each type has its own law.
    caught: set[pymunk.Shape] = field(default_factory=set)
    met: set[frozenset[pymunk.Shape]] = field(default_factory=set)
    inside: set[tuple[pymunk.Shape, pymunk.Shape]] = field(default_factory=set)


Callback = Callable[[pymunk.Arbiter, pymunk.Space, Ledger], None]


def fire(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Cannon: what enters the region is put at the muzzle and shot."""
    shape, region = arbiter.shapes
    law = ledger.laws[region]
    put_to_rest(shape.body, law.muzzle)
    shape.body.apply_impulse_at_local_point(law.impulse)


def blow(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Fan: a force in the frame of the object, which turns as it rolls."""
    shape, region = arbiter.shapes
    shape.body.apply_force_at_local_point(ledger.laws[region].force)


def blow_in_world_frame(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Fan: a force in the frame of the world, as in the later release."""
    shape, region = arbiter.shapes
    shape.body.apply_force_at_world_point(ledger.laws[region].force, shape.body.position)


def carry(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Belt and ladder: the velocity is overwritten."""
    shape, region = arbiter.shapes
    shape.body.velocity = ledger.laws[region].velocity


def catch_in_funnel(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Funnel: from above, through to the tip; else an ordinary block."""
    shape, block = arbiter.shapes
    law = ledger.laws[block]
    centre = shape.body.position
    to_tip = math.dist(centre, law.tip)
    is_above = all(to_tip > math.dist(centre, corner) for corner in law.upper)
    if is_above:
        put_to_rest(shape.body, law.tip)
    arbiter.process_collision = not is_above


def catch_in_bucket(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Bucket: from above, held in its centre for good; else an ordinary block.

    Only the position of what is held is reset, so gravity keeps adding to its velocity.
    """
    shape, block = arbiter.shapes
    law = ledger.laws[block]
    if shape in ledger.caught:
        shape.body.position = law.centre
        if ledger.zeroes_velocity:
            shape.body.velocity = 0.0, 0.0
        arbiter.process_collision = False
        return
    centre = shape.body.position
    nearest_lower = min(math.dist(centre, corner) for corner in law.lower)
    is_above = all(math.dist(centre, corner) < nearest_lower for corner in law.upper)
    if is_above:
        put_to_rest(shape.body, law.centre)
        ledger.caught.add(shape)
    arbiter.process_collision = not is_above


def damp(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Plank: slows balls, and only balls, after the solver.

    A factor of 1 is applied, too: writing a velocity keeps the engine from putting a body to sleep.
    """
    shape, plank = arbiter.shapes
    if isinstance(shape, pymunk.Circle):
        factor = ledger.laws[plank].damping
        shape.body.velocity *= factor
        shape.body.angular_velocity *= factor


def put_to_rest(body: pymunk.Body, position: Point) -> None:
    """Moves a body and takes away its motion, its forces and its angle."""
    body.position = position
    body.velocity = 0.0, 0.0
    body.angular_velocity = 0.0
    body.force = 0.0, 0.0
    body.torque = 0.0
    body.angle = 0.0


def enter_subgoal(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Keeps account of who is in which subgoal disc now."""
    ledger.inside.add(arbiter.shapes)


def leave_subgoal(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    ledger.inside.discard(arbiter.shapes)


def meet(arbiter: pymunk.Arbiter, space: pymunk.Space, ledger: Ledger) -> None:
    """Remembers which objects have ever begun to touch."""
    ledger.met.add(frozenset(arbiter.shapes))
