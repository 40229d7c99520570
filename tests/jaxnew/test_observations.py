"""Recordings in memory and in small files: chosen by id, and checked when they are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnew.observations import (
    ObservationsError,
    RecordingFormat,
    Recordings,
    action_rng,
    row_hash,
)

NUM_ACTIONS, NUM_RECORDINGS = 23, 4
FORMAT = RecordingFormat("Toy-v0 play", (3, 2), "uint8", 0, 200)


def record(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    shape = (num_recordings, *FORMAT.shape)
    return np.stack(
        [action_rng(seed, int(i)).integers(0, 201, shape).astype(np.uint8) for i in ids]
    )


def recorded(ids: np.ndarray) -> Recordings:
    data = record(5, ids, NUM_RECORDINGS)
    return Recordings(data, ids, FORMAT, "a universe", tuple(map(row_hash, data)))


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 0x10
    path.write_bytes(content)


@pytest.mark.unit
def test_select_takes_rows_by_id_in_the_order_asked(tmp_path: Path) -> None:
    found = recorded(np.array([7, 3, 22]))
    np.save(tmp_path / "data.npy", found.data)
    mapped = replace(found, data=np.load(tmp_path / "data.npy", mmap_mode="r"))
    chosen = mapped.select(np.array([22, 7]))
    assert chosen.ids.tolist() == [22, 7]
    np.testing.assert_array_equal(chosen.data, record(5, np.array([22, 7]), NUM_RECORDINGS))
    assert not isinstance(chosen.data, np.memmap)
    assert chosen.hash != found.hash
    assert found.select(found.ids).hash == found.hash
    with pytest.raises(ObservationsError, match=r"No recordings of action 4 \(1 of 2"):
        found.select(np.array([3, 4]))


@pytest.mark.unit
def test_a_format_says_what_does_not_fit() -> None:
    """Shape, type and bounds; values are looked at where that is asked for."""
    data = record(0, np.arange(2), 1)
    assert FORMAT.problem(data, (2, 1, 3, 2), True) is None
    assert FORMAT.problem(data, (2, 3, 2), True) == ("has shape (2, 1, 3, 2), expected (2, 3, 2)")
    assert FORMAT.problem(data.astype(float), data.shape, True) == (
        "has dtype float64, expected uint8"
    )
    assert FORMAT.problem(data | 0xFF, data.shape, False) is None
    assert "values in [255, 255]" in str(FORMAT.problem(data | 0xFF, data.shape, True))
    floats = RecordingFormat("x", (), "f4")
    assert floats.dtype == "float32"
    assert floats.problem(np.float32([np.inf]), (1,), True) == "has a value that is not finite"
    assert FORMAT.estimate_bytes(3, 4) == 72  # 3 actions x 4 recordings x 6 bytes.


@pytest.mark.unit
def test_new_actions_travel_in_one_file(tmp_path: Path) -> None:
    found = recorded(np.array([7, 3]))
    found.save(tmp_path / "new.npz")
    new = Recordings.load(tmp_path / "new.npz").fits(FORMAT)
    np.testing.assert_array_equal(new.data, found.data)
    assert new.ids.tolist() == [7, 3]
    assert (new.universe_hash, new.hash) == (found.universe_hash, found.hash)
    assert new.action_hashes == found.action_hashes
    # By hand, for actions of no universe.
    np.savez(tmp_path / "hand.npz", ids=[900, 1], recordings=np.array(found.data[:, :1]))
    assert Recordings.load(tmp_path / "hand.npz").fits(FORMAT).num_recordings == 1


def good_arrays() -> dict[str, Any]:
    ids = np.array([1, 2])
    return {"ids": ids, "recordings": record(0, ids, 2)}


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"ids": np.array([1, 1])}, "stands there twice"),
        ({"ids": np.array([1])}, "has shape"),
        ({"ids": np.array([-4, 2])}, "ids: action -4 is not in 0"),
        ({"ids": np.array(["a", "b"])}, "list of integers"),
        ({"recordings": np.zeros((2, 2, 9), np.uint8)}, r"expected \(2, 2, 3, 2\)"),
        ({"recordings": np.zeros((2, 0, 3, 2), np.uint8)}, r"expected \[2, S"),
        ({"recordings": np.zeros((2, 2, 3, 2), np.float64)}, "has dtype float64"),
        ({"recordings": np.full((2, 2, 3, 2), 201, np.uint8)}, r"values in \[201, 201\]"),
        ({"recordings": np.array([None, 1], object)}, "is damaged"),
        ({"recordings": np.full((2, 2, 3, 2), "x")}, "has dtype <U1"),
        ({"modality": np.array("Other-v0 play")}, "'Other-v0 play'; the encoder knows"),
        ({"ids": None}, "lacks the array 'ids'"),
    ],
)
def test_files_of_new_actions_are_checked(
    tmp_path: Path, changes: dict[str, Any], text: str
) -> None:
    arrays = {**good_arrays(), **changes}
    kept = {name: value for name, value in arrays.items() if value is not None}
    np.savez(tmp_path / "new.npz", **kept)
    with pytest.raises(ObservationsError, match=text):
        Recordings.load(tmp_path / "new.npz").fits(FORMAT)


@pytest.mark.unit
def test_damaged_files_of_new_actions_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "new.npz"
    with pytest.raises(ObservationsError, match=r"is (missing|damaged)"):
        Recordings.load(path).fits(FORMAT)
    ids = np.arange(NUM_ACTIONS, dtype=np.int32)
    hashes = ("",) * NUM_ACTIONS
    Recordings(record(0, ids, 4), ids, FORMAT, None, hashes).save(path)
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ObservationsError, match=r"is (missing|damaged)"):
            Recordings.load(path).fits(FORMAT)
    rng = np.random.default_rng(0)
    for _ in range(60):
        path.write_bytes(whole)
        flip(path, int(rng.integers(len(whole))))
        try:
            found = Recordings.load(path).fits(FORMAT)
        except ObservationsError:
            continue
        # A byte that does not matter, such as a time stamp.
        np.testing.assert_array_equal(found.data, record(0, ids, 4))
