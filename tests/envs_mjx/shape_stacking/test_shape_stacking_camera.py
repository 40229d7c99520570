"""Pictures of towers (docs/shape_stacking.md, "Camera", "Light", "Play data")."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import shape_library
from envs_mjx.shape_stacking.camera import (
    Camera,
    orbit_camera,
    render,
    render_rgb,
    task_camera,
)

pytestmark = pytest.mark.golden

ROOT = Path(__file__).resolve().parents[3]
LIBRARY = shape_library()
NUM_BODIES = 12
CYLINDER, S = 799, LIBRARY.s[799]
Scene = tuple[np.ndarray, np.ndarray, np.ndarray]

gray = jax.jit(render, static_argnames="has_shadows")
rgb = jax.jit(render_rgb, static_argnames=("has_table", "has_shadows", "size"))


def scene(*shapes: tuple[int, tuple[float, float, float]]) -> Scene:
    """Shapes as they are dropped, at positions of their origins; one program for all scenes."""
    absent = [(-1, (0.0, 0.0, 0.0))] * (NUM_BODIES - len(shapes))
    ids = np.array([shape_id for shape_id, _ in (*shapes, *absent)], np.int32)
    positions = np.array([position for _, position in (*shapes, *absent)], np.float32)
    return ids, positions, LIBRARY.quaternion[ids].astype(np.float32)


REFERENCE = scene((CYLINDER, (-0.65, 0, S - 0.5)), (CYLINDER, (0.65, 0, S - 0.5)))


def crowd(seed: int, depth: float) -> Scene:
    rng = np.random.default_rng(seed)
    ids = rng.choice(810, NUM_BODIES, replace=False)
    positions = rng.uniform((-1.3, -depth, -0.3), (1.3, depth, 2), (NUM_BODIES, 3))
    quaternions = rng.normal(size=(NUM_BODIES, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return ids.astype(np.int32), positions.astype(np.float32), quaternions.astype(np.float32)


def extent(is_covered: np.ndarray) -> tuple[int, int, int, int]:
    """First and last row, first and last column."""
    rows, columns = np.flatnonzero(is_covered.any(1)), np.flatnonzero(is_covered.any(0))
    return rows[0], rows[-1], columns[0], columns[-1]


def silhouette(*arguments: Any) -> np.ndarray:
    picture = rgb(*arguments, has_table=False, has_shadows=False)
    return np.asarray(picture).any(-1)


@pytest.mark.parametrize("has_shadows", [True, False])
def test_reference_frame(has_shadows: bool) -> None:
    """Figures of docs/shape_stacking.md, "Light"."""
    picture = np.asarray(gray(*REFERENCE, task_camera(), has_shadows=has_shadows)) / 255
    assert picture.mean() == pytest.approx(0.0515, abs=0.001)
    assert (picture > 0).mean() == pytest.approx(0.176, abs=0.002)
    assert not picture[:67].any()
    covered = silhouette(*REFERENCE, task_camera())
    left, right = covered.copy(), covered.copy()
    left[:, 42:], right[:, :42] = False, False
    np.testing.assert_allclose(extent(left), (67, 79, 28, 37), atol=1)
    np.testing.assert_allclose(extent(right)[2:], (46, 55), atol=1)
    assert left.sum() == pytest.approx(124, abs=3)
    assert picture[left].mean() == pytest.approx(0.604, rel=0.02)
    table = (picture > 0) & ~covered
    np.testing.assert_allclose(extent(table)[:2], (70, 83), atol=1)
    assert picture[table].mean() == pytest.approx(0.216, rel=0.04)


def test_a_larger_picture_has_the_pixels_of_the_small_one() -> None:
    """The middle of every three times three pixels is the middle of one of the usual size."""
    arguments = (*crowd(3, 0.5), task_camera())
    small = np.asarray(rgb(*arguments, has_table=True, has_shadows=False)).astype(int)
    large = np.asarray(rgb(*arguments, has_table=True, has_shadows=False, size=252))
    assert large.shape == (252, 252, 3)
    middles = large[1::3, 1::3].astype(int)
    # Rounding sends a ray past an edge, and light to the next of 256 levels.
    assert (np.abs(middles - small) > 1).any(axis=-1).mean() < 1e-3
    assert small.any()
    with pytest.raises(ValueError, match="size=0 must be 1 to 4,096"):
        render_rgb(*arguments, has_table=True, has_shadows=False, size=0)


def test_the_original_casts_shadows() -> None:
    """The mean of the reference frame is nearer with them: 0.0516 and 0.0524 for 0.0515."""
    means = [np.mean(gray(*REFERENCE, task_camera(), has_shadows=on)) / 255 for on in (True, False)]
    assert abs(means[0] - 0.0515) < 0.0003
    assert means[1] - means[0] > 0.0005


# Pixels and mean RGB over the silhouette from 0, 90, 180 and 270 degrees, height 1.
PLAY = {
    690: ((1146,) * 4, (0.383, 0.647, 0.383, 0.383)),
    735: ((904,) * 4, (0.401, 0.623, 0.402, 0.300)),
    594: ((1166,) * 4, (0.421, 0.798, 0.421, 0.422)),
    290: ((3446, 4024, 3446, 4024), (0.480, 0.686, 0.480, 0.478)),
    500: ((738, 822, 738, 824), (0.399, 0.609, 0.399, 0.397)),
    402: ((323,) * 4, (0.571, 0.782, 0.572, 0.422)),
    764: ((538,) * 4, (0.430, 0.629, 0.431, 0.327)),
    799: ((1212,) * 4, (0.402, 0.614, 0.402, 0.329)),
}


@cache
def around(shape_id: int) -> np.ndarray:
    """u8[4, 84, 84, 3]"""
    azimuths = jnp.radians(jnp.array([0.0, 90.0, 180.0, 270.0]))
    draw = partial(rgb, *scene((shape_id, (0, 0, 0))), has_table=False, has_shadows=False)
    return np.stack([draw(orbit_camera(azimuth, jnp.float32(1))) for azimuth in azimuths])


@pytest.mark.parametrize("shape_id", PLAY)
def test_play_silhouettes_and_means(shape_id: int) -> None:
    """The means of the original include pixels that its four samples cover in part."""
    pixels, means = PLAY[shape_id]
    pictures = around(shape_id) / 255
    covered = pictures.any(-1)
    np.testing.assert_allclose(covered.sum((1, 2)), pixels, rtol=0.03)
    found = [picture[mask].mean() for picture, mask in zip(pictures, covered, strict=True)]
    np.testing.assert_allclose(found, means, rtol=0.04)


@pytest.mark.parametrize("shape_id", [735, 402, 764, 799])
def test_round_shapes_look_the_same_from_all_sides(shape_id: int) -> None:
    counts = around(shape_id).any(-1).sum((1, 2))
    assert len(set(counts.tolist())) == 1


def test_arch_is_open() -> None:
    """From 90 degrees one looks through the arch of id 500, which has no yaw; not through 290."""
    for shape_id, is_open in ((500, True), (290, False)):
        covered = around(shape_id)[1].any(-1)
        middle = covered[:, 41]
        first, last = np.flatnonzero(covered.any(1))[[0, -1]]
        assert (not middle[first:last].all()) == is_open


def test_columns_grow_with_x_and_rows_shrink_with_z() -> None:
    """Column = 41.5 + 101.4 x / (7 - y), row = 41.5 - 101.4 (z - 2) / (7 - y)."""
    for x, y, z in ((1.5, 0.0, 1.0), (-1.0, 1.5, 3.0), (0.7, -1.9, 0.2)):
        covered = silhouette(*scene((725, (x, y, z))), task_camera())
        row, column = np.argwhere(covered).mean(0)
        # A sphere's picture is centred to a tenth of a pixel; 8e-4 rad of pitch are another.
        assert column == pytest.approx(41.5 + 101.4 * x / (7 - y), abs=0.3)
        assert row == pytest.approx(41.5 - 101.4 * (z - 2) / (7 - y), abs=0.3)
        assert (column > 41.5) == (x > 0)


def test_pitch_of_the_front_camera() -> None:
    """1.57 rad instead of a quarter turn: it looks down by 8e-4 rad."""
    forward = task_camera().forward
    assert float(forward[2]) == pytest.approx(-8e-4, rel=0.01)
    np.testing.assert_array_equal(task_camera(0).position, task_camera(1).position)


def test_camera_of_two_dimensions_looks_down() -> None:
    """From (0, 4, 5) along -y and down by 0.77 rad; mirrored the same way."""
    camera = task_camera(2)
    offset = np.array([0.8, 0.5, 0.3]) - (0, 4, 5)
    forward = np.array([0, -np.sin(0.8), -np.cos(0.8)])
    down = np.array([0, np.cos(0.8), -np.sin(0.8)])
    depth = offset @ forward
    covered = silhouette(*scene((725, (0.8, 0.5, 0.3))), camera)
    row, column = np.argwhere(covered).mean(0)
    assert column == pytest.approx(41.5 + 101.4 * 0.8 / depth, abs=0.3)
    assert row == pytest.approx(41.5 + 101.4 * (offset @ down) / depth, abs=0.3)
    assert np.arctan2(-forward[2], -forward[1]) == pytest.approx(0.77, abs=0.001)


def test_orbit_is_not_mirrored() -> None:
    """From +x one sees +y on the right, and what is higher is above."""
    camera = orbit_camera(jnp.float32(0), jnp.float32(1))
    covered = silhouette(*scene((725, (0.0, 0.4, 0.3))), camera)
    row, column = np.argwhere(covered).mean(0)
    assert column > 50
    assert row < 35
    axes = np.stack([camera.right, -camera.down, -camera.forward])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1, abs=1e-6)


def test_light_by_hand() -> None:
    """By "Light" for a row of pixels on the front of cube 690 at the origin, seen from +y."""
    picture = np.asarray(around(690)[1])
    s, color = LIBRARY.s[690], LIBRARY.color[690]
    position = np.array([0, 2, 1.0])
    forward = -position / np.linalg.norm(position)
    right, down = np.array([-1.0, 0, 0]), np.cross(forward, [-1.0, 0, 0])
    for column in range(33, 51):
        direction = forward + (column - 41.5) / 101.4 * right - 0.5 / 101.4 * down
        point = position + (s - 2) / direction[1] * direction
        light = 0.25 + 0.1 + 0.4 * -forward[1]
        for z in (4, 1):
            towards = np.array([0, 4, z]) - point
            towards /= np.linalg.norm(towards)
            light += 1.5 * towards[1] * towards[1] ** 10 * (towards[1] > np.cos(np.pi / 4))
        expected = np.clip(color * light, 0, 1)
        # Rounded to 8 bits; 101.4 is given to four digits.
        np.testing.assert_allclose(picture[41, column], 255 * expected, atol=0.51)


def test_gray_is_the_weighted_sum_of_the_8_bit_picture() -> None:
    arguments = (*crowd(0, 0.5), task_camera())
    color = np.asarray(rgb(*arguments, has_table=True, has_shadows=True), float)
    found = np.asarray(gray(*arguments))
    assert found.dtype == np.uint8
    # Half a gray level of rounding; the sum itself may be rounded either way at x.5.
    assert np.abs(found - color @ (0.299, 0.587, 0.114)).max() < 0.5001


def test_table_is_a_lit_rectangle() -> None:
    nothing = scene((-1, (0, 0, 0)))
    picture = np.asarray(rgb(*nothing, task_camera(2), has_table=True, has_shadows=False))
    # Its far edge, y = -2 and z = -0.5, is 5.5 below and 6 before the camera.
    forward, down = np.array([-np.sin(0.8), -np.cos(0.8)]), np.array([np.cos(0.8), -np.sin(0.8)])
    edge = np.array([-6.0, -5.5])
    row = 41.5 + 101.4 * (edge @ down) / (edge @ forward)
    assert extent(picture.any(-1))[0] == np.ceil(row)
    assert (picture[..., 0] == picture[..., 1]).all()
    assert not rgb(*nothing, task_camera(2), has_table=False, has_shadows=False).any()
    # Away from it, and from below, where nothing hides the shapes.
    for height, way in ((1.0, 1.0), (-3.0, -1.0), (-3.0, 1.0)):
        axes = ((0.0, 0.0, height), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, way))
        camera = Camera(*(jnp.array(axis) for axis in axes))
        assert not rgb(*nothing, camera, has_table=True, has_shadows=False).any()


def test_nearer_shapes_hide_farther_ones_in_any_order() -> None:
    ids, positions, quaternions = crowd(1, 0.8)
    picture = rgb(ids, positions, quaternions, task_camera(), has_table=True, has_shadows=True)
    back = slice(None, None, -1)
    turned = rgb(
        ids[back],
        positions[back],
        quaternions[back],
        task_camera(),
        has_table=True,
        has_shadows=True,
    )
    np.testing.assert_array_equal(picture, turned)
    # Green sphere 735 before and behind red-free cube 690.
    for y, is_sphere in ((1.0, True), (-1.0, False)):
        front = scene((690, (0, 0, 1)), (735, (0, y, 1)))
        alone = scene((735 if is_sphere else 690, (0, y if is_sphere else 0, 1)))
        both = np.asarray(rgb(*front, task_camera(), has_table=False, has_shadows=False))
        single = np.asarray(rgb(*alone, task_camera(), has_table=False, has_shadows=False))
        covered = single.any(-1)
        np.testing.assert_array_equal(both[covered], single[covered])


def test_shapes_without_id_or_place_are_not_drawn() -> None:
    ids, positions, quaternions = crowd(2, 0.5)
    everything = gray(ids, positions, quaternions, task_camera())
    # Ids far from the table, as unused bodies wait.
    away = positions.copy()
    away[4:] = (50, 0, 100)
    expected = gray(ids, away, quaternions, task_camera())
    assert (np.asarray(expected) != everything).sum() > 100
    ids = np.where(np.arange(NUM_BODIES) < 8, ids, -1)
    positions[4:8] = np.nan
    np.testing.assert_array_equal(gray(ids, positions, quaternions, task_camera()), expected)


def test_shadows_fall_away_from_the_lights() -> None:
    """A cube over the table, between the upper light and the table behind it."""
    cube = scene((717, (0.0, 0.5, 0.5)))
    lit, dark = (
        np.asarray(gray(*cube, task_camera(2), has_shadows=on), int) for on in (False, True)
    )
    covered = silhouette(*cube, task_camera(2))
    # Shadows take light away, from the table only, and leave what the headlight gives.
    assert (dark <= lit).all()
    np.testing.assert_array_equal(dark[covered], lit[covered])
    shaded = np.argwhere(lit - dark > 20)
    assert len(shaded) > 100
    assert shaded[:, 0].mean() < np.argwhere(covered)[:, 0].mean()
    assert dark[(lit > 0) & ~covered].min() >= 0.9 * 0.1 * 255 - 1


@pytest.mark.parametrize("shape_id", [119, 419, 719, 749, 779, 809])
def test_convex_shapes_cast_no_shadow_on_themselves(shape_id: int) -> None:
    for position in ((0.0, 0.5, 0.6), (0.7, -0.4, 1.3), (-1.1, 0.3, 0.2)):
        alone = scene((shape_id, position))
        lit, shaded = (
            np.asarray(gray(*alone, task_camera(2), has_shadows=on)) for on in (False, True)
        )
        covered = silhouette(*alone, task_camera(2))
        # Pixels on an edge may be the table's in one program and the shape's in the other.
        assert (lit != shaded)[covered].sum() <= 1


def test_vmap_and_jit_give_the_same_pictures() -> None:
    crowds = [crowd(seed, 0.6) for seed in range(3)]
    ids, positions, quaternions = (np.stack(part) for part in zip(*crowds, strict=True))
    camera = task_camera()
    together = jax.jit(jax.vmap(lambda i, p, q: render(i, p, q, camera)))(
        ids, positions, quaternions
    )
    assert together.shape == (3, 84, 84)
    assert together.dtype == jnp.uint8
    for k, arguments in enumerate(crowds):
        difference = np.abs(np.asarray(gray(*arguments, camera), int) - together[k])
        # Rounding may move a pixel on an edge to the other side, and a value to the next level.
        assert (difference > 1).sum() <= 3


@pytest.mark.parametrize("position_dim", [-1, 3])
def test_camera_of_an_unknown_variant(position_dim: int) -> None:
    with pytest.raises(ValueError, match=rf"position_dim={position_dim} .* 0, 1 or 2"):
        task_camera(position_dim)


def test_shapes_of_the_arguments_are_checked() -> None:
    ids, positions, quaternions = crowd(0, 0.5)
    with pytest.raises(AssertionError, match="shape"):
        render(ids, positions[:5], quaternions, task_camera())
    with pytest.raises(AssertionError, match="shape"):
        render(ids, positions, quaternions[:, :3], task_camera())


def mujoco_draws(scenes: list[dict[str, Any]], folder: Path) -> dict[str, np.ndarray]:
    """Pictures of MuJoCo's own renderer; skips the test where there is no GL."""
    reasons = []
    for backend in ("egl", "osmesa"):
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "tests.envs_mjx.shape_stacking.mujoco_pictures",
                str(folder / "pictures.npz"),
            ],
            input=json.dumps(scenes),
            env={**os.environ, "MUJOCO_GL": backend},
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=300,
        )
        if done.returncode == 0:
            return dict(np.load(folder / "pictures.npz"))
        reasons.append(f"{backend}: {done.stderr.strip().splitlines()[-1:]}")
    pytest.skip(f"MuJoCo cannot draw here; {'; '.join(reasons)}")


