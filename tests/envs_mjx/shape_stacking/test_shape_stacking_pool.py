"""Contacts of bodies whose shapes are data: which there are, and where, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import scene, shape_library
from envs_mjx.shape_stacking.engines import mjx_pool
from envs_mjx.shape_stacking.engines.mujoco_pool import catalogue_model

TABLE, FIRST, SECOND, THIRD = 0, 1, 2, 3
CUBE, SPHERE, SMALL_SPHERE, CAPSULE = 690, 735, 726, 764
UPRIGHT = np.eye(3)
LYING = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # Its axis along x.
S = shape_library().s


class Found(NamedTuple):
    """One contact."""

    distance: float
    position: tuple[float, ...]
    normal: tuple[float, ...]


@jax.jit
def _find(ids: jax.Array, centers: jax.Array, axes: jax.Array) -> mjx_pool.Contacts:
    pool = mjx_pool.pool(ids)
    return mjx_pool.find_contacts(pool, centers, axes)


def contacts(
    ids: list[int], centers: list[list[float]], axes: list[np.ndarray] | None = None
) -> dict[tuple[int, int], list[Found]]:
    """Those that push, by the two bodies; three slots."""
    missing = 3 - len(ids)
    turned = np.stack([*(axes or [UPRIGHT] * len(ids)), *[UPRIGHT] * missing])
    centers = [*centers, *[[50.0, 0.0, 50.0]] * missing]
    found = _find(
        jnp.array([*ids, *[-1] * missing], jnp.int32),
        jnp.array(centers, jnp.float32),
        jnp.asarray(turned, jnp.float32),
    )
    pushing: dict[tuple[int, int], list[Found]] = {}
    for distance, position, normal, bodies in zip(*map(np.asarray, found), strict=True):
        if distance < 0.0:
            one = Found(float(distance), tuple(position.tolist()), tuple(normal.tolist()))
            pushing.setdefault(tuple(bodies.tolist()), []).append(one)
    return pushing


def resting(height: float, depth: float = 0.001) -> float:
    """z of a centre that is `height` above the table's surface, less `depth`."""
    return scene.TABLE_HEIGHT + height - depth


def assert_is(found: Found, distance: float, position: object, normal: object) -> None:
    assert found.distance == pytest.approx(distance, abs=1e-5)
    assert found.position == pytest.approx(position, abs=1e-5)
    assert found.normal == pytest.approx(normal, abs=1e-5)


@pytest.mark.unit
def test_a_sphere_touches_the_table_in_one_point() -> None:
    found = contacts([SPHERE], [[0.3, 0.2, resting(S[SPHERE])]])
    assert list(found) == [(TABLE, FIRST)]
    (one,) = found[TABLE, FIRST]
    assert_is(one, -0.001, (0.3, 0.2, scene.TABLE_HEIGHT - 0.0005), (0, 0, 1))


@pytest.mark.unit
def test_a_capsule_touches_the_table_with_its_ends() -> None:
    s = S[CAPSULE]
    (upright,) = contacts([CAPSULE], [[0, 0, resting(2 * s)]])[TABLE, FIRST]
    assert_is(upright, -0.001, (0, 0, scene.TABLE_HEIGHT - 0.0005), (0, 0, 1))
    lying = contacts([CAPSULE], [[0, 0, resting(s)]], [LYING])[TABLE, FIRST]
    assert sorted(one.position[0] for one in lying) == pytest.approx([-s, s], abs=1e-5)


@pytest.mark.unit
def test_a_cube_touches_the_table_with_its_corners() -> None:
    s = S[CUBE]
    found = contacts([CUBE], [[0, 0, resting(s)]])[TABLE, FIRST]
    corners = {(round(one.position[0] / s), round(one.position[1] / s)) for one in found}
    assert corners == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    for one in found:
        assert one.distance == pytest.approx(-0.001, abs=1e-5)
        assert one.position[2] == pytest.approx(scene.TABLE_HEIGHT - 0.0005, abs=1e-5)


@pytest.mark.unit
def test_round_bodies_touch_between_their_axes() -> None:
    """A sphere beside the upper half of an upright capsule, and above a lying one."""
    s, r = S[CAPSULE], S[SPHERE]
    found = contacts([CAPSULE, SPHERE], [[0, 0, 2], [s + r - 0.002, 0, 2 + 0.9 * s]])
    (one,) = found[FIRST, SECOND]
    assert_is(one, -0.002, (s - 0.001, 0, 2 + 0.9 * s), (1, 0, 0))
    two = contacts(
        [SPHERE, CAPSULE], [[0.5 * s, 0, 2 + s + r - 0.002], [0, 0, 2]], [UPRIGHT, LYING]
    )
    assert_is(two[FIRST, SECOND][0], -0.002, (0.5 * s, 0, 2 + s - 0.001), (0, 0, -1))


