"""Stage one from a script: recordings, an encoder, its table, and tables by name."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew import embedding
from jaxnew.actions import SplitMismatch
from jaxnew.embedding import (
    SPLIT_FILE,
    TABLE_FILE,
    UNTRAINED_FILE,
    WEIGHTS_FILE,
    Encoder,
    embed,
    find_table,
)
from jaxnew.observations import ObservationsError, Recordings
from jaxnew.recording import REPRESENTATION_SEED, collect, parse_representation
from jaxnew.representation.table import RepresentationTable, engineered_table, random_table
from jaxnew.storage.checkpoint import CheckpointError
from jaxnew.storage.config import ConfigError
from jaxnew.storage.files import StorageError
from jaxnew.storage.metrics import read
from jaxnew.storage.run_directory import ConfigMismatch, RunDirectory, RunDirectoryError
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.training import train
from tests import toy_device, toy_task, video_task

pytestmark = pytest.mark.integration

LADDER, VIDEO = toy_device.TASK, video_task.TASK
DOMAIN = Domain.of(LADDER)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def encoder(runs: Path) -> Encoder:
    return embed(LADDER, "hvae", budget="smoke", runs=runs)


# Names.


def test_names_say_kind_play_and_modality() -> None:
    kind, play, modality, appends_changes = parse_representation(DOMAIN, "vae")
    assert (kind, play, modality.name, appends_changes) == ("vae", toy_device.PLAY, "way", False)
    changes = parse_representation(DOMAIN, "hvae-way-changes-oracle")
    assert (changes.kind, changes.modality.name, changes.appends_changes) == ("hvae", "way", True)
    assert parse_representation(DOMAIN, "vae-changes").appends_changes
    assert parse_representation(DOMAIN, "hvae-way-oracle").kind == "hvae"
    domain = Domain.of(VIDEO)
    assert parse_representation(domain, "hvae").play is video_task.STATES
    assert parse_representation(domain, "vae-video").play is video_task.VIDEO
    assert parse_representation(domain, "hvae-video-oracle").modality.name == "video"


@pytest.mark.parametrize("name", ["have", "hvae-video", "hvae-oracle-way", "gt3"])
def test_other_names_are_refused_with_those_that_are_legal(name: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_representation(DOMAIN, name)
    for words in (repr(name), "hvae, vae, hvae-way, vae-way", "engineered: gt3", "random-SIZE"):
        assert words in str(caught.value)


# Recordings.


def test_recordings_lie_where_tasks_with_the_same_actions_find_them(runs: Path) -> None:
    shared = Domain.of(replace(LADDER, name="other", actions_name="ladders"))
    found = collect(shared, runs, 2)
    assert (runs / "ladders" / "recordings-2" / "manifest.json").exists()
    assert found.drawn is None
    expected = toy_device.record(REPRESENTATION_SEED, np.arange(toy_device.A), 2)
    np.testing.assert_array_equal(found.recorded.data, expected)
    ids = np.array([5, 2])
    np.testing.assert_array_equal(found.for_training(ids), expected[ids])
    np.testing.assert_array_equal(found.for_encoding(), expected)
    np.testing.assert_array_equal(found.for_encoding(ids, 1), expected[ids, :1])


def test_drawn_recordings_are_the_same_stored_or_on_demand(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    domain, ids = Domain.of(VIDEO), np.array([4, 1])
    on_demand = collect(domain, runs, 2, video_task.VIDEO)
    said = capsys.readouterr().out
    assert "24 actions x 2 recordings take" in said
    assert "they are drawn on demand" in said
    stored = collect(domain, runs, 2, video_task.VIDEO, stores_drawn=True)
    assert "they are stored" in capsys.readouterr().out
    assert on_demand.drawn is None
    assert stored.drawn is not None
    assert (runs / "toy-video" / "frames-2" / "manifest.json").exists()
    rows, recordings = np.array([[1, 0]]), np.array([[0, 1, 1]])
    batches = [
        found.for_training(ids).gather(rows.T, recordings)  # type: ignore[union-attr]
        for found in (on_demand, stored)
    ]
    np.testing.assert_array_equal(batches[0], batches[1])
    assert batches[0].dtype == np.uint8
    assert batches[0].any()


# Encoders.


def test_a_run_lies_where_it_says_and_explains_itself(encoder: Encoder, runs: Path) -> None:
    assert encoder.path == runs / "toy-ladder" / "embed-hvae-default-smoke-31"
    config = encoder.config
    assert (config.task, config.representation) == ("tests.toy_device:TASK", "hvae")
    assert (config.split, config.split_seed, config.split_hash) == (
        "default",
        0,
        DOMAIN.split.hash,
    )
    assert (config.seed, config.train_on, config.model.num_steps) == (31, "train", 4)
    assert encoder.is_finished
    assert (encoder.path / SPLIT_FILE).exists()
    assert [report["step"] for report in read(encoder.path)] == [2, 4]
    sessions = RunDirectory.load(encoder.path).provenance["sessions"]
    assert sessions[0]["table_hash"] == encoder.table.hash


def test_the_table_covers_every_action(encoder: Encoder) -> None:
    table = encoder.table
    assert table.vectors.shape == (toy_device.A, 4)
    table.check(DOMAIN.universe, DOMAIN.split)
    assert table.source == "hvae, smoke, seed 31"
    assert np.ptp(table.vectors, axis=0).min() > 0
    with pytest.raises(SplitMismatch, match="split"):
        table.check(DOMAIN.universe, Domain.of(LADDER, split_seed=1).split)


def test_mean_changes_follow_what_the_same_encoder_makes(encoder: Encoder, runs: Path) -> None:
    """In its table, and of new recordings."""
    other = embed(LADDER, "hvae-changes", budget="smoke", runs=runs)
    size = encoder.table.vectors.shape[1]
    np.testing.assert_array_equal(other.table.vectors[:, :size], encoder.table.vectors)
    steps, numbers = toy_device.PLAY.format.shape
    assert other.table.vectors.shape[1] == size + (steps - 1) * numbers
    old = collect(DOMAIN, encoder.path.parents[1], 3).recorded.select(np.array([1, 4]))
    np.testing.assert_allclose(other.encode(old).vectors, other.table.rows(old.ids), atol=1e-5)


def test_images_have_no_changes_to_append() -> None:
    with pytest.raises(UsageError, match=r"'hvae-video-changes': .* 'video' are not; leave out"):
        parse_representation(Domain.of(VIDEO), "hvae-video-changes")


def test_a_finished_run_is_found_complete(
    encoder: Encoder, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = embed("tests.toy_device:TASK", budget="smoke", runs=str(runs))
    assert "already complete" in capsys.readouterr().out
    assert again.table.hash == encoder.table.hash
    loaded = Encoder.load(str(encoder.path))
    assert loaded.table.hash == encoder.table.hash
    assert (loaded.task.name, loaded.config) == ("toy-ladder", encoder.config)
    assert Encoder.load(encoder.path, replace(LADDER, name="mine")).task.name == "mine"


def test_settings_make_another_run(encoder: Encoder, runs: Path, tmp_path: Path) -> None:
    for changes in ({"model.action_latent": 3}, ["model.action_latent=3"]):
        with pytest.raises(ConfigMismatch, match=r"model\.action_latent: 4 recorded, 3 asked"):
            embed(LADDER, "hvae", budget="smoke", runs=runs, set=changes)
    others: dict[str, Any] = {"workdir": tmp_path, "set": changes, "seed": 7, "num_recordings": 2}
    other = embed(LADDER, "hvae-oracle", budget="smoke", runs=runs, **others)
    assert (other.path, other.table.vectors.shape[1], other.config.seed) == (tmp_path, 3, 7)
    assert other.config.train_on == "all"
    assert other.config.observations_hash == collect(DOMAIN, runs, 2).recorded.hash
    assert other.config.observations_hash != encoder.config.observations_hash


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"representation": "gt3"}, UsageError, "Unknown representation 'gt3'"),
        ({"budget": "paper"}, UsageError, "Stage one has no budget 'paper'"),
        ({"split": "full"}, UsageError, "has no split 'full'"),
        ({"seed": -1}, ConfigError, "seed=-1 must be an integer"),
        ({"set": {"train_on": "all"}}, ConfigError, "train_on cannot be set; give the -oracle"),
        ({"set": ["observations_hash=x"]}, ConfigError, "observations_hash cannot be set; it fol"),
        ({"set": {"model.num_steps": 0}}, ConfigError, "num_steps=0 must be positive"),
        ({"task": toy_task.TASK}, UsageError, "toy has no play environment"),
    ],
)
def test_what_cannot_be_is_refused(
    runs: Path, encoder: Encoder, arguments: dict[str, Any], error: type[Exception], says: str
) -> None:
    before = set((runs / "toy-ladder").iterdir())
    given = {"task": LADDER, "representation": "hvae", "budget": "smoke", **arguments}
    with pytest.raises(error, match=says):
        embed(runs=runs, **given)
    assert set((runs / "toy-ladder").iterdir()) == before


def test_new_recordings_are_encoded(encoder: Encoder, tmp_path: Path) -> None:
    """Of actions that did not exist, in a file; recordings that it learned from give its table."""
    seen = toy_device.PLAY.format
    ids = np.array([901, 77], np.int32)
    np.savez(tmp_path / "new.npz", ids=ids, recordings=toy_device.record(5, ids % 24, 2))
    table = encoder.encode(Recordings.load(tmp_path / "new.npz"))
    assert table.ids.tolist() == [77, 901]
    assert table.vectors.shape == (2, 4)
    assert (table.universe_hash, table.split_hash) == (None, DOMAIN.split.hash)
    assert table.source == "hvae of embed-hvae-default-smoke-31, new recordings"
    old = collect(DOMAIN, encoder.path.parents[1], 3).recorded
    again = encoder.encode(old)
    # The same numbers, in another batch.
    np.testing.assert_allclose(again.vectors, encoder.table.vectors, rtol=1e-4, atol=1e-5)
    np.savez(tmp_path / "wrong.npz", ids=ids, recordings=np.zeros((2, 2, 9), np.float32))
    with pytest.raises(ObservationsError, match=r"expected \(2, 2, 3, 2\)"):
        encoder.encode(Recordings.load(tmp_path / "wrong.npz"))
    learner, _, play = encoder.frozen()
    assert (learner.config, play.seen) == (encoder.config.model, seen)


def test_weights_of_other_files(encoder: Encoder, tmp_path: Path) -> None:
    """Those of a checkpoint, as older runs keep them; damaged ones; those of another encoder."""
    copy = tmp_path / "copy"
    shutil.copytree(encoder.path, copy)
    mine = replace(encoder, path=copy)
    file = copy / WEIGHTS_FILE
    kept = file.read_bytes()
    file.unlink()
    jax.tree.map(np.testing.assert_array_equal, mine.frozen()[1], encoder.frozen()[1])
    file.write_bytes(kept[:-100])
    with pytest.raises(CheckpointError, match=f"{file} is damaged"):
        mine.frozen()
    arrays = dict(np.load(io.BytesIO(kept)))
    name, leaf = next((name, leaf) for name, leaf in arrays.items() if leaf.ndim == 2)
    for other in ({**arrays, name: leaf.T[:-1]}, {**arrays, "params/more": leaf}):
        np.savez(file, **other)
        with pytest.raises(CheckpointError, match=r"another encoder than config\.json describes"):
            mine.frozen()


def test_a_flat_vae_that_draws_one_recording_of_an_action_is_frozen(tmp_path: Path) -> None:
    few = {"model.actions_per_batch": 24, "model.recordings_per_action": 1}
    flat = embed(LADDER, "vae", budget="smoke", set=few, runs=tmp_path)
    data = collect(DOMAIN, tmp_path, 3).recorded
    np.testing.assert_allclose(flat.encode(data).vectors, flat.table.vectors, atol=1e-5)


def test_an_export_is_small_and_says_nothing_of_its_maker(encoder: Encoder, tmp_path: Path) -> None:
    exported = Encoder.load(encoder.export(tmp_path / "mine"), LADDER)
    names = ["config.json", "provenance.json", "split.json", "table.npz", "weights.npz"]
    assert sorted(file.name for file in exported.path.iterdir()) == names
    for session in RunDirectory.load(exported.path).provenance["sessions"]:
        assert not {"command", "machine", "devices"} & set(session)
    assert exported.table.hash == encoder.table.hash
    np.savez(tmp_path / "new.npz", ids=[0, 1], recordings=toy_device.record(5, np.arange(2), 2))
    new = Recordings.load(tmp_path / "new.npz")
    np.testing.assert_array_equal(exported.encode(new).vectors, encoder.encode(new).vectors)
    with pytest.raises(StorageError, match="mine cannot be written: File exists"):
        encoder.export(tmp_path / "mine")
    with pytest.raises(UsageError, match="was interrupted"):
        replace(encoder, _table=None).export(tmp_path / "other")


def test_half_an_export_is_no_run(
    encoder: Encoder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(embedding, "write_arrays", stopped)
    with pytest.raises(KeyboardInterrupt):
        encoder.export(tmp_path / "mine")
    with pytest.raises(RunDirectoryError, match="it has no provenance"):
        Encoder.load(tmp_path / "mine", LADDER)


def stopped(*args: Any) -> None:
    raise KeyboardInterrupt


def test_its_report_is_kept(encoder: Encoder) -> None:
    numbers = encoder.report()
    assert RunDirectory.load(encoder.path).evaluation("representation") == numbers
    assert "rungs" in json.dumps(numbers)
    others = encoder.references()
    assert list(others) == ["random", "untrained", "gt3"]
    assert all(other.keys() == numbers.keys() and other != numbers for other in others.values())
    learner, _, _ = encoder.frozen()
    data = collect(DOMAIN, encoder.path.parents[1], 3)
    start = learner.init(jax.random.key(encoder.config.seed), (8, 3, 3, 2))
    untrained = RepresentationTable.load(encoder.path / UNTRAINED_FILE)
    np.testing.assert_array_equal(learner.encode(start, data.recorded.data), untrained.vectors)


def test_an_interrupted_run_has_no_table(encoder: Encoder, tmp_path: Path) -> None:
    unfinished = replace(encoder, _table=None)
    assert not unfinished.is_finished
    with pytest.raises(UsageError, match="was interrupted; embed again to go on"):
        _ = unfinished.table
    with RunDirectory.open_or_create(tmp_path / "run", {"task": "grid_world"}):
        pass
    with pytest.raises(ConfigError, match="is no run of an encoder: its config has no model"):
        Encoder.load(tmp_path / "run")


# Tables by name.


def test_tables_are_found_by_name(encoder: Encoder, runs: Path, tmp_path: Path) -> None:
    expected = {
        "gt3": engineered_table(DOMAIN.universe, "gt3"),
        "random-5": random_table(DOMAIN.universe, 5, REPRESENTATION_SEED),
        str(encoder.path): encoder.table,
        str(encoder.path / TABLE_FILE): encoder.table,
        "hvae": encoder.table,
    }
    for name, table in expected.items():
        assert find_table(DOMAIN, runs, name, "smoke").hash == table.hash, name
    other = Domain.of(LADDER, split_seed=1)
    with pytest.raises(SplitMismatch, match="split"):
        find_table(other, runs, str(encoder.path), "smoke")
    with pytest.raises(UsageError, match="Unknown representation 'random-'"):
        find_table(DOMAIN, runs, "random-", "smoke")


def test_an_encoder_that_is_not_there_is_trained(
    encoder: Encoder, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the split and the seed of the split of the run, with a budget of its own."""
    train(LADDER, "vae", budget="smoke", split_seed=1, runs=runs, set={"num_updates": 1})
    path = runs / "toy-ladder" / "embed-vae-default-split1-smoke-31"
    assert Encoder.load(path).config.split_seed == 1
    assert "Training vae (4 steps; seconds)" in capsys.readouterr().out
    with pytest.raises(UsageError, match="Stage one has no budget 'paper'"):
        train(LADDER, "vae", budget="smoke", representation_budget="paper", runs=runs)