@pytest.mark.oracle
def test_mujoco_draws_the_same(tmp_path: Path) -> None:
    """Its pictures without anti-aliasing: same silhouettes, gray levels within a few of 255.

    It lights corners of triangles instead of pixels, and its shadows are maps of finite size.
    """
    scenes, ours = [], []
    cases = ((REFERENCE, 1), (crowd(0, 0.05), 1), (crowd(0, 0.6), 2), (crowd(3, 0.6), 2))
    for (ids, positions, quaternions), dim in cases:
        camera = task_camera(dim)
        rows = zip(ids.tolist(), positions.tolist(), quaternions.tolist(), strict=True)
        shapes = [row for row in rows if row[0] >= 0]
        axes = [camera.position.tolist(), camera.right.tolist(), camera.down.tolist()]
        scenes.append({"shapes": shapes, "has_table": True, "has_shadows": True, "cameras": [axes]})
        ours.append(np.asarray(gray(ids, positions, quaternions, camera), float))
    theirs = mujoco_draws(scenes, tmp_path)
    for k, picture in enumerate(ours):
        # The original never turns the rows over: `up` above is the picture's `down`.
        expected = theirs[f"{k}-0"][::-1] @ (0.299, 0.587, 0.114)
        assert ((picture > 0) != (expected > 0)).sum() <= 3
        assert np.abs(picture - expected).mean() < 1.5
        assert np.median(np.abs(picture - expected)[expected > 0]) < 1.0
