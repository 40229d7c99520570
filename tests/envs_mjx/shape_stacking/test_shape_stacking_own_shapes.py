"""Shapes of a user's own; of the MJX engine, see `test_shape_stacking_mjx`."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import (
    Shape,
    ShapeStacking,
    films,
    load_shapes,
    rules,
    scene,
    shape_library,
    shape_universe,
)
from envs_mjx.shape_stacking.engines import make_engine
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.play import draw_pictures, record_block
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from envs_mjx.shape_stacking.viewer import body_mesh
from jaxnew import Action
from tests.envs_mjx.shape_stacking.own_shapes import (
    COPIES,
    CUBE,
    CYLINDER,
    NUM_SHAPES,
    OWN,
    PUBLISHED,
    STRAIGHT,
    TURNED,
    resting,
)

HEADER = "solid,scale,yaw_deg,red,green,blue"


@pytest.fixture(scope="module")
def engine() -> MujocoC:
    return MujocoC(num_threads=1, shapes=OWN)


@pytest.mark.golden
def test_a_library_that_has_grown_begins_with_the_published_one() -> None:
    library, grown = shape_library(), shape_library(OWN)
    assert grown is shape_library(OWN)
    for name, values in vars(library).items():
        if name == "hulls":
            assert grown.hulls is values
            continue
        rows = getattr(grown, name)
        assert len(rows) == NUM_SHAPES
        np.testing.assert_array_equal(rows[:810], values)
        # Degrees and back are exact to the last bits.
        np.testing.assert_allclose(rows[COPIES], values[[*PUBLISHED]], rtol=1e-15, atol=1e-15)
    # Scales that no published shape has are counted on.
    assert grown.scale_index[[TURNED, STRAIGHT, CYLINDER]].tolist() == [10, 10, 30]
    assert shape_universe().hash == "b86deae55b2b4062"


@pytest.mark.unit
def test_a_universe_that_has_grown() -> None:
    universe, grown = shape_universe(), shape_universe(OWN)
    assert grown.name == universe.name
    assert grown.action_names[:810] == universe.action_names
    assert grown.action_names[TURNED] == "cube 0.250 m, 33 deg"
    assert grown.action_hashes[:810] == universe.action_hashes
    # The copy of a shape with a yaw may differ in its last bit.
    copied = tuple(universe.action_hashes[i] for i in PUBLISHED[1:])
    assert grown.action_hashes[811:815] == copied
    np.testing.assert_array_equal(grown.engineered["gt21"][:810], universe.engineered["gt21"])
    one_hot = np.arange(16) == CLASS_NAMES.index("cube")
    np.testing.assert_allclose(
        grown.engineered["gt21"][TURNED], [0.25, 0, 0, 1, 33 * math.pi / 180, *one_hot], rtol=1e-6
    )
    assert grown.hash not in (universe.hash, shape_universe(OWN[:-1]).hash)


@pytest.mark.oracle
def test_masses_and_inertias_of_new_shapes() -> None:
    """A cube of side 0.5 m; a cylinder of radius 0.3 m and height 0.6 m."""
    library = shape_library(OWN)
    mass = 1000 * 0.5**3
    assert library.mass[TURNED] == pytest.approx(mass)
    np.testing.assert_allclose(library.inertia[TURNED], np.eye(3) * mass * 0.5**2 / 6, atol=1e-9)
    assert library.bounding_radius[TURNED] == pytest.approx(0.25 * 1.732)
    mass = 1000 * math.pi * 0.3**2 * 0.6
    across = mass * (3 * 0.3**2 + 0.6**2) / 12
    assert library.mass[CYLINDER] == pytest.approx(mass)
    np.testing.assert_allclose(
        library.inertia[CYLINDER], np.diag([across, across, mass * 0.3**2 / 2]), atol=1e-9
    )


@pytest.mark.unit
def test_drops_of_new_shapes() -> None:
    bodies, library = rules.start(799, 0.0, 1.3), shape_library(OWN)
    drop = jax.jit(jax.vmap(partial(rules.drop_height, shapes=OWN), (None, 0)))
    heights = np.array(drop(bodies, np.array([*PUBLISHED, *COPIES, TURNED])))
    np.testing.assert_array_equal(heights[5:10], heights[:5])
    # The radius of the first cylinder and that of the cube; its yaw changes nothing.
    top = -0.5 + library.s[799] + library.bounding_radius[799]
    assert heights[10] == pytest.approx(top + 0.25 * (1.732 - 0.1), abs=1e-5)
    # Above a new shape, 100 m high.
    above = bodies.replace(shape_ids=bodies.shape_ids.at[2].set(TURNED))
    expected = 100.0 + 0.25 * (2 * 1.732 - 0.1)
    assert drop(above, np.array([*PUBLISHED, *COPIES, TURNED]))[10] == pytest.approx(expected)


@pytest.mark.unit
def test_pictures_of_new_shapes() -> None:
    ids = np.array([*PUBLISHED, *COPIES, TURNED, STRAIGHT, 684, 678])
    views = record_block(3, ids, 1)[:, 0]
    views[ids == STRAIGHT, 0] -= np.float32(math.radians(33.0))  # It is seen as the turned cube.
    pictures = draw_pictures(ids, views, OWN)
    np.testing.assert_array_equal(pictures[5:10], pictures[:5])
    is_seen = pictures.any(axis=-1)
    turned, straight = is_seen[10], is_seen[11]
    # Rounding may move a pixel on an edge to the other side.
    assert (turned != straight).sum() <= 3
    # s = 0.25 lies between 0.213 and 0.258 of the two published cubes.
    assert turned.sum() > 300
    color = pictures[10][turned].astype(float)
    np.testing.assert_allclose(color[:, 0], 4 * color[:, 1], atol=2.6)  # Each is rounded to 0.5.
    np.testing.assert_allclose(color[:, 0], 2 * color[:, 2], atol=1.6)
    with pytest.raises(ValueError, match=r"Shape 818 does not exist; ids are 0\.\.817"):
        draw_pictures(np.array([3, 818]), np.zeros((2, 2), np.float32), OWN)


@pytest.mark.unit
def test_new_shapes_in_the_c_engine(engine: MujocoC) -> None:
    ids = np.array([*PUBLISHED, *COPIES, TURNED, CYLINDER])
    state = resting(ids)
    qpos, _, ok = engine.settle_host(*state)
    assert ok.all()
    np.testing.assert_allclose(qpos[5:10], qpos[:5], atol=1e-6)  # Of the hat's yaw.
    np.testing.assert_array_equal(qpos[6:10], qpos[1:5])
    published = MujocoC(num_threads=1).settle_host(*(x[:5] for x in state))
    np.testing.assert_array_equal(qpos[:5], published[0])
    # They stand upright, 1 mm or less deep in the table.
    np.testing.assert_allclose(qpos[10:, 1, 2], (-0.25, -0.2), atol=1e-3)
    np.testing.assert_allclose(qpos[10:, 1, 3:], state[1][10:, 1, 3:], atol=1e-3)
    with pytest.raises(ValueError, match=r"shape_ids has 818; ids are 0\.\.817"):
        engine.settle_host(*resting(np.array([818])))


@pytest.fixture(scope="module")
def played() -> tuple[ShapeStacking, list[Any], list[Any], list[Action]]:
    """The turned cube above the cylinders, moved by one step of the engine only; then no shape."""
    env = ShapeStacking(MujocoC(settle_steps=1, num_threads=1, shapes=OWN), shapes=OWN)
    step = jax.jit(env.step_env)
    states, infos = [env.start_from(rules.start(799, 0.0, 1.3))[1]], []
    actions = [Action(jnp.int32(i), jnp.zeros(1), jnp.bool_(False)) for i in (NUM_SHAPES, TURNED)]
    for action in actions:
        _, state, *_, info = step(jax.random.key(0), states[-1], action, env.default_params)
        states.append(state)
        infos.append(info)
    return env, states, infos, actions


@pytest.mark.unit
def test_an_episode_with_new_shapes(played: Any) -> None:
    env, states, (invalid, valid), _ = played
    assert env.action_spec.num_actions == NUM_SHAPES
    assert (bool(invalid["invalid_action"]), int(invalid["num_placed"])) == (True, 0)
    assert (bool(valid["invalid_action"]), int(valid["num_placed"])) == (False, 1)
    library, half = shape_library(OWN), math.radians(33.0) / 2
    z = -0.5 + library.s[799] + library.bounding_radius[799] + 0.25 * (1.732 - 0.1)
    pose = (0.0, 0.0, z, math.cos(half), 0.0, 0.0, math.sin(half))
    np.testing.assert_allclose(states[2].bodies.qpos[3], pose, atol=0.002)
    frames = np.asarray(states[2].frames)
    rows, columns = np.nonzero(frames[..., -1] != frames[..., -2])
    # docs/shape_stacking.md, "Camera"; the cube's sides are 0.5 m and it is seen over an edge.
    assert rows.mean() == pytest.approx(41.5 - 101.4 / 7 * (z - 2), abs=0.7)
    assert columns.mean() == pytest.approx(41.5, abs=0.7)
    width = 0.5 * (math.cos(2 * half) + math.sin(2 * half))
    assert np.ptp(columns) + 1 == pytest.approx(101.4 / 7 * width, abs=1.5)


@pytest.mark.integration
def test_films_and_pages_of_new_shapes(played: Any) -> None:
    env, states, _, actions = played
    shown = films.seen(env, states, actions)
    assert shown[-2].shape_ids[3] == shown[-1].shape_ids[3] == TURNED
    # Let go, and 0.01 s later.
    np.testing.assert_allclose(shown[-2].qpos[3], shown[-1].qpos[3], atol=0.002)
    (picture,) = films.draw(env, shown[-1:], 42)
    center = np.round(20.5 - 101.4 / 14 * (shown[-1].qpos[3, 2] - 2)).astype(int)
    red, green, blue = picture[center, 20].astype(float)
    assert (red, green, blue) == pytest.approx((red, red / 4, red / 2), abs=1)
    assert red > 0
    assert '"03_cube_815": {"from"' in films.page(shown, OWN)
    mesh = body_mesh(815, OWN)
    color = mesh.visual.material.baseColorFactor
    np.testing.assert_allclose(color / 255.0, [*CUBE.color, 1.0], atol=0.005)
    assert np.abs(mesh.bounds).max() == pytest.approx(0.25)


@pytest.mark.unit
def test_an_engine_with_other_shapes_is_refused(engine: MujocoC) -> None:
    with pytest.raises(ValueError, match="made for 8 shapes of the user's own, the environment"):
        ShapeStacking(engine)
    assert ShapeStacking("mujoco", shapes=OWN).engine is make_engine("mujoco", OWN)
    assert make_engine("mujoco", OWN).shapes == OWN


@pytest.mark.property
def test_the_smallest_and_the_largest_solids_stand() -> None:
    """Prisms over a right triangle too: their centres of mass are above their bases."""
    shapes = tuple(Shape(name, s, 0.0, (1.0, 1.0, 1.0)) for name in CLASS_NAMES for s in (0.01, 1))
    engine = MujocoC(num_threads=1, shapes=shapes)
    state = resting(np.arange(810, 842), shapes)
    qpos, _, ok = engine.settle_host(*state)
    assert ok.all()
    rises = qpos[:, 1, 2] - (scene.TABLE_HEIGHT - shape_library(shapes).base[810:])
    np.testing.assert_allclose(rises, 0.0, atol=1.5e-3)


@pytest.mark.unit
def test_shapes_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(f"\ufeff{HEADER}\ncube,0.25,33,0.5,0.125,0.25\n\nhat,1,-90,0,1,0\n")
    assert load_shapes(path) == (CUBE, Shape("hat", 1.0, -90.0, (0.0, 1.0, 0.0)))


@pytest.mark.unit
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("cube,1,0,1,1,1\n", f"line 1: the header is 'cube,1,0,1,1,1' and must be '{HEADER}'"),
        ("", f"line 1: the header is '' and must be '{HEADER}'"),
        (f"{HEADER}\n" + "cube,1,0,1,1,1\n" * 10_001, "has 10,001 shapes; 10,000 are the most"),
        (f"{HEADER}\n", "has no shapes; give one a line, such as cube,0.25,33,"),
        ("cube,0.2,0,1,1\n", "line 3: 'cube,0.2,0,1,1' is not a solid and five numbers, such as"),
        ("cube,big,0,1,1,1\n", "line 3: 'cube,big,0,1,1,1' is not a solid and five numbers"),
        ("box,0.2,0,1,1,1\n", "line 3: solid='box' is unknown; choose from .*'cube'"),
        ("cube,0,0,1,1,1\n", r"line 3: scale=0.0 must be 0.01 to 1.0 m"),
        ("cube,1.1,0,1,1,1\n", r"line 3: scale=1.1 must be 0.01 to 1.0 m"),
        ("cube,nan,0,1,1,1\n", r"line 3: scale=nan must be 0.01 to 1.0 m"),
        ("cube,0.2,inf,1,1,1\n", "line 3: yaw_deg=inf must be -360 to 360 degrees"),
        ("cube,0.2,0,1,-0.1,1\n", r"line 3: color=\(1.0, -0.1, 1.0\) must be red, green and blue"),
        ("cube,0.2,0,1,1,255\n", r"line 3: color=\(1.0, 1.0, 255.0\) must be red, green and blue"),
    ],
)
def test_a_file_that_is_none(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "mine.csv"
    good = "" if "line 3" not in says else f"{HEADER}\nhat,0.2,0,1,1,1\n"
    path.write_text(good + text)
    with pytest.raises(ValueError, match=f"mine.csv.*{says}"):
        load_shapes(path)
