"""The page of a tower: what it holds, against the library, the engine and MuJoCo; a browser."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.spatial
import trimesh
from PIL import Image

from envs_mjx.shape_stacking import rules, scene, shape_library
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.engines.mujoco_pool import catalogue_model
from envs_mjx.shape_stacking.solids import CLASS_NAMES, solids
from envs_mjx.shape_stacking.viewer import body_mesh, tower_html

CUBE, ARCH = 690, 500
NAMES = ["00_cylinder_799", "01_cylinder_799", "02_cube_690", "03_arch_500"]


BROWSERS = ("chromium-headless-shell", "chrome-headless-shell", "chromium", "google-chrome")


def world_of(page: str) -> trimesh.Scene:
    """The bodies of a page, as they are when its script has not run."""
    packed = re.search(r'base64_data="([A-Za-z0-9+/=]+)"', page)
    assert packed is not None
    return trimesh.load_scene(io.BytesIO(base64.b64decode(packed.group(1))), file_type="glb")


def film_of(page: str) -> dict[str, Any]:
    """What the script reads."""
    found = re.search(r"const film = (.*);", page)
    assert found is not None
    film: dict[str, Any] = json.loads(found.group(1))
    return film


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
def page(episode: tuple[np.ndarray, np.ndarray]) -> str:
    return tower_html(*episode, seconds_per_frame=0.25)


@pytest.mark.integration
def test_the_page_holds_the_tower(page: str, episode: tuple[np.ndarray, np.ndarray]) -> None:
    """Each body in its place and in its colour, on the table."""
    world, (_, qpos) = world_of(page), episode
    assert set(world.geometry) == {"table", *NAMES}
    for name, pose, shape_id in zip(NAMES, qpos[-1], (799, 799, CUBE, ARCH), strict=False):
        matrix, _ = world.graph.get(name)
        np.testing.assert_allclose(matrix[:3, 3], pose[:3], atol=1e-6)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, pose[3:].astype(np.float64))
        np.testing.assert_allclose(matrix[:3, :3].ravel(), turn, atol=1e-6)
        color = world.geometry[name].visual.material.baseColorFactor
        np.testing.assert_allclose(color[:3] / 255.0, shape_library().color[shape_id], atol=0.005)


@pytest.mark.integration
def test_the_page_holds_the_poses_of_each_frame(
    page: str, episode: tuple[np.ndarray, np.ndarray]
) -> None:
    """A body that waits is not there, and stands where it will be first."""
    (_, qpos), film = episode, film_of(page)
    assert film["times"] == [0.0, 0.25, 0.5]
    assert list(film["bodies"]) == NAMES
    assert [body["from"] for body in film["bodies"].values()] == [0.0, 0.0, 0.25, 0.5]
    for slot, body in enumerate(film["bodies"].values()):
        first = int(body["from"] / 0.25)
        positions = np.reshape(body["positions"], (3, 3))
        rotations = np.reshape(body["rotations"], (3, 4))[:, [3, 0, 1, 2]]
        shown = qpos[np.maximum(np.arange(3), first), slot]
        np.testing.assert_array_equal(positions, shown[:, :3])
        np.testing.assert_array_equal(rotations, shown[:, 3:])
    # The tower stands: each body within 3 cm of where flat faces would carry it.
    s = shape_library().s[[799, CUBE, ARCH]]
    heights = -0.5 + np.array([s[0], 2 * s[0] + s[1], 2 * (s[0] + s[1]) + s[2]])
    np.testing.assert_allclose(qpos[2, [0, 2, 3], 2], heights, atol=0.03)


@pytest.mark.golden
def test_the_table_is_that_of_the_spec(page: str) -> None:
    """Half-sizes 4 by 2, top at -0.5."""
    low, high = world_of(page).geometry["table"].bounds
    np.testing.assert_allclose((low[:2], high[:2]), ((-4.0, -2.0), (4.0, 2.0)))
    assert high[2] == pytest.approx(-0.5)


@pytest.mark.oracle
def test_geometry_is_that_of_the_engine() -> None:
    """One shape of each class, against MuJoCo's compiled model of all of them."""
    ids = [9, 80, 130, 185, 290, 315, 370, 402, 425, 500, 545, 625, 690, 735, 764, 799]
    labels = shape_library().class_labels[ids]
    assert labels.tolist() == list(range(16))
    model, (_, form_of) = catalogue_model(), scene.forms()
    for shape_id, label in zip(ids, labels, strict=True):
        geom = int(form_of[shape_id]) + 1  # The first is the table.
        kind = mujoco.mjtGeom(model.geom_type[geom]).name
        mesh = body_mesh(shape_id)
        if kind == "mjGEOM_MESH":
            if CLASS_NAMES[label] != "arch":
                np.testing.assert_allclose(
                    corners(np.asarray(mesh.vertices)), corners(vertices(model, geom)), atol=1e-5
                )
            continue
        radius, half = model.geom_size[geom, :2]
        height = {"mjGEOM_SPHERE": radius, "mjGEOM_CAPSULE": half + radius}.get(kind, half)
        # Chords of round shapes: corners are on the surface, within a half per cent.
        np.testing.assert_allclose(mesh.bounds[1], (radius, radius, height), rtol=5e-3)
        np.testing.assert_allclose(mesh.bounds[0], -mesh.bounds[1], atol=1e-9)


def vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """f64[n, 3] of a mesh in the axes of its body: the compiler turns it into its own."""
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
    points = model.mesh_vert[first : first + count] @ matrix.reshape(3, 3).T
    return np.asarray(points + model.geom_pos[geom])


def corners(points: np.ndarray) -> np.ndarray:
    """Distinct points, sorted."""
    return np.unique(np.round(points, 5) + 0.0, axis=0)


@pytest.mark.oracle
@pytest.mark.parametrize("shape_id", [9, 80, 130, 185, 290, 315, 370, 402, 425, 500, 545, 625, 690])
def test_meshes_are_closed_and_turned_outwards(shape_id: int) -> None:
    """Their volume by the divergence theorem is the hull's, the arch's that of the true solid."""
    library, mesh = shape_library(), body_mesh(shape_id)
    solid = solids()[library.class_labels[shape_id]]
    assert solid.hull is not None
    s = library.s[shape_id]
    triangles = np.asarray(mesh.triangles) / s
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
    for corner in range(len(mesh.vertices)):
        at = normals[(mesh.faces == corner).any(axis=1)]
        np.testing.assert_allclose(at - at[0], 0.0, atol=1e-9)


@pytest.mark.unit
def test_the_page_loads_nothing(page: str) -> None:
    """What it names of the net is a namespace and, in a comment of three.js, a discussion."""
    assert set(re.findall(r"https?://[^\s\"')]+", page)) == {
        "http://www.w3.org/1999/xhtml",
        "https://github.com/mrdoob/three.js/pull/23228",
    }
    tags = re.findall(r"<(script|link|img|iframe|base|style)\b([^>]*)>", page)
    assert [attributes for _, attributes in tags] == [""] * len(tags)
    assert not re.search(r"\bimport\s*[({*\"']|@import|importScripts", page)


@pytest.mark.integration
def test_a_browser_without_network_shows_the_tower(page: str, tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"there is no browser: none of {', '.join(BROWSERS)}")
    (tmp_path / "page.html").write_text(page)
    flags = ["--headless", "--no-sandbox", "--window-size=400,300", "--virtual-time-budget=2000"]
    flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--screenshot={tmp_path / 'seen.png'}"]
    command = [browser, *flags, f"file://{tmp_path / 'page.html'}"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    seen = np.asarray(Image.open(tmp_path / "seen.png").convert("RGB")).astype(int)
    is_green = (seen[..., 1] > seen[..., 0] + 40) & (seen[..., 1] > seen[..., 2] + 10)
    assert 500 < is_green.sum() < 20_000  # The cylinders; in the middle, below half height.
    rows, columns = np.nonzero(is_green)
    assert 100 < columns.mean() < 300
    assert 120 < rows.mean() < 240


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
    assert tower_html(ids, unused) == tower_html(ids, qpos)
