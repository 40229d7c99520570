"""Runs of a figure's settings are found wherever they lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from experiments.reports.production import Cell, find
from experiments.reports.runs import Group, group_runs
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage.config import ConfigError
from jaxnew.task.places import UsageError
from jaxnew.task.settings import identity
from tests.experiments.handwritten import config_of, finished, source_of, write_run

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
CONDITIONED = Cell("ours", "hvae", conditions_position=True)
FULL = Cell("ours", "hvae", split="full")
GT12 = Cell("ours", "gt12")
TASK = "shape_stacking"
HEIGHT = "final_height"


def run_config(method: str = "ours", seed: int = 1, **changes: Any) -> dict[str, Any]:
    """The config of a run of Grid World that `figures --budget=smoke` would have made."""
    return {**config_of(source_of("grid_world"), Cell(method, "gt12"), seed), **changes}


def written(path: Path, config: dict[str, Any], **options: Any) -> Path:
    """A run whose last report is that of its last update."""
    return write_run(path, config, curve=(0.1, 0.3), **options)


@pytest.mark.unit
def test_runs_of_a_cell_are_found_wherever_they_lie(tmp_path: Path) -> None:
    folder = tmp_path / "grid_world"
    one = written(folder / "deep" / "down", run_config(seed=1))
    other_microbatch = run_config(seed=2)
    other_microbatch["ppo"] = {**other_microbatch["ppo"], "microbatch_size": 32}
    two = written(folder / "two", other_microbatch)
    written(folder / "other-seed", run_config(seed=3))
    written(folder / "other-method", run_config("continuous", seed=1))
    written(folder / "longer", run_config(seed=1, num_updates=8))
    write_run(folder / "unfinished", run_config(seed=1, num_updates=4), curve=(0.1,))
    written(folder / "finetuned", run_config(seed=1, trained_on="test"))
    written(folder / "other-split", run_config(seed=1, split_hash="s"))
    entropy = run_config(seed=1)
    entropy["hyperparameters"] = {**entropy["hyperparameters"], "entropy_coefficient": 0.0}
    written(folder / "other-numbers", entropy)
    found = find(source_of("grid_world", tmp_path), GT12)
    assert {seed: run.path for seed, run in found.items()} == {1: one, 2: two}
    assert find(source_of("grid_world", tmp_path), Cell("ours", "hvae")) == {}


@pytest.mark.unit
def test_two_runs_that_fit_are_not_guessed_between(tmp_path: Path) -> None:
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    tables = [RepresentationTable(k * vectors, ids, source=f"hvae, {k}") for k in (1, 2)]
    paths = [
        written(
            tmp_path / "grid_world" / f"{k}",
            run_config(representation="hvae", table_hash=table.hash),
            table=table,
        )
        for k, table in enumerate(tables)
    ]
    with pytest.raises(UsageError, match=r"are both ours on hvae with seed 1.*--given=hvae=TABLE"):
        find(source_of("grid_world", tmp_path), Cell("ours", "hvae"))
    tables[1].save(tmp_path / "given.npz")
    source = source_of("grid_world", tmp_path, given={"hvae": tmp_path / "given.npz"})
    assert find(source, Cell("ours", "hvae"))[1].path == paths[1]


@pytest.mark.unit
def test_a_cell_has_a_task_and_a_split_of_its_own() -> None:
    tables = {"hvae": Path("a"), "hvae@full": Path("b"), "hvae@analysis": Path("c")}
    source = source_of("create-seesaw", given=tables)
    assert source.of(OURS) is source
    assert source.of(NO_SUBGOALS).domain.task.name == "create-seesaw-no-subgoals"
    assert source.of(NO_SUBGOALS).given == tables  # The same tools.
    assert source.of(FULL).domain.split_name == "full"
    assert source.of(FULL).domain.split.hash != source.domain.split.hash
    assert source.of(FULL).given == {"hvae": Path("b")}
    analysed = source.of(Cell("ours", "hvae", variant="-analysis"))
    assert analysed.domain.universe.num_actions == 10_877
    assert analysed.given == {"hvae": Path("c")}
    labels = [cell.label for cell in (OURS, NO_SUBGOALS, FULL, CONDITIONED)]
    assert labels == [
        "ours, hvae",
        "ours, hvae, no subgoals",
        "ours, hvae, split full",
        "ours, hvae, conditioned position",
    ]
    with pytest.raises(UsageError, match="Unknown task 'create-seesaw-upside-down'"):
        source.of(Cell("ours", "hvae", variant="-upside-down"))
    with pytest.raises(ValueError, match="has no split 'half'"):
        source.of(Cell("ours", "hvae", split="half"))


@pytest.mark.unit
def test_runs_are_told_apart_by_all_that_cells_differ_in(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path)
    cells = (OURS, NO_SUBGOALS, CONDITIONED, FULL)
    paths = {cell: finished(source, cell) for cell in cells}
    for cell in cells:
        assert {1: paths[cell]} == {s: r.path for s, r in find(source.of(cell), cell).items()}
    assert paths[NO_SUBGOALS].parent.name == "create-push-no-subgoals"
    assert paths[FULL].parent == paths[OURS].parent


def as_before(config: dict[str, Any], environment: list[str]) -> dict[str, Any]:
    """A config as the revision before 2026-11-29 recorded it."""
    old = {name: config[name] for name in config if name not in ("sets", "split_seed")}
    sets = config["sets"]
    sizes = {"set_size": sets["size"], "padded_set_size": sets["padded_size"]}
    rollout = {**config["ppo"]["rollout"], **sizes, "has_fixed_set": sets["is_fixed"]}
    return {**old, "ppo": {**config["ppo"], "rollout": rollout}, "environment": environment}


@pytest.mark.unit
def test_figures_find_runs_of_their_own_environment_only(tmp_path: Path) -> None:
    """A run with other settings is another setting, which the paper has no numbers of."""
    kept, curve = "environment.reward_variant=paper", {"curve": (0.1,), "metric": HEIGHT}
    plain = source_of(TASK, tmp_path)
    changed = replace(plain, assignments=(kept,))
    for name, source in (("plain", plain), ("changed", changed)):
        config, folder = config_of(source, OURS), tmp_path / TASK
        write_run(folder / name, config, **curve)
        texts = [kept] if source is changed else []
        write_run(folder / f"{name}-before", as_before({**config, "seed": 2}, texts), **curve)
    for source, name in ((plain, "plain"), (changed, "changed")):
        found = find(source, OURS)
        places = {seed: run.path.name for seed, run in found.items()}
        assert places == {1: name, 2: f"{name}-before"}
        assert len(group_runs(list(found.values()))) == 1
        for run in found.values():
            group = Group("ours", source.domain.task, (run,))
            assert group.paper_method == {"plain": "ours", "changed": None}[name]
            assert group.standard("test").set_size == 5
    source = replace(plain, assignments=(kept, "pool.max_restarts=3", "num_updates=7"))
    with pytest.raises(ConfigError, match="pool"):  # Towers are no business of worker processes.
        source.config_of(OURS)
    push = source_of("create-push", assignments=("pool.max_restarts=3", "num_updates=7"))
    assert push.config_of(OURS).num_updates == 7
    assert "pool" not in identity(push.config_of(OURS))
