"""A pymunk space that knows CREATE's tools: add things, run substeps."""

from __future__ import annotations

import pymunk

from envs_host.create import handlers
from envs_host.create.config import PhysicsConfig
from envs_host.create.handlers import Contact, Ledger
from envs_host.create.things import Thing

SUBSTEP_S = 1.0 / 30.0
SLEEP_TIME_S = 0.3


class Stage:
    """Things in a space. A callback exists only once something that needs it has been added.

    Attributes:
      physics: gravity, variants.
      space: the pymunk space.
      ledger: what callbacks have noted.
    """

    def __init__(self, physics: PhysicsConfig) -> None:
        self.physics = physics
        self.space = pymunk.Space()
        self.space.gravity = (0.0, -physics.gravity)
        self.space.sleep_time_threshold = SLEEP_TIME_S
        self.ledger = Ledger(physics.bucket_zeroes_velocity)
        self._handled: set[Contact] = set()

    def add(self, thing: Thing) -> None:
        """Puts a thing into the space, and its behaviour into force."""
        self.space.add(*thing.parts)
        if thing.law is not None:
            self.ledger.laws[thing.shape] = thing.law
        contact = Contact(thing.shape.collision_type)
        if contact not in self._handled:
            self._handled.add(contact)
            self._handle(contact)

    def remove(self, thing: Thing) -> None:
        """Takes a thing out of the space."""
        self.space.remove(*thing.parts)
        self.ledger.laws.pop(thing.shape, None)

    def is_free(self, thing: Thing) -> bool:
        """Whether the shape of a thing, not yet added, overlaps no shape of the space."""
        return not self.space.shape_query(thing.shape)

    def run(self, num_substeps: int) -> None:
        """Advances the world by substeps of 1/30 s."""
        step = self.space.step
        for _ in range(num_substeps):
            step(SUBSTEP_S)

    def have_met(self, first: Thing, second: Thing) -> bool:
        """Whether two things have begun to touch in any substep so far."""
        return frozenset((first.shape, second.shape)) in self.ledger.met

    def is_inside(self, thing: Thing, subgoal: Thing) -> bool:
        """Whether a thing touches a subgoal disc as of the last substep."""
        return (thing.shape, subgoal.shape) in self.ledger.inside

    def _handle(self, contact: Contact) -> None:
        """Registers the callbacks of one collision type."""
        blow = handlers.blow if self.physics.fan_frame == "body" else handlers.blow_in_world_frame
        callbacks: dict[Contact, dict[str, handlers.Callback]] = {
            Contact.CANNON: {"begin": handlers.fire},
            Contact.FAN: {"pre_solve": blow},
            Contact.CONVEYOR: {"pre_solve": handlers.carry},
            Contact.FUNNEL: {"pre_solve": handlers.catch_in_funnel},
            Contact.BUCKET: {"pre_solve": handlers.catch_in_bucket},
            Contact.PLANK: {"post_solve": handlers.damp},
            Contact.GOAL: {"begin": handlers.meet},
            Contact.MOVING: {"begin": handlers.meet},
            Contact.SUBGOAL: {
                "begin": handlers.enter_subgoal,
                "separate": handlers.leave_subgoal,
            },
        }
        if contact in callbacks:
            self.space.on_collision(Contact.MOVING, contact, data=self.ledger, **callbacks[contact])
