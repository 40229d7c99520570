"""Skills and their universe (docs/grid_world.md, "Skills")."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld, play, skill_universe
from envs_mjx.grid_world.environment import encode_layout
from envs_mjx.grid_world.skills import (
    NUM_SKILLS,
    QUADRANT_NAMES,
    load_skills,
    move_displacements,
    moves_of,
    net_displacement,
    quadrant_of,
    skill_name,
)
from jaxnew.environment import Action

pytestmark = pytest.mark.unit

# R R D L U: 0 + 0*4 + 1*16 + 2*64 + 3*256.
RRDLU = 912


def test_moves_of_numpy_and_jax() -> None:
    ids = np.arange(1024).reshape(32, 32)
    from_numpy, from_jax = moves_of(ids), jax.jit(moves_of)(jnp.asarray(ids))
    assert isinstance(from_numpy, np.ndarray)
    assert isinstance(from_jax, jax.Array)
    assert from_numpy.shape == (32, 32, 5)
    assert from_numpy.dtype == from_jax.dtype == np.int32
    assert np.array_equal(from_numpy, from_jax)
    # Base 4, first move least significant.
    assert np.array_equal((from_numpy * 4 ** np.arange(5)).sum(-1), ids)


@pytest.mark.golden
def test_engineered_12_of_the_spec_row() -> None:
    assert skill_name(RRDLU) == "RRDLU"
    row = skill_universe().engineered["gt12"][RRDLU]
    assert row.tolist() == [-1, 0, -1, 0, -1, 0, 0, -1, 1, 0, 0, 1]
    assert not np.signbit(row[row == 0]).any()


def test_engineered_vectors() -> None:
    engineered = skill_universe().engineered
    assert {name: (v.shape, v.dtype) for name, v in engineered.items()} == {
        "gt12": ((1024, 12), np.float32),
        "gt5": ((1024, 5), np.float32),
    }
    assert engineered["gt5"][RRDLU].tolist() == [-1.5, -1.5, -0.5, 0.5, 1.5]
    assert np.array_equal(engineered["gt12"][:, :2], -net_displacement())
    assert np.array_equal(engineered["gt12"][:, 2:], -move_displacements())
    assert len(np.unique(engineered["gt12"], axis=0)) == 1024


def test_displacements() -> None:
    assert net_displacement().shape == (1024, 2)
    assert move_displacements().shape == (1024, 10)
    assert net_displacement()[RRDLU].tolist() == [1, 0]
    assert move_displacements()[RRDLU].tolist() == [1, 0, 1, 0, 0, 1, -1, 0, 0, -1]
    size = np.abs(net_displacement()).sum(axis=1)
    assert set(size) == {1, 3, 5}  # five moves are odd, so none ends where it began


def test_quadrants_hold_256_skills_and_point_where_they_say() -> None:
    universe = skill_universe()
    assert np.bincount(universe.class_labels).tolist() == [256] * 4
    # y grows downwards: the release's figures swap two of these glyphs.
    for corner, name in [
        ((2, 1), "south-east"),
        ((-2, 1), "south-west"),
        ((-2, -1), "north-west"),
        ((2, -1), "north-east"),
    ]:
        skills = np.flatnonzero((net_displacement() == corner).all(axis=1))
        assert len(skills) > 0
        assert {universe.class_names[label] for label in universe.class_labels[skills]} == {name}
    axes = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    assert [QUADRANT_NAMES[label] for label in quadrant_of(axes)] == list(QUADRANT_NAMES)


def test_universe() -> None:
    universe = skill_universe()
    assert (universe.name, universe.num_actions) == ("GridWorld-v0", 1024)
    assert (universe.content.shape, universe.content.dtype) == ((1024, 5), np.uint8)
    assert len(set(universe.action_hashes)) == 1024
    assert len(set(universe.action_names)) == 1024
    angle = universe.primary_parameter
    assert (angle.min() >= 0, angle.max() < 360, angle.dtype) == (True, True, np.float64)
    # East, south, west, north as seen on the screen.
    names = ("RRRRR", "DDDDD", "LLLLL", "UUUUU")
    assert [angle[universe.action_names.index(name)] for name in names] == [0, 90, 180, 270]
    assert (angle // 90 == universe.class_labels).all()


def test_skill_name_refuses_other_ids() -> None:
    for bad in (-1, 1024):
        with pytest.raises(ValueError, match=r"ids are 0\.\.1023"):
            skill_name(bad)


@pytest.mark.oracle
def test_skills_of_a_users_own_are_played_and_recorded_letter_by_letter(tmp_path: Path) -> None:
    (tmp_path / "skills.txt").write_text("R.D..\n.RR.D\n")
    extra = load_skills(tmp_path / "skills.txt")
    assert extra == ("R.D..", ".RR.D")
    steps = {"R": (1, 0), "D": (0, 1), ".": (0, 0)}
    ways = np.cumsum([[steps[letter] for letter in name] for name in extra], axis=1)
    env = GridWorld(extra=extra, fixed_layout=encode_layout(True, 5, 7))
    _, start = env.reset_env(jax.random.key(0), env.default_params)
    for row, way in enumerate(ways):
        action = Action.of(NUM_SKILLS + row)
        _, state, *_, info = env.step_env(jax.random.key(1), start, action, env.default_params)
        assert state.agent_xy.tolist() == (way[-1] + 1).tolist()
        assert (int(state.num_moves), bool(info["invalid_action"])) == (5, False)
    beyond = Action.of(NUM_SKILLS + 2)
    _, state, *_, info = env.step_env(jax.random.key(1), start, beyond, env.default_params)
    assert bool(info["invalid_action"])
    assert state.agent_xy.tolist() == [1, 1]
    ids = np.array([NUM_SKILLS, NUM_SKILLS + 1])
    seen = np.asarray(play.record(jax.random.key(2), ids, 3, False, extra)).astype(int)
    np.testing.assert_array_equal(seen[:, :, 1:] - seen[:, :, :1], np.repeat(ways[:, None], 3, 1))
