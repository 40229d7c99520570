"""Comparisons of runs: which are pairs, and how sure their difference is."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import jaxnew
from jaxnew.comparison import compare, paired_interval
from jaxnew.run import Run
from jaxnew.task.places import UsageError


@pytest.mark.oracle
def test_one_pair_has_the_interval_of_its_episodes() -> None:
    """A mean of 4,000 numbers is normal; the percentiles of 2,000 draws are known to 5 %."""
    values = np.random.default_rng(1).choice([-1.0, 0.0, 1.0], 4000, p=[0.1, 0.5, 0.4])
    found = paired_interval([[values]])
    half = stats.norm.ppf(0.975) * values.std() / np.sqrt(4000)
    assert found.mean == pytest.approx(values.mean(), abs=1e-12)
    assert found.high - found.mean == pytest.approx(half, rel=0.08)
    assert found.mean - found.low == pytest.approx(half, rel=0.08)
    assert paired_interval([[values]]) == found


@pytest.mark.oracle
def test_splits_and_seeds_are_drawn_too() -> None:
    """Four splits of constants: the percentiles of all 256 means of four, which lie in wide steps;
    and two seeds of one split: a quarter of all means are the first's, a quarter the second's."""
    constants = [0.0, 0.1, 0.3, 1.0]
    found = paired_interval([[np.full(10, c)] for c in constants])
    means = sorted(np.mean(drawn) for drawn in itertools.product(constants, repeat=4))
    assert found.mean == pytest.approx(0.35)
    # The 6th to 7th of 256 from either end; two in a hundred draws lie beyond the 5th and the 8th.
    assert means[4] - 1e-9 <= found.low <= means[7] + 1e-9
    assert means[-8] - 1e-9 <= found.high <= means[-5] + 1e-9
    found = paired_interval([[np.zeros(10), np.ones(10)]])
    assert found == pytest.approx((0.5, 0.0, 1.0))
    # Splits count alike, whatever the number of their seeds.
    assert paired_interval([[np.zeros(4)] * 3, [np.ones(4)]]).mean == pytest.approx(0.5)


@dataclass
class Recorded:
    """What a comparison asks of a run."""

    config: Any
    path: Path = Path("run")


def recorded(
    split_seed: int, seed: int, task: str = "grid_world", environment: str = "usual"
) -> Any:
    fields = {"task": task, "split": "default", "split_seed": split_seed, "seed": seed}
    return Recorded(type("Config", (), {**fields, "environment": environment}))


@pytest.mark.unit
def test_runs_without_a_partner_are_refused() -> None:
    with pytest.raises(UsageError, match=r"seed 1; .* seed 2 against grid_world, default split 0"):
        compare([recorded(0, 1), recorded(0, 2)], [recorded(0, 1)])
    with pytest.raises(UsageError, match="got no run against no run"):
        compare([], [])
    with pytest.raises(UsageError, match="are of one split and seed"):
        compare([recorded(0, 1), recorded(0, 1)], [recorded(0, 1)])
    with pytest.raises(UsageError, match="have other environments: usual and slippery"):
        compare([recorded(0, 1)], [recorded(0, 1, environment="slippery")])
    two = [recorded(0, 1), recorded(0, 1, task="recommender")]
    with pytest.raises(
        UsageError, match=r"one task and one kind of split; got grid_world, .*; rec"
    ):
        compare(two, two)


@pytest.mark.integration
def test_runs_play_the_same_episodes(tmp_path: Path) -> None:
    made = {
        (name, seed): jaxnew.train(
            "grid_world",
            "gt12",
            method=name,
            budget="smoke",
            seed=seed,
            set={"num_updates": 1},
            runs=tmp_path,
        ).path
        for name in ("ours", "random")
        for seed in (1, 2)
    }
    ours, others = ([Run.load(made[name, s]) for s in (1, 2)] for name in ("ours", "random"))
    found: jaxnew.Comparison = jaxnew.compare(ours, others, "validation", episodes=40)
    expected = [
        [run.evaluate("validation", episodes=40).to_dict()["validation"]["metrics"] for run in runs]
        for runs in (ours, others)
    ]
    means = [[row["is_success"]["mean"] for row in rows] for rows in expected]
    assert list(found.pairs) == [(0, 1), (0, 2)]
    assert [*found.pairs.values()] == [*zip(*means, strict=True)]
    assert found.difference.mean == pytest.approx(np.subtract(*np.mean(means, axis=1)))
    assert "is_success, validation actions, 40 episodes" in str(found)
    assert found.means == pytest.approx(np.mean(means, axis=1))
    # All train actions at once are other episodes than sets of them.
    fixed = jaxnew.train(
        "grid_world",
        "gt12",
        method="no-subsampling",
        budget="smoke",
        seed=1,
        set={"num_updates": 1},
        runs=tmp_path,
    )
    with pytest.raises(UsageError, match=r"With train actions these runs play sets of .*one size"):
        jaxnew.compare(ours[:1], [fixed], "train", episodes=4)
    same = jaxnew.compare(ours, [Run.load(made["ours", s]) for s in (1, 2)], episodes=40)
    assert same.difference == (0.0, 0.0, 0.0)
