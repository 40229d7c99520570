"""A user's mistake ends a command with one line that says what was given, allowed, and to do."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from jaxnew import collection
from jaxnew.actions import SplitMismatch
from jaxnew.embedding import find_table
from jaxnew.observations import ObservationsError
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.device import DeviceRollout
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from tests.experiments.commands import ROOT, command_line, refused, run, run_alone

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def policy_run(runs: Path) -> Path:
    run("train", "--budget=smoke", "--representation=gt12", f"--runs={runs}")
    return runs / "grid_world" / "ours-gt12-default-smoke-31"


WRONG = {
    "--task=gridworld": ["gridworld", "grid_world"],
    "--task=jaxnew.actions:TASK": ["jaxnew.actions:TASK", "Task"],
    "--method=our": ["'our'", "ours"],
    "--representation=gt13": ["gt13", "gt12", "hvae"],
    "--split=half": ["half", "default"],
    "--budget=papr": ["papr", "paper"],
    "--set=ppo.num_epoch=2": ["ppo.num_epoch", "ppo.num_epochs"],
    "--set=ppo.num_epochs=two": ["ppo.num_epochs", "int", "two"],
    "--set=ppo.num_minibatches=7": ["256", "num_minibatches=7"],
    "--set=sets.size=300": ["300", "validation", "256"],
    "--set=hyperparameters.learning_rate=-1": ["learning_rate=-1", "[0, 1]"],
    "--set=hyperparameters.discount=2": ["discount=2", "[0, 1]"],
    "--set=hyperparameters.clip=-1": ["clip=-1", "at least 0"],
    "--set=environment.max_moves=0": ["max_moves=0", "1"],
    "--set=table_hash=0": ["table_hash cannot be set"],
    "--workers=2": ["num_workers=2", "inside jit", "--workers"],
    "--representation_budget=smoke": ["representation_budget=smoke", "nothing is trained"],
    "--set=split=full": ["split cannot be set", "--split"],
    "--seed=4294967296": ["4294967296", "4294967295"],
    "--seed=-1": ["seed=-1", "0..4294967295"],
    "--split_seed=4294967296": ["4294967296", "4294967295"],
    "train": ["train", "--flag=value"],
}


@pytest.fixture(scope="module")
def answers(runs: Path) -> dict[str, str]:
    """What `train` says to each of `WRONG`."""
    defaults = ("--budget=smoke", "--representation=gt12", f"--runs={runs / 'none'}")
    outputs = refused("train", [(*defaults, flag) for flag in WRONG])
    return dict(zip(WRONG, outputs, strict=True))


@pytest.mark.parametrize("flag", WRONG)
def test_wrong_names_and_values(answers: dict[str, str], flag: str) -> None:
    last_lines = answers[flag][-700:]
    for words in WRONG[flag]:
        assert words in last_lines


@pytest.mark.parametrize("command", ["train", "sweep"])
def test_a_wrong_method_is_named_before_anything_is_made(command: str, tmp_path: Path) -> None:
    output = run_alone(
        command,
        "--budget=smoke",
        "--representation=hvae",
        "--method=envs_mjx.grid_world:Policy",
        f"--runs={tmp_path / 'none'}",
        fails=True,
    )
    assert "envs_mjx.grid_world has no Policy" in output
    assert not (tmp_path / "none").exists()


def test_tables_that_do_not_fit(policy_run: Path, runs: Path, tmp_path: Path) -> None:
    table = RepresentationTable.load(policy_run / "table.npz")
    cases = {
        "other_universe": {"universe_hash": "0123456789abcdef"},
        "other_split": {"universe_hash": table.universe_hash, "split_hash": "0123456789abcdef"},
        "too_few": {"vectors": table.vectors[:10], "ids": table.ids[:10]},
    }
    for name, change in cases.items():
        fields = {"vectors": table.vectors, "ids": table.ids, **change}
        RepresentationTable(**fields).save(tmp_path / f"{name}.npz")
    (tmp_path / "cut.npz").write_bytes((policy_run / "table.npz").read_bytes()[:1000])
    np.savez(tmp_path / "nan.npz", ids=table.ids, vectors=table.vectors * np.nan)
    says = {
        "other_universe": "0123456789abcdef",
        "other_split": "0123456789abcdef",
        "too_few": "lacks 1014",
        "cut": "damaged",
        "nan": "NaN",
    }
    domain = Domain.of(load_task("grid_world"), None)
    for name, words in says.items():
        with pytest.raises((ValueError, SplitMismatch), match=words):
            find_table(domain, runs, str(tmp_path / f"{name}.npz"), "smoke")


def test_a_user_s_own_table_trains(policy_run: Path, tmp_path: Path) -> None:
    # As wide as that of `policy_run`, so that both share their programs.
    vectors = np.random.default_rng(0).normal(size=(1024, 12))
    np.savez(tmp_path / "mine.npz", ids=np.arange(1024), vectors=vectors)
    output = run(
        "train",
        "--budget=smoke",
        f"--representation={tmp_path / 'mine.npz'}",
        f"--runs={tmp_path}",
    )
    assert "ours-mine" in output


def test_damaged_run_directories(policy_run: Path, tmp_path: Path) -> None:
    """Each case is a copy with one thing broken; evaluating says which, and changes nothing."""

    def broken(name: str) -> Path:
        return Path(shutil.copytree(policy_run, tmp_path / name))

    no_config = broken("no_config")
    (no_config / "config.json").unlink()
    cut_config = broken("cut_config")
    (cut_config / "config.json").write_text('{"task": "grid')
    no_checkpoint = broken("no_checkpoint")
    shutil.rmtree(no_checkpoint / "checkpoints")
    cut_checkpoint = broken("cut_checkpoint")
    for file in (cut_checkpoint / "checkpoints" / "best").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:10])
    swapped_split = broken("swapped_split")
    record = json.loads((swapped_split / "split.json").read_text())
    record["train"][0], record["test"][0] = record["test"][0], record["train"][0]
    (swapped_split / "split.json").write_text(json.dumps(record))
    cases = {
        no_config: "config.json",
        cut_config: "config.json",
        no_checkpoint: "checkpoint",
        cut_checkpoint: "checkpoint",
        swapped_split: "split.json",
        tmp_path / "nowhere": "nowhere",
    }
    outputs = refused("evaluate", [(f"--run={path}", "--episodes=8") for path in cases])
    for words, output in zip(cases.values(), outputs, strict=True):
        assert words in output[-900:]


def test_bad_id_files(policy_run: Path, tmp_path: Path) -> None:
    contents = {
        "1 2 x": "x",
        "": "no action id",
        "1 1 2": "twice",
        "5 1024": "0..1023",
        "1 2 3": "3",
    }
    jobs = []
    for number, content in enumerate(contents):
        file = tmp_path / f"{number}.txt"
        file.write_text(content)
        jobs.append((f"--run={policy_run}", f"--ids={file}", "--episodes=8"))
    for says, output in zip(contents.values(), refused("evaluate", jobs), strict=True):
        assert says in output[-500:]


NOWHERE = "/proc/nowhere"  # Nobody can make it, root neither.
LONG = "/tmp/" + "x" * 300
PATHS: list[tuple[str, tuple[str, ...], str]] = [
    ("evaluate", ("--run={run}", "--ids=/nowhere/ids.txt"), "There is no file '/nowhere/ids.txt'"),
    ("evaluate", ("--run={run}", f"--ids={LONG}"), "is no file (File name too long). --ids takes"),
    ("evaluate", (f"--run={LONG}",), f"{LONG}/config.json: File name too long. Give a path"),
    ("evaluate", ("--run={run}", f"--output={NOWHERE}"), f"Nothing can be written in {NOWHERE}"),
    ("evaluate", ("--run={run}/typo",), "typo is no checkpoint of"),
    ("evaluate", ("--run={run}/checkpoints/best", "--checkpoint=latest"), "not a latest one"),
    ("evaluate", ("--run=",), "--run is empty; give a value, or leave it out"),
    ("evaluate", ("--run=~/nothing-is-here",), f"{Path.home()}/nothing-is-here is neither"),
    ("finetune", ("--run={run}/typo",), "typo is no checkpoint of"),
    ("figures", ("--run={run}", f"--out={NOWHERE}"), f"Nothing can be written in {NOWHERE}"),
    ("figures", ("--run={run}", "--seeds=a"), "flag --seeds=a: invalid literal"),
    (
        "figures",
        ("--figure=8", f"--out={NOWHERE}", "--task=create-push", "--budget=smoke"),
        "Nothing",
    ),
    ("analyze", ("--study=set-size", "--run={run}", f"--out={NOWHERE}"), "Nothing can be written"),
    (
        "analyze",
        ("--study=set-size", "--run={run}", "--values=1,b"),
        "flag --values=1,b: could not",
    ),
    ("anchors", (f"--out={NOWHERE}", "--episodes=8"), f"Nothing can be written in {NOWHERE}"),
    ("train", ("--budget=smoke", f"--representation={LONG}.npz"), "File name too long"),
]


@pytest.mark.parametrize(("command", "flags", "says"), PATHS)
def test_paths_are_checked_before_work_starts(
    policy_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    flags: tuple[str, ...],
    says: str,
) -> None:
    """What was given and what to do, in one line, and no episode was played for it."""
    monkeypatch.setattr(DeviceRollout, "measure", None)
    before = sorted(policy_run.rglob("*"))
    output = run(command, *(flag.format(run=policy_run) for flag in flags), fails=True)
    assert says in output
    assert len(output.splitlines()) == 1 + ("shows where" in output), output
    assert sorted(policy_run.rglob("*")) == before


def test_an_encoder_is_no_policy(tmp_path: Path) -> None:
    RunDirectory.open_or_create(tmp_path / "encoder", {"model": {}, "task": "grid_world"}).close()
    output = run("evaluate", f"--run={tmp_path / 'encoder'}", fails=True)
    assert f"{tmp_path / 'encoder'}: This is no run of a policy" in output
    assert "those of embed are for --representation" in output


def test_names_of_files_may_be_any_and_results_lie_elsewhere(
    policy_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The names have blanks and umlauts; the home of the user is written as shells write it."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "my ids ü.txt").write_text("\ufeff" + " ".join(map(str, range(60))), "utf-8")
    before = sorted(policy_run.rglob("*"))
    flags = ("--ids=~/my ids ü.txt", "--output=~/kept", "--episodes=8")
    output = run("evaluate", f"--run={policy_run}", *flags)
    assert "ids-my ids ü  " in output
    (file,) = (tmp_path / "kept").iterdir()
    assert file.name.startswith("ids-my-ids-")
    assert json.loads(file.read_text())["run"] == str(policy_run)
    assert sorted(policy_run.rglob("*")) == before


def test_what_a_command_prints_ends_nothing(policy_run: Path) -> None:
    """Behind a pipe that nobody reads, on a terminal of few letters, without a home."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        command_line("evaluate", f"--run={policy_run}", "--help"),
        cwd=ROOT,
        stdout=writer,
        stderr=subprocess.PIPE,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_flags_of_another_mode_are_refused(policy_run: Path, tmp_path: Path) -> None:
    """Nothing is ignored in silence."""
    new = [f"--{name}={tmp_path}" for name in ("checkpoint", "observations", "output")]
    cases: list[tuple[str, tuple[str, ...], str]] = [
        ("evaluate", (f"--run={policy_run}", "--growth=2"), "--growth: of no meaning without"),
        ("embed", (*new, "--seed=3", "--frames=stored"), "--seed, --frames: of no meaning with"),
        ("embed", ("--budget=smoke", "--frames=stored"), "no drawn frames; leave out --frames"),
        ("collect", ("--budget=smoke", "--frames=on-demand"), "no drawn frames"),
        ("collect", ("--budget=smoke", "--overwrite"), "--overwrite: of no meaning without --out"),
    ]
    for command, flags, says in cases:
        arguments = importlib.import_module(f"experiments.{command}").ARGUMENTS
        runs = () if command == "evaluate" or flags[:3] == tuple(new) else (f"--runs={tmp_path}",)
        arguments.parse([*flags, *runs])
        with pytest.raises(UsageError, match=says):
            importlib.import_module(f"experiments.{command}").main()
    assert not any(tmp_path.iterdir())


