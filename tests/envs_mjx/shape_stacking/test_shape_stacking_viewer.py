"""The page of a tower: what its JSON holds, against the library, the engine and Brax's own dump."""

from __future__ import annotations

import base64
import json
import re
import warnings
import zlib
from typing import Any

import brax.base
import brax.io.json
import brax.io.mjcf
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.spatial

from envs_mjx.shape_stacking import rules, scene, shape_library
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.solids import CLASS_NAMES, solids
from envs_mjx.shape_stacking.viewer import body_geom, tower_html

CUBE, ARCH = 690, 500
NAMES = ["00_cylinder_799", "01_cylinder_799", "02_cube_690", "03_arch_500"]


def system_of(page: str) -> dict[str, Any]:
    """What the page hands to the viewer."""
    packed = re.search(r'var system = "([A-Za-z0-9+/=]+)";', page)
    assert packed is not None
    return json.loads(zlib.decompress(base64.b64decode(packed.group(1))))


@pytest.fixture(scope="module")
def episode() -> tuple[np.ndarray, np.ndarray]:
    """A cube on the left cylinder, then an arch on the cube: ids, and poses after each action."""
    engine = MujocoC(num_threads=1)
    bodies = rules.start(799, 0.1, 1.4)
    poses = [np.asarray(bodies.qpos)]
    for slot, shape_id in ((2, CUBE), (3, ARCH)):
        bodies = rules.place(bodies, slot, shape_id, jnp.array([-0.6, 0.0]))
        qpos, qvel, ok = engine.settle_host(bodies.shape_ids, bodies.qpos, bodies.qvel)
        assert ok
        bodies = rules.Bodies(bodies.shape_ids, jnp.asarray(qpos), jnp.asarray(qvel))
        poses.append(qpos)
    return np.asarray(bodies.shape_ids), np.stack(poses)


