"""Recordings of what actions do: collected, saved, loaded. NumPy only.

A recording directory holds `recordings.npy`, all recordings as one memory-mapped array, and
`manifest.json`: what they are and the hash of each finished action. An action counts only once
its hash is in the manifest, so collecting can be killed at any instant and goes on later.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxnew._collection import RecordBlock, collect_into
from jaxnew._files import write_bytes_atomically
from jaxnew._recordings import (
    ActionObservations,
    ObservationsError,
    RecordingFormat,
    checked_ids,
    open_data,
    read_manifest,
    row_hash,
)
from jaxnew.actions import ActionUniverse

__all__ = [
    "ActionObservations",
    "ObservationsError",
    "RecordBlock",
    "RecordingFormat",
    "action_rng",
    "collect",
    "load",
    "load_npz",
    "save_npz",
]


def action_rng(seed: int, action_id: int) -> np.random.Generator:
    """Random numbers for recording one action, the same whatever else is recorded beside it."""
    return np.random.default_rng(np.random.SeedSequence([seed, action_id]))


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
) -> ActionObservations:
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
    """
    collect_into(
        Path(path),
        record_block,
        format=format,
        universe=universe,
        ids=ids,
        num_recordings=num_recordings,
        seed=seed,
        block_actions=block_actions,
        play_settings=play_settings or {},
    )
    return load(path, universe, verify=False)


def load(path: Path | str, universe: ActionUniverse, verify: bool = True) -> ActionObservations:
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
    return ActionObservations(data, ids, format, universe.hash, tuple(hashes))


def save_npz(path: Path | str, observations: ActionObservations) -> None:
    """Writes recordings as one small file with the arrays `ids`, `recordings` and `modality`."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        ids=observations.ids,
        recordings=observations.data,
        modality=np.array(observations.format.modality),
    )
    write_bytes_atomically(Path(path), buffer.getvalue())


def load_npz(path: Path | str, format: RecordingFormat) -> ActionObservations:
    """Reads recordings of new actions, which need not exist in any universe.

    Args:
      path: a file with `ids` int[A] (names of the new actions, each once), `recordings`
        [A, S, *format.shape] and, optionally, the string `modality`.
      format: what the encoder was trained on.

    Raises:
      ObservationsError: the file is missing or damaged, or what it holds does not fit `format`.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (
        OSError,
        ValueError,
        EOFError,
        AttributeError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as err:
        raise ObservationsError(
            f"{path} is missing or damaged ({err}); it must be an .npz file with the arrays `ids` "
            "and `recordings`."
        ) from err
    for name in ("ids", "recordings"):
        if name not in arrays:
            raise ObservationsError(f"{path} lacks the array {name!r}; it has {sorted(arrays)}.")
    modality = str(arrays.get("modality", format.modality))
    if modality != format.modality:
        raise ObservationsError(
            f"{path} holds recordings of {modality!r}; the encoder knows {format.modality!r}."
        )
    ids, data = checked_ids(arrays["ids"], None, str(path)), arrays["recordings"]
    num_recordings = data.shape[1] if data.ndim > 1 else 0
    problem = format.problem(data, (len(ids), num_recordings, *format.shape), True)
    if problem is None and num_recordings == 0:
        problem = "has no recording"
    if problem is not None:
        raise ObservationsError(f"{path}: the array `recordings` {problem}.")
    hashes = tuple(row_hash(rows) for rows in data)
    return ActionObservations(data, ids, format, None, hashes)
