"""Sweeps from a script: their members are the runs that they stand for."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from experiments.reports.runs import read_runs
from experiments.reports.sweeps import as_markdown
from jaxnew import loop
from jaxnew.ppo import Hyperparameters, Learner
from jaxnew.representation.table import engineered_table
from jaxnew.run import Run
from jaxnew.runs import Runs
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.config import ConfigError
from jaxnew.storage.metrics import read
from jaxnew.storage.run_directory import ConfigMismatch
from jaxnew.sweeping import SweepProgram, checked_seeds, member_configs, sweep
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.task.settings import TrainConfig
from jaxnew.trainer import Trainer
from jaxnew.training import train, train_config
from tests import toy_device, toy_task

LADDER = toy_device.TASK
DOMAIN = Domain.of(LADDER)
TABLE = engineered_table(DOMAIN.universe, "gt3")
VARY = {"entropy_coefficient": [0.01, 0.5]}
# One update: rounding may later turn a choice.
ONE_UPDATE = {"num_updates": 1}


@pytest.fixture(scope="module")
def base() -> TrainConfig:
    return train_config(DOMAIN, "ours", "gt3", TABLE, LADDER.budget("smoke"), 31)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """Two seeds with two values each."""
    runs = tmp_path_factory.mktemp("runs")
    return sweep(LADDER, TABLE, seeds=[3, 4], vary=VARY, budget="smoke", runs=runs, set=ONE_UPDATE)


@pytest.mark.unit
def test_one_member_per_seed_and_combination(base: TrainConfig) -> None:
    vary: Any = {"entropy_coefficient": (0.0, 0.1), "clip": np.array([0.1, 0.2, 0.3])}
    members = member_configs(base, [1, 2], vary)
    found = {
        (m.seed, m.hyperparameters.entropy_coefficient, m.hyperparameters.clip) for m in members
    }
    assert len(members) == len(found) == 2 * 2 * 3
    assert (2, 0.1, 0.3) in found
    assert all(m.hyperparameters.discount == base.hyperparameters.discount for m in members)
    assert member_configs(base, [1], {}) == [member_configs(base, [1, 2], {})[0]]


@pytest.mark.unit
@pytest.mark.parametrize(
    ("vary", "says"),
    [
        ({"entropy": [0.1]}, "Cannot vary entropy .* entropy_coefficient"),
        ({"clip": []}, r"Cannot vary clip over \[\]: give at least one value"),
        ({"clip": [0.1, 0.1]}, r"Cannot vary clip over \[0.1, 0.1\]: .* each once"),
        ({"discount": [2.0]}, "discount=2.0 must be in"),
        ({"learning_rate": [-1.0]}, "learning_rate=-1.0 must be in"),
    ],
)
def test_axes_that_cannot_be_varied(base: TrainConfig, vary: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        member_configs(base, [1], vary)


@pytest.mark.unit
def test_seeds_are_distinct_and_whole(base: TrainConfig) -> None:
    assert checked_seeds(range(3)) == [0, 1, 2]
    for seeds in ([1, 1], []):
        with pytest.raises(UsageError, match="distinct seeds and at least one"):
            checked_seeds(seeds)
    for seed in (-1, 2**32, True):
        with pytest.raises(ConfigError, match="must be an integer in"):
            member_configs(base, [seed], {})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("members", "devices", "at_once", "expected"),
    [(8, 1, 0, (1, 1)), (8, 4, 0, (4, 1)), (7, 6, 0, (1, 1)), (8, 3, 8, (2, 4)), (6, 4, 1, (3, 1))],
)
def test_devices_divide_the_members(
    base: TrainConfig, members: int, devices: int, at_once: int, expected: tuple[int, int]
) -> None:
    trainer: Any = None
    program = SweepProgram.of(trainer, [base] * members, jax.devices() * devices, at_once)
    assert (len(program.devices), program.members_at_once) == expected


@pytest.mark.integration
def test_members_are_the_runs_that_they_stand_for(swept: Runs, tmp_path: Path) -> None:
    """Reloaded, with the metrics of `train` under the same names."""
    assert swept.path.name.startswith("sweep-ours-gt3-smoke-entropy_coefficient-")
    assert swept.selection_metric == "validation/is_success"
    assert len(swept) == 4
    for run, row in zip(swept, swept.table(), strict=True):
        assert str(run.path) == row["path"]
        seed, entropy = row["seed"], row["entropy_coefficient"]
        assert run.path.name == f"entropy_coefficient={entropy}-seed={seed}"
        assert run.config.seed == seed
        assert run.config.hyperparameters.entropy_coefficient == entropy
    found = [(row["entropy_coefficient"], row["seed"]) for row in swept.rows]
    assert found == [(0.01, 3), (0.01, 4), (0.5, 3), (0.5, 4)]
    single = train(
        LADDER,
        TABLE,
        budget="smoke",
        seed=4,
        workdir=tmp_path / "single",
        set={**ONE_UPDATE, "hyperparameters.entropy_coefficient": 0.5},
    )
    member = Run.load(swept.rows[3]["path"])
    assert member.config == single.config
    for one, other in zip(*map(jax.tree.leaves, (member.policy, single.policy)), strict=True):
        # Roundings of the gradient, which Adam's eps dampens to a hundredth of its step.
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    reports = [
        {name for report in read(path) for name in report if not name.startswith("time/")}
        for path in (member.path, single.path)
    ]
    assert reports[0] == reports[1]
    evaluated = [
        next(r for r in read(path) if "validation/is_success" in r)
        for path in (member.path, single.path)
    ]
    for name in ("train/num_steps", "validation/is_success"):
        assert evaluated[0][name] == pytest.approx(evaluated[1][name], abs=1e-6)


@pytest.mark.integration
def test_rows_are_those_of_the_runs(swept: Runs) -> None:
    for row in swept.table():
        assert set(row) == {
            *("path", "seed", "best_metric", "best_step", "elapsed_s"),
            *("diverged_at", "diverged_by"),
            *(field.name for field in fields(Hyperparameters)),
        }
        metadata = Checkpointer(Path(row["path"]) / "checkpoints").metadata("best")
        assert metadata["best_metric"] == row["best_metric"]
        assert row["best_step"] == 1
    kept = json.loads((swept.path / "evaluation" / "members.json").read_text())
    assert kept["members"] == swept.table()
    best = swept.best()
    assert best.path == Path(max(swept.rows, key=lambda row: row["best_metric"])["path"])
    found = best.evaluate(episodes=4, record=False)
    assert list(found.rows) == ["test"]
    with pytest.raises(UsageError, match="has no evaluated runs; sweep again to go on"):
        Runs(swept.path, (), swept.task).best()


@pytest.mark.integration
def test_a_finished_sweep_is_left_alone(swept: Runs, capsys: pytest.CaptureFixture[str]) -> None:
    before = {p: p.stat().st_mtime_ns for p in (swept.path / "members").rglob("*")}
    arguments: dict[str, Any] = {"budget": "smoke", "workdir": swept.path, "set": ONE_UPDATE}
    again = sweep(LADDER, TABLE, seeds=[3, 4], vary=VARY, **arguments)
    assert "already complete" in capsys.readouterr().out
    assert again.table() == swept.table()
    assert {p: p.stat().st_mtime_ns for p in (swept.path / "members").rglob("*")} == before
    with pytest.raises(ConfigMismatch) as caught:
        sweep(LADDER, TABLE, seeds=[3, 5, 6], vary=VARY, **arguments)
    (what,) = caught.value.differences
    assert what == ("members.seed", [3, 4], [3, 5, 6])
    assert len(str(caught.value)) < 500
    with pytest.raises(ConfigMismatch, match=r"num_updates: 1 recorded, 2 asked for\n"):
        sweep(LADDER, TABLE, seeds=[3, 4], vary=VARY, **{**arguments, "set": {"num_updates": 2}})


@pytest.mark.integration
def test_it_is_read_back_as_one_table(swept: Runs, tmp_path: Path) -> None:
    """What was varied, over seeds, with the evaluations on record; wherever it was moved to."""
    path = tmp_path / "moved"
    shutil.copytree(swept.path, path)
    values = iter([0.1, 0.3, 0.5, 0.6])
    rows = [{**row, "best_metric": next(values)} for row in swept.rows]
    write_rows(path, rows)
    runs = Runs.load(path, LADDER)
    assert runs.varied == ["entropy_coefficient"]
    for run in runs.load_each("latest"):
        run.evaluate(["test"], episodes=8)
    low, high = runs.summary()
    assert [low["is_best"], high["is_best"]] == [False, True]
    assert (low["entropy_coefficient"], high["entropy_coefficient"]) == (0.01, 0.5)
    found = [low[f"best_metric{end}"] for end in ("", "_std", "_seeds")]
    assert found == pytest.approx([0.2, 0.1, 2])
    name = "test-latest-sampled-m4"
    tested = [row[name] for row in runs.table()]
    assert high[name] == pytest.approx(np.mean(tested[2:]))
    assert high[f"{name}_std"] == pytest.approx(np.std(tested[2:]))
    # A run that diverged counts nowhere.
    write_rows(path, [{**rows[0], "diverged_at": 2, "diverged_by": "loss"}, *rows[1:]])
    runs = Runs.load(path, LADDER)
    low = runs.summary()[0]
    assert [row["diverged"] for row in runs.summary()] == [1, 0]
    assert (low["best_metric"], low["best_metric_seeds"]) == (0.3, 1)
    assert [run.path.name for run in runs] == [Path(row["path"]).name for row in rows[1:]]
    shared = [run.trainer.learner for run in runs]
    assert shared[0] is shared[-1]


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    (path / "evaluation" / "members.json").write_text(json.dumps({"members": rows}))


@pytest.mark.integration
def test_a_member_that_diverges_is_named_and_stopped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It stays what it was before the chunk, while the other goes on; nothing is played with it."""
    real = Learner.update

    def spoiled(self: Learner, state: Any, numbers: Any, actions: Any) -> Any:
        state, metrics = real(self, state, numbers, actions)
        is_bad = (numbers.clip > 0.4) & (state.step == 4)
        params = jax.tree.map(lambda x: jax.numpy.where(is_bad, jax.numpy.nan, x), state.params)
        metrics["nonfinite/reward"] += is_bad
        return state.replace(params=params), metrics

    monkeypatch.setattr(Learner, "update", spoiled)
    # The last chunk, of one update, would be a sound one.
    settings = {"num_updates": 5, "loop.chunk_updates": 2, "loop.evaluate_every": 4}
    arguments: dict[str, Any] = {"budget": "smoke", "runs": tmp_path, "set": settings}
    both = sweep(LADDER, TABLE, seeds=[3], vary={"clip": [0.1, 0.5]}, **arguments)
    output = capsys.readouterr().out
    assert output.count("clip=0.5-seed=3 diverged by update 4: A reward was NaN") == 1
    sound, diverged = both.rows
    assert (diverged["diverged_at"], diverged["diverged_by"]) == (4, "reward")
    assert sound["diverged_at"] is None
    assert sound["best_step"] in (4, 5)
    assert diverged["best_step"] is None  # What it stayed was never evaluated.
    found = Run.load(diverged["path"], "latest")
    assert found.step == 2
    assert Checkpointer(found.path / "checkpoints").steps("latest") == [2]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found.policy))
    with pytest.raises(loop.NonFiniteError, match="diverged by update 4, so that nothing"):
        found.evaluate(episodes=4)
    with pytest.raises(loop.NonFiniteError, match="by update 4, before its first evaluation"):
        Run.load(diverged["path"])
    best = both.best()
    assert best.path == Path(sound["path"])
    nan = best.acting_as(jax.tree.map(lambda x: x * np.nan, best.policy), "nan")
    with pytest.raises(loop.NonFiniteError, match=r"Parameters of .*, nan, are not finite"):
        nan.play()
    assert [run.path for run in both.load_each("latest")] == [Path(sound["path"])]
    assert max(line["step"] for line in read(diverged["path"])) == 4
    assert "clip=0.5-seed=3, by update 4. A reward was NaN" in as_markdown(both)
    assert [record.path.name for record in read_runs([both.path])] == ["clip=0.1-seed=3"]


