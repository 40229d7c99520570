"""Shape Stacking through the commands at smoke budget: train, save, reload, evaluate.

Every method, ablation, representation, split and placement variant: `stacking_runs.RUNS` gives each
of them to a run. Most are `slow`, for their programs take long to compile and are never kept.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from envs_mjx.shape_stacking import ShapeStacking, published_split, shape_universe
from jaxnew.representation.table import RepresentationTable
from jaxnew.run import Run
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from tests.experiments import commands
from tests.experiments import stacking_runs as stacking
from tests.experiments.commands import read_json
from tests.experiments.create_runs import parameters, saved, timeless
from tests.experiments.several import finish_several, run_several, start_several
from tests.experiments.stacking_probes import EPISODES, seen
from tests.experiments.stacking_runs import (
    ALIKE,
    EMBED,
    OTHERS,
    RUNS,
    WATCHED,
    WIDTH,
    evaluation,
    logged,
    means,
)

pytestmark = pytest.mark.integration

NAMES = [*ALIKE, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
ENCODERS = ("hvae", "vae", "hvae-oracle", "vae-oracle")
FIXED_SETS = ("no-place", "no-subsampling")
# A start cylinder is 0.3 to 0.37 m high; ten of the largest shapes could be stacked up to 10 m.
HEIGHTS = (0.3, 10.0)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all runs."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def encoders(runs: Path) -> Path:
    """The same with encoders, and a table of the user's own."""
    pictures = ("--task=shape_stacking", "--recordings=1", "--frames=stored", f"--runs={runs}")
    run_several("collect", [pictures], optimized=True)  # As drawing 810 takes long otherwise.
    stacking.embed(runs, ENCODERS, "--frames=stored")
    stacking.save_own_table(runs / "mine.npz")
    return runs


@pytest.fixture(scope="module")
def trained_alike(runs: Path) -> dict[str, str]:
    return stacking.train(runs, ALIKE)


@pytest.fixture(scope="module")
def trained_others(encoders: Path) -> dict[str, str]:
    return stacking.train(encoders, OTHERS)


@pytest.fixture(scope="module")
def page(encoders: Path) -> list[list[str]]:
    """Commands of the page on new actions, with the encoder and a run of these tests."""
    paths = {
        "runs/shape_stacking/embed-hvae-default-laptop-31": encoders / EMBED.format("hvae"),
        "runs/shape_stacking/ours-hvae-default-laptop-31": encoders / "encoded",
    }
    return commands.of_new_actions("Shape Stacking", encoders, paths)


@pytest.fixture(scope="module")
def new_shapes(runs: Path, page: list[list[str]]) -> Path:
    """The table of the page's new shapes."""
    (_, _, *recording, _) = page
    for words in recording:
        output = commands.run(*words)
    assert f"40 actions, {WIDTH} numbers each" in output
    return runs / "new_shapes_table.npz"


@pytest.fixture(scope="module")
def evaluated_alike(runs: Path, trained_alike: dict[str, str]) -> dict[str, str]:
    assert trained_alike
    return stacking.evaluate(runs, ALIKE, {})


@pytest.fixture(scope="module")
def evaluated_others(
    runs: Path, trained_others: dict[str, str], page: list[list[str]], new_shapes: Path
) -> dict[str, str]:
    """Also of `encoded` with new shapes."""
    assert trained_others
    _, *with_new = page[-1]
    assert f"--table={new_shapes}" in with_new
    return stacking.evaluate(runs, OTHERS, {"new shapes": with_new})


@pytest.fixture
def trained(request: pytest.FixtureRequest, name: str) -> str:
    """What `train` printed for a run."""
    outputs = request.getfixturevalue("trained_alike" if name in ALIKE else "trained_others")
    output: str = outputs[name]
    return output


@pytest.fixture
def evaluated(request: pytest.FixtureRequest, name: str) -> str:
    """What `evaluate` printed for a run."""
    outputs = request.getfixturevalue("evaluated_alike" if name in ALIKE else "evaluated_others")
    output: str = outputs[name]
    return output


