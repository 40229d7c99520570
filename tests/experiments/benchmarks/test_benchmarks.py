"""Benchmarks: that they run, and what they say."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.benchmarks import _measure as m
from experiments.benchmarks import create, environment, pool, run, sweep, training
from jaxnew.ppo import Learner
from jaxnew.sampling import Actions
from tests.experiments.benchmarks.quick import read, report_to, run_quick, timing


@pytest.mark.unit
def test_compilation_is_added_to_every_round() -> None:
    timing = m.Timing((m.Cost(1.0, 3.0), m.Cost(2.0, 4.0)), m.Cost(wall_s=10.0, cpu_s=20.0))
    added = sweep.scaled(timing, compilations=8)
    assert added.costs == (m.Cost(81.0, 163.0), m.Cost(82.0, 164.0))
    assert sweep.scaled(timing, 4.0).costs == (m.Cost(4.0, 12.0), m.Cost(8.0, 16.0))


@pytest.mark.unit
def test_overheads_of_made_up_timings(tmp_path: Path) -> None:
    output = tmp_path / "results.jsonl"
    # Ten decisions in 1, 10, 3 and 2 ms: 100 us for the loop's; beyond it 900, 200 and 100 us.
    wall_s = {"plain loop": 1e-3, "pool, 1 worker": 3e-3, "pool, 2 workers": 2e-3, pool.PEER: 1e-2}
    cpu_us = {"plain loop": 1.0, "pool, 1 worker": 3.0, "pool, 2 workers": 5.0, pool.PEER: 21.0}
    timings = {case: timing((x, x, 9.0), (0.0, 0.0, 0.0)) for case, x in wall_s.items()}
    report = report_to(output)
    pool.report_overheads(report, timings, cpu_us, num_envs=4, num_decisions=10)
    lines = read(output)
    values = {line["case"]: line["values"] for line in lines}
    peer = values[f"empty, overhead of {pool.PEER}"]
    assert peer == {"wall_us": pytest.approx(900.0), "cpu_us": pytest.approx(20.0)}
    ratios = {n: values[f"empty, overhead of {pool.PEER} / {pool.pool_name(n)}"] for n in (1, 2)}
    assert ratios[1] == {"wall": pytest.approx(4.5), "cpu": pytest.approx(10.0)}
    assert ratios[2] == {"wall": pytest.approx(9.0), "cpu": pytest.approx(5.0)}
    assert len(lines) == 5


@pytest.mark.unit
@pytest.mark.parametrize(
    ("replaced", "parent"),
    [
        (training.CountedSets, Actions),
        (training.WithoutGradient, Learner),
        (training.InOrder, Learner),
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
    for name in ("gray", "none"):
        rates = lines[f"Push, observation {name}"]["rates"]
        assert rates["substeps"]["median"] == pytest.approx(40 * rates["decisions"]["median"])
        assert ("rendering" in lines[f"Push, observation {name}"]["includes"]) == (name != "none")
    assert 0.0 < lines["Push, share of the physics"]["values"]["cpu"] < 1.0
    for tools in (0, 10):
        assert lines[f"one gray frame, Push with {tools} tools"]["rates"]["frames"]["median"] > 0


@pytest.mark.unit
def test_the_clock_of_the_physics_is_taken_off_again() -> None:
    run_before = create.Stage.run
    env = create.crowded_env("Push", 3)
    assert len(env.world.tools) == 3
    assert 0.0 < create.share_of_physics(lambda: env.world.run(2000)) <= 1.0
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
    assert {"floor of an update", "single runs / 2 device(s), members in turn"} <= cases
    floor = next(line for line in lines if line["case"] == "floor of an update")
    assert floor["values"]["fraction of floor"] == pytest.approx(
        floor["values"]["max_s"] / floor["values"]["update_s"]
    )


@pytest.mark.unit
def test_counted_sets_are_sets_of_the_pool() -> None:
    drawn = Actions.of(jnp.zeros((9, 1)), np.array([1, 3, 5, 7]), 3)
    found = training.CountedSets(**vars(drawn)).draw(jax.random.split(jax.random.key(0), 3))
    np.testing.assert_array_equal(found.ids, [[1, 3, 5], [3, 5, 7], [5, 7, 1]])
    assert found.mask.all()


@pytest.mark.unit
def test_benchmarks_have_flags_of_their_own() -> None:
    environment.ARGUMENTS.parse(["--games=navix", "--quick"])
    create.ARGUMENTS.parse([])
    assert (environment.ARGUMENTS.games, environment.ARGUMENTS.quick) == (["navix"], True)
    assert (create.ARGUMENTS.levels, create.ARGUMENTS.quick) == (["Push", "Obstacle"], False)
