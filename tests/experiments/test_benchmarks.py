"""Benchmarks: what they compute from timings and shapes, what they write, and that they run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver

from experiments.benchmarks import _floor, create, environment, pool, run, sweep, training
from experiments.benchmarks import _measure as m
from jaxnew.ppo import Learner
from jaxnew.rollout.device import DeviceRollout

ROOT = Path(__file__).resolve().parents[2]

# Grid World at the paper's shapes: 81 numbers observed, d = 16, 1024 skills, sets of 50, 32 x 512
# steps, 4 epochs of 4 gradient steps.
PAPER = _floor.Shapes(
    obs_size=81,
    representation_size=16,
    num_actions=1024,
    set_size=50,
    steps=16_384,
    epochs=4,
    gradient_steps=16,
)


@pytest.mark.unit
def test_operations_of_one_transition_by_hand() -> None:
    # An encoder: 81 * 64 + 64 * 64 = 9280 multiply-adds forward; backward the weight gradients of
    # both layers and the input gradient of the second: 5184 + 4096 + 4096 = 13376.
    assert _floor.encoder_madds(PAPER) == (9280, 13_376)
    # Forward: two encoders (18560), the value (64), the state's half (4096), the scores
    # (50 * 64 = 3200): 25920. Backward: 2 * 13376 and twice the other three: 26752 + 14720.
    assert _floor.transition_madds(PAPER) == (25_920, 41_472)


@pytest.mark.unit
def test_operations_of_one_update_by_hand() -> None:
    # Projection of 1024 rows: 16 * 64 + 64 * 64 = 5120 each; backward 1024 + 2 * 4096 = 9216.
    assert _floor.projection_madds(PAPER) == (5_242_880, 9_437_184)
    # Rollout: 16384 * 25920 + 5242880 = 429,916,160. Learning: 4 * 16384 * 67392 = 4,416,602,112
    # and 16 * 14,680,064 = 234,881,024. Two operations for each multiply-add.
    assert _floor.update_operations(PAPER) == 2 * (429_916_160 + 4_416_602_112 + 234_881_024)


@pytest.mark.oracle
def test_operations_agree_with_what_xla_counts() -> None:
    """For the matrix products of one transition, forward; XLA counts two per multiply-add."""
    from jaxnew.policy import UtilityMethod

    method = UtilityMethod()
    params = method.init(jax.random.key(0), jnp.zeros(81), 16)

    def forward(obs: jax.Array, projected: jax.Array) -> tuple[jax.Array, jax.Array]:
        distribution = method.distribution(params, obs, projected, jnp.ones(50, bool))
        return distribution.logits, method.value(params, obs)

    program = jax.jit(forward).lower(jnp.zeros(81), jnp.zeros((50, 64))).compile()
    counted = program.cost_analysis()["flops"]
    needed = 2 * _floor.transition_madds(PAPER)[0]
    # XLA also counts biases, additions and ReLUs: 2 * 50 * 64 for the latter two, some 400 biases.
    assert needed < counted < 1.25 * needed


@pytest.mark.unit
def test_bytes_of_one_update_by_hand() -> None:
    cached, memory = _floor.update_bytes(PAPER)
    # 50 rows of 64 floats are 12800 bytes; read in the rollout, and four times per epoch.
    assert cached == 16_384 * 12_800 * (1 + 4 * 4)
    # 81 floats, 50 ids and mask bytes, five numbers: 324 + 250 + 20 = 594 bytes; written in the
    # rollout, and moved three times per epoch.
    assert memory == 16_384 * 594 * (1 + 4 * 3)


@pytest.mark.unit
def test_floor_is_the_larger_of_operations_and_bytes() -> None:
    rates = _floor.Rates(operations=1e11, cached_bytes=1e11, memory_bytes=1e10)
    floor = _floor.floor_seconds(PAPER, rates)
    # 10,162,798,592 operations at 1e11; 3,565,158,400 bytes at 1e11 and 126,517,248 at 1e10.
    assert floor["operations_s"] == pytest.approx(0.10162798592)
    assert floor["bytes_s"] == pytest.approx(0.035651584 + 0.0126517248)
    assert floor["max_s"] == floor["operations_s"]
    assert floor["sum_s"] == pytest.approx(0.10162798592 + 0.0483033088)


@pytest.mark.unit
def test_ratio_of_made_up_timings() -> None:
    slow = m.Timing(wall_s=(2.0, 4.0, 9.0), cpu_s=(1.0, 2.0, 3.0))
    fast = m.Timing(wall_s=(1.0, 4.0, 3.0), cpu_s=(4.0, 4.0, 4.0))
    # Medians 4 / 3 and 2 / 4; wall ratios of the rounds 2, 1, 3.
    assert m.ratio(slow, fast) == {"wall": 4 / 3, "cpu": 0.5, "wall_min": 1.0, "wall_max": 3.0}


@pytest.mark.unit
def test_share_saved_of_made_up_timings() -> None:
    whole = m.Timing(wall_s=(10.0, 8.0, 9.0), cpu_s=(4.0, 4.0, 4.0))
    without = m.Timing(wall_s=(6.0, 7.0, 5.0), cpu_s=(5.0, 5.0, 5.0))
    # Medians 9 and 6; 4 and 5: a stand-in may cost more than the part.
    assert m.share_saved(whole, without) == {"wall": pytest.approx(1 / 3), "cpu": -0.25}


@pytest.mark.unit
def test_compilation_is_added_to_every_round() -> None:
    timing = m.Timing((1.0, 2.0), (3.0, 4.0), m.Cost(wall_s=10.0, cpu_s=20.0))
    added = sweep.with_compilation(timing, times=8)
    assert (added.wall_s, added.cpu_s) == ((81.0, 82.0), (163.0, 164.0))


@pytest.mark.unit
def test_overheads_of_made_up_timings(tmp_path: Path) -> None:
    output = tmp_path / "results.jsonl"
    # Ten decisions in 1, 10, 3 and 2 ms: 100 us for the loop's; beyond it 900, 200 and 100 us.
    wall_s = {"plain loop": 1e-3, "pool, 1 worker": 3e-3, "pool, 2 workers": 2e-3, pool.PEER: 1e-2}
    cpu_us = {"plain loop": 1.0, "pool, 1 worker": 3.0, "pool, 2 workers": 5.0, pool.PEER: 21.0}
    timings = {case: m.Timing((x, x, 9.0), (0.0, 0.0, 0.0)) for case, x in wall_s.items()}
    flags.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(output=str(output)):
        report = m.Report("pool")
        pool.report_overheads(report, pool.EMPTY, timings, cpu_us, num_envs=4, num_decisions=10)
        pool.report_overheads(report, pool.WORKING, timings, cpu_us, num_envs=4, num_decisions=10)
    lines = read(output)
    values = {line["case"]: line["values"] for line in lines}
    peer = values[f"empty, overhead of {pool.PEER}"]
    assert peer == {"wall_us": pytest.approx(900.0), "cpu_us": pytest.approx(20.0)}
    ratios = {n: values[f"empty, overhead of {pool.PEER} / {pool.pool_name(n)}"] for n in (1, 2)}
    assert ratios[1] == {"wall": pytest.approx(4.5), "cpu": pytest.approx(10.0)}
    assert ratios[2] == {"wall": pytest.approx(9.0), "cpu": pytest.approx(5.0)}
    assert len(lines) == 5 + 3  # Ratios only where there is no work.


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
    assert {len(t.wall_s) for t in timings.values()} == {len(timings["a"].cpu_s)} == {5}


@pytest.mark.unit
def test_lines_have_every_field(tmp_path: Path) -> None:
    output = tmp_path / "deeper" / "results.jsonl"
    flags.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(output=str(output)):
        report = m.Report("subject")
        timings = m.measure({"sum": m.compiled(jnp.sum, lambda key: (jnp.ones(3),))}, repeats=5)
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
@pytest.mark.parametrize(
    ("replaced", "parent"),
    [
        (training.CountedSets, DeviceRollout),
        (training.WithoutGradient, Learner),
        (training.InOrder, Learner),
        (training.WithoutOptimizer, Learner),
    ],
)
def test_stand_ins_replace_something_that_exists(replaced: type, parent: type) -> None:
    names = {name for name in vars(replaced) if not name.startswith("__")}
    assert names
    assert names <= set(dir(parent))


@pytest.mark.unit
def test_random_play_visits_new_observations() -> None:
    """What is timed is not optimised away: observations and rewards come out."""
    game = environment.grid_world()
    start = jax.vmap(game.reset)(jax.random.split(jax.random.key(0), 16))
    (obs, state), total = jax.jit(environment.random_play(game, 20))(jax.random.key(1), start)
    assert obs.shape == (16, 81)
    assert not np.array_equal(obs, start[0])
    assert len(np.unique(state.layout)) > 1
    assert float(total.sum()) > 0.0


@pytest.mark.integration
def test_environment_runs_without_peers(tmp_path: Path) -> None:
    lines = run_quick("environment", tmp_path)
    cases = [line["case"] for line in lines]
    assert "grid_world, auto-reset" in cases
    assert "auto-reset / raw, 4 envs" in cases
    for line in lines:
        if line["rates"]:
            decisions, moves = (line["rates"][unit]["median"] for unit in ("decisions", "moves"))
            assert line["num_envs"] == 4
            assert moves == pytest.approx(5 * decisions)


@pytest.mark.integration
def test_create_tells_what_drawing_and_physics_take(tmp_path: Path) -> None:
    lines = {line["case"]: line for line in run_quick("create", tmp_path)}
    for name in ("gray", "rgb", "none"):
        rates = lines[f"Push, observation {name}"]["rates"]
        assert rates["substeps"]["median"] == pytest.approx(40 * rates["decisions"]["median"])
        assert ("rendering" in lines[f"Push, observation {name}"]["includes"]) == (name != "none")
    assert 0.0 < lines["Push, share of the physics"]["values"]["cpu"] < 1.0
    for tools in (0, 10):
        assert lines[f"one gray frame, Push with {tools} tools"]["rates"]["frames"]["median"] > 0


@pytest.mark.unit
def test_the_clock_of_the_physics_is_taken_off_again() -> None:
    run_before, clock = create.Stage.run, create.Clock()
    env = create.crowded_env("Push", 3)
    assert len(env.world.tools) == 3
    with create.timed_physics(clock):
        env.world.run(2000)
    assert 0.0 < clock.physics <= clock.whole
    assert create.Stage.run is run_before


@pytest.mark.slow
@pytest.mark.integration
def test_shares_of_training_on_the_host_are_of_one_update(tmp_path: Path) -> None:
    lines = {line["case"]: line["values"] for line in run_quick("host_training", tmp_path)}
    training = lines["training"]
    assert training["steps_per_s"] == pytest.approx(4 * 16 / training["update_s"])
    shares = lines["shares of the wall clock"]
    assert sum(shares.values()) == pytest.approx(1.0)
    assert all(0.0 < share < 1.0 for share in shares.values())
    assert min(lines["processor time, us per step"].values()) > 0.0


@pytest.mark.slow
@pytest.mark.integration
def test_all_benchmarks_run(tmp_path: Path) -> None:
    lines = run_quick("run", tmp_path)
    assert {line["benchmark"] for line in lines} == set(run.SUBJECTS)
    for line in lines:
        assert tuple(line) == m.FIELDS
        assert line["quick"]
        assert (line["wall_s"] is None) == bool(line["values"])
        for value in line["values"].values():
            assert np.isfinite(value)
    cases = {line["case"] for line in lines}
    assert {"floor of an update (wall clock)", "one device / 2 devices"} <= cases
    floor = next(line for line in lines if line["case"] == "floor of an update (wall clock)")
    assert floor["values"]["fraction of floor"] == pytest.approx(
        floor["values"]["max_s"] / floor["values"]["update_s"]
    )


def run_quick(name: str, folder: Path) -> list[dict]:
    """The lines that a benchmark writes with `--quick`."""
    output = folder / "results.jsonl"
    command = [sys.executable, "-m", f"experiments.benchmarks.{name}", "--quick"]
    done = subprocess.run(
        [*command, f"--output={output}"],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=1500,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return read(output)


def read(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]
