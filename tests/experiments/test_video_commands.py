"""Learning from videos by the commands; frames kept or drawn."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_host.create.play import PlayConfig, record_images
from envs_host.create.recorder import Recorder
from jaxnew.embedding import embed
from jaxnew.observations import ObservationsError, Recordings
from jaxnew.recording import REPRESENTATION_SEED, collect, parse_representation
from jaxnew.representation.sources import DrawnRecordings, StoredRecordings
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from tests import video_task
from tests.experiments.commands import compiling, evaluation, read_json, run, run_alone

PLACE = "--task=tests.video_task:TASK"
COMMON = (PLACE, "--representation=hvae-video", "--budget=smoke")
TOY = "toy-video"
ENCODER = "embed-hvae-video-default-smoke-31"


SEEN = slice(video_task.FIRST, video_task.FIRST + video_task.NUM_FRAMES)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded, encoded and trained by the commands, with frames drawn on demand."""
    runs = tmp_path_factory.mktemp("runs")
    output = run("collect", *COMMON, f"--runs={runs}")
    assert "24 actions x 3 recordings take 0.0 MB where frames are drawn on demand" in output
    assert "0.3 MB where they are stored (--frames=stored); they are drawn on demand" in output
    assert sorted(path.name for path in (runs / TOY).iterdir()) == ["poses-3"]
    run("embed", *COMMON, f"--runs={runs}")
    run("train", *COMMON, f"--runs={runs}", "--workers=1", "--set=num_updates=1")
    return runs


@pytest.mark.integration
def test_the_encoder_is_trained_and_describes_every_action(runs: Path) -> None:
    folder = runs / TOY / ENCODER
    table = RepresentationTable.load(folder / "table.npz")
    assert table.vectors.shape == (24, 4)
    assert len(np.unique(table.vectors, axis=0)) == 24
    lines = [line for line in metrics.read(folder) if "loss" in line]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert lines[-1]["loss"] < lines[0]["loss"]


@pytest.mark.integration
def test_a_policy_that_sees_videos_is_evaluated_in_a_new_process(runs: Path) -> None:
    policy = runs / TOY / "ours-hvae-video-default-smoke-31"
    config = read_json(policy / "config.json")
    table = RepresentationTable.load(runs / TOY / ENCODER / "table.npz")
    assert (config["representation"], config["table_hash"]) == ("hvae-video", table.hash)
    flags = (f"--run={policy}", "--sets=test", "--episodes=5")
    assert "which is not installed" in run_alone("evaluate", *flags, fails=True)
    assert "Importing tests.video_task, which the run" in run_alone("evaluate", *flags, "--trust")
    found = evaluation(policy, "test-best-sampled-m4")
    assert found["num_episodes"] == 5


class Killed(Exception):
    """Stands for a signal that no process survives."""


