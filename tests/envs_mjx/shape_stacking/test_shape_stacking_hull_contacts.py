"""Contacts of two hulls, against the Minkowski difference and by hand."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from envs_mjx.shape_stacking import shape_library
from envs_mjx.shape_stacking.engines import hull_contacts, mjx_pool
from envs_mjx.shape_stacking.solids import CLASS_NAMES

HULL_CLASSES = [k for k, name in enumerate(CLASS_NAMES) if name not in ("sphere", "capsule")]


class Pairs(NamedTuple):
    """Two shapes each: ids int32[n], centres of mass f64[n, 3] and axes f64[n, 3, 3]."""

    ids: list[np.ndarray]
    centers: list[np.ndarray]
    axes: list[np.ndarray]


class Found(NamedTuple):
    distance: np.ndarray
    position: np.ndarray
    normal: np.ndarray


@jax.jit
def _found(ids: list[jax.Array], centers: list[jax.Array], axes: list[jax.Array]) -> Found:
    one, two = (
        mjx_pool._turned(mjx_pool.pool(i), c, a) for i, c, a in zip(ids, centers, axes, strict=True)
    )
    return Found(*jax.vmap(hull_contacts.hull_hull)(one, two))


def found(pairs: Pairs) -> Found:
    floats = [[jnp.asarray(x, jnp.float32) for x in arrays] for arrays in pairs[1:]]
    ids = [jnp.asarray(x, jnp.int32) for x in pairs.ids]
    return Found(*map(np.asarray, _found(ids, *floats)))


def corners(shape_id: int, center: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """f64[V, 3] in the world, without padding."""
    library = shape_library()
    label = library.class_labels[shape_id]
    vertices = library.hulls.vertices[label][: library.hulls.num_vertices[label]]
    return center + library.s[shape_id] * vertices @ axes.T


def overlap(pairs: Pairs, k: int) -> float:
    """How far one must move to touch no more, m; negative where they are apart.

    The origin's depth in the Minkowski difference; all its facets are candidates.
    """
    one, two = (corners(i[k], c[k], a[k]) for i, c, a in zip(*pairs, strict=True))
    hull = ConvexHull((two[:, None] - one[None]).reshape(-1, 3))
    return float(-hull.equations[:, 3].max())


def random_pairs(seed: int, count: int, depth: tuple[float, float]) -> Pairs:
    """Shapes of any class, size and attitude, moved until they overlap by a depth from a range."""
    rng = np.random.default_rng(seed)
    library = shape_library()
    hulls = np.flatnonzero(np.isin(library.class_labels, HULL_CLASSES))
    ids = [rng.choice(hulls, count) for _ in range(2)]
    axes = [Rotation.random(count, random_state=seed + k).as_matrix() for k in range(2)]
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    wanted = rng.uniform(*depth, count)
    low, high = np.zeros(count), np.full(count, 3.0)
    origin = rng.uniform(-1.0, 1.0, (count, 3))
    for _ in range(14):  # Farther along `away` they overlap less.
        middle = 0.5 * (low + high)
        pairs = Pairs(ids, [origin, origin + middle[:, None] * away], axes)
        is_deep = np.array([overlap(pairs, k) for k in range(count)]) > wanted
        low, high = np.where(is_deep, middle, low), np.where(is_deep, high, middle)
    return Pairs(ids, [origin, origin + low[:, None] * away], axes)


def flat_pair(one: int, two: int, height: float, yaw: float = 0.0, x: float = 0.0) -> Pairs:
    """The second shape's centre of mass is above the first's, upright, turned and shifted."""
    turned = Rotation.from_euler("z", yaw).as_matrix()[None]
    ids = [np.array([i]) for i in (one, two)]
    return Pairs(ids, [np.zeros((1, 3)), np.array([[x, 0.0, height]])], [np.eye(3)[None], turned])


@pytest.mark.oracle
def test_depth_and_normal_are_those_of_the_minkowski_difference() -> None:
    pairs = random_pairs(0, 40, (0.001, 0.01))
    contacts = found(pairs)
    for k in range(40):
        depth = overlap(pairs, k)
        assert -contacts.distance[k].min() == pytest.approx(depth, abs=3e-4)
        # Other directions may be as good to within the preference for faces.
        moved = Pairs(pairs.ids, [pairs.centers[0], pairs.centers[1].copy()], pairs.axes)
        moved.centers[1][k] += (depth + 3e-4) * contacts.normal[k]
        assert overlap(moved, k) <= 1e-6


@pytest.mark.oracle
def test_contacts_lie_where_both_hulls_are() -> None:
    """To within half the overlap: beside a corner that stands askew, the midpoint is in one."""
    pairs = random_pairs(1, 40, (0.001, 0.01))
    contacts = found(pairs)
    for k in range(40):
        touching = contacts.position[k][contacts.distance[k] < 0.0]
        assert len(touching) > 0
        margin = 1e-4 - 0.5 * contacts.distance[k].min()
        for ids, centers, axes in zip(*pairs, strict=True):
            planes = ConvexHull(corners(ids[k], centers[k], axes[k])).equations
            assert (touching @ planes[:, :3].T + planes[:, 3]).max() < margin


@pytest.mark.oracle
def test_hulls_that_are_apart_have_no_contact() -> None:
    pairs = random_pairs(2, 40, (-0.02, -0.0005))
    assert found(pairs).distance.min() > 0.0


@pytest.mark.oracle
def test_order_of_the_two_does_not_matter() -> None:
    pairs = random_pairs(3, 30, (0.001, 0.01))
    swapped = Pairs(*(list(reversed(arrays)) for arrays in pairs))
    one, other = found(pairs), found(swapped)
    np.testing.assert_allclose(one.distance.min(axis=1), other.distance.min(axis=1), atol=3e-4)
    # Where two directions are equally good, each order may take its own.
    assert np.mean(np.abs(one.normal + other.normal).max(axis=1) < 1e-5) > 0.9


@pytest.mark.unit
def test_a_cube_on_a_cube_touches_at_its_corners() -> None:
    """690 (s = 0.3022) below 684 (s = 0.2578), 0.002 too near: the corners of the upper one."""
    s = shape_library().s
    contacts = found(flat_pair(690, 684, s[690] + s[684] - 0.002))
    np.testing.assert_allclose(contacts.distance[0], -0.002, atol=1e-6)
    np.testing.assert_allclose(contacts.normal[0], [0.0, 0.0, 1.0], atol=1e-6)
    # Halfway between the lower one's top and the upper one's base.
    np.testing.assert_allclose(contacts.position[0][:, 2], s[690] - 0.001, atol=1e-6)
    xy = contacts.position[0][:, :2] / s[684]
    assert {tuple(np.round(row).astype(int)) for row in xy} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    np.testing.assert_allclose(np.abs(xy), 1.0, atol=1e-5)


def polygon(shape_id: int, x: float, yaw: float) -> np.ndarray:
    """f64[n, 2] outline of an upright shape from above, counter-clockwise."""
    axes = Rotation.from_euler("z", yaw).as_matrix()
    points = corners(shape_id, np.array([x, 0.0, 0.0]), axes)[:, :2]
    return points[ConvexHull(points).vertices]


def shared(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """f64[n, 2] what is inside both polygons (Sutherland and Hodgman)."""
    for start, end in zip(two, np.roll(two, -1, axis=0), strict=True):
        along = end - start
        inside = along[0] * (one[:, 1] - start[1]) - along[1] * (one[:, 0] - start[0])
        kept = []
        for k in range(len(one)):
            here, there = inside[k - 1], inside[k]
            if (here < 0.0) != (there < 0.0):
                kept.append(one[k - 1] + here / (here - there) * (one[k] - one[k - 1]))
            if there >= 0.0:
                kept.append(one[k])
        one = np.array(kept).reshape(-1, 2)
        if len(one) == 0:
            break
    return one


def area(points: np.ndarray) -> float:
    return float(ConvexHull(points).volume) if len(points) > 2 else 0.0


@pytest.mark.oracle
def test_flat_shapes_touch_within_the_area_that_they_share() -> None:
    """Boxes and cylinders on each other, turned and shifted: four points span most of it."""
    rng = np.random.default_rng(4)
    flat = [690, 684, 799, 594, 624]
    s = shape_library().s
    rows = []
    for _ in range(40):
        one, two = rng.choice(flat, 2)
        rows.append((one, two, rng.uniform(0.0, 2.0 * s[one]), rng.uniform(0.0, 2.0 * np.pi)))
    heights = shape_library().top[flat]
    half = dict(zip(flat, heights, strict=True))
    singles = [flat_pair(i, j, half[i] + half[j] - 0.002, yaw, x) for i, j, x, yaw in rows]
    pairs = Pairs(
        *(
            [np.concatenate([single[k][side] for single in singles]) for side in range(2)]
            for k in range(3)
        )
    )
    contacts = found(pairs)
    num_areas = 0
    for k, (one, two, x, yaw) in enumerate(rows):
        both = shared(polygon(one, 0.0, 0.0), polygon(two, x, yaw))
        touching = contacts.position[k][contacts.distance[k] < 0.0]
        if area(both) < 0.01:
            continue
        num_areas += 1
        np.testing.assert_allclose(touching[:, 2], half[one] - 0.001, atol=1e-5)
        planes = ConvexHull(both).equations
        assert (touching[:, :2] @ planes[:, :2].T + planes[:, 2]).max() < 1e-4
        assert area(touching[:, :2]) > 0.5 * area(both)
    assert num_areas > 20


@pytest.mark.unit
def test_a_plate_that_overhangs_touches_where_it_is_supported() -> None:
    """Cube 690 half over the edge of another: the shared strip, x from s to 2 s of the second."""
    s = float(shape_library().s[690])
    contacts = found(flat_pair(690, 690, 2.0 * s - 0.001, x=s))
    x, y = contacts.position[0][:, 0], contacts.position[0][:, 1]
    assert sorted(np.round(x / s, 4)) == [0.0, 0.0, 1.0, 1.0]
    assert sorted(np.round(y / s, 4)) == [-1.0, -1.0, 1.0, 1.0]


@pytest.mark.unit
@pytest.mark.parametrize("yaw", [0.0, 0.2, np.pi / 4.0])
def test_round_areas_touch_symmetrically(yaw: float) -> None:
    """The middle of the four points is the middle of the area, so nothing tips on impact."""
    s = shape_library().s
    pair = flat_pair(799, 690, s[799] + s[690] - 0.01, yaw)
    contacts = found(pair)
    assert (contacts.distance[0] < 0.0).all()
    np.testing.assert_allclose(contacts.position[0][:, :2].mean(axis=0), 0.0, atol=1e-5)
    spread = contacts.position[0][:, :2] - contacts.position[0][0, :2]
    assert np.linalg.norm(spread, axis=1).max() > 1.9 * s[690]


@pytest.mark.unit
def test_crossed_edges_touch_in_a_point() -> None:
    """Two roofs (class middle_triangle), ridge on ridge, the upper one upside down and turned."""
    shape = 30
    library = shape_library()
    top = library.top[shape] - library.center_of_mass[shape, 2]
    down = Rotation.from_euler("xz", [np.pi, np.pi / 2.0]).as_matrix()[None]
    ids = [np.array([shape])] * 2
    centers = [np.zeros((1, 3)), np.array([[0.02, 0.01, 2.0 * top - 0.003]])]
    contacts = found(Pairs(ids, centers, [np.eye(3)[None], down]))
    np.testing.assert_allclose(contacts.distance[0], [-0.003, 1.0, 1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(contacts.normal[0], [0.0, 0.0, 1.0], atol=1e-6)
    # The lower ridge runs along y at x = 0, the upper one along x at y = 0.01.
    np.testing.assert_allclose(contacts.position[0][0], [0.0, 0.01, top - 0.0015], atol=1e-5)


@pytest.mark.unit
def test_four_corners_of_a_plane_polygon() -> None:
    """A unit square, its middle, and a point that does not count; it leans towards (1, 1)."""
    points = jnp.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0], [9, 9, 0.0]])
    up, along = jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    gaps = -0.1 - 0.05 * (points[:, 0] + points[:, 1])
    choose = jax.jit(hull_contacts.four_corners)
    for members, expected in (
        ([0, 1, 2, 3, 4], {0, 1, 2, 3}),
        ([0, 1, 4], {0, 1, 4}),
        ([0, 2], {0, 2}),
        ([3], {3}),
        ([], set()),
    ):
        is_one = jnp.asarray(np.isin(np.arange(6), members))
        chosen, are_new = choose(points, gaps, is_one, up, along)
        assert set(np.asarray(chosen)[np.asarray(are_new)].tolist()) == expected
        assert are_new.sum() == len(expected)
        if 2 in members:
            assert chosen[0] == 2
