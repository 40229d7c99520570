"""The Shape Stacking task: a tower on two cylinders, from shapes let go one by one.

The observation is what a camera sees after every settling, the last four pictures of it. Rules:
docs/shape_stacking.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.shape_stacking import rules, scene
from envs_mjx.shape_stacking.camera import FRAME_SIZE, render, task_camera
from envs_mjx.shape_stacking.engines import PHYSICS, Engine, Physics, make_engine
from envs_mjx.shape_stacking.rules import REWARD_VARIANTS, Bodies, RewardVariant
from envs_mjx.shape_stacking.shapes import NUM_SHAPES, Shape
from jaxnew.environment import Action, ActionSpec, Environment, Info, ObservationSpec, Transition

STACK_SIZE = 4
POSITION_DIMS = (0, 1, 2)


@dataclass(frozen=True)
class StackingSettings:
    """What a run may set; the defaults are the published task.

    Attributes:
      physics: name of the engine, see `engines.make_engine`.
      reward_variant: see `rules.tower_reward`.
      has_shadows: draw the shadows of the two spots; pictures then take about 2.5 times as long.
      max_actions: actions after which an episode is cut, 1 to 10: a body of the pool for each.

    Raises:
      ValueError: a value is none of what is allowed.
    """

    physics: Physics = "auto"
    reward_variant: RewardVariant = "release"
    has_shadows: bool = False
    max_actions: int = scene.NUM_PLACEMENTS

    def __post_init__(self) -> None:
        for name, allowed in (("physics", PHYSICS), ("reward_variant", REWARD_VARIANTS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}={getattr(self, name)!r} must be one of {allowed}.")
        if not 1 <= self.max_actions <= scene.NUM_PLACEMENTS:
            raise ValueError(f"max_actions={self.max_actions} must be 1 to {scene.NUM_PLACEMENTS}.")


@struct.dataclass
class StackingParams:
    """Numbers of the task; traced.

    Attributes:
      max_actions: int32[] as in `StackingSettings`.
    """

    max_actions: jax.Array | int = StackingSettings.max_actions


@struct.dataclass
class StackingState:
    """One episode.

    Attributes:
      bodies: the two start cylinders, then what was placed by action k in slot k + 2.
      frames: uint8[84, 84, 4] the last pictures, newest last; zeros before the first.
      num_actions: int32[] so far.
      num_repeats: int32[] of them that named a shape which had been placed.
      max_height: f32[] largest height of the tower after any action so far, m.
    """

    bodies: Bodies
    frames: jax.Array
    num_actions: jax.Array
    num_repeats: jax.Array
    max_height: jax.Array


class ShapeStacking(Environment[StackingState, StackingParams]):
    """Build a high tower.

    Actions: 810 shapes and those of `shapes`, `action.id`, let go above the tower
      (`rules.drop_height`) at `action.position` in metres, clipped to [-1, 1]; `action.stop` ends
      the episode and places nothing. A shape that was placed before in the episode, or an id that
      does not exist, places nothing and uses the action up. After every action 3 s are simulated.
    Observation: uint8[84, 84, 4] gray pictures after the last four settlings, newest last.
    Reward: `rules.tower_reward` at the end of an episode, else 0.
    Ends: `terminated` by a stop, or where the simulation left the finite or plausible numbers, with
      reward 0 then; `truncated` after `max_actions`.
    Starts: two equal cylinders at rest, drawn anew.
    Parameters: `StackingParams`.
    Info: `final_height` f32[] height of the highest origin above the table, m; `max_height` f32[]
      the same, largest of the episode so far; `num_placed`, `num_repeats`, `episode_length` int32[]
      so far; `is_stopped`, `has_failed` (the simulation), `invalid_action` bool[] of this step;
      from `step` also `final_observation` uint8[84, 84, 4].

    Attributes:
      engine: what simulates.
      position_dim: coordinates of a position: 0 (always at x = y = 0), 1 (x) or 2 (x and y).
      shapes: of the user's own, with ids from 810.
    """

    name = "ShapeStacking-v0"
    episode_metrics = (
        "final_height",
        "max_height",
        "episode_length",
        "num_placed",
        "num_repeats",
        "is_stopped",
        "has_failed",
    )

    def __init__(
        self,
        physics: Physics | Engine = StackingSettings.physics,
        position_dim: int = 1,
        reward_variant: RewardVariant = StackingSettings.reward_variant,
        has_shadows: bool = StackingSettings.has_shadows,
        max_actions: int = StackingSettings.max_actions,
        shapes: tuple[Shape, ...] = (),
    ) -> None:
        """Takes the fields of `StackingSettings`, in place of a name also an engine.

        Args:
          physics: an engine, or its name.
          position_dim: 0, 1 or 2; the camera of 2 looks down on the table.
          reward_variant, has_shadows, max_actions: see `StackingSettings`; the last becomes
            `default_params`.
          shapes: of the user's own (`shapes.load_shapes`); an engine must have the same.

        Raises:
          ValueError: an argument is none of what is allowed.
        """
        if position_dim not in POSITION_DIMS:
            raise ValueError(f"position_dim={position_dim} must be one of {POSITION_DIMS}.")
        # Of the physics, `engine` tells.
        self._settings = StackingSettings(
            reward_variant=reward_variant, has_shadows=has_shadows, max_actions=max_actions
        )
        self.engine = make_engine(physics, shapes) if isinstance(physics, str) else physics
        self.position_dim = position_dim
        self.shapes = shapes
        if self.engine.shapes != shapes:
            raise ValueError(
                f"The engine was made for {len(self.engine.shapes)} shapes of the user's own, the "
                f"environment for {len(shapes)}, or for others; give both the same `shapes`."
            )

    @property
    def default_params(self) -> StackingParams:
        """As many actions as were set; ten if none were."""
        return StackingParams(jnp.int32(self._settings.max_actions))

    @property
    def action_spec(self) -> ActionSpec:
        """810 shapes and the user's own, `position_dim` coordinates, and a stop."""
        return ActionSpec(NUM_SHAPES + len(self.shapes), self.position_dim, has_stop=True)

    def observation_spec(self, params: StackingParams) -> ObservationSpec:
        """uint8[84, 84, 4]."""
        del params
        shape = (FRAME_SIZE, FRAME_SIZE, STACK_SIZE)
        return ObservationSpec(shape=shape, dtype=jnp.uint8, low=0, high=255)

    def max_episode_steps(self, params: StackingParams) -> int:
        """`max_actions`; `params` must be concrete.

        Raises:
          ValueError: it is not in 1..10.
        """
        return StackingSettings(max_actions=int(params.max_actions)).max_actions

    def reset_env(self, key: jax.Array, params: StackingParams) -> tuple[jax.Array, StackingState]:
        """Two cylinders at rest; consumes `key`. Returns (obs uint8[84, 84, 4], state)."""
        del params
        key_cylinder, key_center, key_gap = jax.random.split(key, 3)
        number = jax.random.randint(key_cylinder, (), 0, len(rules.START_CYLINDERS), jnp.int32)
        cylinder = jnp.array(rules.START_CYLINDERS, jnp.int32)[number]
        low, high = rules.START_CENTER
        center = jax.random.uniform(key_center, (), jnp.float32, low, high)
        low, high = rules.START_GAP
        gap = jax.random.uniform(key_gap, (), jnp.float32, low, high)
        return self.start_from(rules.start(cylinder, center, gap))

    def start_from(self, bodies: Bodies) -> tuple[jax.Array, StackingState]:
        """Starts an episode from two start cylinders and nothing else, as of `rules.start`."""
        # Two bodies are far faster to draw than all.
        picture = self.picture(bodies, scene.NUM_START_CYLINDERS)
        frames = jnp.zeros((FRAME_SIZE, FRAME_SIZE, STACK_SIZE), jnp.uint8)
        frames = frames.at[:, :, -1].set(picture)
        none = jnp.int32(0)
        return frames, StackingState(bodies, frames, none, none, rules.tower_height(bodies))

    def step_env(
        self, key: jax.Array, state: StackingState, action: Action, params: StackingParams
    ) -> Transition:
        """One action and 3 s, without auto-reset.

        Args:
          key: not used; nothing is random.
          state: of an episode in progress; what follows an end is undefined.
          action: `id` int32[], `position` f32[position_dim], `stop` bool[].

        Returns:
          (obs uint8[84, 84, 4], state, reward f32[], terminated bool[], truncated bool[], info).

        Raises:
          ValueError: the position has another number of coordinates.
        """
        del key
        stop = jnp.asarray(action.stop, bool)
        is_valid = (action.id >= 0) & (action.id < self.action_spec.num_actions)
        placed_ids = state.bodies.shape_ids[scene.NUM_START_CYLINDERS :]
        is_repeat = ~stop & is_valid & (placed_ids == action.id).any()
        places = ~stop & is_valid & ~is_repeat
        bodies, ok = self._after(state, action, places)

        height = rules.tower_height(bodies)
        next_state = StackingState(
            bodies=bodies,
            frames=jnp.concatenate(
                [state.frames[:, :, 1:], self.picture(bodies)[:, :, None]], axis=-1
            ),
            num_actions=state.num_actions + 1,
            num_repeats=state.num_repeats + is_repeat.astype(jnp.int32),
            max_height=jnp.maximum(state.max_height, height),
        )
        terminated = stop | ~ok
        truncated = ~terminated & (next_state.num_actions >= params.max_actions)
        reward = rules.tower_reward(bodies, self._settings.reward_variant)
        reward = jnp.where(ok & (terminated | truncated), reward, 0.0)
        info: Info = {
            "final_height": height,
            "max_height": next_state.max_height,
            "episode_length": next_state.num_actions,
            "num_placed": jnp.sum(
                bodies.shape_ids[scene.NUM_START_CYLINDERS :] >= 0, dtype=jnp.int32
            ),
            "num_repeats": next_state.num_repeats,
            "is_stopped": stop,
            "has_failed": ~ok,
            "invalid_action": ~is_valid,
        }
        return next_state.frames, next_state, reward, terminated, truncated, info

    def _after(
        self, state: StackingState, action: Action, places: jax.Array
    ) -> tuple[Bodies, jax.Array]:
        """The bodies at rest after the action, and whether the simulation held.

        Of a simulation that failed, they are the bodies before the action.
        """
        slot = scene.NUM_START_CYLINDERS + state.num_actions
        position = self._position(action)
        placed = rules.place(state.bodies, slot, action.id, position, self.shapes)
        before = jax.tree.map(lambda new, old: jnp.where(places, new, old), placed, state.bodies)
        qpos, qvel, ok = self.engine.settle(before.shape_ids, before.qpos, before.qvel)
        after = Bodies(before.shape_ids, qpos, qvel)
        return jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, state.bodies), ok

    def _position(self, action: Action) -> jax.Array:
        """f32[2] x and y, m; those that the action does not set are 0."""
        if action.position.shape != (self.position_dim,):
            raise ValueError(
                f"The position is f32{list(action.position.shape)}, and {self.name} with "
                f"position_dim={self.position_dim} takes f32[{self.position_dim}]."
            )
        position = jnp.clip(jnp.asarray(action.position, jnp.float32), -1.0, 1.0)
        return jnp.zeros(2, jnp.float32).at[: self.position_dim].set(position)

    def picture(self, bodies: Bodies, num_bodies: int = scene.NUM_SLOTS) -> jax.Array:
        """The picture uint8[84, 84] that an observation shows, of the first bodies only."""
        return render(
            bodies.shape_ids[:num_bodies],
            bodies.qpos[:num_bodies, :3],
            bodies.qpos[:num_bodies, 3:],
            task_camera(self.position_dim),
            has_shadows=self._settings.has_shadows,
            shapes=self.shapes,
        )
