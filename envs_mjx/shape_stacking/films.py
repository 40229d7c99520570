"""Films of towers: each shape is seen to fall and to come to rest, in colour.

What is seen between two actions only illustrates them: it is simulated anew from the moment when
the shape is let go. The last picture of every action shows the environment's own state.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking import rules, scene
from envs_mjx.shape_stacking.camera import Camera, render_rgb, task_camera
from envs_mjx.shape_stacking.engines import Engine
from envs_mjx.shape_stacking.environment import ShapeStacking, StackingState
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.shapes import Shape
from jaxnew.environment import Action

# Physics steps between pictures: shown for 60 ms each, they move as fast as the world does.
FRAME_STEPS = 6
# A moment is left out where no body has moved further or turned more since the last picture.
_STILL_M = 0.01
_STILL_TURN = 0.02  # Of a quaternion's numbers; half the angle, rad.

# An engine that compiles nothing, so that it may be cut short anywhere.
_EXACT = "mujoco_c"


def draw(env: ShapeStacking, shown: Sequence[Bodies], size: int = 400) -> list[np.ndarray]:
    """The pictures of an episode, with shadows, from where the task's camera stands.

    Args:
      env: where it was played.
      shown: the moments of `seen`.
      size: pixels of a side.

    Returns:
      Frames uint8[size, size, 3].
    """
    camera = task_camera(env.position_dim)
    return [draw_bodies(bodies, camera, size, env.shapes) for bodies in shown]


def page(shown: Sequence[Bodies], shapes: tuple[Shape, ...] = ()) -> str:
    """The moments of `seen` as a page that turns under the mouse; see `viewer.tower_html`.

    Args:
      shown: the moments.
      shapes: of the user's own, as the environment has them.
    """
    from envs_mjx.shape_stacking.viewer import tower_html  # Nothing else here needs trimesh.

    poses = np.stack([np.asarray(bodies.qpos) for bodies in shown])
    return tower_html(shown[-1].shape_ids, poses, FRAME_STEPS * scene.TIMESTEP_S, shapes)


def seen(
    env: ShapeStacking, states: Sequence[StackingState], actions: Sequence[Action]
) -> list[Bodies]:
    """The bodies at every moment that a film of an episode shows.

    Args:
      env: where it was played.
      states: T + 1 states: the start and what `step_env` returned after each action.
      actions: T actions.

    Returns:
      One world each. Times in which nothing moves are left out.

    Raises:
      ValueError: the numbers of states and actions do not belong together.
    """
    if len(states) != len(actions) + 1:
        raise ValueError(
            f"{len(states)} states and {len(actions)} actions; T actions need T + 1 states."
        )
    shown = [_on_host(states[0].bodies)]
    befores = [
        let_go(state, after, action, env.shapes)
        for state, after, action in zip(states[:-1], states[1:], actions, strict=True)
    ]
    between = moments(env.engine, _stacked(befores)) if befores else []
    for t, before in enumerate(befores):
        for bodies in (before, *(_world(moment, t) for moment in between)):
            if has_moved(shown[-1], bodies):
                shown.append(bodies)
        shown.append(_on_host(states[t + 1].bodies))
    return shown


def let_go(
    state: StackingState, after: StackingState, action: Action, shapes: tuple[Shape, ...] = ()
) -> Bodies:
    """The bodies at the moment of an action: with its shape above the tower if it was placed.

    Args:
      state, after: before and after the action.
      action: with f32[k] position, k of 0 to 2.
      shapes: of the user's own.
    """
    slot = scene.NUM_START_CYLINDERS + int(state.num_actions)
    shape_id = int(after.bodies.shape_ids[slot])
    if shape_id < 0:
        return _on_host(state.bodies)
    xy = np.zeros(2, np.float32)
    position = np.asarray(action.position, np.float32)
    xy[: len(position)] = np.clip(position, -1.0, 1.0)
    bodies = jax.tree.map(jnp.asarray, state.bodies)
    return _on_host(rules.place(bodies, slot, shape_id, jnp.asarray(xy), shapes))


def moments(engine: Engine, bodies: Bodies) -> list[Bodies]:
    """The bodies every 0.06 s of a settling, without its beginning and its end.

    MuJoCo's C engine simulates up to each moment from the start, so that a moment is exactly what
    the whole settling went through. Others, whose programs are compiled for their number of steps,
    simulate in short pieces; as every piece begins with a cold solver, a shaky tower may then go
    another way than in the whole settling.

    Args:
      engine: of the environment; what it is made of is shared, it is not changed.
      bodies: of n worlds, as let go.
    """
    steps = range(FRAME_STEPS, engine.settle_steps, FRAME_STEPS)
    if engine.name == _EXACT:
        return [_settled(_cut_short(engine, k), bodies) for k in steps]
    piece, found = _cut_short(engine, FRAME_STEPS), [bodies]
    settle = jax.jit(partial(_settled_by, piece))
    for _ in steps:
        found.append(_on_host(settle(found[-1])))
    return found[1:]


def _cut_short(engine: Engine, settle_steps: int) -> Engine:
    """The same engine with fewer steps in a call; they share their models."""
    short = copy.copy(engine)
    short.settle_steps = settle_steps
    return short


def _settled(engine: Engine, bodies: Bodies) -> Bodies:
    return _on_host(_settled_by(engine, bodies))


def _settled_by(engine: Engine, bodies: Bodies) -> Bodies:
    qpos, qvel, _ = engine.settle(bodies.shape_ids, bodies.qpos, bodies.qvel)
    return Bodies(bodies.shape_ids, qpos, qvel)


def has_moved(before: Bodies, after: Bodies) -> bool:
    """Whether one can see that a body moved or came, one world each."""
    if not np.array_equal(before.shape_ids, after.shape_ids):
        return True
    change = np.abs(np.asarray(after.qpos) - np.asarray(before.qpos))[after.is_used]
    is_seen = (change[:, :3] > _STILL_M).any() or (change[:, 3:] > _STILL_TURN).any()
    return bool(is_seen)


def draw_bodies(
    bodies: Bodies, camera: Camera, size: int, shapes: tuple[Shape, ...] = ()
) -> np.ndarray:
    """uint8[size, size, 3] a picture of one world on its table, with shadows."""
    state = bodies.shape_ids, np.asarray(bodies.qpos)[:, :3], np.asarray(bodies.qpos)[:, 3:]
    return np.asarray(_draw(*state, camera, size=size, shapes=shapes))


_draw = jax.jit(
    partial(render_rgb, has_table=True, has_shadows=True), static_argnames=("size", "shapes")
)


def _on_host(bodies: Bodies) -> Bodies:
    host: Bodies = jax.tree.map(np.asarray, bodies)
    return host


def _stacked(worlds: Sequence[Bodies]) -> Bodies:
    """n worlds as one batch."""
    batch: Bodies = jax.tree.map(lambda *leaves: np.stack(leaves), *worlds)
    return batch


def _world(batch: Bodies, index: int) -> Bodies:
    world: Bodies = jax.tree.map(lambda leaf: leaf[index], batch)
    return world