def check_heights(found: dict[str, float]) -> None:
    """Towers are no lower than a start cylinder, and none is higher than shapes can be stacked."""
    assert HEIGHTS[0] <= found["final_height"] <= found["max_height"] + 1e-6
    assert found["max_height"] <= HEIGHTS[1]


@pytest.mark.parametrize("name", NAMES)
def test_a_run_is_trained_and_saved(runs: Path, trained: str, name: str) -> None:
    run, path = RUNS[name], runs / name
    split = run.action_split
    updates = 2 if name == "line" else 1
    config = read_json(path / "config.json")
    table = RepresentationTable.load(path / "table.npz")
    assert (config["task"], config["method"], config["split"]) == (run.task, run.method, run.split)
    assert config["split_hash"] == split.hash
    assert config["table_hash"] == table.hash
    assert table.universe_hash in (shape_universe().hash, None)
    lines = metrics.read(path)
    assert [line["step"] for line in lines if "loss/total" in line] == [*range(1, updates + 1)]
    assert Checkpointer(path / "checkpoints").steps("latest")[-1] == updates
    for step in range(1, updates + 1):
        for prefix in ("episode", "train", "validation"):
            check_heights(logged(path, step, prefix))
    engine = seen(trained)
    assert engine.placed <= {*split.train.tolist(), *split.validation.tolist()}
    assert engine.placed & {*split.train.tolist()}
    assert engine.placed & {*split.validation.tolist()}
    assert engine.batches == {(2,), (EPISODES,)}, "all worlds at once"


