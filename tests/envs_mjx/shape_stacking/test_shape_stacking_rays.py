"""Rays against every solid, beside a search along each ray."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs_mjx.shape_stacking.rays import Bodies, Hits, enter, nearest, normals, walk
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from tests.envs_mjx.shape_stacking.shape_solids import SOLIDS

pytestmark = pytest.mark.oracle

NUM_RAYS = 300
# Steps of the search, in units of s; a ray that is inside for less may be missed by it.
STEP = 2e-3
S, POSITION = 0.3, np.array([0.4, -0.2, 0.7])
TURN = Rotation.from_euler("xyz", [0.4, -0.7, 2.1])


def body_of(name: str, turn: Rotation = TURN) -> Bodies:
    return Bodies(
        label=jnp.int32(CLASS_NAMES.index(name)),
        s=jnp.float32(S),
        position=jnp.asarray(POSITION, jnp.float32),
        rotation=jnp.asarray(turn.as_matrix(), jnp.float32),
    )


def several(*bodies: Bodies) -> Bodies:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *bodies)


def components(vectors: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    x, y, z = jnp.asarray(vectors, jnp.float32).T
    return x, y, z


def random_rays(name: str) -> tuple[np.ndarray, np.ndarray]:
    """f64[n, 3] origins and directions in the solid's axes and units, towards its surroundings."""
    rng = np.random.default_rng(CLASS_NAMES.index(name))
    origins = rng.normal(size=(NUM_RAYS, 3))
    origins *= rng.uniform(6, 25, (NUM_RAYS, 1)) / np.linalg.norm(origins, axis=1, keepdims=True)
    targets = 1.4 * rng.uniform(-1, 1, (NUM_RAYS, 3)) * SOLIDS[name][0]
    directions = targets - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def search(
    name: str, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First point inside along each ray: distance, outward normal, and how surely it is one.

    The last is the length of the stretch inside after it, in units of s; negative for misses: minus
    the nearest that the ray comes to the solid's surface.
    """
    outside = SOLIDS[name][1]
    middle = -(origins * directions).sum(1)
    t = middle[:, None] + np.arange(-3.5, 3.5, STEP)
    points = origins[:, None] + t[..., None] * directions[:, None]
    values = outside(*np.moveaxis(points, -1, 0))
    first = (values < 0).argmax(1)
    rows = np.arange(len(t))
    is_hit = values[rows, first] < 0
    after = (values > 0) & (np.arange(t.shape[1]) > first[:, None])
    margin = np.where(is_hit, t[rows, after.argmax(1)] - t[rows, first], -values.min(1))
    low, high = t[rows, first] - STEP, t[rows, first]
    for _ in range(40):
        between = (low + high) / 2
        is_in = outside(*(origins + between[:, None] * directions).T) < 0
        low, high = np.where(is_in, low, between), np.where(is_in, between, high)
    met = origins + high[:, None] * directions
    gradient = np.stack(
        [outside(*(met + h).T) - outside(*(met - h).T) for h in 1e-6 * np.eye(3)], axis=-1
    )
    length = np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return np.where(is_hit, high, np.inf), gradient / length, margin


@pytest.mark.parametrize("name", CLASS_NAMES)
def test_distance_and_normal_where_rays_enter(name: str) -> None:
    origins, directions = random_rays(name)
    distance, normal, margin = search(name, origins, directions)
    world = POSITION + S * TURN.apply(origins), TURN.apply(directions)
    start, along = components(world[0]), components(world[1])
    bodies = several(body_of(name))
    hits = jax.jit(nearest)(bodies, start, along, jnp.full(NUM_RAYS, jnp.inf))
    met = walk(start, jnp.where(jnp.isfinite(hits.distance), hits.distance, 0.0), along)
    found_normal = np.stack(jax.jit(normals)(bodies, hits, met), axis=-1)

    # Rays that only graze the solid may be seen or missed.
    is_clear = np.abs(margin) > 5 * STEP
    assert is_clear.mean() > 0.9
    is_hit = np.isfinite(distance)
    assert 0.2 < is_hit.mean() < 0.95
    np.testing.assert_array_equal(np.isfinite(hits.distance)[is_clear], is_hit[is_clear])
    is_hit &= is_clear
    # f32 distances of up to 8 m.
    np.testing.assert_allclose(hits.distance[is_hit], S * distance[is_hit], atol=2e-5)
    # Two sides meet where a numerical gradient belongs to neither; a ray in a hundred goes there.
    cosine = (found_normal * TURN.apply(normal)).sum(1)[is_hit]
    assert (cosine > 0.9999).mean() > 0.98
    np.testing.assert_allclose(np.linalg.norm(found_normal[is_hit], axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("name", CLASS_NAMES)
def test_rays_along_the_axes_of_solids(name: str) -> None:
    """Exactly parallel to flat sides, to cylinders and to the axis of cones; inside and outside."""
    offsets = np.array([(a, b) for a in (-1.7, -0.35, 0.0, 0.6, 1.7) for b in (-1.7, -0.35, 0.6)])
    rays = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            origins = np.insert(offsets, axis, -8 * side, axis=1)
            rays.append((origins, np.tile(side * np.eye(3)[axis], (len(offsets), 1))))
    origins, directions = (np.concatenate(part) for part in zip(*rays, strict=True))
    expected, _, _ = search(name, origins, directions)
    body = body_of(name, Rotation.identity())
    found, surface = jax.jit(enter)(
        body, components(POSITION + S * origins), components(directions)
    )
    assert not np.isnan(found).any()
    assert ((surface >= 0) & (surface < 10)).all()
    assert np.isfinite(expected).any()
    assert np.isinf(expected).any()
    np.testing.assert_allclose(found, S * expected, atol=2e-5)


def test_rays_along_the_side_of_a_cone() -> None:
    """Exactly as steep as the cone's side: one of the two crossings is at infinity."""
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rays = [
        (sign * np.array([np.cos(a), np.sin(a), -2.0]) / np.sqrt(5), b)
        for a in turns
        for sign in (-1, 1)
        for b in ((0.1, 0.2, -0.6), (-0.3, 0.1, 0.0), (0.9, 0.9, 0.5))
    ]
    directions = np.array([direction for direction, _ in rays])
    origins = np.array([through for _, through in rays]) - 5 * directions
    expected, _, _ = search("cone", origins, directions)
    body = body_of("cone", Rotation.identity())
    found, _ = jax.jit(enter)(body, components(POSITION + S * origins), components(directions))
    assert 0.5 < np.isfinite(expected).mean() < 1.0
    np.testing.assert_allclose(found, S * expected, atol=2e-5)


def test_no_nan_is_made_where_a_ray_touches_a_sphere() -> None:
    """Both crossings and their product are zero there; outside of jit every step is checked."""
    sphere = Bodies(
        jnp.int32(CLASS_NAMES.index("sphere")), jnp.float32(1), jnp.zeros(3), jnp.eye(3)
    )
    with jax.debug_nans(True):
        distance, _ = enter(
            sphere, components(np.array([[-5.0, 0, 1]])), components(np.array([[1.0, 0, 0]]))
        )
    assert distance.tolist() == [np.inf]


def test_rays_from_far_away_still_meet_small_shapes() -> None:
    """The camera is 7 m away and a shape may be 0.08 m small: 90 units of s."""
    grid = np.linspace(-1.2, 1.2, 41)
    targets = np.array([(x, 0.0, z) for x in grid for z in grid])
    origin = np.array([3.0, 85.0, 20.0])
    directions = targets - origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    body = Bodies(jnp.int32(13), jnp.float32(0.08), jnp.zeros(3), jnp.eye(3))
    start = tuple(jnp.float32(0.08 * value) for value in origin)
    found, _ = jax.jit(enter)(body, start, components(directions))
    nearest_approach = np.linalg.norm(np.cross(origin, directions), axis=1)
    is_clear = np.abs(nearest_approach - 1) > 1e-3
    assert np.array_equal(np.isfinite(found)[is_clear], (nearest_approach < 1)[is_clear])
    depth = np.sqrt(np.maximum(1 - nearest_approach**2, 0))
    expected = 0.08 * (-(directions @ origin) - depth)
    is_hit = is_clear & (nearest_approach < 1)
    np.testing.assert_allclose(found[is_hit], expected[is_hit], atol=2e-5)


def test_rays_do_not_look_back_nor_from_inside() -> None:
    body = body_of("cube", Rotation.identity())
    along = components(np.array([[1.0, 0.0, 0.0]] * 3))
    origins = POSITION + S * np.array([[-3.0, 0, 0], [3.0, 0, 0], [0, 0, 0]])
    distance, _ = enter(body, components(origins), along)
    np.testing.assert_allclose(distance, [2 * S, np.inf, np.inf], rtol=1e-5)


def test_rays_from_within_the_opening_of_an_arch() -> None:
    """To the vault above, from one side of the vault to the other, and out along the opening."""
    body = body_of("arch", Rotation.identity())
    half_width = np.sqrt(1.25**2 - 0.5**2)  # Half-way up to the middle of the box.
    rays = {
        ((0, 0, -0.999), (0, 0, 1)): 1.249,
        ((0.001 - half_width, 0, -0.5), (1, 0, 0)): 2 * half_width - 0.001,
        ((0.001 - half_width, 0, -0.5), (0, 1, 0)): np.inf,
    }
    starts, ways = (np.array(part, float) for part in zip(*rays, strict=True))
    distance, _ = jax.jit(enter)(body, components(POSITION + S * starts), components(ways))
    np.testing.assert_allclose(distance, [S * value for value in rays.values()], rtol=1e-5)


def test_nearest_body_wins_in_any_order() -> None:
    near, far = body_of("sphere"), body_of("cube")
    far = far.replace(position=far.position + jnp.array([0.0, 2.0, 0.0]))
    # At any size it would be met first.
    absent = near.replace(s=jnp.float32(0), position=near.position - jnp.array([0.0, 0.5, 0.0]))
    start = components(np.array([POSITION - [0, 3, 0]] * 2))
    along = components(np.array([[0.0, 1, 0], [0, -1, 0]]))
    for order in ([near, far, absent], [absent, far, near]):
        hits: Hits = nearest(several(*order), start, along, jnp.full(2, jnp.inf))
        np.testing.assert_allclose(hits.distance, [3 - S, np.inf], rtol=1e-5)
        assert hits.body.tolist() == [order.index(near), -1]
    wall = nearest(several(near, far), start, along, jnp.full(2, 2.0))
    assert wall.distance.tolist() == [2.0, 2.0]
    assert wall.surface.tolist() == [-1, -1]


def test_a_body_at_nan_is_met_by_no_ray() -> None:
    lost = body_of("cylinder").replace(position=jnp.full(3, jnp.nan))
    start, along = components(POSITION[None] - [0, 3, 0]), components(np.array([[0.0, 1, 0]]))
    hits = nearest(several(lost, body_of("sphere")), start, along, jnp.full(1, jnp.inf))
    assert hits.body.tolist() == [1]


def test_vmap_equals_one_by_one() -> None:
    origins, directions = random_rays("arch")
    start, along = components(POSITION + S * origins), components(directions)
    bodies = several(*(body_of(name) for name in CLASS_NAMES))
    one = jax.jit(enter)
    every = jax.jit(jax.vmap(enter, in_axes=(0, None, None)))
    together, _ = every(bodies, start, along)
    for label, name in enumerate(CLASS_NAMES):
        alone, _ = one(body_of(name), start, along)
        # Fused differently, rounded differently: more of 8 m where a ray grazes a round side.
        np.testing.assert_allclose(together[label], alone, atol=1e-4)
