"""Films of towers: what is seen between two states is the simulation that led to the second."""

from __future__ import annotations

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import (
    ShapeStacking,
    StackingState,
    films,
    rules,
    scene,
    shape_library,
    viewer,
)
from envs_mjx.shape_stacking.camera import task_camera
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.rules import Bodies
from jaxnew.environment import Action

CUBE, PLATE = 690, 651
SLOT = scene.NUM_START_CYLINDERS


class Pieces(MujocoC):
    """Stands for an engine whose programs are compiled for their number of steps."""

    name = "pieces"


@pytest.fixture(scope="module")
def engine() -> MujocoC:
    return MujocoC(settle_steps=60)


def state_of(bodies: Bodies, num_actions: int = 0) -> StackingState:
    none = jnp.int32(0)
    frames = jnp.zeros((84, 84, 4), jnp.uint8)
    return StackingState(bodies, frames, jnp.int32(num_actions), none, rules.tower_height(bodies))


def action(shape_id: int, *position: float, stop: bool = False) -> Action:
    return Action(jnp.int32(shape_id), jnp.array(position, jnp.float32), jnp.bool_(stop))


def settled(engine: MujocoC, bodies: Bodies) -> Bodies:
    qpos, qvel, ok = engine.settle(bodies.shape_ids, bodies.qpos, bodies.qvel)
    assert ok
    return Bodies(bodies.shape_ids, qpos, qvel)


def dropped(engine: MujocoC, bodies: Bodies, slot: int, shape_id: int, x: float) -> Bodies:
    return settled(engine, rules.place(bodies, slot, shape_id, jnp.array([x, 0.0])))


@pytest.mark.unit
def test_a_shape_is_let_go_where_the_action_said(engine: MujocoC) -> None:
    start = rules.start(799, 0.0, 1.3)
    after = state_of(dropped(engine, start, SLOT, CUBE, 1.0), 1)
    found = films.let_go(state_of(start), after, action(CUBE, 1.5))
    assert found.shape_ids.tolist()[: SLOT + 1] == [799, 799, CUBE]
    # Reference figure 5: 0.819; positions end at 1.
    np.testing.assert_allclose(found.qpos[SLOT, :3], (1.0, 0.0, 0.819), atol=5e-4)
    two = films.let_go(state_of(start), after, action(CUBE, 0.25, -0.5))
    np.testing.assert_allclose(two.qpos[SLOT, :2], (0.25, -0.5))
    none = films.let_go(state_of(start), after, action(CUBE))
    np.testing.assert_array_equal(none.qpos[SLOT, :2], (0.0, 0.0))
    # What places nothing leaves the bodies where they are.
    still = films.let_go(after, state_of(after.bodies, 2), action(CUBE, 0.0))
    np.testing.assert_array_equal(still.qpos, after.bodies.qpos)


@pytest.mark.unit
def test_moments_are_those_of_the_whole_settling(engine: MujocoC) -> None:
    worlds = [rules.start(799, 0.0, 1.3), rules.start(798, 0.1, 1.0)]
    placed = [rules.place(bodies, SLOT, PLATE, jnp.array([-0.6, 0.0])) for bodies in worlds]
    both = films._stacked([films._on_host(bodies) for bodies in placed])
    found = films.moments(engine, both)
    assert len(found) == 9  # At 6, 12, ... 54 of 60 steps.
    assert engine.settle_steps == 60
    expected = MujocoC(settle_steps=18).settle(both.shape_ids, both.qpos, both.qvel)
    np.testing.assert_array_equal(found[2].qpos, expected.qpos)
    assert (found[0].qpos[:, SLOT, 2] > found[2].qpos[:, SLOT, 2] + 0.05).all()


@pytest.mark.unit
def test_other_engines_go_in_pieces() -> None:
    start = rules.place(rules.start(799, 0.0, 1.3), SLOT, PLATE, jnp.array([-0.6, 0.0]))
    one = films._stacked([films._on_host(start)])
    found = films.moments(Pieces(settle_steps=20), one)
    assert len(found) == 3
    piece, expected = MujocoC(settle_steps=6), one
    for moment in found:
        expected = Bodies(one.shape_ids, *piece.settle(*vars(expected).values())[:2])
        np.testing.assert_array_equal(moment.qpos, expected.qpos)


