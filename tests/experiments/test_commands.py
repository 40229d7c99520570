"""Every command at smoke budget, as a user calls it."""

from __future__ import annotations

import csv
import os
import random
import re
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from tests.experiments.commands import (
    ENVIRONMENT,
    ROOT,
    command_line,
    evaluation,
    of_new_actions,
    read_json,
    run,
    run_alone,
)
from tests.experiments.create_runs import saved, timeless
from tests.experiments.several import run_several

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def hvae_run(runs: Path) -> Path:
    """Both stages, by the commands of the README's quickstart at smoke budget."""
    readme = (ROOT / "README.md").read_text()
    commands = re.findall(r"^jaxnew (.+ --budget=laptop)$", readme, re.MULTILINE)
    assert [command.split()[0] for command in commands] == ["collect", "embed", "train"]
    for command in commands:
        smaller = command.replace("laptop", "smoke").replace("every=50", "every=2")
        run(*smaller.split(), f"--runs={runs}")
    return runs / "grid_world" / "ours-hvae-default-smoke-31"


@pytest.fixture(scope="module")
def encoder_run(hvae_run: Path) -> Path:
    return hvae_run.parent / "embed-hvae-default-smoke-31"


def test_a_run_directory_explains_itself(hvae_run: Path, encoder_run: Path) -> None:
    config = read_json(hvae_run / "config.json")
    table = RepresentationTable.load(hvae_run / "table.npz")
    assert config["table_hash"] == table.hash
    assert table.hash == RepresentationTable.load(encoder_run / "table.npz").hash
    assert table.vectors.shape == (1024, 16)
    session = read_json(hvae_run / "provenance.json")["sessions"][-1]
    assert session["split_hash"] == config["split_hash"]
    assert "experiments.train" in session["command"]
    lines = metrics.read(hvae_run)
    assert {line["step"] for line in lines} == {2, 4}
    assert any("validation/is_success" in line for line in lines)
    for kind in ("best", "latest"):
        assert Checkpointer(hvae_run / "checkpoints").steps(kind)


@pytest.fixture(scope="module")
def evaluated(hvae_run: Path) -> tuple[str, dict[str, Any]]:
    """What `evaluate` printed and found; then, in another process, it is run in several ways."""
    flags = (f"--run={hvae_run}", "--sets=train,test", "--episodes=96")
    output = run("evaluate", *flags)
    (file,) = (hvae_run / "evaluation").glob("test-best-sampled-m50-*.json")
    first = read_json(file)
    file.unlink()
    ids_file = hvae_run.parent / "chosen.txt"
    ids_file.write_text(" ".join(map(str, read_json(hvae_run / "split.json")["test"][:60])))
    latest = next((hvae_run / "checkpoints" / "latest").iterdir())
    of_ids = (f"--run={latest}", f"--ids={ids_file}", "--episodes=32", "--deterministic")
    mixture = (f"--run={hvae_run}", "--unseen_ratio=0.5", "--episodes=32", "--set_size=20")
    run_several("evaluate", [flags, of_ids, mixture])
    return output, first


def test_evaluate_in_a_new_process_and_twice_the_same(
    hvae_run: Path, evaluated: tuple[str, dict[str, Any]]
) -> None:
    output, first = evaluated
    assert re.search(r"96 sampled episodes each; .*\n +is_success .*\ntrain .*\ntest  ", output)
    assert first["num_episodes"] == 96
    assert first["num_actions"] == 256
    success = first["metrics"]["is_success"]
    assert success["low"] <= success["mean"] <= success["high"]
    second = evaluation(hvae_run, "test-best-sampled-m50")
    assert second["metrics"] == first["metrics"]


def test_evaluate_on_a_checkpoint_ids_a_mixture_and_greedily(
    hvae_run: Path, evaluated: tuple[str, dict[str, Any]]
) -> None:
    assert evaluated
    found = evaluation(hvae_run, "ids-chosen-????????-latest-greedy-m50")
    assert (found["num_actions"], found["checkpoint"]) == (60, "latest")
    found = evaluation(hvae_run, "unseen-0.5-best-sampled-m20")
    assert (found["num_actions"], found["set_size"]) == (128 + 256, 20)


@pytest.fixture(scope="module")
def page(hvae_run: Path, runs: Path) -> list[list[str]]:
    """Commands of the page on new actions, with the encoder and the run of these tests."""
    assert hvae_run
    names = ("embed-hvae-default-{}-31", "ours-hvae-default-{}-31")
    folder = runs / "grid_world"
    paths = {
        f"runs/grid_world/{name.format('laptop')}": folder / name.format("smoke") for name in names
    }
    return of_new_actions("Grid World", runs, paths)