@pytest.mark.unit
def test_a_sweep_ends_where_every_member_diverged(
    base: TrainConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer: Any = None
    program = SweepProgram.of(trainer, member_configs(base, [1, 2], {}), jax.devices()[:1])
    stopped: Any = SimpleNamespace(members=SimpleNamespace(step=np.array([2, 1])))
    counts = {"nonfinite/loss": np.array([1.0, 0.0]), "nonfinite/gradient": np.array([4.0, 0.0])}
    with pytest.raises(loop.NonFiniteError, match="All 2 members diverged, the last by update 3"):
        program._tell_diverged(stopped, np.array([True, False]), counts, 3)
    assert "seed=1 diverged by update 3: The loss was not finite first." in capsys.readouterr().out


@pytest.mark.integration
def test_older_sweeps_are_read_and_left_alone(swept: Runs, tmp_path: Path) -> None:
    """Members were numbered, and rows had them by name, with hyper-parameters as a group."""
    path = tmp_path / "old"
    shutil.copytree(swept.path, path)
    numbers = {field.name for field in fields(Hyperparameters)}
    rows = []
    for index, row in enumerate(swept.rows):
        assert row["diverged_at"] is None
        (path / "members" / Path(row["path"]).name).rename(path / "members" / f"{index:03d}")
        since = {"path", "diverged_at", "diverged_by", *numbers}
        rest = {name: row[name] for name in row if name not in since}
        own = {name: row[name] for name in numbers}
        rows.append({"member": f"{index:03d}", **rest, "hyperparameters": own})
    write_rows(path, rows)
    expected = [
        {**row, "path": str(path / "members" / f"{index:03d}")}
        for index, row in enumerate(swept.rows)
    ]
    assert Runs.load(path, LADDER).table() == expected
    arguments: dict[str, Any] = {"budget": "smoke", "workdir": path, "set": ONE_UPDATE}
    again = sweep(LADDER, TABLE, seeds=[3, 4], vary=VARY, **arguments)
    assert again.table() == expected
    assert not (path / "members.partial").exists()


@pytest.mark.integration
def test_no_sweep_meets_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever differs; and what it takes follows from the settings."""

    def stop(*given: Any, **named: Any) -> Any:
        return SimpleNamespace(was_interrupted=True, interrupted_by=15)

    monkeypatch.setattr(loop, "run", stop)
    changes: list[dict[str, Any]] = [
        {},
        {"seeds": [3, 5]},
        {"vary": {"entropy_coefficient": [0.01, 0.6]}},
        {"set": {"num_updates": 2}},
        {"split_seed": 1},
    ]
    arguments = {"seeds": [3, 4], "vary": VARY, "budget": "smoke", "runs": tmp_path}
    paths = [sweep(LADDER, "gt3", **{**arguments, **change}).path for change in changes]
    assert len(set(paths)) == len(changes)
    again = sweep(LADDER, "gt3", **arguments)
    assert (again.path, again.interrupted_by) == (paths[0], 15)
    first, *_, other, _, last = capsys.readouterr().out.splitlines()
    assert first == last
    assert "of its steps" not in first
    assert f"this has {2 / LADDER.budget('smoke').num_updates:.2g} of its steps" in other
    with pytest.raises(UsageError, match="has written no members yet; run it to its end"):
        Runs.load(paths[0], LADDER)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"task": toy_task.TASK, "table": "gt4"}, UsageError, "of toy run on the host, so its"),
        ({"method": "our"}, UsageError, "Unknown method 'our'"),
        ({"seeds": [1, 1]}, UsageError, "distinct seeds"),
        ({"vary": {"seed": [1]}}, UsageError, "Cannot vary seed"),
        ({"vary": {"clip": [-1.0]}}, ValueError, "clip=-1.0 must be at least 0"),
        ({"set": {"sets.size": 30}}, ValueError, "Sets of 30 actions"),
    ],
)
def test_what_cannot_be_swept(
    tmp_path: Path, arguments: dict[str, Any], error: type[Exception], says: str
) -> None:
    given = {"task": LADDER, "table": TABLE, "seeds": [1], "budget": "smoke", **arguments}
    with pytest.raises(error, match=says):
        sweep(runs=tmp_path, **given)
    assert not list(tmp_path.iterdir())


@pytest.mark.unit
def test_a_sweep_says_what_it_takes(base: TrainConfig) -> None:
    """Numbers of all members, one per member, whatever else they share."""
    configs = member_configs(base, [1, 2], {"clip": [0.1, 0.3]})
    trainer = Trainer.of(configs[0], LADDER, DOMAIN.split, TABLE)
    program = SweepProgram.of(trainer, configs, jax.devices()[:1])
    numbers: Any = program.hyperparameters
    assert numbers.clip.tolist() == pytest.approx([0.1, 0.1, 0.3, 0.3])
    assert numbers.discount.shape == (4,)
