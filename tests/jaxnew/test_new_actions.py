"""Actions that a policy was not trained with: recorded, encoded, and played where they exist."""

from __future__ import annotations

import functools
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnew.actions import ActionIdentity, SplitMismatch
from jaxnew.embedding import Encoder, embed, find_table
from jaxnew.new_actions import offer
from jaxnew.observations import ObservationsError, Recordings
from jaxnew.recording import record
from jaxnew.representation.table import RepresentationTable
from jaxnew.run import Run
from jaxnew.storage.files import StorageError
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.training import finetune, train
from tests import toy_device

pytestmark = pytest.mark.integration

LADDER = toy_device.TASK
DOMAIN = Domain.of(LADDER)
A = toy_device.A
SHIFTED, GROWN = "3-30", "0-30"  # Its first is action 3 of ours, its last six are new.


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Encoder:
    return embed(LADDER, "hvae", budget="smoke", runs=tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module", params=["modulated", "nearest-neighbour", "continuous"])
def run(
    request: pytest.FixtureRequest, encoder: Encoder, tmp_path_factory: pytest.TempPathFactory
) -> Run:
    path = tmp_path_factory.mktemp(request.param)
    return train(LADDER, encoder.table, method=request.param, budget="smoke", workdir=path)


@pytest.fixture(scope="module")
def ours(encoder: Encoder, tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("ours")
    return train(LADDER, encoder.table, budget="smoke", workdir=path / "run")


def part_of(table: RepresentationTable, ids: np.ndarray, /, **changes: Any) -> RepresentationTable:
    """The rows of some actions, as of a table of its own."""
    assert table.identity is not None
    values = {
        "vectors": table.rows(ids),
        "ids": ids,
        "encoder_hash": table.made_by,
        "identity": table.identity.rows(ids),
    }
    return replace(table, **{**values, **changes})


def metrics(run: Run, table: RepresentationTable, **arguments: Any) -> Any:
    found = run.evaluate(table=table, episodes=12, record=False, **arguments)
    (row,) = found.rows.values()
    return row["metrics"]


def test_actions_are_recorded_encoded_and_played(
    encoder: Encoder, ours: Run, tmp_path: Path
) -> None:
    new = record(LADDER, "new", output=tmp_path / "new.npz", universe=SHIFTED, budget="smoke")
    assert new.ids.tolist() == list(range(21, 30))
    assert new.num_recordings == 3
    assert new.identity is not None
    assert new.identity.names == tuple(f"action {n}" for n in range(24, 33))
    assert (new.identity.universe, new.identity.place) == ("Ladder-v0", SHIFTED)
    assert [path.name for path in tmp_path.iterdir()] == ["new.npz"]
    expected = toy_device.record(31, new.ids, 3, range(3, 33))
    np.testing.assert_array_equal(new.data, expected)
    table = encoder.encode(new)
    assert (table.made_by, table.play) == (encoder.table.hash, "Ladder play")
    table.save(tmp_path / "table.npz")
    read = RepresentationTable.load(tmp_path / "table.npz")
    assert (read.identity, read.made_by) == (new.identity, encoder.table.hash)
    found = ours.evaluate(table=read, episodes=8)
    (row,) = found.rows.values()
    assert (row["num_seen"], row["num_actions"], row["universe"]) == (0, 9, "Ladder-v0")
    text = "9 actions of Ladder-v0, 0 seen in training, e.g. action 24; action 25; action 26"
    assert text in str(found)


def test_what_is_recorded_anew_is_what_was_recorded(encoder: Encoder, tmp_path: Path) -> None:
    """The same actions, numbers of recordings and seed: the same rows of the table."""
    ids = np.array([7, 2], np.int32)
    again = encoder.encode(record(LADDER, ids, output=tmp_path / "a.npz", budget="smoke"))
    np.testing.assert_allclose(again.vectors, encoder.table.rows(again.ids), atol=1e-6)
    parts = record(LADDER, "test", output=tmp_path / "b.npz", budget="smoke")
    assert parts.ids.tolist() == encoder.domain().split.test.tolist()
    (tmp_path / "ids.txt").write_text("3 1")
    listed = record(LADDER, tmp_path / "ids.txt", output=tmp_path / "c.npz", num_recordings=1)
    assert (listed.ids.tolist(), listed.num_recordings) == ([3, 1], 1)


def test_a_file_is_not_replaced_unless_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, ids = tmp_path / "a.npz", np.array([7, 2], np.int32)
    again = functools.partial(record, LADDER, output=file, budget="smoke")
    before = again(ids).hash
    with pytest.raises(StorageError, match=r"a\.npz exists already.*--overwrite"):
        again(ids[:1])
    assert Recordings.load(file).hash == before
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):  # Killed when the file was there.
            again(ids[:1], overwrite=True)
    assert again(ids[:1]).ids.tolist() == [7]
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"ids": "new"}, "has no action that task toy-ladder lacks"),
        ({"ids": "tests"}, "ids='tests' is neither all, new, train"),
        ({"universe": "more"}, "no universe 'more'; give FIRST-COUNT"),
        ({"representation": "hvae-film"}, "Unknown representation"),
        ({"budget": "huge"}, "no budget 'huge'"),
    ],
)
def test_what_cannot_be_recorded(tmp_path: Path, arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        record(LADDER, output=tmp_path / "x.npz", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_actions_are_what_they_do_and_not_their_numbers(encoder: Encoder, run: Run) -> None:
    """Ours under other numbers: played at home or in the other universe, the same episodes."""
    ids = np.arange(3, A, dtype=np.int32)
    at_home = part_of(encoder.table, ids)
    shifted = part_of(encoder.table, ids, ids=ids - 3)
    expected = metrics(run, at_home)
    assert metrics(run, shifted) == expected
    assert metrics(run, shifted, universe=SHIFTED) == expected
    # Taken as what they are not, they are others.
    nameless = replace(shifted, identity=None)
    assert metrics(run, nameless, allow=["unknown-actions"]) != expected
    assert metrics(run, nameless, allow=["unknown-actions"], universe=SHIFTED) == expected


def test_environments_receive_the_action_that_was_recorded(encoder: Encoder, ours: Run) -> None:
    """Of sets of one action there is only one way to go."""
    for number in (5, 26):
        there = LADDER.with_universe(SHIFTED).make_universe()
        ids = np.array([number - 3], np.int32)
        identity = ActionIdentity.of(there, ids, SHIFTED)
        row = part_of(encoder.table, np.array([1]), ids=ids, identity=identity)
        played = metrics(ours, row, set_size=1)
        ladder = toy_device.Ladder(4, 1.0, False).default_params
        rung, total = 0, 0.0
        for _ in range(4):
            total += float(ladder.reward[rung, number % A])
            terminated = bool(ladder.terminates[rung, number % A])
            rung = int(ladder.next_state[rung, number % A])
            if terminated:
                break
        assert played["final_state"]["mean"] == rung
        assert played["episode_return"]["mean"] == pytest.approx(total, rel=1e-5)


def test_a_universe_that_has_grown_is_known_again(encoder: Encoder, ours: Run) -> None:
    grown = LADDER.with_universe(GROWN)
    loaded = Run.load(ours.path, task=grown)
    before = ours.evaluate("test", episodes=12, record=False).rows["test"]
    after = loaded.evaluate("test", episodes=12, record=False).rows["test"]
    assert after["metrics"] == before["metrics"]
    ids = np.arange(A - 2, 30, dtype=np.int32)
    identity = ActionIdentity.of(grown.make_universe(), ids)
    vectors = np.zeros((len(ids), encoder.table.vectors.shape[1]), np.float32)
    new = RepresentationTable(
        vectors, ids, encoder_hash=encoder.table.hash, identity=identity, source="new"
    )
    found = offer(loaded.trainer, new)
    assert found.trainer is loaded.trainer
    assert found.vectors.shape == (30, vectors.shape[1])
    np.testing.assert_array_equal(found.vectors[: A - 2], encoder.table.vectors[: A - 2])
    assert set(found.ids.tolist()) == set(ids.tolist())
    assert loaded.evaluate(table=new, episodes=4, record=False).rows
    with pytest.raises(ValueError, match=r"hold action 29, and the table describes 0\.\.23"):
        loaded.evaluate(ids={"mine": ids}, episodes=4)
    with pytest.raises(SplitMismatch, match="was made for universe"):
        Run.load(ours.path, task=LADDER.with_universe(SHIFTED))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"identity": None}, r"does not say what its actions are.* allow unknown-actions"),
        ({"encoder_hash": "f" * 16}, r"is of encoder f{16}, .* allow other-encoder"),
        ({"encoder_hash": None}, "its vectors mean something else"),
    ],
)
def test_tables_of_something_else_are_refused(
    encoder: Encoder, ours: Run, changes: dict[str, Any], says: str
) -> None:
    table = part_of(encoder.table, np.arange(6), **changes)
    with pytest.raises(SplitMismatch, match=says):
        ours.evaluate(table=table)
    names = ["unknown-actions", "other-encoder"]
    assert ours.evaluate(table=table, allow=names, episodes=2, record=False).rows


