"""Recordings on disk: resumable, independent of block size, and checked when they are loaded.

Run as a script, `test_collection.py DIRECTORY`, it is the collection that the tests kill.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnew.actions import ActionUniverse
from jaxnew.collection import collect, load
from jaxnew.observations import ObservationsError, RecordingFormat, Recordings, action_rng
from jaxnew.storage.files import take_lock
from tests.kills import Killed, dying

ROOT = Path(__file__).resolve().parents[2]
NUM_ACTIONS, NUM_RECORDINGS = 23, 4
FORMAT = RecordingFormat("Toy-v0 play", (3, 2), "uint8", 0, 200)


def make_universe(name: str = "Toy-v0") -> ActionUniverse:
    return ActionUniverse(
        name=name,
        class_labels=np.zeros(NUM_ACTIONS, np.int32),
        class_names=("only",),
        primary_parameter=np.arange(NUM_ACTIONS, dtype=float),
        action_names=tuple(f"action {i}" for i in range(NUM_ACTIONS)),
        content=np.arange(NUM_ACTIONS),
    )


def record(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    shape = (num_recordings, *FORMAT.shape)
    return np.stack(
        [action_rng(seed, int(i)).integers(0, 201, shape).astype(np.uint8) for i in ids]
    )


def gather(path: Path, record_block: Any = record, **changes: Any) -> Recordings:
    arguments: dict[str, Any] = {
        "format": FORMAT,
        "universe": make_universe(),
        "ids": np.arange(NUM_ACTIONS),
        "num_recordings": NUM_RECORDINGS,
        "seed": 5,
        "block_actions": 4,
    }
    return collect(path, record_block, **{**arguments, **changes})


def contents(path: Path) -> dict[str, bytes]:
    return {name: (path / name).read_bytes() for name in ("manifest.json", "recordings.npy")}


@pytest.mark.unit
def test_collected_recordings_are_those_of_the_recorder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ids = np.array([7, 3, 22])
    found = gather(tmp_path, ids=ids, play_settings={"has_border": True})
    # 3 actions x 4 recordings x 6 bytes.
    assert FORMAT.estimate_bytes(3, 4) == 72
    assert "3 actions x 4 recordings, 0.0 MB" in capsys.readouterr().out
    assert (found.num_actions, found.num_recordings) == (3, 4)
    assert found.ids.dtype == np.int32
    np.testing.assert_array_equal(found.data, record(5, ids, NUM_RECORDINGS))
    assert isinstance(found.data, np.memmap)
    assert not found.data.flags.writeable
    loaded = load(tmp_path, make_universe())
    assert loaded.hash == found.hash
    assert loaded.format == FORMAT
    assert loaded.universe_hash == make_universe().hash


@pytest.mark.property
@settings(max_examples=15, deadline=None)
@given(block=st.integers(1, 30), seed=st.integers(0, 3))
def test_the_block_size_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory, block: int, seed: int
) -> None:
    path = tmp_path_factory.mktemp("recordings")
    gather(path / "a", block_actions=block, seed=seed)
    gather(path / "b", block_actions=NUM_ACTIONS, seed=seed)
    assert contents(path / "a") == contents(path / "b")


@pytest.mark.unit
def test_the_recorder_always_gets_blocks_of_one_size(tmp_path: Path) -> None:
    sizes = []

    def counting(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        sizes.append(len(ids))
        return record(seed, ids, num_recordings)

    gather(tmp_path / "a", counting, block_actions=10)
    assert sizes == [10, 10, 10]
    sizes.clear()
    gather(tmp_path / "b", counting, block_actions=100)
    assert sizes == [NUM_ACTIONS]
    sizes.clear()
    gather(tmp_path / "a", counting)
    assert sizes == []


@pytest.mark.integration
def test_killed_at_every_instant_and_resumed(tmp_path: Path) -> None:
    gather(tmp_path / "whole")
    for at in range(50):
        path, is_killed, dies = tmp_path / str(at), False, dying(at)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "replace", dies(os.replace))
            patch.setattr(os, "fsync", dies(os.fsync))
            patch.setattr(np.lib.format, "open_memmap", dies(np.lib.format.open_memmap))
            try:
                gather(path, dies(record), block_actions=8)
            except Killed:
                is_killed = True
        # At the very last instants everything is there, though collect did not return.
        is_complete = path.exists() and "null" not in _text(path / "manifest.json")
        if not is_complete:
            with pytest.raises(ObservationsError, match=r"unfinished|no manifest"):
                load(path, make_universe())
        else:
            load(path, make_universe())
        assert is_complete or is_killed
        gather(path, block_actions=3)
        assert contents(path) == contents(tmp_path / "whole")
        shutil.rmtree(path)
        if not is_killed:
            assert at > 10  # Every instant was tried.
            return
    pytest.fail("50 instants were not enough")


@pytest.mark.integration
def test_a_sigkilled_process_is_continued(tmp_path: Path) -> None:
    gather(tmp_path / "whole", block_actions=1)
    rng, num_kills = random.Random(0), 0
    command = [sys.executable, __file__, str(tmp_path / "killed")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for _ in range(3):
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            while "recording" not in process.stdout.readline():
                assert process.poll() is None
            time.sleep(rng.uniform(0.0, 0.2))
            if process.poll() is None:
                process.kill()
                num_kills += 1
    recorded = []

    def counting(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        recorded.extend(ids.tolist())
        return record(seed, ids, num_recordings)

    gather(tmp_path / "killed", counting, block_actions=1)
    assert num_kills >= 1
    assert len(recorded) < NUM_ACTIONS  # What was finished is kept.
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


def _text(path: Path) -> str:
    return path.read_text() if path.exists() else "null"


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 0x10
    path.write_bytes(content)


def cut(path: Path, length: int) -> None:
    path.write_bytes(path.read_bytes()[:length])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("damage", "text", "is_warned"),
    [
        (lambda p: flip(p / "recordings.npy", -1), "action 22 has other bytes", "action 22"),
        (lambda p: flip(p / "recordings.npy", 128), "action 0 has other bytes", "action 0"),
        (lambda p: flip(p / "recordings.npy", 1), "missing or damaged", "everything again"),
        (lambda p: cut(p / "recordings.npy", 300), "missing or damaged", "everything again"),
        (lambda p: cut(p / "recordings.npy", 0), "missing or damaged", "everything again"),
        (lambda p: (p / "recordings.npy").unlink(), "missing or damaged", "everything again"),
        (
            lambda p: np.save(p / "recordings.npy", np.zeros((2, 2), np.uint8)),
            r"has shape \(2, 2\)",
            "everything again",
        ),
    ],
)
def test_damaged_recordings_are_refused_and_made_again(
    tmp_path: Path, damage: Any, text: str, is_warned: str
) -> None:
    gather(tmp_path)
    whole = contents(tmp_path)
    damage(tmp_path)
    with pytest.raises(ObservationsError, match=text):
        load(tmp_path, make_universe())
    with pytest.warns(UserWarning, match=is_warned):
        gather(tmp_path)
    assert contents(tmp_path) == whole
    load(tmp_path, make_universe())


@pytest.mark.unit
def test_a_damaged_or_absent_manifest_is_refused(tmp_path: Path) -> None:
    gather(tmp_path)
    manifest = tmp_path / "manifest.json"
    whole = manifest.read_bytes()
    for content in (b"", b"[]", b"{}", whole[:-9], whole.replace(b'"seed": 5', b'"seed": 4')):
        assert content != whole
        manifest.write_bytes(content)
        for action in (lambda: load(tmp_path, make_universe()), lambda: gather(tmp_path)):
            with pytest.raises(ObservationsError, match=r"manifest\.json is damaged"):
                action()
    manifest.unlink()
    with pytest.raises(ObservationsError, match=r"no manifest\.json: there are no recordings"):
        load(tmp_path, make_universe())
    with pytest.raises(ObservationsError, match="is not empty"):
        gather(tmp_path)
    with pytest.raises(ObservationsError, match="no recordings"):
        load(tmp_path / "absent", make_universe())


@pytest.mark.unit
def test_another_format_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gather(tmp_path)
    monkeypatch.setattr("jaxnew.collection.FORMAT_VERSION", 9)
    for read in (lambda: load(tmp_path, make_universe()), lambda: gather(tmp_path)):
        with pytest.raises(ObservationsError, match=r"of format 1; this program reads .* format 9"):
            read()


@pytest.mark.unit
def test_another_universe_is_refused(tmp_path: Path) -> None:
    gather(tmp_path)
    with pytest.raises(ObservationsError, match=r"of universe Toy-v0 .* asked for was Other-v0"):
        load(tmp_path, make_universe("Other-v0"))


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"seed": 6}, "seed: 5 recorded, 6 asked for"),
        ({"num_recordings": 3}, "num_recordings: 4 recorded, 3 asked for"),
        ({"ids": np.arange(5)}, "num_actions: 23 recorded, 5 asked for"),
        ({"ids": np.arange(NUM_ACTIONS)[::-1]}, "ids_hash"),
        ({"universe": make_universe("Other-v0")}, "universe.name: 'Toy-v0' recorded"),
        ({"play_settings": {"size": 3}}, r"play.size: \(absent\) recorded, 3 asked for"),
        ({"format": RecordingFormat("Toy-v0 play", (3, 2), "uint8")}, "format.low"),
    ],
)
def test_other_settings_are_named(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    gather(tmp_path)
    with pytest.raises(ObservationsError, match=text):
        gather(tmp_path, **changes)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"ids": np.zeros(0, np.int32)}, "non-empty list of integers"),
        ({"ids": np.array([0.5])}, "non-empty list of integers, got float64"),
        ({"ids": np.array([0, NUM_ACTIONS])}, r"action 23 is not in 0\.\.22"),
        ({"ids": np.array([-1])}, "action -1 is not in"),
        ({"ids": np.array([3, 3])}, "stands there twice"),
        ({"num_recordings": 0}, "must be at least 1"),
        ({"block_actions": 0}, "must be at least 1"),
    ],
)
def test_illegal_requests_are_refused(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ObservationsError, match=text):
        gather(tmp_path / "new", **changes)
    assert not (tmp_path / "new").exists()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda data: data[1:], r"has shape \(3, 4, 3, 2\), expected \(4, 4, 3, 2\)"),
        (lambda data: data.astype(np.int32), "has dtype int32, expected uint8"),
        (lambda data: data | 0xFF, r"has values in \[255, 255\], expected \[0, 200\]"),
    ],
)
def test_a_recorder_that_breaks_its_promise_is_stopped(
    tmp_path: Path, spoil: Any, text: str
) -> None:
    with pytest.raises(ObservationsError, match=text):
        gather(tmp_path, lambda *arguments: spoil(record(*arguments)))


@pytest.mark.unit
def test_floats_must_be_finite(tmp_path: Path) -> None:
    floats = RecordingFormat("Toy-v0 play", (3, 2), "float32")

    def recorder(value: float) -> Any:
        return lambda seed, ids, n: np.full((len(ids), n, 3, 2), value, np.float32)

    with pytest.raises(ObservationsError, match="not finite"):
        gather(tmp_path / "bad", recorder(np.nan), format=floats)
    assert gather(tmp_path / "good", recorder(1.5), format=floats).data.dtype == np.float32


@pytest.mark.unit
def test_too_small_a_disk_is_said_before_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(9, 9, 0))
    with pytest.raises(ObservationsError, match=r"needs 0\.013 MB, 0\.012 .* only 0\.000 MB are"):
        gather(tmp_path, lambda *arguments: pytest.fail("recorded all the same"))


@pytest.mark.unit
def test_one_process_collects_at_a_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "busy").mkdir()
    lock = take_lock(tmp_path / "busy" / ".lock")
    try:
        second = threading.Thread(target=gather, args=(tmp_path / "busy",))
        second.start()
        time.sleep(0.3)
        assert second.is_alive(), "it waits"
        assert not (tmp_path / "busy" / "manifest.json").exists()
    finally:
        os.close(lock)
    second.join(20)
    load(tmp_path / "busy", make_universe())
    assert f"Waiting for another process that collects in {tmp_path / 'busy'}" in (
        capsys.readouterr().out
    )


@pytest.mark.unit
def test_the_hash_is_that_of_the_content(tmp_path: Path) -> None:
    first = gather(tmp_path / "a")
    assert gather(tmp_path / "b").hash == first.hash
    assert gather(tmp_path / "c", seed=6).hash != first.hash


@pytest.mark.unit
def test_recordings_need_no_jax() -> None:
    code = "import sys, jaxnew.collection; print('jax' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == "False"


if __name__ == "__main__":

    def slowly(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        print("recording", flush=True)
        time.sleep(0.03)
        return record(seed, ids, num_recordings)

    gather(Path(sys.argv[1]), slowly, block_actions=1)
