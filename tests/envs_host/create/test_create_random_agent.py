"""A random agent fares as the release's did."""

from __future__ import annotations

import numpy as np
import pytest

from envs_host.create import random_agent
from envs_host.create.levels import TASK_NAMES
from envs_host.create.random_agent import MEASURES, RELEASE, compare, main, random_episodes

# 125 comparisons, many of them of the same episodes: 4.5 standard errors by chance are 1 in 1000.
LARGEST_Z = 4.5


@pytest.mark.slow
@pytest.mark.parametrize("name", TASK_NAMES)
def test_a_random_agent_fares_as_on_the_release(name: str) -> None:
    rows = compare(name, random_episodes(name, 600, seed=1))
    assert {
        row.measure: row.z for row in rows if row.z is not None and abs(row.z) > LARGEST_Z
    } == {}


@pytest.mark.unit
def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--episodes", "3", "--levels", "Push,Seesaw"])
    printed = capsys.readouterr().out
    assert "Push: 3 episodes" in printed
    assert "Seesaw: 3 episodes" in printed
    assert "9.860" in printed
    assert "21 comparisons" in printed


@pytest.mark.unit
def test_seeds_make_the_episodes() -> None:
    np.testing.assert_array_equal(random_episodes("Push", 3, 1), random_episodes("Push", 3, 1))
    assert (random_episodes("Push", 3, 1) != random_episodes("Push", 3, 2)).any()


@pytest.mark.unit
def test_distances_are_in_standard_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    row = [None] * len(MEASURES)
    row[0], row[1] = 10.0, 0.25
    monkeypatch.setitem(random_agent.RELEASE, "Push", tuple(row))
    episodes = np.zeros((600, len(MEASURES)))
    episodes[:, 0] = np.tile([9.0, 12.0], 300)  # Mean 10.5, deviation 1.5.
    episodes[:150, 1] = 1.0  # A rate of 0.25.
    length, goal, hit = compare("Push", episodes)[:3]
    assert length.z == pytest.approx(0.5 / (1.5 * np.sqrt(2.0 / 600.0)))
    assert goal.z == pytest.approx(0.0)
    assert hit.z is None


@pytest.mark.unit
def test_ends_of_the_table_are_shares() -> None:
    assert set(RELEASE) == set(TASK_NAMES)
    for row in RELEASE.values():
        assert sum(row[-4:]) == pytest.approx(1.0, abs=0.002)