def test_new_actions_are_recorded_encoded_and_acted_with(
    hvae_run: Path, runs: Path, page: list[list[str]]
) -> None:
    """Paper algorithm 2, as the page shows it: nothing is trained."""
    assert [words[0] for words in page[:2]] == ["embed", "train"]
    outputs = [run(*words, *(["--episodes=32"] * (words[0] == "evaluate"))) for words in page[2:]]
    assert "100 actions x 16 recordings" in outputs[0]
    assert "100 actions, 16 numbers each" in outputs[1]
    first = (ROOT / "examples" / "skills.txt").read_text().split()[0]
    assert f"100 actions of GridWorld-v0, 0 seen in training, e.g. {first}; " in outputs[2]
    found = evaluation(hvae_run, "table-new_skills_table-????????-best-sampled-m50")
    assert (found["num_actions"], found["num_seen"], found["num_episodes"]) == (100, 0, 32)
    table = RepresentationTable.load(runs / "new_skills_table.npz")
    assert table.ids.tolist() == list(range(1024, 1124))


def test_new_actions_that_are_mistaken_are_refused(
    hvae_run: Path, encoder_run: Path, runs: Path, page: list[list[str]], tmp_path: Path
) -> None:
    """Renumbered ids, another encoder, another universe."""
    mine = tmp_path / "mine.npz"
    arrays = dict(np.load(runs / "new_skills.npz"))
    renumbered = np.arange(100)
    encode = ("embed", f"--checkpoint={encoder_run}", f"--observations={mine}")
    evaluate = ("evaluate", f"--run={hvae_run}", f"--table={tmp_path / 'table.npz'}")
    np.savez(mine, **{**arrays, "ids": renumbered})
    output = run(*encode, f"--output={tmp_path / 'table.npz'}", fails=True)
    assert "was edited: its ids and recordings hash to" in output
    np.savez(mine, ids=renumbered, recordings=arrays["recordings"])
    run(*encode, f"--output={tmp_path / 'table.npz'}")
    output = run(*evaluate, fails=True)
    assert "does not say what its actions are" in output
    assert "allow unknown-actions" in output
    run(*evaluate, "--allow=unknown-actions", "--episodes=8")
    table = RepresentationTable.load(runs / "new_skills_table.npz")
    replace(table, encoder_hash="0" * 16).save(tmp_path / "table.npz")
    output = run(*evaluate, fails=True)
    assert "is of encoder 0000000000000000, the policy learned with" in output
    table.save(tmp_path / "table.npz")
    skills = tmp_path / "skills.txt"
    skills.write_text("RR.RR\n.DDDD\n")
    output = run(*evaluate, f"--universe={skills}", fails=True)
    assert "describes 100 actions of GridWorld-v0; GridWorld-v0 lacks 100 of them" in output
    skills.write_text("RR.R\n")
    output = run("collect", f"--universe={skills}", f"--output={mine}", fails=True)
    assert "'RR.R' is not a skill" in output
    output = run("collect", "--universe=nowhere.txt", f"--output={mine}", fails=True)
    assert "There is no file 'nowhere.txt'. Grid World takes a text file" in output
    output = run("collect", "--ids=test", fails=True)
    assert "--ids: of no meaning without --output" in output
    output = run("evaluate", f"--run={hvae_run}", "--allow=unknown-actions", fails=True)
    assert "--allow: of no meaning without --table" in output
    assert page


def test_train_again_finds_the_run_complete(hvae_run: Path, runs: Path) -> None:
    before = (hvae_run / "metrics.jsonl").read_bytes()
    output = run("train", "--budget=smoke", "--representation=hvae", f"--runs={runs}")
    assert "already complete" in output
    assert (hvae_run / "metrics.jsonl").read_bytes() == before


def test_another_config_is_refused_and_named(hvae_run: Path, runs: Path) -> None:
    before = read_json(hvae_run / "config.json")
    output = run(
        "train",
        "--budget=smoke",
        "--representation=hvae",
        f"--runs={runs}",
        "--set=hyperparameters.clip=0.2",
        fails=True,
    )
    assert "hyperparameters.clip" in output
    assert "0.1" in output
    assert "0.2" in output
    assert "--overwrite" in output
    assert read_json(hvae_run / "config.json") == before


def test_an_embed_report_and_other_representations(encoder_run: Path, runs: Path) -> None:
    """Of a run that is complete, and of two that are made."""
    common = ("--budget=smoke", f"--runs={runs}")
    names = ("hvae", "hvae-onehot-oracle", "vae-relative")
    jobs = [(*common, f"--representation={name}") for name in names]
    outputs = [run("embed", *job) for job in jobs]
    assert "already complete" in outputs[0]
    numbers = read_json(encoder_run / "evaluation" / "representation.json")
    assert 0.0 <= numbers["purity_held_out"] <= 1.0
    assert len(numbers["linear_r2"]["net displacement"]) == 2
    assert len(numbers["linear_r2"]["per-move coordinates"]) == 10
    for name, part in zip(names[1:], ("all", "train"), strict=True):
        path = runs / "grid_world" / f"embed-{name}-default-smoke-31"
        assert read_json(path / "config.json")["train_on"] == part
        assert RepresentationTable.load(path / "table.npz").vectors.shape == (1024, 16)