@pytest.fixture(scope="module")
def system(episode: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    return system_of(tower_html(*episode, seconds_per_frame=0.25))


@pytest.mark.integration
def test_the_page_holds_the_bodies_of_the_episode(system: dict[str, Any]) -> None:
    """Also in the order of their links, which the viewer looks their poses up by."""
    assert list(system["geoms"]) == ["world", *NAMES]
    assert [len(geoms) for geoms in system["geoms"].values()] == [1] * 5
    assert [geoms[0]["link_idx"] for geoms in system["geoms"].values()] == [-1, 0, 1, 2, 3]
    assert system["opt"]["timestep"] == 0.25
    kinds = [system["geoms"][name][0]["name"] for name in NAMES]
    assert kinds == ["Cylinder", "Cylinder", "Mesh", "Mesh"]
    colors = np.array([system["geoms"][name][0]["rgba"] for name in NAMES])
    library = shape_library().color
    np.testing.assert_array_equal(colors[:, :3], library[[799, 799, CUBE, ARCH]])
    np.testing.assert_allclose(colors[0], (0.2321, 0.6973, 0.5357, 1.0), atol=1e-4)
    np.testing.assert_allclose(colors[2], (0.136, 0.839, 0.648, 1.0), atol=1e-3)


@pytest.mark.integration
def test_the_page_holds_the_poses_of_each_frame(
    system: dict[str, Any], episode: tuple[np.ndarray, np.ndarray]
) -> None:
    _, qpos = episode
    frames = system["states"]["x"]
    assert len(frames) == 3
    pos = np.array([frame["pos"] for frame in frames])
    rot = np.array([frame["rot"] for frame in frames])
    assert (pos.shape, rot.shape) == ((3, 4, 3), (3, 4, 4))
    is_there = np.array([[1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]], bool)
    np.testing.assert_array_equal(pos[is_there], qpos[:, :4, :3][is_there])
    np.testing.assert_array_equal(rot[is_there], qpos[:, :4, 3:][is_there])
    # The tower stands: each body within 3 cm of where flat faces would carry it.
    s = shape_library().s[[799, CUBE, ARCH]]
    heights = -0.5 + np.array([s[0], 2 * s[0] + s[1], 2 * (s[0] + s[1]) + s[2]])
    np.testing.assert_allclose(pos[2, [0, 2, 3], 2], heights, atol=0.03)


@pytest.mark.unit
def test_bodies_wait_above_their_first_place(
    system: dict[str, Any], episode: tuple[np.ndarray, np.ndarray]
) -> None:
    _, qpos = episode
    frames = system["states"]["x"]
    for link, first in ((2, 1), (3, 2)):
        for frame in frames[:first]:
            above = np.subtract(frame["pos"][link], qpos[first, link, :3])
            np.testing.assert_allclose(above, (0.0, 0.0, 70.0), atol=1e-5)
            np.testing.assert_array_equal(frame["rot"][link], qpos[first, link, 3:])


@pytest.mark.golden
def test_the_table_is_that_of_the_spec(system: dict[str, Any]) -> None:
    """Half-sizes 4 by 2, top at -0.5. Brax's `createPlane` takes whole sizes."""
    (table,) = system["geoms"]["world"]
    assert (table["name"], table["pos"]) == ("Plane", [0.0, 0.0, -0.5])
    assert (table["size"][:2], table["rgba"]) == ([8.0, 4.0], [0.9, 0.9, 0.9, 1.0])


@pytest.mark.oracle
def test_geometry_is_what_brax_dumps_of_the_physical_scene() -> None:
    """One shape of each class, from the MJCF of the engines, through a Brax system.

    Collisions are off there, since Brax refuses cylinders that collide. The compiler turns meshes
    into their principal axes; Brax dumps the turn with them.
    """
    ids = [9, 80, 130, 185, 290, 315, 370, 402, 425, 500, 545, 625, 690, 735, 764, 799]
    labels = shape_library().class_labels[ids]
    assert labels.tolist() == list(range(16))
    all_forms, form_of = scene.forms()
    chosen = [all_forms[form_of[shape_id]] for shape_id in ids]
    bodies, poses = [], np.random.default_rng(0).uniform(-1.0, 1.0, (16, 7))
    for k, (shape_id, form) in enumerate(zip(ids, chosen, strict=True)):
        rgba = " ".join(map(repr, [*shape_library().color[shape_id].tolist(), 1.0]))
        geom = scene.geom_text(form).replace("/>", f' contype="0" conaffinity="0" rgba="{rgba}"/>')
        inertial = scene.inertial_text(shape_id)
        bodies.append(scene.body_text(f"body{k}", inertial, [geom], poses[k]))
    assets = [scene.hull_text(form) for form in chosen if form.kind == "mesh"]
    model = mujoco.MjModel.from_xml_string(scene.scene_text(bodies, assets))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Brax System", UserWarning)
        sys = brax.io.mjcf.load_model(model)
    x = brax.base.Transform(pos=jnp.asarray(poses[:, :3]), rot=jnp.asarray(poses[:, 3:]))
    state = brax.base.State(q=None, qd=None, x=x, xd=None, contact=None)
    dumped = json.loads(brax.io.json.dumps(sys, [state]))

    qpos = np.tile(scene.parked_qpos(), (1, 1, 1))
    for k, shape_id in enumerate(ids):
        theirs = dumped["geoms"][f"body{k}"][0]
        one = np.full(12, -1)
        one[0] = shape_id
        qpos[0, 0] = poses[k]
        page = system_of(tower_html(one, qpos, 0.01))
        ours = page["geoms"][f"00_{CLASS_NAMES[k]}_{shape_id}"][0]
        assert set(ours) == set(theirs)
        assert (ours["name"], theirs["link_idx"]) == (theirs["name"], k)
        np.testing.assert_allclose(ours["rgba"], theirs["rgba"], atol=1e-7)
        if ours["name"] == "Mesh" and CLASS_NAMES[k] != "arch":
            np.testing.assert_allclose(corners(ours), corners(theirs), atol=1e-6)
        elif ours["name"] != "Mesh":
            for key in ("size", "pos", "rot"):
                np.testing.assert_allclose(ours[key], theirs[key], atol=1e-6)
        assert set(page["states"]["x"][0]) <= set(dumped["states"]["x"][0])
        for key in ("pos", "rot"):
            mine, other = page["states"]["x"][0][key][0], dumped["states"]["x"][0][key][k]
            np.testing.assert_allclose(mine, other, atol=1e-6)
    assert {"opt", "geoms", "states"} <= set(dumped)
    np.testing.assert_allclose(page["opt"]["timestep"], dumped["opt"]["timestep"], atol=1e-6)


def corners(geom: dict[str, Any]) -> np.ndarray:
    """f64[n, 3] distinct corners of a mesh in the axes of its body, sorted."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(geom["rot"]))
    points = np.array(geom["vert"]) @ matrix.reshape(3, 3).T + geom["pos"]
    return np.unique(np.round(points, 5) + 0.0, axis=0)


@pytest.mark.oracle
@pytest.mark.parametrize("shape_id", [9, 80, 130, 185, 290, 315, 370, 402, 425, 500, 545, 625, 690])
def test_meshes_are_closed_and_turned_outwards(shape_id: int) -> None:
    """Their volume by the divergence theorem is the hull's, the arch's that of the true solid."""
    library, geom = shape_library(), body_geom(shape_id)
    solid = solids()[library.class_labels[shape_id]]
    assert solid.hull is not None
    s = library.s[shape_id]
    triangles = np.array(geom["vert"])[np.array(geom["face"])] / s
    a, b, c = triangles.swapaxes(0, 1)
    areas = np.cross(b - a, c - a)
    np.testing.assert_allclose(areas.sum(axis=0), 0.0, atol=1e-12)
    volume = np.einsum("ij,ij->", areas, a) / 6.0
    if solid.name == "arch":
        # 32 chords leave out 0.16 % of the half disc, whose volume is 4.909.
        assert volume == pytest.approx(16.0 - 0.9984 * 4.9087, abs=1e-3)
        assert library.volume[shape_id] / s**3 == pytest.approx(volume, abs=0.01)
        inside = np.hypot(triangles[..., 0], triangles[..., 2] + 1.0)
        assert inside.min() == pytest.approx(1.25)
        np.testing.assert_allclose(np.abs(triangles).max(axis=(0, 1)), (2.0, 1.0, 1.0))
    else:
        hull = scipy.spatial.ConvexHull(solid.hull.vertices)
        assert volume == pytest.approx(hull.volume, rel=1e-9)
    # Flat shading: no corner belongs to two polygons, so all its triangles have one normal.
    normals = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    for corner in range(len(geom["vert"])):
        at = normals[(np.array(geom["face"]) == corner).any(axis=1)]
        np.testing.assert_allclose(at - at[0], 0.0, atol=1e-9)


@pytest.mark.unit
def test_names_are_such_that_three_js_finds_the_bodies(system: dict[str, Any]) -> None:
    """Its tracks are addressed as `scene/NAME.position`: no blanks, dots, colons or brackets."""
    everything = {f"00_{name}_0" for name in CLASS_NAMES} | set(system["geoms"])
    assert all(re.fullmatch(r"[\w-]+", name) for name in everything)


@pytest.mark.unit
def test_what_the_page_loads(episode: tuple[np.ndarray, np.ndarray]) -> None:
    """As `brax_adapter.render_page` tells; all that is of the tower is in the page."""
    hosts = set(re.findall(r"https://([^/]+)/", tower_html(*episode)))
    assert hosts == {"unpkg.com", "cdn.jsdelivr.net"}


@pytest.mark.unit
def test_bad_input(episode: tuple[np.ndarray, np.ndarray]) -> None:
    ids, qpos = episode
    too_large, nobody, broken = ids.copy(), np.full(12, -1), qpos.copy()
    too_large[1], broken[1, 2, 0] = 810, np.nan
    for arguments, message in [
        ((ids[:4], qpos), r"the shapes \(4,\) and \(3, 12, 7\)"),
        ((ids, qpos[0]), r"give \(12,\) and \(T, 12, 7\)"),
        ((ids, qpos[:0]), "at least one frame"),
        ((too_large, qpos), r"ids 0\.\.809"),
        ((nobody, qpos), "at least one body"),
        ((ids, broken), "not finite"),
        ((ids, qpos, 0.0), "seconds_per_frame=0.0 must be positive"),
        ((ids, qpos, np.inf), "seconds_per_frame=inf must be positive"),
    ]:
        with pytest.raises(ValueError, match=message):
            tower_html(*arguments)
    unused = qpos.copy()
    unused[:, 7] = np.nan
    assert system_of(tower_html(ids, unused)) == system_of(tower_html(ids, qpos))