def test_a_universe_that_lacks_them_is_refused_with_both_named(encoder: Encoder, ours: Run) -> None:
    there = LADDER.with_universe("40-8").make_universe()
    identity = ActionIdentity.of(there, np.arange(8))
    table = part_of(encoder.table, np.arange(8), identity=identity)
    says = r"8 actions of Ladder-v0; Ladder-v0 lacks 8 of them, e\.g\. 'action 40'\. Name the univ"
    with pytest.raises(SplitMismatch, match=says):
        ours.evaluate(table=table)
    assert metrics(ours, table, universe="40-8")
    with pytest.raises(UsageError, match="about the actions of a table; give one"):
        ours.evaluate(universe="40-8")
    with pytest.raises(UsageError, match="allow='nothing' is none of other-encoder, unknown"):
        ours.evaluate(table=table, allow=["nothing"])
    wide = part_of(encoder.table, np.arange(8), vectors=np.ones((8, 9), np.float32))
    with pytest.raises(UsageError, match="has 9 numbers per action; the policy reads 4"):
        ours.evaluate(table=wide)


def test_recordings_that_were_renumbered_or_are_of_another_play(
    encoder: Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "new.npz"
    record(LADDER, "test", output=path, budget="smoke")
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "ids": np.arange(len(arrays["ids"]))})
    with pytest.raises(ObservationsError, match="was edited"):
        Recordings.load(path)
    np.savez(path, **{**arrays, "modality": np.array("Other play")})
    with pytest.raises(ObservationsError, match="was edited"):
        Recordings.load(path)
    own = {name: arrays[name] for name in ("ids", "recordings")}
    np.savez(path, **own, modality=np.array("Other play"))
    with pytest.raises(ObservationsError, match="'Other play'; the encoder knows 'Ladder play'"):
        encoder.encode(Recordings.load(path))
    np.savez(path, **own)
    assert encoder.encode(Recordings.load(path)).identity is None
    older = replace(encoder, _table=replace(encoder.table, play="Ladder play 0"))
    with pytest.raises(ObservationsError, match=r"learned from 'Ladder play 0', .* 'Ladder play'"):
        older.encode(Recordings.load(path))