@pytest.mark.unit
@pytest.mark.parametrize("is_first", [True, False])
def test_a_sphere_touches_a_cube_in_one_point(is_first: bool) -> None:
    """The round body comes first in a contact, whichever slot it is in."""
    s, r = S[CUBE], S[SPHERE]
    ids, centers = [CUBE, SPHERE], [[0, 0, 2], [0.1, 0.0, 2 + s + r - 0.002]]
    if is_first:
        ids, centers = ids[::-1], centers[::-1]
    found = contacts(ids, centers)
    assert list(found) == [(FIRST, SECOND) if is_first else (SECOND, FIRST)]
    (one,) = next(iter(found.values()))
    assert_is(one, -0.002, (0.1, 0, 2 + s - 0.001), (0, 0, -1))


@pytest.mark.unit
def test_a_capsule_lies_on_a_cube_with_two_points() -> None:
    s, r = S[CUBE], S[CAPSULE]
    found = contacts([CUBE, CAPSULE], [[0, 0, 2], [0, 0, 2 + s + r - 0.002]], [UPRIGHT, LYING])
    points = found[SECOND, FIRST]
    assert sorted(one.position[0] for one in points) == pytest.approx([-r, r], abs=1e-4)


@pytest.mark.unit
def test_every_pair_of_a_stack_is_found_and_no_other() -> None:
    """Cube, cube and sphere; unused bodies touch nothing, wherever they are."""
    s, r = S[CUBE], S[SMALL_SPHERE]
    heights = [resting(s), resting(s) + 2 * s - 0.001, resting(s) + 3 * s + r - 0.002]
    centers = [[0.0, 0.0, z] for z in heights]
    found = contacts([CUBE, CUBE, SMALL_SPHERE], centers)
    counts = {bodies: len(points) for bodies, points in found.items()}
    assert counts == {(TABLE, FIRST): 4, (FIRST, SECOND): 4, (THIRD, SECOND): 1}
    assert set(contacts([CUBE, -1, SMALL_SPHERE], centers)) == {(TABLE, FIRST)}


@pytest.mark.unit
def test_boxes_around_bodies_tell_which_pairs_are_near() -> None:
    s, r = S[CUBE], S[CAPSULE]
    ids = jnp.array([CUBE, CAPSULE, SPHERE], jnp.int32)
    centers = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, s + 2 * r + 0.1], [1.5, 0.3, 0.0]])
    pool = mjx_pool.pool(ids)
    corners = centers[:, None] + pool.vertices
    lengths = jnp.array([0.0, 0.0, 1.0]) * pool.half_length[:, None]
    gaps = mjx_pool._gaps(pool, centers, corners, lengths)
    # Of all three axes the widest: z for the first two, x for the others.
    expected = [0.1, 1.5 - s - S[SPHERE], 1.5 - r - S[SPHERE]]
    np.testing.assert_allclose(gaps, expected, atol=2e-4)
    is_candidate = jnp.array([True, False, True])
    chosen, is_near = mjx_pool._nearest(is_candidate, -gaps, 1)
    assert chosen.tolist() == [2]  # The deeper of the two, were these overlaps.
    assert is_near.tolist() == [True]
    assert not mjx_pool._nearest(is_candidate, gaps, 2)[1].any()


@pytest.mark.oracle
def test_masses_are_those_that_mujoco_compiles() -> None:
    """Every class and scale, as a body of its own in a compiled model."""
    compiled = catalogue_model()
    names = ("mass", "subtreemass", "inertia", "ipos", "iquat", "invweight0")
    fields = {f"body_{name}": getattr(compiled, f"body_{name}") for name in names}

    class Model(SimpleNamespace):
        def replace(self, **values: jax.Array) -> dict[str, jax.Array]:
            return values

    ids = jnp.array([form.shape_id for form in scene.forms()[0]], jnp.int32)
    empty = {name: jnp.zeros(values.shape) for name, values in fields.items()}
    found = mjx_pool.with_shapes(Model(**empty), ids)
    assert set(found) == set(fields)
    for name, values in fields.items():
        np.testing.assert_allclose(found[name][1:], values[1:], rtol=1e-4, atol=1e-7)
