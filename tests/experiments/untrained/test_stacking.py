"""Policies without training in Shape Stacking: what they do and what they reach."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import ShapeStacking, shape_library
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.untrained import stacking
from experiments.untrained.stacking import OpenStacking, StackingAnchor
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.sampling import AvailableSet

# Cubes by size (690 and 719 are the largest flat shapes here), a sphere, a plate, a cone.
IDS = np.array([735, 660, 690, 402, 719, 606], np.int32)
SIZES = stacking.flat_sizes()[IDS]


def moves(name: str, number: float, mask: np.ndarray | None = None, dim: int = 1) -> Any:
    mask = np.ones(len(IDS), bool) if mask is None else mask
    obs = jnp.array([-0.625, number])
    return StackingAnchor(name, dim).distribution({}, obs, jnp.asarray(SIZES), jnp.asarray(mask))


@pytest.mark.unit
def test_flat_tops_are_the_classes_that_bear_others() -> None:
    sizes, library = stacking.flat_sizes()[:, 0], shape_library()
    # docs/shape_stacking.md, "Ids": horizontal rectangles, arches,
    # rectangles, plates, cubes and cylinders.
    ranges = ((240, 300), (480, 540), (540, 600), (600, 660), (660, 720), (780, 810))
    is_flat = np.zeros(810, bool)
    for first, end in ranges:
        is_flat[first:end] = True
    np.testing.assert_array_equal(sizes > 0.0, is_flat)
    np.testing.assert_allclose(sizes[is_flat], library.s[is_flat], rtol=1e-6)


@pytest.mark.unit
def test_the_script_stacks_flat_shapes_by_size_on_the_left_cylinder() -> None:
    key, available = jax.random.key(0), AvailableSet(jnp.asarray(IDS), jnp.ones(6, bool))
    anchor = StackingAnchor("scripted", 1)
    played = [
        anchor.decode(moves("scripted", t).sample(key), available, jnp.zeros(0)) for t in range(10)
    ]
    s = shape_library().s
    flat = sorted([660, 690, 719, 606], key=lambda i: -s[i])
    assert [int(action.id) for action in played] == flat + [-1] * 6
    assert all(action.position.tolist() == [-0.625] for action in played)
    assert not any(bool(action.stop) for action in played)
    # Padding is no shape.
    mask = flat[0] != IDS
    assert int(IDS[int(moves("scripted", 0, mask).sample(key).id)]) == flat[1]
    assert int(moves("scripted", 3, mask).sample(key).id) == -1
    assert moves("scripted", 0, dim=2).sample(key).position.tolist() == [-0.625, 0.0]
    assert moves("scripted", 0, dim=0).sample(key).position.shape == (0,)


@pytest.mark.unit
def test_random_play_is_uniform_and_stops_as_told() -> None:
    mask = IDS != 690
    keys = jax.random.split(jax.random.key(1), 4000)

    def drawn(name: str) -> Any:
        return jax.vmap(moves(name, 2, mask, dim=2).sample)(keys)

    half = drawn("random, stops with probability 0.5")
    counts = np.bincount(np.asarray(half.id), minlength=6)
    # Binomial: sqrt(4000 * 0.2 * 0.8) = 25 for choices, 32 for stops; 4 deviations.
    np.testing.assert_allclose(counts, np.where(mask, 800, 0), atol=100)
    assert int(half.stop.sum()) == pytest.approx(2000, abs=128)
    assert bool(drawn("stop at once").stop.all())
    assert not bool(drawn("random, never stops").stop.any())
    position = np.asarray(half.position)
    assert position.shape == (4000, 2)
    assert -1.0 <= position.min() < -0.99 < 0.99 < position.max() < 1.0
    # Deviation of a uniform number 0.577 / sqrt(4000) = 0.009, 4 of them.
    np.testing.assert_allclose(position.mean(axis=0), 0.0, atol=0.04)
    assert abs(np.corrcoef(position.T)[0, 1]) < 0.07


@pytest.mark.golden
def test_stopping_at_once_on_the_starts_of_evaluations() -> None:
    """The cylinder's s, one of three, and half of it as the reward."""
    found = stacking.play(OpenStacking(MujocoC()), "stop at once", np.arange(405), 20, 8)
    env, key = ShapeStacking(MujocoC()), jax.random.key(EVALUATION_SEED)

    @jax.jit
    @jax.vmap
    def cylinder(number: jax.Array) -> jax.Array:
        _, key_reset, _ = jax.random.split(jax.random.fold_in(key, number), 3)
        return env.reset_env(key_reset, env.default_params)[1].bodies.shape_ids[0]

    sizes = shape_library().s[np.asarray(cylinder(jnp.arange(8)))]
    np.testing.assert_allclose(found["final_height"], sizes, atol=0.001)
    assert len(np.unique(sizes)) > 1
    np.testing.assert_allclose(found["reward"], found["final_height"] / 2.0, rtol=1e-6)
    np.testing.assert_array_equal(found["is_stopped"], 1.0)
    np.testing.assert_array_equal(found["num_steps"], 1.0)


@pytest.mark.integration
@pytest.mark.parametrize(("name", "position_dim"), [("scripted", 0), ("random, never stops", 2)])
def test_anchors_of_the_other_ways_of_placing(name: str, position_dim: int) -> None:
    # Nothing falls far in one physics step, so that every shape is let go above the last one.
    env = OpenStacking(MujocoC(settle_steps=1), position_dim)
    found = stacking.play(env, name, np.arange(405), 20, 16)
    placed, repeats = found["num_placed"], found["num_repeats"]
    np.testing.assert_array_equal(found["num_steps"], 10.0)
    # Of 20 shapes of 405, about 40 % are flat-topped.
    assert placed.min() < placed.max() <= 10.0
    assert placed.min() >= 1.0
    expected = 0.0 if name == "scripted" else 10.0 - placed
    np.testing.assert_array_equal(repeats, expected)
    # The more shapes, the higher the last one; and all of them count in the reward's mean.
    assert np.corrcoef(placed, found["final_height"])[0, 1] > 0.2
    assert (found["reward"] > 0.5 * found["final_height"]).all()


@pytest.mark.golden
@pytest.mark.slow
def test_what_is_known_of_them() -> None:
    """Mean heights and rewards over all shapes as in docs/shape_stacking.md, "Anchors"."""
    for name, height, reward, tolerance in (
        # Three standard errors of its 60 episodes (30 of the script's) and of ours.
        ("random, stops with probability 0.5", 0.60, 0.38, 0.2),
        ("random, never stops", 1.37, 0.94, 0.2),
        ("scripted", 4.28, 3.30, 1.0),
    ):
        found = stacking.play(OpenStacking(MujocoC()), name, np.arange(810), 20, 128)
        assert found["final_height"].mean() == pytest.approx(height, abs=tolerance), name
        assert found["reward"].mean() == pytest.approx(reward, abs=tolerance), name
        if name != "random, stops with probability 0.5":  # Nothing is lower than the cylinders.
            assert found["final_height"].min() > 0.32, name