@pytest.mark.integration
@pytest.mark.parametrize("stores_drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_both_ways_and_a_resumed_run_give_the_same_bits(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stores_drawn: bool
) -> None:
    """Killed while the batch of a later step is gathered, then run again, perhaps the other way."""
    domain = Domain.of(replace(video_task.TASK, place=PLACE.partition("=")[2]))
    shutil.copytree(runs / TOY / "poses-3", tmp_path / TOY / "poses-3")
    kind = StoredRecordings if stores_drawn else DrawnRecordings
    gather, calls = kind.gather, []

    def dying(self: Any, rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        calls.append(rows.shape == (3, 1))
        if sum(calls) == 3:
            raise Killed
        return gather(self, rows, numbers)

    def train(stores: bool) -> Path:
        with compiling():  # As the run that it is compared with.
            encoder = embed(
                domain.task, "hvae-video", budget="smoke", stores_drawn=stores, runs=tmp_path
            )
        return encoder.path

    with monkeypatch.context() as patch:
        patch.setattr(kind, "gather", dying)
        with pytest.raises(Killed):
            train(stores_drawn)
    folder = tmp_path / TOY / ENCODER
    assert Checkpointer(folder / "checkpoints").steps("latest")[-1] == 2
    assert (tmp_path / TOY / "frames-3").exists() == stores_drawn
    # What was drawn on demand goes on with stored frames; what was stored goes on as it began.
    assert train(True) == folder
    assert_same_run(folder, runs / TOY / ENCODER)
    frames = np.load(tmp_path / TOY / "frames-3" / "recordings.npy")
    np.testing.assert_array_equal(frames[..., 0], simulated(3))


@pytest.mark.integration
def test_the_frozen_encoder_reads_frames(runs: Path, tmp_path: Path) -> None:
    """Paper algorithm 2: of the actions themselves, and nothing but frames."""
    encoder = runs / TOY / ENCODER
    np.savez(tmp_path / "new.npz", ids=np.arange(24), recordings=simulated(3)[..., None])
    output = run(
        "embed",
        f"--checkpoint={encoder}",
        f"--observations={tmp_path / 'new.npz'}",
        f"--output={tmp_path / 'new_table.npz'}",
    )
    assert "24 actions, 4 numbers each" in output
    new = RepresentationTable.load(tmp_path / "new_table.npz")
    own = RepresentationTable.load(encoder / "table.npz")
    np.testing.assert_allclose(new.vectors, own.vectors, atol=1e-6)
    np.savez(tmp_path / "poses.npz", ids=np.array([1]), recordings=np.zeros((1, 2, 2, 4, 3)))
    with pytest.raises(ObservationsError, match=r"expected \(1, 2, 2, 48, 48, 1\)"):
        Recordings.load(tmp_path / "poses.npz").fits(video_task.VIDEO.seen)


def simulated(num_recordings: int) -> np.ndarray:
    """u8[24, S, 2, 48, 48] frames drawn while the world is simulated."""
    frames = record_images(REPRESENTATION_SEED, video_task.TOOL_OF, num_recordings)
    return frames[:, :, SEEN]


@pytest.mark.unit
def test_recordings_of_both_kinds_are_those_of_the_simulations(tmp_path: Path) -> None:
    domain = Domain.of(video_task.TASK)
    made = {
        stores: collect(domain, tmp_path, 2, video_task.VIDEO, stores, seed=9)
        for stores in (False, True)
    }
    expected = record_images(9, video_task.TOOL_OF, 2)[:, :, SEEN, ..., None]
    ids, numbers = np.array([5, 20, 11]), np.array([[1], [0], [1]])
    for recordings in made.values():
        source: Any = recordings.for_training(ids)
        assert source.shape == (3, 2, 2, 48, 48, 1)
        found = source.gather(np.arange(3)[:, None], numbers)
        np.testing.assert_array_equal(found, expected[ids[:, None], numbers])
        first: Any = recordings.for_encoding(ids, 1)
        assert first.shape == (3, 1, 2, 48, 48, 1)
        np.testing.assert_array_equal(first.gather(np.array([2]), np.array([0])), expected[[11], 0])
        whole: Any = recordings.for_encoding()
        assert whole.shape == expected.shape
    assert made[True].recorded.hash == made[False].recorded.hash
    assert made[False].drawn is None
    states = collect(domain, tmp_path, 2, video_task.STATES, seed=9)
    of_states = np.asarray(states.for_training(ids))
    np.testing.assert_array_equal(of_states, video_task.record_states(9, ids, 2))
    np.testing.assert_array_equal(states.for_encoding(ids, 1), of_states[:, :1])


@pytest.mark.unit
def test_stored_frames_are_gone_on_with_and_belong_to_their_poses(tmp_path: Path) -> None:
    domain = Domain.of(video_task.TASK)
    made = collect(domain, tmp_path, 1, video_task.VIDEO, stores_drawn=True, seed=9)
    assert made.drawn is not None
    before = made.drawn.hash
    data = np.lib.format.open_memmap(tmp_path / TOY / "frames-1" / "recordings.npy", "r+")
    data[3] = 0  # A damaged action is drawn again.
    data.flush()
    with pytest.warns(UserWarning, match="action 3 is damaged"):
        again = collect(domain, tmp_path, 1, video_task.VIDEO, stores_drawn=True, seed=9)
    assert again.drawn is not None
    assert again.drawn.hash == before
    shutil.rmtree(tmp_path / TOY / "poses-1")
    with pytest.raises(ObservationsError, match="drawn_from"):
        collect(domain, tmp_path, 1, video_task.VIDEO, stores_drawn=True, seed=10)


@pytest.mark.contract
@pytest.mark.parametrize("name", ["create-push", "create-funnel-no-subgoals", "create-analysis"])
def test_every_create_task_has_videos(name: str) -> None:
    domain = Domain.of(load_task(name))
    for representation in ("hvae-video", "vae-video-oracle"):
        kind, play, modality, _ = parse_representation(domain, representation)
        assert kind == representation.partition("-")[0]
        assert (modality.name, modality.image_shape) == ("video", (48, 48, 1))
        assert play.seen.shape == (7, 48, 48, 1)
        assert set(play.stage_one) == {"smoke", "laptop", "paper"}
        budget = domain.stage_one(play, "paper")
        config = budget.config(kind, 1098, 1098)
        sizes = config.actions_per_batch, config.recordings_per_action, config.num_steps
        assert (sizes, budget.num_recordings) == ((32, 45, 170_000), 1024)
        assert not budget.stores_drawn
        laptop = domain.stage_one(play, "laptop").num_recordings
        kinds = (play.format, play.seen)
        assert name == "create-analysis" or (
            sum(kind.estimate_bytes(2366, laptop) for kind in kinds) < 1e9
        )
    spacing, last = (3, 10876) if name == "create-analysis" else (15, 2365)
    assert domain.universe.num_actions == last + 1
    recorder: Any = play.record_block
    made = Recorder(5, 1, **recorder._settings).step(last - 1, np.zeros(0)).observation
    poses = made.view(np.float64).reshape(1, 7, 4, 3)
    assert play.drawing is not None
    frames = play.drawing.draw(np.array([last - 1]), poses)
    expected = record_images(5, [last - 1], 1, PlayConfig(angle_spacing=spacing))
    np.testing.assert_array_equal(frames[..., 0], expected[0])
    assert parse_representation(domain, "hvae").play is domain.play
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
