"""Rules of stacking against a NumPy version, and figures worked by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs_mjx.shape_stacking import rules, shape_library
from envs_mjx.shape_stacking.rules import Bodies


def random_bodies(seed: int, num_used: int) -> Bodies:
    """Bodies anywhere, turned anyhow, in random slots."""
    rng = np.random.default_rng(seed)
    ids = np.full(12, -1, np.int32)
    ids[rng.choice(12, num_used, replace=False)] = rng.integers(0, 810, num_used)
    quaternions = rng.normal(size=(12, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    qpos = np.concatenate([rng.uniform(-1.0, 1.0, (12, 3)), quaternions], axis=1)
    qpos[ids < 0, 2] = 100.0
    qvel = rng.normal(size=(12, 6))
    return Bodies(*map(jnp.asarray, (ids, qpos.astype(np.float32), qvel.astype(np.float32))))


def top_in_numpy(bodies: Bodies) -> float:
    library, tops = shape_library(), [-np.inf]
    for i, pose in zip(np.asarray(bodies.shape_ids), np.array(bodies.qpos, float), strict=True):
        if i >= 0:
            turn = Rotation.from_quat(pose[3:], scalar_first=True)
            center = pose[:3] + turn.apply(np.array(library.center_of_mass[i]))
            tops.append(center[2] + library.bounding_radius[i])
    return max(tops) if len(tops) > 1 else 0.0


# Lengths are below 4 m, where float32 is exact to 2.4e-7; a few roundings add up.
CLOSE = {"abs": 3e-6}


@pytest.mark.oracle
@pytest.mark.property
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12), st.integers(0, 809))
def test_drops_and_rewards_equal_numpy(seed: int, num_used: int, new: int) -> None:
    bodies, library = random_bodies(seed, num_used), shape_library()
    top = top_in_numpy(bodies)
    assert float(rules.top(bodies)) == pytest.approx(top, **CLOSE)
    height = top + library.bounding_radius[new] - 0.1 * library.s[new]
    assert float(rules.drop_height(bodies, new)) == pytest.approx(height, **CLOSE)

    z = np.asarray(bodies.qpos, float)[np.asarray(bodies.shape_ids) >= 0, 2]
    tower = z.max() + 0.5 if num_used else 0.0
    assert float(rules.tower_height(bodies)) == pytest.approx(tower, **CLOSE)
    above = z[z > 0.0].mean() if (z > 0.0).any() else 0.0
    assert float(rules.tower_reward(bodies)) == pytest.approx(0.5 * (tower + above), **CLOSE)
    mean = (z + 0.5).mean() if num_used else 0.0
    paper = float(rules.tower_reward(bodies, "paper"))
    assert paper == pytest.approx(0.5 * (tower + mean), **CLOSE)


@pytest.mark.golden
def test_start_scene() -> None:
    """Cylinder 800 at rest on the table, c = 0.1, gap = 1.4; the rest is parked."""
    bodies = rules.start(800, 0.1, 1.4)
    assert bodies.shape_ids.tolist() == [800, 800, *[-1] * 10]
    np.testing.assert_allclose(bodies.qpos[0, :3], [-0.6, 0.0, -0.5 + 0.35586], atol=1e-5)
    np.testing.assert_allclose(bodies.qpos[1, :3], [0.8, 0.0, -0.5 + 0.35586], atol=1e-5)
    np.testing.assert_array_equal(bodies.qpos[:, 3:], np.tile([1.0, 0.0, 0.0, 0.0], (12, 1)))
    assert not np.asarray(bodies.qvel).any()
    parked = np.asarray(bodies.qpos[2:, :3])
    np.testing.assert_allclose(parked[:, 0], 20.0 + 3.0 * np.arange(2, 12))
    np.testing.assert_array_equal(parked[:, 1:], np.tile([0.0, 100.0], (10, 1)))
    assert float(rules.tower_height(bodies)) == pytest.approx(0.35586, abs=1e-5)


@pytest.mark.golden
@pytest.mark.parametrize(("shape_id", "height"), [(690, 0.819), (735, 0.658)])
def test_05_height_of_the_first_drop(shape_id: int, height: float) -> None:
    bodies = rules.start(799, 0.0, 1.3)
    assert float(rules.drop_height(bodies, shape_id)) == pytest.approx(height, abs=0.0006)


@pytest.mark.unit
def test_placing_turns_the_shape_and_stops_everything() -> None:
    bodies = rules.start(799, 0.0, 1.3)
    bodies = bodies.replace(qvel=jnp.ones((12, 6)))
    shape_id = 127  # A triangle, turned by 7/10 of a full turn.
    placed = rules.place(bodies, 2, shape_id, jnp.array([0.3, -0.2]))
    assert placed.shape_ids.tolist() == [799, 799, shape_id, *[-1] * 9]
    library = shape_library()
    assert library.yaw[shape_id] == pytest.approx(1.4 * np.pi)
    pose = np.array(placed.qpos[2], float)
    np.testing.assert_allclose(pose[:2], [0.3, -0.2], atol=1e-7)
    assert pose[2] == pytest.approx(float(rules.drop_height(bodies, shape_id)), abs=1e-7)
    turn = Rotation.from_quat(pose[3:], scalar_first=True)
    np.testing.assert_allclose(turn.as_rotvec() % (2 * np.pi), [0, 0, 1.4 * np.pi], atol=1e-6)
    others = np.delete(np.arange(12), 2)
    np.testing.assert_array_equal(placed.qpos[others], bodies.qpos[others])
    assert not np.asarray(placed.qvel).any()


@pytest.mark.golden
def test_reward_of_known_heights() -> None:
    """0.5 * (0.7 + 0.5) + 0.5 * mean(0.2, 0.7); paper: heights 0.34, 0.34, 0.7, 1.2."""
    bodies = rules.start(799, 0.0, 1.3)
    for slot, z in ((2, 0.2), (3, 0.7)):
        bodies = rules.place(bodies, slot, 690, jnp.zeros(2))
        bodies = bodies.replace(qpos=bodies.qpos.at[slot, 2].set(z))
    assert float(rules.tower_reward(bodies)) == pytest.approx(0.6 + 0.225, abs=1e-6)
    mean = (2 * 0.34207 + 0.7 + 1.2) / 4
    paper = float(rules.tower_reward(bodies, "paper"))
    assert paper == pytest.approx(0.6 + 0.5 * mean, abs=1e-5)


@pytest.mark.unit
def test_an_unknown_reward_is_refused() -> None:
    with pytest.raises(ValueError, match="variant='mean' is unknown; choose from"):
        rules.tower_reward(rules.start(799, 0.0, 1.3), "mean")


@pytest.mark.contract
def test_one_program_for_many_worlds() -> None:
    worlds = [random_bodies(seed, 5) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    ids = jnp.array([3, 290, 809], jnp.int32)
    slots = jnp.array([2, 5, 11], jnp.int32)
    placed = jax.jit(jax.vmap(rules.place))(stacked, slots, ids, jnp.zeros((3, 2)))
    rewards = jax.jit(jax.vmap(rules.tower_reward))(placed)
    for k, world in enumerate(worlds):
        alone = rules.place(world, slots[k], ids[k], jnp.zeros(2))
        np.testing.assert_array_equal(placed.shape_ids[k], alone.shape_ids)
        np.testing.assert_allclose(placed.qpos[k], alone.qpos, atol=1e-6)
        assert float(rewards[k]) == pytest.approx(float(rules.tower_reward(alone)), abs=1e-6)
