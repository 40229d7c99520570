"""Policies without training in Shape Stacking, and the tables of figures."""

from __future__ import annotations

import numpy as np
import pytest

from envs_mjx.shape_stacking import shape_library
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments import stacking_figures as figures
from experiments.stacking_figures import Start
from experiments.untrained import towers as stacking
from experiments.untrained.towers import SETTLE_ONLY, Row

# Cubes, a hat, a sphere, a rectangle, plates; the largest flat ones are 719, 659, 605.
ACTION_SET = np.array([660, 690, 719, 80, 735, 594, 659, 605, *range(400, 412)])


@pytest.mark.unit
def test_the_script_stacks_flat_shapes_by_size_on_the_left_cylinder() -> None:
    drops = figures.scripted(np.random.default_rng(0), Start(ACTION_SET, 799, 0.1, 1.4))
    ids = [i for i, _ in drops]
    assert sorted(ids[:6]) == [594, 605, 659, 660, 690, 719]
    s = shape_library().s[ids[:6]]
    assert (np.diff(s) <= 0.0).all()
    assert s[0] > s[-1]
    assert ids[6:] == [SETTLE_ONLY] * 4
    assert all(x == pytest.approx(-0.6) for _, x in drops[:6])


@pytest.mark.unit
def test_random_play_repeats_nothing_and_stops() -> None:
    start = Start(ACTION_SET[:3], 799, 0.0, 1.3)
    lengths = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        drops = figures.random_play(0.0)(rng, start)
        assert len(drops) == 10
        ids = [i for i, _ in drops if i != SETTLE_ONLY]
        assert len(ids) == len(set(ids)) <= 3
        assert all(-1.0 <= x <= 1.0 for _, x in drops)
        lengths.append(len(figures.random_play(0.5)(rng, start)))
    # The action that stops is counted: 2 - 2^-9 on average, deviation 1.4 / sqrt(200), 4 of them.
    assert np.mean(lengths) == pytest.approx(2.0, abs=0.4)
    assert figures.random_play(1.0)(rng, start) == [(SETTLE_ONLY, 0.0)]


@pytest.mark.golden
def test_stopping_at_once() -> None:
    """Spec 10: the cylinder's s, one of three, and half of it as the reward."""
    heights, rewards = figures.play(MujocoC(), figures.random_play(1.0), 8, seed=0)
    sizes = shape_library().s[[798, 799, 800]]
    assert np.abs(heights[:, None] - sizes).min(axis=1).max() < 0.001
    assert len(np.unique(heights.round(2))) > 1
    np.testing.assert_allclose(rewards, heights / 2.0, rtol=1e-6)


@pytest.mark.golden
@pytest.mark.slow
def test_17_random_play_without_stopping() -> None:
    heights, _ = figures.play(MujocoC(), figures.random_play(0.0), 60, seed=0)
    assert 1.0 < heights.mean() < 1.7
    assert heights.min() > 0.32


@pytest.mark.unit
def test_worlds_with_fewer_drops_stay_as_they_are() -> None:
    engine = MujocoC(settle_steps=20)
    drops = [[(690, 0.0)], [(690, 0.0), (594, 0.1)], []]
    start = stacking.start_scenes([799] * 3, [0.0] * 3, [1.3] * 3)
    found = np.asarray(stacking.stack(engine, start, drops).qpos)
    alone = stacking.start_scenes([799], [0.0], [1.3])
    np.testing.assert_array_equal(found[0], stacking.stack(engine, alone, drops[:1]).qpos[0])
    np.testing.assert_array_equal(found[1], stacking.stack(engine, alone, drops[1:2]).qpos[0])
    np.testing.assert_array_equal(found[2], start.qpos[2])
    assert (found[1, 2:4, 2] < 10.0).all()


@pytest.mark.unit
def test_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values beyond the tolerance stand out."""
    rows = iter(
        [
            [Row(6, "cube: z1", 0.482, 0.005, 0.484), Row(16, "cone: z2", "falls", None, 0.3)],
            [Row(6, "cube: z1", 0.482, 0.005, 0.488), Row(16, "cone: z2", "falls", None, 0.9)],
        ]
    )
    monkeypatch.setattr(stacking, "measured", lambda engine: next(rows))
    engine = MujocoC(settle_steps=1)
    columns = figures.columns_of({"a": engine, "b": engine})
    assert figures.figures_table(columns).splitlines() == [
        "| check | what | spec | tolerance | a | b |",
        "| --- | --- | --- | --- | --- | --- |",
        "| 6 | cube: z1 | 0.482 | 0.005 | 0.4840 | **0.4880** |",
        "| 16 | cone: z2 | falls |  | 0.3000 | 0.9000 |",
    ]
    assert figures.differences_table(columns, "a", "b").splitlines() == [
        "| check | what | a | b | difference |",
        "| --- | --- | --- | --- | --- |",
        "| 16 | cone: z2 | 0.3000 | 0.9000 | +0.6000 |",
    ]


@pytest.mark.unit
def test_engines_of_the_tables() -> None:
    assert [e.name for e in figures.engines_of("mujoco").values()] == ["mujoco_c"] * 2
    assert [e.name for e in figures.engines_of("mjx").values()] == ["mujoco_c"] * 2 + ["mjx"]