@pytest.mark.unit
def test_what_one_can_see() -> None:
    bodies = films._on_host(rules.start(799, 0.0, 1.3))

    def moved(slot: int, number: int, by: float) -> Bodies:
        qpos = bodies.qpos.copy()
        qpos[slot, number] += by
        return Bodies(bodies.shape_ids, qpos, bodies.qvel)

    assert not films.has_moved(bodies, bodies)
    assert not films.has_moved(bodies, moved(1, 0, 0.009))
    assert films.has_moved(bodies, moved(1, 0, -0.011))
    assert films.has_moved(bodies, moved(0, 5, 0.03))
    assert not films.has_moved(bodies, moved(0, 5, 0.01))
    assert not films.has_moved(bodies, moved(5, 2, 9.0))  # Not used.
    more = np.where(np.arange(12) == 2, CUBE, bodies.shape_ids)
    assert films.has_moved(bodies, Bodies(more, bodies.qpos, bodies.qvel))


@pytest.mark.unit
def test_a_film_falls_rests_and_ends_with_the_state(
    engine: MujocoC, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = ShapeStacking(engine)
    start = rules.start(799, 0.0, 1.3)
    first = films._on_host(dropped(engine, start, SLOT, CUBE, -0.65))
    # Not what the engine would make of it, so that it is told from the moments.
    shifted = first.qpos.copy()
    shifted[SLOT, 0] = 0.5
    first = Bodies(first.shape_ids, shifted, np.zeros_like(first.qvel))
    last = films._on_host(settled(engine, first))
    states = [state_of(start), state_of(first, 1), state_of(last, 2)]
    monkeypatch.setattr(films, "draw_bodies", lambda bodies, *_: bodies)
    actions = [action(CUBE, -0.65), action(3, 0.0, stop=True)]
    shown = films.draw(env, films.seen(env, states, actions))
    np.testing.assert_array_equal(shown[0].qpos, start.qpos)
    let_go = shown[1].qpos[SLOT]
    np.testing.assert_allclose(let_go[[0, 2]], (-0.65, 0.819), atol=5e-4)
    z = [bodies.qpos[SLOT, 2] for bodies in shown[1:]]
    ends = [k for k, bodies in enumerate(shown) if np.array_equal(bodies.qpos, first.qpos)]
    assert len(ends) == 1
    (end,) = ends
    falling = z[: end - 1]
    assert 4 <= len(falling) < 10
    assert all(b < a for a, b in pairwise(falling[:4]))
    # After it only what moves: the cube was left in the air at x = 0.5, over the other cylinder's
    # edge, and the stop lets 0.6 s go by.
    np.testing.assert_array_equal(shown[-1].qpos, last.qpos)
    with pytest.raises(ValueError, match="3 states and 1 actions; T actions need"):
        films.seen(env, states, actions[:1])


@pytest.mark.unit
def test_a_page_holds_what_a_film_shows(engine: MujocoC, monkeypatch: pytest.MonkeyPatch) -> None:
    env = ShapeStacking(engine)
    start = rules.start(799, 0.0, 1.3)
    first = films._on_host(dropped(engine, start, SLOT, CUBE, -0.65))
    states, actions = [state_of(start), state_of(first, 1)], [action(CUBE, -0.65)]
    given: list[tuple[np.ndarray, np.ndarray, float, tuple[()]]] = []
    monkeypatch.setattr(viewer, "tower_html", lambda *page: given.append(page) or "page")
    shown = films.seen(env, states, actions)
    assert films.page(shown) == "page"
    ((ids, qpos, seconds, _),) = given
    np.testing.assert_array_equal(ids, first.shape_ids)
    np.testing.assert_array_equal(qpos, np.stack([bodies.qpos for bodies in shown]))
    assert len(qpos) > 5
    assert seconds == pytest.approx(0.06)
    np.testing.assert_array_equal(qpos[0, SLOT], scene.parked_qpos()[SLOT])
    with pytest.raises(ValueError, match="2 states and 0 actions"):
        films.seen(env, states, [])


@pytest.mark.golden
def test_pictures_have_the_shapes_and_their_colours() -> None:
    bodies = rules.start(799, 0.0, 1.3)
    qpos = bodies.qpos.at[SLOT, :3].set(jnp.array([0.0, 0.0, 2.0]))
    bodies = Bodies(bodies.shape_ids.at[SLOT].set(CUBE), qpos, bodies.qvel)
    picture = films.draw_bodies(films._on_host(bodies), task_camera(), 42)
    assert (picture.shape, picture.dtype) == ((42, 42, 3), np.uint8)
    # z = 2 is the height of the camera: the middle of the picture, seen straight from the front.
    middle = picture[20:22, 20:22].reshape(-1, 3).mean(axis=0) / 255.0
    color = shape_library().color[CUBE]
    light = middle[0] / color[0]
    # Bright enough for two of the three colours to be cut off; 255 levels.
    np.testing.assert_allclose(middle, np.minimum(light * color, 1.0), atol=0.01)
    assert light * color[1] > 1.0 > light * color[0]
    assert not picture[:15].any()
    assert not picture[20, :10].any()
    assert picture[36, 16].any()
    assert picture[-1, 3].any()  # The table.