def test_a_table_is_not_replaced_unless_it_is_asked_for(tmp_path: Path) -> None:
    output = tmp_path / "table.npz"
    output.write_text("precious")
    flags = [f"--{name}={tmp_path / name}" for name in ("checkpoint", "observations")]
    job = (*flags, f"--output={output}")
    refusal, next_error = refused("embed", [job, (*job, "--overwrite")])
    assert f"{output} exists already" in refusal
    assert "checkpoint is not a directory" in next_error
    assert output.read_text() == "precious"


def test_a_nan_stops_the_run_and_keeps_what_was_saved(runs: Path, tmp_path: Path) -> None:
    flags = ["--budget=smoke", "--representation=gt12", f"--workdir={tmp_path / 'nan'}"]
    job = (*flags, "--set=hyperparameters.entropy_coefficient=1e38")
    output, again = refused("train", [job, job])
    assert "NonFiniteError" in output
    assert "step" in output
    assert "NonFiniteError" in again


def test_damaged_recordings_are_found(tmp_path: Path) -> None:
    run("collect", "--budget=smoke", f"--runs={tmp_path}")
    file = tmp_path / "grid_world" / "recordings-16" / "recordings.npy"
    content = bytearray(file.read_bytes())
    content[-5] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(ObservationsError, match="1023"):
        collection.load(file.parent, skill_universe())
    output = run("collect", "--budget=smoke", f"--runs={tmp_path}")
    assert "1024 actions x 16 recordings" in output
    collection.load(file.parent, skill_universe())
