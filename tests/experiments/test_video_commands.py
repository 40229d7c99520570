"""Learning from videos by the commands, each in a process of its own; frames kept or drawn."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_host.create.play import record_images
from experiments._artifacts import REPRESENTATION_SEED, Domain, parse_representation
from experiments._flags import UsageError, load_task
from experiments._recordings import collect
from jaxnew import metrics, observations
from jaxnew.checkpoint import Checkpointer
from jaxnew.representation.table import RepresentationTable
from tests import video_task
from tests.experiments.commands import ROOT, read_json, run

PLACE = "--task=tests.video_task:TASK"
COMMON = (PLACE, "--representation=hvae-video", "--budget=smoke")
TOY = "toy-video"
ENCODER = "embed-hvae-video-default-smoke-31"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded and encoded, with frames drawn on demand."""
    runs = tmp_path_factory.mktemp("runs")
    output = run("collect", *COMMON, f"--runs={runs}")
    assert "24 actions x 3 recordings take 0.0 MB where frames are drawn on demand" in output
    assert "0.5 MB where they are stored (--frames=stored); they are drawn on demand" in output
    assert sorted(path.name for path in (runs / TOY).iterdir()) == ["poses-3"]
    run("embed", *COMMON, f"--runs={runs}")
    return runs


@pytest.mark.integration
def test_the_encoder_is_trained_and_describes_every_action(runs: Path) -> None:
    folder = runs / TOY / ENCODER
    table = RepresentationTable.load(folder / "table.npz")
    assert table.vectors.shape == (24, 4)
    assert len(np.unique(table.vectors, axis=0)) == 24
    lines = [line for line in metrics.read(folder) if "loss" in line]
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert lines[-1]["loss"] < lines[0]["loss"]


@pytest.mark.integration
def test_stored_frames_give_the_same_run_to_the_bit(runs: Path, tmp_path: Path) -> None:
    """From the poses and by itself; the stored frames are those of the simulations."""
    output = run("embed", *COMMON, f"--runs={tmp_path}", "--frames=stored")
    assert "; they are stored." in output
    assert sorted(path.name for path in (tmp_path / TOY).glob("*-3")) == ["frames-3", "poses-3"]
    frames = np.load(tmp_path / TOY / "frames-3" / "recordings.npy")
    expected = record_images(REPRESENTATION_SEED, video_task.TOOL_OF, 3)[:, :, 2:5]
    np.testing.assert_array_equal(frames[..., 0], expected)
    assert_same_run(tmp_path / TOY / ENCODER, runs / TOY / ENCODER)