@pytest.mark.parametrize("name", NAMES)
def test_a_run_is_loaded_and_evaluated(runs: Path, evaluated: str, name: str) -> None:
    path, split = runs / name, RUNS[name].action_split
    engine, found, mean = seen(evaluated), evaluation(path), means(path)
    assert engine.placed <= {*split.train.tolist(), *split.test.tolist()}
    assert engine.placed & {*split.test.tolist()}
    assert (found["num_episodes"], found["num_actions"]) == (EPISODES, len(split.test))
    assert found["set_size"] == 5
    assert evaluation(path, "train")["set_size"] == (len(split.train) if name in FIXED_SETS else 5)
    names = {*ShapeStacking.episode_metrics, "num_steps"}
    assert set(mean) == names
    for metric, row in found["metrics"].items():
        assert row["low"] <= row["mean"] <= row["high"], metric
    check_heights(mean)
    assert 1.0 <= mean["num_steps"] == mean["episode_length"] <= 10.0
    assert mean["has_failed"] == 0.0
    # Every action places a shape, names one that is there, or stops.
    counted = mean["num_placed"] + mean["num_repeats"] + mean["is_stopped"]
    assert counted == pytest.approx(mean["num_steps"], abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_loaded_is_what_was_saved(runs: Path, evaluated: str, name: str) -> None:
    """The same episodes as during the training, at the best checkpoint."""
    assert evaluated
    path = runs / name
    found = means(path, "train")
    before = logged(path, evaluation(path, "train")["step"], "train")
    assert set(found) == set(before)
    for metric, value in before.items():
        # Means in f32 and in f64.
        assert found[metric] == pytest.approx(value, rel=1e-6), metric


@pytest.mark.slow
def test_the_encoder_describes_every_shape(encoders: Path) -> None:
    path = encoders / EMBED.format("hvae")
    table = RepresentationTable.load(path / "table.npz")
    assert table.vectors.shape == (810, WIDTH)
    assert len(np.unique(table.vectors, axis=0)) == 810, "no two shapes look the same"
    config = read_json(path / "config.json")
    assert (config["train_on"], config["split_hash"]) == ("train", published_split().hash)
    lines = [line for line in metrics.read(path) if "loss" in line]
    assert [line["step"] for line in lines] == [1, 2]
    # Pictures start as their mean colour; from gray ones on it would be below -10,000.
    assert min(line["reconstruction"] for line in lines) > 0.0
    pictures = np.load(encoders / "shape_stacking" / "pictures-1" / "recordings.npy", mmap_mode="r")
    assert (pictures.shape, pictures.dtype) == ((810, 1, 84, 84, 3), np.uint8)


@pytest.mark.slow
def test_new_shapes_are_recorded_encoded_and_stacked(
    runs: Path, new_shapes: Path, evaluated_others: dict[str, str]
) -> None:
    """Paper algorithm 2: shapes that did not exist when encoder and policy were trained."""
    table = RepresentationTable.load(new_shapes)
    assert table.ids.tolist() == list(range(810, 850))
    assert len(np.unique(table.vectors, axis=0)) == 40
    output = evaluated_others["new shapes"]
    assert "40 actions of ShapeStacking-v0, 0 seen in training, e.g. middle_triangle" in output
    engine = seen(output)
    assert engine.placed
    assert engine.placed <= {*table.ids.tolist()}
    result = evaluation(runs / "encoded", "table-new_shapes_table-*")
    assert (result["num_actions"], result["num_episodes"]) == (40, EPISODES)
    check_heights({name: row["mean"] for name, row in result["metrics"].items()})


@pytest.mark.slow
def test_pictures_that_are_taken_again_are_encoded_as_before(
    encoders: Path, tmp_path: Path
) -> None:
    ids = np.sort(published_split().test[:8])
    (tmp_path / "ids.txt").write_text(" ".join(map(str, ids)))
    again, table = tmp_path / "again.npz", tmp_path / "table.npz"
    of_these = (f"--ids={tmp_path / 'ids.txt'}", "--recordings=1", f"--output={again}")
    commands.run("collect", "--task=shape_stacking", *of_these)
    stored = np.load(encoders / "shape_stacking" / "pictures-1" / "recordings.npy", mmap_mode="r")
    # Rounded by other programs.
    assert np.abs(np.load(again)["recordings"].astype(int) - stored[ids]).max() <= 1
    encoder = encoders / EMBED.format("hvae")
    files = (f"--observations={again}", f"--output={table}")
    commands.run("embed", f"--checkpoint={encoder}", *files)
    own = RepresentationTable.load(encoder / "table.npz").vectors
    spread = np.abs(own - own.mean(axis=0)).max()
    found = RepresentationTable.load(table)
    assert np.abs(found.vectors - own[ids]).max() < 0.1 * spread


@pytest.mark.slow
def test_pictures_drawn_on_demand_give_the_same_table(tmp_path: Path) -> None:
    """By the same program; that of `runs` is another, which rounds otherwise."""
    folders = [tmp_path / "stored", tmp_path / "on-demand"]
    for folder in folders:
        stacking.embed(folder, ["hvae"], f"--frames={folder.name}")
        is_stored = (folder / "shape_stacking" / "pictures-1").exists()
        assert is_stored == (folder.name == "stored")
    tables = [
        RepresentationTable.load(folder / EMBED.format("hvae") / "table.npz") for folder in folders
    ]
    np.testing.assert_array_equal(tables[0].vectors, tables[1].vectors)
    assert tables[0].hash == tables[1].hash
    lines = [timeless(folder / EMBED.format("hvae")) for folder in folders]
    assert lines[0] == lines[1]


@pytest.mark.slow
def test_what_methods_are_made_of(
    runs: Path, trained_alike: dict[str, str], trained_others: dict[str, str]
) -> None:
    assert trained_alike
    assert trained_others
    config = {name: read_json(runs / name / "config.json") for name in RUNS}
    size = {
        name: {key: value.shape for key, value in parameters(runs / name).items()} for name in RUNS
    }
    entropy = {name: config[name]["hyperparameters"]["entropy_coefficient"] for name in RUNS}
    assert {name for name, value in entropy.items() if value == 0.0} == {"no-entropy"}
    assert {value for value in entropy.values() if value} == {0.01}
    fixed = {name for name in RUNS if config[name]["sets"]["is_fixed"]}
    assert fixed == set(FIXED_SETS)
    assert config["clusters"]["num_clusters"] == 10
    assert all(name == "clusters" or not config[name]["num_clusters"] for name in RUNS)
    assert size["no-entropy"] == size["full"] == size["encoded"] == size["line"]
    modulated = size.pop("clusters")
    assert modulated["utility.score.kernel"] == (256, 64)
    assert modulated["auxiliary.heads.stop.kernel"] == (256, 2)
    assert size["no-place"]["policy.logits.kernel"] == (64, 405)
    assert size["continuous"]["policy.mean.kernel"] == (64, WIDTH)
    for name in ("no-place", "continuous"):
        assert not [key for key in size[name] if key.startswith("utility")]
    positions = {name: shapes.get("auxiliary.heads.alpha.kernel") for name, shapes in size.items()}
    assert positions.pop("no-subsampling") == (64, 2)
    assert {name for name, shape in positions.items() if shape is None} == {
        "no-place",
        "random",
        "2d-place",
    }
    assert size["2d-place"]["auxiliary.alpha.kernel"] == (128, 64), "[f(s), a]"
    assert size["2d-place"]["auxiliary.alpha.out.kernel"] == (64, 2)
    assert {shapes["auxiliary.heads.stop.kernel"] for shapes in size.values()} == {(64, 2)}


@pytest.mark.slow
def test_clusters_are_of_train_shapes(runs: Path, trained_others: dict[str, str]) -> None:
    assert trained_others
    run = Run.load(runs / "clusters")
    pool = run.trainer.training.pool
    assert np.asarray(pool.group_starts).shape == (11,), "ten clusters"
    np.testing.assert_array_equal(np.sort(pool.ids[: int(pool.size)]), run.split.train)


@pytest.mark.slow
def test_representations_are_those_that_were_asked_for(
    runs: Path, trained_alike: dict[str, str], trained_others: dict[str, str]
) -> None:
    assert trained_alike
    assert trained_others
    used = {name: RepresentationTable.load(runs / name / "table.npz") for name in RUNS}
    embedded = {name: run.representation for name, run in RUNS.items() if "/" in run.representation}
    assert len(embedded) == len(ENCODERS)
    for name, representation in embedded.items():
        config = read_json(runs / representation / "config.json")
        assert config["train_on"] == ("all" if "oracle" in representation else "train")
        assert config["model"]["kind"] == ("vae" if "embed-vae" in representation else "hvae")
        assert used[name].hash == RepresentationTable.load(runs / representation / "table.npz").hash
        assert metrics.read(runs / representation)[-1]["step"] == 2
    np.testing.assert_array_equal(used["continuous"].vectors, np.load(runs / "mine.npz")["vectors"])
    gt21 = shape_universe().engineered["gt21"]
    for name in ("line", "no-entropy", "full", "random"):
        np.testing.assert_array_equal(used[name].vectors, gt21)
    assert len({table.hash for table in used.values()}) == len(RUNS) - 3, "gt21 four times"
    assert all(table.vectors.shape == (810, WIDTH) for table in used.values())
    assert all(np.isfinite(table.vectors).all() for table in used.values())


@pytest.mark.slow
def test_finetuning_of_each_kind(
    runs: Path, trained_alike: dict[str, str], trained_others: dict[str, str], tmp_path: Path
) -> None:
    """Both policies, warm and from scratch, with all test shapes as one set."""
    assert trained_alike
    assert trained_others
    sources = {"ours": "line", "nearest-neighbour": "no-place"}
    kinds = [(method, start) for method in sources for start in ("warm", "scratch")]
    jobs = []
    for method, start in kinds:
        flags = ("--budget=smoke", "--seed=7", *stacking.SHORT)
        flags = (*flags, *(["--scratch"] if start == "scratch" else []))
        workdir = f"--workdir={tmp_path / f'{method}-{start}'}"
        jobs.append((f"--run={runs / sources[method]}", *flags, workdir))
    outputs = run_several("finetune", jobs, probe=WATCHED)
    test = published_split().test
    for (method, start), output in zip(kinds, outputs, strict=True):
        path = tmp_path / f"{method}-{start}"
        config = read_json(path / "config.json")
        assert seen(output).placed
        assert seen(output).placed <= {*test.tolist()}
        assert config["trained_on"] == "test"
        assert config["method"] == {"ours": "no-subsampling"}.get(method, method)
        assert config["start"] == {"warm": f"{method}, seed 31"}.get(start, "fresh parameters")
        check_heights(logged(path, 1, "episode"))
        found, source = parameters(path), parameters(runs / sources[method])
        kept = [key for key in found if "logits" not in key and "stop" not in key]
        moved = max(np.abs(found[key] - source[key]).max() for key in kept)
        # Four steps of Adam by about 1e-3 each, against parameters of another seed.
        assert (moved < 0.02) == (start == "warm")
        if method == "nearest-neighbour":
            assert found["policy.logits.kernel"].shape == (64, len(test))


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_to_the_same_bits(
    runs: Path, trained_alike: dict[str, str], tmp_path: Path
) -> None:
    """SIGTERM during or after the first update, then the same command in a new process."""
    assert trained_alike
    path = tmp_path / "stopped"
    job = RUNS["line"].training(runs, path)
    process = start_several("train", [job], probe=WATCHED)
    log = path / "metrics.jsonl"
    while process.poll() is None and not (log.exists() and log.stat().st_size):
        time.sleep(0.05)
    process.terminate()
    (output,) = finish_several(process)
    assert "stopped at step 1; run again to go on" in output
    assert Checkpointer(path / "checkpoints").steps("latest")[-1] == 1
    (output,) = run_several("train", [job], probe=WATCHED, alone=True)
    assert "at step 1 of 2" in output
    calm = runs / "line"
    for kind in ("best", "latest"):
        assert saved(path, kind) == saved(calm, kind)
    assert any("env_state" in leaf for leaf in saved(path, "latest"))
    assert timeless(path) == timeless(calm)
    assert metrics.read(path)[-1]["step"] == 2
    assert read_json(path / "config.json") == read_json(calm / "config.json")


@pytest.mark.slow
def test_members_of_a_sweep_share_their_batches(
    runs: Path, trained_others: dict[str, str], tmp_path: Path
) -> None:
    """Two seeds side by side: the engine gets the worlds of both at once."""
    assert trained_others
    run = RUNS["no-entropy"]
    flags = [flag for flag in run.training(runs, tmp_path / "sweep") if "seed" not in flag]
    job = (*flags, "--seeds=31,41", "--members_at_once=2")
    probe = f"{WATCHED}_on_one_core"
    (output,) = run_several("sweep", [job], probe=probe, alone=True)
    engine = seen(output)
    assert engine.batches == {(2, 2), (2, EPISODES)}
    split = published_split()
    assert engine.placed <= {*split.train.tolist(), *split.validation.tolist()}
    members = [tmp_path / "sweep" / "members" / name for name in ("seed=31", "seed=41")]
    assert [read_json(path / "config.json")["seed"] for path in members] == [31, 41]
    assert read_json(members[0] / "config.json") == read_json(runs / "no-entropy" / "config.json")
    first, second = (logged(path, 1, "episode") for path in members)
    check_heights(first)
    check_heights(second)
    assert first["final_height"] != second["final_height"]
    alone = logged(runs / "no-entropy", 1, "episode")
    # The same episodes up to rounding, which a falling tower magnifies.
    assert first["episode_length"] == alone["episode_length"]
    assert first["final_height"] == pytest.approx(alone["final_height"], abs=0.02)