def test_files_of_a_run_that_were_exchanged_are_refused(
    encoder: Encoder, ours: Run, tmp_path: Path
) -> None:
    """By whoever reads them: evaluate, finetune, resume, and the encoder."""
    copy = tmp_path / "copy"
    shutil.copytree(ours.path, copy)
    other = replace(encoder.table, vectors=encoder.table.vectors + 1.0)
    other.save(copy / "table.npz")
    says = r"The table in .*copy is not the run's own: its hash is .*, on record is"
    for use in (Run.load, finetune):
        with pytest.raises(SplitMismatch, match=says):
            use(copy)
    with pytest.raises(SplitMismatch, match=says):
        train(LADDER, encoder.table, budget="smoke", workdir=copy)
    encoder.table.save(copy / "table.npz")
    split = replace(ours.split, train=ours.split.validation, validation=ours.split.train)
    split.save(copy / "split.json")
    replace(encoder.table, split_hash=split.hash).save(copy / "table.npz")
    says = says.replace("table", "split")
    for use in (Run.load, finetune):
        with pytest.raises(SplitMismatch, match=says):
            use(copy)
    with pytest.raises(SplitMismatch, match=says):
        train(LADDER, encoder.table, budget="smoke", workdir=copy)
    shutil.copytree(encoder.path, tmp_path / "encoder")
    other.save(tmp_path / "encoder" / "table.npz")
    for use in (Encoder.load, lambda path: find_table(DOMAIN, tmp_path, str(path), "smoke")):
        with pytest.raises(SplitMismatch, match=r"The table in .*encoder is not the run's own"):
            use(tmp_path / "encoder")
    (tmp_path / "encoder" / "table.npz").unlink()
    with pytest.raises(UsageError, match=r"encoder has no table\.npz: it was interrupted; embed"):
        find_table(DOMAIN, tmp_path, str(tmp_path / "encoder"), "smoke")
