"""What is computed from timings, and what is written of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from experiments.benchmarks import _measure as m
from tests.experiments.benchmarks.quick import read, report_to, timing


@pytest.mark.unit
def test_ratio_of_made_up_timings() -> None:
    slow = timing((2.0, 4.0, 9.0), (1.0, 2.0, 3.0))
    fast = timing((1.0, 4.0, 3.0), (4.0, 4.0, 4.0))
    # Medians 4 / 3 and 2 / 4; wall ratios of the rounds 2, 1, 3.
    assert m.ratio(slow, fast) == {"wall": 4 / 3, "cpu": 0.5, "wall_min": 1.0, "wall_max": 3.0}


@pytest.mark.unit
def test_share_saved_of_made_up_timings() -> None:
    whole = timing((10.0, 8.0, 9.0), (4.0, 4.0, 4.0))
    without = timing((6.0, 7.0, 5.0), (5.0, 5.0, 5.0))
    # Medians 9 and 6; 4 and 5: a stand-in may cost more than the part.
    assert m.share_saved(whole, without) == {"wall": pytest.approx(1 / 3), "cpu": -0.25}
    other = timing((18.0, 18.0, 18.0), (8.0, 8.0, 8.0))
    assert m.share_saved(whole, without, other) == {"wall": pytest.approx(1 / 6), "cpu": -0.125}


@pytest.mark.unit
def test_processor_time_of_other_processes() -> None:
    command = [sys.executable, "-c", "sum(range(10**7)); print(flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert 0.05 < m.cpu_s_of([process.pid]) < 30.0  # 0.2 s, start included.
        process.communicate(b"\n")
    assert m.cpu_s_of([]) == 0.0


@pytest.mark.unit
def test_subjects_alternate_and_the_first_round_is_not_counted() -> None:
    calls: list[tuple[str, float]] = []

    def subject(name: str) -> m.Subject:
        return m.Subject(
            lambda key: calls.append((name, float(jax.random.uniform(key)))), lambda key: (key,)
        )

    timings = m.measure({"a": subject("a"), "b": subject("b")}, repeats=5)
    assert [name for name, _ in calls] == ["a", "b"] * 6
    assert len({number for _, number in calls}) == 6  # A key of its own in every round, for both.
    assert {len(timing.costs) for timing in timings.values()} == {5}


@pytest.mark.unit
def test_lines_have_every_field(tmp_path: Path) -> None:
    output = tmp_path / "deeper" / "results.jsonl"
    report = report_to(output)
    timings = report.measure({"sum": m.compiled(jnp.sum, lambda key: (jnp.ones(3),))})
    report.timing("sum", timings["sum"], work={"numbers": 3.0}, num_envs=2, includes=["x"])
    report.values("ratio", {"wall": 2.0}, how="made up")
    timing, values = read(output)
    assert tuple(timing) == tuple(values) == m.FIELDS
    assert timing["repeats"] == 5
    assert timing["num_envs"] == 2
    assert timing["includes"] == ["x"]
    assert timing["compile_s"]["wall"] > 0
    for clock in ("wall_s", "cpu_s"):
        assert timing[clock]["min"] <= timing[clock]["median"] <= timing[clock]["max"]
    median = timing["wall_s"]["median"]
    assert timing["rates"]["numbers"]["median"] == pytest.approx(3.0 / median)
    assert timing["versions"]["jax"] == jax.__version__
    assert values["values"] == {"wall": 2.0}
    assert values["wall_s"] is None


@pytest.mark.unit
def test_arithmetic_of_costs() -> None:
    found = m.Cost(3.0, 5.0) - m.Cost(1.0, 1.0) * 2.0 + m.Cost(0.5, 0.25)
    assert found == m.Cost(1.5, 3.25)
    costs = [m.Cost(1.0, 30.0), m.Cost(2.0, 10.0), m.Cost(9.0, 20.0)]
    assert m.Cost.median(costs) == m.Cost(2.0, 20.0)