def test_train_makes_what_it_needs(tmp_path: Path) -> None:
    """Recordings and encoder are made on demand, each with a line that says so."""
    output = run("train", "--budget=smoke", "--representation=hvae", f"--runs={tmp_path}")
    assert "1024 actions x 16 recordings" in output
    assert "Training hvae (8 steps" in output
    assert "update 4 of 4" in output
    path = tmp_path / "grid_world" / "embed-hvae-default-smoke-31"
    assert RepresentationTable.load(path / "table.npz").vectors.shape == (1024, 16)


def test_no_random_key_is_used_twice(tmp_path: Path) -> None:
    run_alone(
        "train",
        "--budget=smoke",
        "--representation=hvae",
        "--representation_budget=smoke",
        f"--runs={tmp_path}",
        environment={**ENVIRONMENT, "JAX_DEBUG_KEY_REUSE": "1"},
    )


def test_a_sweep_is_read_back_and_its_members_are_ordinary_runs(runs: Path) -> None:
    output = run_alone(
        "sweep",
        "--budget=smoke",
        "--representation=gt5",
        "--seeds=1,2",
        "--vary=entropy_coefficient=0.0,0.1",
        f"--runs={runs}",
    )
    (path,) = (runs / "grid_world").glob("sweep-ours-gt5-smoke-entropy_coefficient-*")
    names = [f"entropy_coefficient={value}-seed={seed}" for value in (0.0, 0.1) for seed in (1, 2)]
    assert sorted(member.name for member in (path / "members").iterdir()) == names
    for name in names:
        config = read_json(path / "members" / name / "config.json")
        entropy, seed = config["hyperparameters"]["entropy_coefficient"], config["seed"]
        assert name == f"entropy_coefficient={entropy}-seed={seed}"
    last = path / "members" / names[3]
    run("evaluate", f"--run={last}", "--episodes=32")
    before = evaluation(last, "test-best-sampled-m50")["metrics"]
    # As `train` reports: a line per chunk of two updates.
    assert [line["step"] for line in metrics.read(last) if "loss/total" in line] == [2, 4]
    assert "| entropy_coefficient | validation/is_success | by validation |" in output
    output = run("evaluate", f"--run={path}", "--sets=train,test", "--episodes=32")
    header = "| entropy_coefficient | validation/is_success | test-best-sampled-m50 | train-best-"
    assert header in output
    assert evaluation(last, "test-best-sampled-m50")["metrics"] == before  # Alone and in turn.
    with (path / "figures" / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["entropy_coefficient"] for row in rows] == ["0.0", "0.1"]
    for row, members in zip(rows, (names[:2], names[2:]), strict=True):
        found = [evaluation(path / "members" / m, "test-best-sampled-m50") for m in members]
        means = [each["metrics"]["is_success"]["mean"] for each in found]
        assert float(row["test-best-sampled-m50"]) == pytest.approx(np.mean(means))
        assert row["test-best-sampled-m50_seeds"] == "2"
    assert header in run("figures", f"--run={path}")
    assert Image.open(path / "figures" / "sweep.png").size[0] > 500
    output = run("evaluate", f"--run={path}", "--workers=1", fails=True)
    assert "--workers: of no meaning for a sweep" in output


def test_a_killed_run_resumes_to_the_same_bits(runs: Path) -> None:
    """SIGKILL at a random instant (more of them: `tests/drills`); the end is that of a calm run."""
    flags = (
        "--budget=smoke",
        "--representation=gt12",
        f"--runs={runs}",
        "--set=num_updates=80",
        "--set=ppo.num_epochs=1",
        "--set=ppo.lr_steps=40000",
        "--set=loop.evaluation_episodes=8",
    )
    calm, killed = runs / "calm", runs / "killed"
    run("train", *flags, f"--workdir={calm}")
    process = subprocess.Popen(
        command_line("train", *flags, f"--workdir={killed}"),
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and newest_step(killed) < 0:
        time.sleep(0.01)
    time.sleep(random.Random(0).uniform(0.0, 0.3))
    assert process.poll() is None, "the run ended before it was killed"
    process.kill()
    process.wait()
    output = run("train", *flags, f"--workdir={killed}")
    assert "resuming" in output
    assert timeless(killed) == timeless(calm)
    for kind in ("best", "latest"):
        assert saved(killed, kind) == saved(calm, kind)


def newest_step(path: Path) -> int:
    return max(Checkpointer(path / "checkpoints").steps("latest"), default=-1)