@pytest.mark.integration
@pytest.mark.parametrize("frames", ["on-demand", "stored"])
def test_a_killed_run_resumes_to_the_same_bits(runs: Path, tmp_path: Path, frames: str) -> None:
    """Stopped somewhere, then gone on with in the other way; the config says they are one."""
    shutil.copytree(runs / TOY / "poses-3", tmp_path / TOY / "poses-3")
    killed = tmp_path / TOY / ENCODER
    flags = [*COMMON, f"--runs={tmp_path}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.embed", *flags, f"--frames={frames}"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and not Checkpointer(killed / "checkpoints").steps("latest"):
        time.sleep(0.005)
    assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 0 < Checkpointer(killed / "checkpoints").steps("latest")[-1] < 6
    other = {"stored": "on-demand", "on-demand": "stored"}[frames]
    assert "resuming" in run("embed", *flags, f"--frames={other}")
    assert_same_run(killed, runs / TOY / ENCODER)


@pytest.mark.integration
def test_a_policy_is_trained_on_videos_and_evaluated_in_a_new_process(
    runs: Path, tmp_path: Path
) -> None:
    run("train", *COMMON, f"--runs={runs}", "--workers=1", f"--workdir={tmp_path / 'policy'}")
    config = read_json(tmp_path / "policy" / "config.json")
    table = RepresentationTable.load(runs / TOY / ENCODER / "table.npz")
    assert (config["representation"], config["table_hash"]) == ("hvae-video", table.hash)
    run("evaluate", f"--run={tmp_path / 'policy'}", "--sets=test", "--episodes=5")
    found = read_json(tmp_path / "policy" / "evaluation" / "test-best-sampled-m4.json")
    assert found["num_episodes"] == 5


@pytest.mark.integration
def test_the_frozen_encoder_reads_videos_of_new_tools(runs: Path, tmp_path: Path) -> None:
    """Paper algorithm 2: recordings of tools 1 and 5, which are none of the 24 actions."""
    frames = record_images(3, [1, 5], 4)[:, :, 2:5, ..., None]
    np.savez(tmp_path / "new.npz", ids=np.array([101, 105]), recordings=frames)
    encoder = runs / TOY / ENCODER
    output = run(
        "embed",
        f"--checkpoint={encoder}",
        f"--observations={tmp_path / 'new.npz'}",
        f"--output={tmp_path / 'new_table.npz'}",
    )
    assert "2 actions, 4 numbers each" in output
    new = RepresentationTable.load(tmp_path / "new_table.npz")
    assert new.ids.tolist() == [101, 105]
    own = RepresentationTable.load(encoder / "table.npz")
    np.savez(
        tmp_path / "same.npz",
        ids=np.arange(24),
        recordings=record_images(REPRESENTATION_SEED, video_task.TOOL_OF, 3)[:, :, 2:5, ..., None],
    )
    run(
        "embed",
        f"--checkpoint={encoder}",
        f"--observations={tmp_path / 'same.npz'}",
        f"--output={tmp_path / 'same_table.npz'}",
    )
    same = RepresentationTable.load(tmp_path / "same_table.npz")
    np.testing.assert_allclose(same.vectors, own.vectors, atol=1e-6)
    np.savez(tmp_path / "poses.npz", ids=np.array([1]), recordings=np.zeros((1, 2, 3, 4, 3)))
    output = run(
        "embed",
        f"--checkpoint={encoder}",
        f"--observations={tmp_path / 'poses.npz'}",
        f"--output={tmp_path / 'none.npz'}",
        fails=True,
    )
    assert "has shape (1, 2, 3, 4, 3), expected (1, 2, 3, 48, 48, 1)" in output


@pytest.mark.unit
def test_recordings_of_both_kinds_are_those_of_the_simulations(tmp_path: Path) -> None:
    domain = Domain.of(video_task.TASK, None)
    made = {
        stores: collect(tmp_path, video_task.VIDEO, domain.universe, 2, 9, stores)
        for stores in (False, True)
    }
    expected = record_images(9, video_task.TOOL_OF, 2)[:, :, 2:5, ..., None]
    ids, numbers = np.array([5, 20, 11]), np.array([[1], [0], [1]])
    for recordings in made.values():
        source: Any = recordings.for_training(ids)
        assert source.shape == (3, 2, 3, 48, 48, 1)
        found = source.gather(np.arange(3)[:, None], numbers)
        np.testing.assert_array_equal(found, expected[ids[:, None], numbers])
        first: Any = recordings.for_encoding(ids, 1)
        assert first.shape == (3, 1, 3, 48, 48, 1)
        np.testing.assert_array_equal(first.gather(np.array([2]), np.array([0])), expected[[11], 0])
        whole: Any = recordings.for_encoding()
        assert whole.shape == expected.shape
    assert made[True].hash == made[False].hash
    assert made[False].drawn is None
    states = collect(tmp_path, video_task.STATES, domain.universe, 2, 9)
    of_states = np.asarray(states.for_training(ids))
    np.testing.assert_array_equal(of_states, video_task.record_states(9, ids, 2))
    np.testing.assert_array_equal(states.for_encoding(ids, 1), of_states[:, :1])


@pytest.mark.unit
def test_stored_frames_are_gone_on_with_and_belong_to_their_poses(tmp_path: Path) -> None:
    domain = Domain.of(video_task.TASK, None)
    made = collect(tmp_path, video_task.VIDEO, domain.universe, 1, 9, stores_drawn=True)
    assert made.drawn is not None
    before = made.drawn.hash
    data = np.lib.format.open_memmap(tmp_path / "frames-1" / "recordings.npy", "r+")
    data[3] = 0  # A damaged action is drawn again.
    data.flush()
    with pytest.warns(UserWarning, match="action 3 is damaged"):
        again = collect(tmp_path, video_task.VIDEO, domain.universe, 1, 9, stores_drawn=True)
    assert again.drawn is not None
    assert again.drawn.hash == before
    shutil.rmtree(tmp_path / "poses-1")
    with pytest.raises(observations.ObservationsError, match="drawn_from"):
        collect(tmp_path, video_task.VIDEO, domain.universe, 1, 10, stores_drawn=True)


@pytest.mark.contract
@pytest.mark.parametrize("name", ["create-push", "create-funnel-no-subgoals", "create-analysis"])
def test_every_create_task_has_videos(name: str) -> None:
    domain = Domain.of(load_task(name), None)
    for representation in ("hvae-video", "vae-video-oracle"):
        kind, play, modality = parse_representation(domain, representation)
        assert kind == representation.partition("-")[0]
        assert (modality.name, modality.image_shape) == ("video", (48, 48, 1))
        assert play.seen.shape == (7, 48, 48, 1)
        assert set(play.stage_one) == {"smoke", "laptop", "paper"}
        budget = domain.stage_one(play, "paper")
        config = budget.configs[kind]
        # Spec method 3, column CREATE video; method 4 of images.
        sizes = config.actions_per_batch, config.recordings_per_action, config.num_steps
        assert (sizes, budget.num_recordings) == ((32, 45, 170_000), 1024)
        assert not budget.stores_drawn
        laptop = domain.stage_one(play, "laptop").num_recordings
        kinds = (play.format, play.seen)
        assert name == "create-analysis" or (
            sum(kind.estimate_bytes(2366, laptop) for kind in kinds) < 1e9
        )
    assert parse_representation(domain, "hvae").play is domain.task.play
    assert domain.stage_one(domain.play, "smoke").num_recordings == 4
    with pytest.raises(UsageError, match="hvae-position, hvae-video, vae-state"):
        parse_representation(domain, "hvae-film")
    with pytest.raises(UsageError, match="has no budget 'short'; choose one of smoke, laptop"):
        domain.stage_one(parse_representation(domain, "hvae-video").play, "short")


def assert_same_run(one: Path, other: Path) -> None:
    """The same checkpoints, metrics, table and config."""
    hashes = []
    for path in (one, other):
        checkpointer = Checkpointer(path / "checkpoints")
        step = checkpointer.steps("latest")[-1]
        record = checkpointer._read_record(checkpointer._path("latest", step))
        leaves = [(leaf["path"], leaf["sha256"]) for leaf in record["leaves"]]
        lines = [
            {name: value for name, value in line.items() if not name.startswith("time/")}
            for line in metrics.read(path)
        ]
        table = RepresentationTable.load(path / "table.npz")
        hashes.append((step, leaves, lines, table.hash, read_json(path / "config.json")))
    assert hashes[0] == hashes[1]
