"""Shape Stacking's own rules, as an agent meets them.

Numbers are those of docs/shape_stacking.md, "Reference figures".
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import ShapeStacking, StackingState, rules, scene, shape_library
from envs_mjx.shape_stacking.camera import render, task_camera
from envs_mjx.shape_stacking.engines import Settled, make_engine
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from jaxnew.environment import Action

pytestmark = pytest.mark.unit


class Recorder:
    """An engine that moves nothing, and fails where body `fails_at` is in use."""

    name, settle_steps, shapes = "recorder", 1, ()

    def __init__(self, fails_at: int = scene.NUM_SLOTS) -> None:
        self.fails_at = fails_at

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        ok = ~(shape_ids[self.fails_at :] >= 0).any()
        return Settled(qpos, qvel, ok)


def started(env: ShapeStacking, cylinder: int = 799) -> StackingState:
    """The scene of the reference figures: cylinders at x = -0.65 and 0.65."""
    return env.start_from(rules.start(cylinder, 0.0, 1.3))[1]


def act(env: ShapeStacking, state: StackingState, shape_id: int, *x: float, stop: bool = False):
    action = Action(jnp.int32(shape_id), jnp.asarray(x, jnp.float32), jnp.asarray(stop))
    out = jitted_step(env)(jax.random.key(0), state, action, env.default_params)
    return out[1], float(out[2]), bool(out[3]), bool(out[4]), jax.tree.map(np.asarray, out[5])


_STEPS: dict[int, Any] = {}


def jitted_step(env: ShapeStacking) -> Any:
    return _STEPS.setdefault(id(env), jax.jit(env.step_env))


REAL = ShapeStacking(MujocoC(num_threads=1))
STILL = ShapeStacking(Recorder())


@pytest.mark.parametrize(("cylinder", "height"), [(798, 0.328), (799, 0.342), (800, 0.355)])
def test_stop_at_once(cylinder: int, height: float) -> None:
    """Figures 4 and 21."""
    _, reward, terminated, truncated, info = act(REAL, started(REAL, cylinder), 690, 0.0, stop=True)
    assert (terminated, truncated) == (True, False)
    assert info["final_height"] == pytest.approx(height, abs=0.001)
    assert reward == pytest.approx(height / 2.0, abs=0.001)
    assert (info["num_placed"], info["episode_length"], info["is_stopped"]) == (0, 1, True)


def test_a_shape_is_placed_once() -> None:
    """Figure 6: heights of the first cube; the second time nothing changes but a counter."""
    state, reward, terminated, truncated, info = act(REAL, started(REAL), 690, -0.65)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert info["final_height"] == pytest.approx(0.982, abs=0.005)
    again, _, _, _, later = act(REAL, state, 690, 0.3)
    assert (info["num_repeats"], later["num_repeats"]) == (0, 1)
    assert (later["num_placed"], later["episode_length"]) == (1, 2)
    np.testing.assert_array_equal(again.bodies.shape_ids, state.bodies.shape_ids)
    np.testing.assert_allclose(again.bodies.qpos, state.bodies.qpos, atol=1e-3)
    again, *_, later = act(REAL, again, 690, 0.3)
    assert (later["num_repeats"], later["num_placed"], later["episode_length"]) == (2, 1, 3)
    _, reward, *_, last = act(REAL, again, 0, 0.0, stop=True)
    assert reward == pytest.approx(0.732, abs=0.005)
    assert last["max_height"] == pytest.approx(0.982, abs=0.005)


def test_only_a_new_shape_stops_the_others() -> None:
    """Repeated shapes and stops leave velocities as they are."""
    state, *_ = act(STILL, started(STILL), 690, -0.65)
    moving = state.bodies.replace(qvel=jnp.ones_like(state.bodies.qvel))
    state = state.replace(bodies=moving)
    for shape_id, stops, speed in ((690, False, 1.0), (7, True, 1.0), (7, False, 0.0)):
        after, *_ = act(STILL, state, shape_id, 0.0, stop=stops)
        np.testing.assert_array_equal(after.bodies.qvel, speed)


def test_a_start_cylinder_is_no_placed_shape() -> None:
    """Its id may be in the action set too, as a body of its own."""
    state, *_, info = act(STILL, started(STILL), 799, 0.5)
    assert (info["num_placed"], info["num_repeats"]) == (1, 0)
    assert state.bodies.shape_ids.tolist() == [799, 799, 799, *[-1] * 9]


def test_drop_pose_and_clipping() -> None:
    """Figure 5, and a position beyond what is allowed."""
    library = shape_library()
    state, *_ = act(STILL, started(STILL), 690, 1.7)
    assert state.bodies.qpos[2, :3] == pytest.approx((1.0, 0.0, 0.819), abs=0.001)
    np.testing.assert_allclose(state.bodies.qpos[2, 3:], library.quaternion[690], atol=1e-6)
    state, *_ = act(STILL, started(STILL), 735, -0.4)
    assert state.bodies.qpos[2, :3] == pytest.approx((-0.4, 0.0, 0.658), abs=0.001)


@pytest.mark.parametrize(
    ("position_dim", "given", "expected"),
    [(0, (), (0.0, 0.0)), (1, (0.3,), (0.3, 0.0)), (2, (0.3, -0.7), (0.3, -0.7))],
)
def test_variants_of_placement(
    position_dim: int, given: tuple[float, ...], expected: tuple[float, float]
) -> None:
    env = ShapeStacking(Recorder(), position_dim=position_dim)
    assert env.action_spec.position_dim == position_dim
    assert (env.action_spec.num_actions, env.action_spec.has_stop) == (810, True)
    state, *_ = act(env, started(env), 690, *given)
    assert state.bodies.qpos[2, :2] == pytest.approx(expected)
    picture = render(
        state.bodies.shape_ids,
        state.bodies.qpos[:, :3],
        state.bodies.qpos[:, 3:],
        task_camera(position_dim),
        has_shadows=False,
    )
    # Rounding may move a pixel on an edge to the other side.
    assert (np.abs(picture.astype(int) - state.frames[..., -1]) > 1).sum() <= 3
    assert (picture > 0).sum() > 500


def test_shadows_can_be_drawn() -> None:
    bodies = rules.start(799, 0.0, 1.3)
    dark, lit = (
        ShapeStacking(Recorder(), has_shadows=on).start_from(bodies)[0] for on in (True, False)
    )
    assert lit.mean() - dark.mean() > 0.01  # Of the four frames, of which three are black.


def test_ten_actions_are_the_limit() -> None:
    state = started(STILL)
    for k in range(10):
        state, reward, terminated, truncated, info = act(STILL, state, k, 0.0)
        assert (terminated, truncated) == (False, k == 9)
        assert (reward > 0.0) == (k == 9)
    assert (info["num_placed"], info["episode_length"]) == (10, 10)
    # Nothing fell, so the reward is by hand: the topmost origin, and those above z = 0.
    z = np.asarray(state.bodies.qpos)[:, 2].astype(np.float64)
    expected = 0.5 * (z.max() + 0.5) + 0.5 * z[z > 0.0].mean()
    assert reward == pytest.approx(expected, rel=1e-5)
    assert info["final_height"] == pytest.approx(z.max() + 0.5, rel=1e-6)


def test_a_stop_at_the_limit_is_a_stop() -> None:
    params = STILL.default_params.replace(max_actions=jnp.int32(1))
    action = Action(jnp.int32(690), jnp.zeros(1), jnp.bool_(True))
    _, _, _, terminated, truncated, _ = jitted_step(STILL)(
        jax.random.key(0), started(STILL), action, params
    )
    assert (bool(terminated), bool(truncated)) == (True, False)


def test_reward_of_the_paper_s_text() -> None:
    env = ShapeStacking(Recorder(), reward_variant="paper")
    state, *_ = act(env, started(env), 690, 0.0)
    _, reward, *_ = act(env, state, 0, 0.0, stop=True)
    heights = np.asarray(state.bodies.qpos)[:3, 2].astype(np.float64) + 0.5
    assert reward == pytest.approx(0.5 * heights.max() + 0.5 * heights.mean(), rel=1e-5)


def test_a_failed_simulation_ends_the_episode_with_nothing() -> None:
    env = ShapeStacking(Recorder(fails_at=3))
    first, _, terminated, _, info = act(env, started(env), 690, 0.0)
    assert not terminated
    assert not info["has_failed"]
    state, reward, terminated, truncated, info = act(env, first, 594, 0.0)
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["has_failed"]
    assert not info["is_stopped"]
    np.testing.assert_array_equal(state.bodies.qpos, first.bodies.qpos)
    np.testing.assert_array_equal(state.bodies.shape_ids, first.bodies.shape_ids)
    assert np.isfinite(info["final_height"])


def test_a_position_that_is_no_number_fails_safely() -> None:
    state, reward, terminated, _, info = act(REAL, started(REAL), 690, float("nan"))
    assert (reward, terminated, info["has_failed"]) == (0.0, True, True)
    assert np.isfinite(state.bodies.qpos).all()


@pytest.mark.parametrize("shape_id", [-1, 810])
def test_an_id_that_does_not_exist_uses_the_action_up(shape_id: int) -> None:
    state, _, terminated, _, info = act(STILL, started(STILL), shape_id, 0.0)
    assert info["invalid_action"]
    assert not terminated
    assert (info["num_placed"], info["num_repeats"], info["episode_length"]) == (0, 0, 1)
    assert (state.bodies.shape_ids[2:] == -1).all()
    # Free bodies do not count as shape -1 that was placed.
    assert act(STILL, state, -1, 0.0)[-1]["num_repeats"] == 0


def test_start_scenes_are_uniform() -> None:
    keys = jax.random.split(jax.random.key(3), 900)
    bodies = jax.jit(jax.vmap(lambda key: STILL.reset_env(key, STILL.default_params)[1].bodies))(
        keys
    )
    ids, x = np.asarray(bodies.shape_ids), np.asarray(bodies.qpos)[:, :2, 0]
    np.testing.assert_array_equal(ids[:, 0], ids[:, 1])
    _, counts = np.unique(ids[:, 0], return_counts=True)
    assert len(counts) == 3
    assert np.abs(counts - 300).max() < 57  # Four standard deviations.
    for values, (low, high) in ((x.mean(1), (-0.2, 0.2)), (x[:, 1] - x[:, 0], (1.0, 1.6))):
        assert low - 1e-6 <= values.min() < values.max() <= high + 1e-6
        counts, _ = np.histogram(values, 6, (low, high))
        assert np.abs(counts - 150).max() < 45  # Four standard deviations.
    np.testing.assert_allclose(
        bodies.qpos[:, :2, 2] + 0.5, shape_library().s[ids[:, :2]], atol=1e-6
    )


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match=r"position_dim=3 must be one of \(0, 1, 2\)"):
        ShapeStacking(Recorder(), position_dim=3)
    with pytest.raises(ValueError, match="reward_variant='both' must be one of"):
        ShapeStacking(Recorder(), reward_variant="both")
    with pytest.raises(ValueError, match="physics='warp' is unknown; choose from"):
        ShapeStacking("warp")
    with pytest.raises(ValueError, match=r"takes f32\[1\]"):
        STILL.step_env(jax.random.key(0), started(STILL), Action.of(690), STILL.default_params)


def test_engines_by_name() -> None:
    assert ShapeStacking("mujoco").engine is make_engine("mujoco")
    assert isinstance(ShapeStacking("mujoco").engine, MujocoC)
    assert isinstance(ShapeStacking().engine, MujocoC)  # Tests run on CPUs.
