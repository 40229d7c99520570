"""Collecting recordings of actions into a directory, whatever kills the process meanwhile.

NumPy only. A recording directory holds `recordings.npy`, all recordings as one memory-mapped array,
and `manifest.json`: what they are and the hash of each finished action. An action counts only once
its hash is in the manifest, so collecting can be killed at any instant and goes on later.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxnew.actions import ActionIdentity, ActionUniverse, content_hash
from jaxnew.observations import (
    ObservationsError,
    RecordingFormat,
    Recordings,
    checked_ids,
    row_hash,
)
from jaxnew.storage.config import differences
from jaxnew.storage.files import (
    StorageError,
    access,
    megabytes,
    read_json,
    remove_temporaries,
    take_lock,
    write_json_atomically,
)
from jaxnew.storage.progress import ProgressDisplay, say

KIND = "jaxnew action recordings"
FORMAT_VERSION = 1
MANIFEST = "manifest.json"
DATA = "recordings.npy"
_MANIFEST_BYTES = 100  # Per action: number and hash, in the manifest and in the one that follows.

RecordBlock = Callable[[int, np.ndarray, int], np.ndarray]


def collect(
    path: Path | str,
    record_block: RecordBlock,
    *,
    format: RecordingFormat,
    universe: ActionUniverse,
    ids: np.ndarray,
    num_recordings: int,
    seed: int,
    block_actions: int,
    play_settings: Mapping[str, Any] | None = None,
) -> Recordings:
    """Records actions into the directory `path`; goes on where an earlier call was killed.

    Says how large the result will be, and shows progress. Where another process collects there, it
    waits. Calling it again when everything is recorded only checks the recordings; damaged ones are
    made again.

    Args:
      record_block: `(seed, ids int32[n], num_recordings) -> [n, num_recordings, *format.shape]`,
        n always the same. The recordings of an id must depend on `seed`, the id and
        `num_recordings` only, not on the other ids (`action_rng`; `jax.random.fold_in(key, id)`):
        then the result does not depend on `block_actions`, nor on where a killed call stopped.
      ids: int[A] actions to record, in the order of the rows.
      block_actions: actions per call of `record_block` (at most A); only a matter of speed.
      play_settings: plain JSON; whatever else fixes the recordings, e.g. environment parameters.

    Raises:
      ObservationsError: `path` holds something else or recordings with other settings, the disk is
        too small, or `record_block` broke its promise.
      StorageError: the system refuses, e.g. because the disk is full. What is recorded is kept.
    """
    path = Path(path)
    ids = checked_ids(ids, universe, "collect")
    if num_recordings < 1 or block_actions < 1:
        raise ObservationsError(
            f"num_recordings={num_recordings} and block_actions={block_actions} must be at least 1."
        )
    settings = _settings(format, universe, ids, num_recordings, seed, play_settings or {})
    with access(path, "written"):
        path.mkdir(parents=True, exist_ok=True)
        is_foreign = not (path / MANIFEST).exists() and any(
            not name.startswith(".") for name in os.listdir(path)
        )
    if is_foreign:
        raise ObservationsError(
            f"{path} is not empty and has no {MANIFEST}. Choose another directory."
        )
    lock = _wait_for_lock(path)
    try:
        remove_temporaries(path)
        _Collection(path, format, ids, num_recordings, settings).run(
            record_block, seed, min(block_actions, len(ids))
        )
    finally:
        os.close(lock)
    return load(path, universe, verify=False)


def load(path: Path | str, universe: ActionUniverse, verify: bool = True) -> Recordings:
    """Opens recordings without reading them into memory.

    Args:
      universe: must be the one whose actions were recorded.
      verify: read every recording once, to compare its hash and check its values.

    Raises:
      ObservationsError: there are none, they are unfinished or damaged, or they belong to another
        universe.
    """
    path = Path(path)
    manifest = read_manifest(path)
    settings = manifest["settings"]
    recorded = settings["universe"]
    if recorded["hash"] != universe.hash:
        raise ObservationsError(
            f"{path} holds recordings of universe {recorded['name']} {recorded['hash']}, asked for "
            f"was {universe.name} {universe.hash}. Collect the actions of this universe."
        )
    hashes = manifest["action_hashes"]
    if None in hashes:
        raise ObservationsError(
            f"{path} is unfinished: {len(hashes) - hashes.count(None)} of {len(hashes)} actions "
            "are recorded. Run collect again with the same settings to go on."
        )
    format = RecordingFormat(**{**settings["format"], "shape": tuple(settings["format"]["shape"])})
    ids = checked_ids(np.array(manifest["ids"]), universe, str(path))
    data = open_data(path, format, (len(ids), settings["num_recordings"], *format.shape))
    for row in range(len(ids) if verify else 0):
        problem = format.problem(data[row], data.shape[1:], True)
        if problem is None and row_hash(data[row]) != hashes[row]:
            problem = "has other bytes than were recorded"
        if problem is not None:
            raise ObservationsError(
                f"{path}: the recording of action {ids[row]} {problem}. Run collect again to "
                "repair it."
            )
    identity = ActionIdentity.of(universe, ids)
    return Recordings(data, ids, format, universe.hash, tuple(hashes), identity)


def _wait_for_lock(path: Path) -> int:
    """The lock of a recording directory, once no other process collects there."""
    is_announced = False
    while True:
        try:
            return take_lock(path / ".lock")
        except BlockingIOError as err:
            if not is_announced:
                say(f"Waiting for another process that collects in {path} ({err}).")
                is_announced = True
            time.sleep(0.5)


def _settings(
    format: RecordingFormat,
    universe: ActionUniverse,
    ids: np.ndarray,
    num_recordings: int,
    seed: int,
    play_settings: Mapping[str, Any],
) -> dict[str, Any]:
    """What fixes the recordings, as plain JSON."""
    settings = {
        "universe": {"name": universe.name, "hash": universe.hash},
        "format": {
            "modality": format.modality,
            "shape": list(format.shape),
            "dtype": format.dtype,
            "low": format.low,
            "high": format.high,
        },
        "num_actions": len(ids),
        "ids_hash": content_hash(ids),
        "num_recordings": num_recordings,
        "seed": seed,
        "play": dict(play_settings),
    }
    return dict(json.loads(json.dumps(settings, allow_nan=False)))


class _Collection:
    """A recording directory that is being filled."""

    def __init__(
        self,
        path: Path,
        format: RecordingFormat,
        ids: np.ndarray,
        num_recordings: int,
        settings: dict[str, Any],
    ) -> None:
        self._path, self._format, self._ids = path, format, ids
        self._shape = (len(ids), num_recordings, *format.shape)
        self._hashes: list[str | None] = [None] * len(ids)
        self._settings = settings
        if (path / MANIFEST).exists():
            manifest = read_manifest(path)
            found = differences(manifest["settings"], settings)
            if found:
                lines = [
                    f"  {name}: {old!r} recorded, {new!r} asked for" for name, old, new in found
                ]
                raise ObservationsError(
                    f"{path} holds recordings with other settings:\n" + "\n".join(lines) + "\n"
                    "Choose another directory."
                )
            self._hashes = manifest["action_hashes"]

    def run(self, record_block: RecordBlock, seed: int, block: int) -> None:
        self._write_manifest()
        self._forget_damaged()
        pending = [row for row, digest in enumerate(self._hashes) if digest is None]
        done = len(self._ids) - len(pending)
        size = self._format.estimate_bytes(len(self._ids), self._shape[1])
        with ProgressDisplay("Recording", len(self._ids), "actions", done) as progress:
            progress.say(
                f"{self._format.modality}: {len(self._ids)} actions x {self._shape[1]} recordings, "
                f"{size / 1e6:,.1f} MB in {self._path}; {done} are there already."
            )
            for start in range(0, len(pending), block):
                rows = np.array(pending[start : start + block])
                # The last block is filled up, so that a compiled recorder is compiled once.
                padded = np.concatenate([rows, np.repeat(rows[:1], block - len(rows))])
                recorded = np.asarray(record_block(seed, self._ids[padded], self._shape[1]))
                problem = self._format.problem(recorded, (block, *self._shape[1:]), True)
                if problem is not None:
                    raise ObservationsError(f"What record_block returned {problem}.")
                self._store(rows, recorded[: len(rows)])
                progress.update(done + start + len(rows))

    def _forget_damaged(self) -> None:
        """Makes the data file if it is unusable; forgets the actions that it does not hold."""
        try:
            data = open_data(self._path, self._format, self._shape)
        except ObservationsError as err:
            if any(self._hashes):
                warnings.warn(f"{err} Recording everything again.", stacklevel=4)
            self._hashes = [None] * len(self._ids)
            self._write_manifest()
            self._create_data()
            return
        for row, digest in enumerate(self._hashes):
            if digest is not None and row_hash(data[row]) != digest:
                warnings.warn(
                    f"{self._path}: action {self._ids[row]} is damaged; recording it again.",
                    stacklevel=4,
                )
                self._hashes[row] = None

    def _create_data(self) -> None:
        manifests = _MANIFEST_BYTES * (100 + len(self._ids))
        needed = self._format.estimate_bytes(len(self._ids), self._shape[1]) + manifests
        with access(self._path / DATA, "written"):
            free = shutil.disk_usage(self._path).free
            if needed > free:
                raise ObservationsError(
                    f"{self._path} needs {megabytes(needed)}, {megabytes(manifests)} of it for the "
                    f"manifest, but only {megabytes(free)} are free. Record fewer actions or fewer "
                    "times, make room, or use another disk."
                )
            temporary = self._path / f".{DATA}"
            np.lib.format.open_memmap(temporary, "w+", np.dtype(self._format.dtype), self._shape)
            os.replace(temporary, self._path / DATA)

    def _store(self, rows: np.ndarray, recorded: np.ndarray) -> None:
        """Writes rows to disk, and only then says in the manifest that they are there."""
        data = open_data(self._path, self._format, self._shape)
        row_bytes = data.nbytes // len(data)
        # Plain writes: a full disk is an error here, but kills a process that writes to a map.
        with access(self._path / DATA, "written"), (self._path / DATA).open("r+b") as file:
            for row, recording in zip(rows.tolist(), recorded, strict=True):
                file.seek(data.offset + row * row_bytes)
                file.write(np.ascontiguousarray(recording).tobytes())
                self._hashes[row] = row_hash(recording)
            file.flush()
            os.fsync(file.fileno())
        self._write_manifest()

    def _write_manifest(self) -> None:
        manifest: dict[str, Any] = {
            "kind": KIND,
            "format_version": FORMAT_VERSION,
            "settings": self._settings,
            "ids": self._ids.tolist(),
            "action_hashes": self._hashes,
        }
        manifest["hash"] = manifest_hash(manifest)
        write_json_atomically(self._path / MANIFEST, manifest)


def manifest_hash(manifest: dict[str, Any]) -> str:
    """Hash of a manifest without its own `hash` entry."""
    return str(content_hash(json.dumps(manifest, sort_keys=True)))


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of the recording directory `path`, checked to be whole and of this format."""
    try:
        manifest = read_json(path / MANIFEST, ObservationsError)
        kind, version = manifest["kind"], manifest["format_version"]
        if kind != KIND or version != FORMAT_VERSION:
            raise ObservationsError(
                f"{path} holds {kind!r} of format {version}; this program reads {KIND!r} of "
                f"format {FORMAT_VERSION}. Collect again in another directory."
            )
        recorded_hash = manifest.pop("hash")
        if manifest_hash(manifest) != recorded_hash:
            raise KeyError("it does not have the hash recorded in it")
    except FileNotFoundError as err:
        raise ObservationsError(
            f"{path} has no {MANIFEST}: there are no recordings. Run collect first."
        ) from err
    except KeyError as err:
        raise ObservationsError(
            f"{path / MANIFEST} is damaged ({err!r}). Restore it from a copy, or move the "
            "directory away and collect again."
        ) from err
    return dict(manifest)


def open_data(path: Path, format: RecordingFormat, shape: tuple[int, ...]) -> np.memmap:
    """The memory-mapped recordings, read-only, with the right shape and dtype."""
    try:
        with access(path / DATA):
            (path / DATA).open("rb").close()
        data = np.load(path / DATA, mmap_mode="r", allow_pickle=False)
    except (FileNotFoundError, ValueError, EOFError) as err:
        if isinstance(err, StorageError):
            raise
        raise ObservationsError(
            f"{path / DATA} is missing or damaged ({err}). Run collect again to repair it."
        ) from err
    problem = format.problem(data, shape, False)
    if problem is not None:
        raise ObservationsError(f"{path / DATA} {problem}. Run collect again to repair it.")
    return cast(np.memmap, data)
