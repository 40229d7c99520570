"""Checkpoints of a run: the only module that names Orbax.

A checkpoint holds the leaves of a state (any pytree), a description of each leaf with its hash,
and a plain dictionary. It appears in one rename, so whatever kills the process leaves earlier
ones readable; a damaged one is recognised by its hashes. What the system refuses (no permission,
no space) is a `StorageError`, not damage.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import re
import shutil
import sys
import uuid
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from jaxnew.storage.files import StorageError, access, check_name, check_no_link, sync_folder

State = TypeVar("State")
Leaf = dict[str, Any]  # Path, shape, dtype and hash of a leaf, as plain JSON.
Kind = Literal["latest", "best"]
KINDS: tuple[Kind, ...] = ("latest", "best")
_KEEP = {"latest": 2, "best": 3}
_LEFT = ("new-", "old-")  # Of processes that were killed.
_TO_DO = {
    "latest": "Restore it from a copy; or start the run anew, which deletes it, with --overwrite.",
    "best": "Restore it from a copy; or run the command that trained it again: it goes on from the "
    "`latest` checkpoint and makes a new `best`.",
}
_FORMAT_VERSION = 1


class CheckpointError(ValueError):
    """There is no readable checkpoint, or it holds another state than the one asked for."""


def record_hash(record: Mapping[str, Any]) -> str:
    """Hash of the record of a checkpoint without its own `hash` entry."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


class _DamagedError(Exception):
    """One checkpoint cannot be read; another may do."""


def _system_error(err: BaseException | None) -> OSError | None:
    """What the system refused, if that is at the root of an error of Orbax or TensorStore."""
    while err is not None:
        told = re.search(r"os_error_code='(\d+)'", str(err))
        number = int(told[1]) if told else err.errno if isinstance(err, OSError) else None
        if number:
            return OSError(number, os.strerror(number))
        err = err.__cause__ or err.__context__
    return None


def _failed(path: Path, err: Exception) -> Exception:
    """What to raise where a checkpoint could not be read."""
    refused = _system_error(err)
    is_missing = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EINVAL)
    if refused is not None and refused.errno not in is_missing:
        return StorageError.of(path, "read", refused)
    return _DamagedError(f"{type(err).__name__}: {str(err)[:200]}")


@contextlib.contextmanager
def _raised_once() -> Iterator[None]:
    """What Orbax's threads print about an error that is raised here as well is left out."""
    logger, hook = logging.getLogger("absl"), sys.unraisablehook

    def without_loops(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            hook(unraisable)

    was_disabled, logger.disabled = logger.disabled, True
    sys.unraisablehook = without_loops
    try:
        yield
        sys.unraisablehook = hook  # After an error the threads go on for a while.
    finally:
        logger.disabled = was_disabled


class Checkpointer:
    """Saves and restores the checkpoints of one run, in `directory/KIND/STEP`.

    Of kind `latest` the two newest are kept, of kind `best` the three newest, so that there is one
    to fall back on. Saving is synchronous. One process writes; any number may read.
    """

    def __init__(self, directory: Path | str) -> None:
        self._directory = Path(directory).absolute()
        check_name(self._directory)
        self._orbax = ocp.Checkpointer(ocp.CompositeCheckpointHandler())

    @property
    def directory(self) -> Path:
        return self._directory

    def steps(self, kind: Kind) -> list[int]:
        """Steps of the committed checkpoints of a kind, ascending."""
        folder = self._folder(kind)
        with access(folder):
            names = os.listdir(folder) if folder.is_dir() else []
        return sorted(int(name) for name in names if name.isdecimal())

    def save(
        self, kind: Kind, step: int, state: Any, metadata: Mapping[str, Any] | None = None
    ) -> Path:
        """Writes a checkpoint and then deletes those of its kind that are not kept.

        Args:
          kind: `latest` or `best`.
          step: >= 0, larger than that of every checkpoint of this kind (see `discard_after`).
          state: pytree of arrays, typed PRNG keys and Python numbers; not changed.
          metadata: plain JSON.

        Raises:
          ValueError: `step` is not larger, or `metadata` is not plain JSON.
          TypeError: a leaf cannot be stored.
          StorageError: the system refuses, e.g. because the disk is full; earlier ones are whole.
        """
        folder, existing = self._folder(kind), self.steps(kind)
        if step < 0 or (existing and step <= existing[-1]):
            raise ValueError(
                f"Cannot save {kind} at step {step}: {folder} already holds step "
                f"{existing[-1] if existing else '(none)'}. Steps must grow; call discard_after "
                "when a run goes back to an earlier step."
            )
        leaves = [describe_with_content(name, leaf) for name, leaf in named_leaves(state)]
        record: dict[str, Any] = {
            "format_version": _FORMAT_VERSION,
            "step": step,
            "leaves": [description for description, _ in leaves],
            "metadata": json.loads(json.dumps(metadata or {}, allow_nan=False)),
        }
        record["hash"] = record_hash(record)
        temporary = folder / f"new-{uuid.uuid4().hex}"
        items: dict[str, Any] = {"record": ocp.args.JsonSave(record)}
        # Orbax refuses empty arrays; the description alone restores those.
        filled = {str(i): value for i, (_, value) in enumerate(leaves) if value.size}
        if filled:
            items["state"] = ocp.args.PyTreeSave(filled)
        with access(folder, "written"):
            self.clean(kind)
            folder.mkdir(parents=True, exist_ok=True)
            try:
                with _raised_once():
                    self._orbax.save(temporary, ocp.args.Composite(**items))
            except Exception as err:
                self.clean(kind)
                refused = _system_error(err)
                if refused is None:
                    raise
                raise StorageError.of(self._path(kind, step), "written", refused) from err
            os.rename(temporary, self._path(kind, step))
            sync_folder(folder)
        for old in existing[: 1 - _KEEP[kind]]:
            self._discard(kind, old)
        return self._path(kind, step)

    def restore(
        self, kind: Kind, example: State, step: int | None = None, *, is_part: bool = False
    ) -> tuple[State, dict[str, Any]]:
        """Reads the newest readable checkpoint of a kind.

        Args:
          kind: `latest` or `best`.
          example: a state of the same structure, shapes and dtypes; concrete, or made of
            `jax.ShapeDtypeStruct`. Arrays are placed where those of `example` are.
          step: read this one only, instead of the newest.
          is_part: `example` may lack leaves of the saved state, which are left out.

        Returns:
          (state, metadata): the state with the bits that were saved.

        Raises:
          CheckpointError: none is readable, or the newest holds another structure.
          StorageError: the system refuses to read it.
        """
        found = self._newest(kind, step, lambda path: self._read(path, example, is_part))
        return cast(tuple[State, dict[str, Any]], found)

    def metadata(self, kind: Kind, step: int | None = None) -> dict[str, Any]:
        """Metadata of the newest checkpoint of a kind whose record is readable.

        Raises:
          CheckpointError: there is none.
        """
        return cast(
            dict[str, Any],
            self._newest(kind, step, lambda path: self._read_record(path)["metadata"]),
        )

    def discard_after(self, step: int) -> None:
        """Deletes every checkpoint of a later step, of both kinds: the run goes on from `step`."""
        for kind in KINDS:
            for later in self.steps(kind):
                if later > step:
                    self._discard(kind, later)

    def set_aside_damaged(self, kind: Kind, example: Any) -> None:
        """Renames damaged checkpoints that are newer than every whole one, to `damaged-...`.

        Their steps can be saved again; nothing is deleted.

        Args:
          example: see `restore`.
        """
        for step in reversed(self.steps(kind)):
            path = self._path(kind, step)
            try:
                self._read(path, example, False)
            except _DamagedError as err:
                aside = path.with_name(f"damaged-{path.name}-{uuid.uuid4().hex[:8]}")
                os.rename(path, aside)
                warnings.warn(f"{path} is damaged ({err}); it is {aside.name} now.", stacklevel=2)
            else:
                return

    def clean(self, kind: Kind) -> None:
        """Removes what a killed process left half-written or half-deleted."""
        folder = check_no_link(self._folder(kind))
        for name in os.listdir(folder) if folder.is_dir() else []:
            if name.startswith(_LEFT):
                shutil.rmtree(folder / name, ignore_errors=True)

    def _newest(self, kind: Kind, step: int | None, read: Any) -> Any:
        steps = self.steps(kind) if step is None else [step]
        failures = []
        for candidate in reversed(steps):
            path = self._path(kind, candidate)
            try:
                found = read(path)
            except _DamagedError as err:
                failures.append(f"{path} is damaged ({err})")
                continue
            if failures:
                warnings.warn(f"{'; '.join(failures)}; using step {candidate}.", stacklevel=3)
            return found
        if failures:
            raise CheckpointError(f"No readable checkpoint: {'; '.join(failures)}. {_TO_DO[kind]}")
        raise CheckpointError(
            f"There is no {kind} checkpoint in {self._directory}. Train the run first, or give the "
            f"--workdir of another. If there was one: {_TO_DO[kind]}"
        )

    def _read_record(self, path: Path) -> dict[str, Any]:
        with access(path):
            if not path.is_dir():
                raise _DamagedError("it does not exist")
        try:
            args = ocp.args.Composite(record=ocp.args.JsonRestore())
            with _raised_once():
                record = self._orbax.restore(path, args).record
            if record.pop("hash") != record_hash(record):
                raise ValueError("its record is not what was saved")
        except Exception as err:  # Orbax and TensorStore raise many types for damaged files.
            raise _failed(path, err) from err
        if record["format_version"] != _FORMAT_VERSION:
            raise CheckpointError(
                f"{path} has format {record['format_version']}; this program reads "
                f"{_FORMAT_VERSION}. Use the version of the program that wrote it."
            )
        return cast(dict[str, Any], record)

    def _read(self, path: Path, example: Any, is_part: bool) -> tuple[Any, dict[str, Any]]:
        record = self._read_record(path)
        leaves, saved = named_leaves(example), record["leaves"]
        names = {name for name, _ in leaves}
        difference = first_difference(
            [leaf for leaf in saved if not is_part or leaf["path"] in names],
            [describe_leaf(name, leaf) for name, leaf in leaves],
        )
        if difference is not None:
            raise CheckpointError(
                f"{path} does not fit this program: {difference}. Use the configuration and the "
                "version of the program that wrote it."
            )
        pairs = zip(self._read_values(path, saved), saved, strict=True)
        found = {description["path"]: (value, description) for value, description in pairs}
        restored = [restore_leaf(*found[name], leaf) for name, leaf in leaves]
        return jax.tree.unflatten(jax.tree.structure(example), restored), record["metadata"]

    def _read_values(self, path: Path, saved: list[Leaf]) -> list[np.ndarray]:
        values = [np.zeros(leaf["stored"][1], np.dtype(leaf["stored"][0])) for leaf in saved]
        target = {str(i): value for i, value in enumerate(values) if value.size}
        if target:
            try:
                kinds = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in target}
                restore = ocp.args.PyTreeRestore(item=target, restore_args=kinds)
                with _raised_once():
                    found = self._orbax.restore(path, ocp.args.Composite(state=restore)).state
            except Exception as err:  # As above.
                raise _failed(path, err) from err
            for name, value in found.items():
                values[int(name)] = np.asarray(value)
        for leaf, value in zip(saved, values, strict=True):
            if sha256(value) != leaf["sha256"]:
                raise _DamagedError(
                    f"the bytes of leaf {leaf['path']} are not those that were saved"
                )
        return values

    def _folder(self, kind: Kind) -> Path:
        if kind not in KINDS:
            raise ValueError(f"Unknown kind of checkpoint {kind!r}; choose one of {KINDS}.")
        return self._directory / kind

    def _path(self, kind: Kind, step: int) -> Path:
        return self._folder(kind) / f"{step:012d}"

    def _discard(self, kind: Kind, step: int) -> None:
        """Deletes one checkpoint; it is gone at once even if deleting its files is cut short."""
        folder = check_no_link(self._folder(kind))
        doomed = folder / f"old-{uuid.uuid4().hex}"
        with access(folder, "written"):
            os.rename(self._path(kind, step), doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def is_key(leaf: Any) -> bool:
    """Whether a leaf is an array of typed PRNG keys, concrete or abstract."""
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def named_leaves(state: Any) -> list[tuple[str, Any]]:
    """(path, leaf) of each leaf, in JAX's order; the path looks like `.params['w'][0]`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return [(jax.tree_util.keystr(path) or "(state)", leaf) for path, leaf in leaves]


def describe_leaf(name: str, leaf: Any) -> Leaf:
    """Path, shape and dtype of a leaf; `dtype` is `key<...>` for typed PRNG keys.

    Raises:
      TypeError: the leaf is neither an array nor a number.
    """
    if is_key(leaf):
        return {"path": name, "shape": list(leaf.shape), "dtype": str(leaf.dtype)}
    # NumPy's float64 is a Python float too; it is described as an array.
    if isinstance(leaf, bool | int | float | complex) and not isinstance(leaf, np.generic):
        return {"path": name, "shape": [], "dtype": f"Python {type(leaf).__name__}"}
    if not hasattr(leaf, "dtype") or not hasattr(leaf, "shape"):
        raise TypeError(
            f"Leaf {name} of the state is a {type(leaf).__name__}; checkpoints hold arrays, PRNG "
            "keys and numbers. Keep anything else out of the state or mark it as static."
        )
    return {"path": name, "shape": list(leaf.shape), "dtype": str(np.dtype(leaf.dtype))}


def describe_with_content(name: str, leaf: Any) -> tuple[Leaf, np.ndarray]:
    """`describe_leaf` with what restoring needs, and the bits of the leaf as a NumPy array."""
    description = describe_leaf(name, leaf)
    value = np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)
    description["stored"] = [str(value.dtype), list(value.shape)]
    description["sha256"] = sha256(value)
    if is_key(leaf):
        description["impl"] = str(jax.random.key_impl(leaf))
    return description, value


def sha256(value: np.ndarray) -> str:
    """Hash of the bytes of an array."""
    return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()


def restore_leaf(value: np.ndarray, description: Leaf, example: Any) -> Any:
    """`value` as the kind of leaf that `example` is, and on its device if it was put on one."""
    if isinstance(example, np.generic):
        return value[()]
    if isinstance(example, bool | int | float | complex):
        return type(example)(value.item())
    if isinstance(example, np.ndarray):
        return value
    if is_key(example):
        restored = jax.random.wrap_key_data(jnp.asarray(value), impl=description["impl"])
    else:
        restored = jnp.asarray(value)
        if isinstance(example, jax.Array) and example.weak_type:
            # A strongly typed copy would be another argument type, hence another compilation.
            restored = example.at[...].set(restored)
    sharding = getattr(example, "sharding", None)
    is_placed = getattr(example, "committed", sharding is not None)
    return jax.device_put(restored, sharding) if is_placed else restored


def first_difference(saved: list[Leaf], expected: list[Leaf]) -> str | None:
    """Says which leaf differs first in path, shape or dtype, or None if all agree."""
    saved_by_path = {leaf["path"]: leaf for leaf in saved}
    for leaf in expected:
        twin = saved_by_path.pop(leaf["path"], None)
        if twin is None or not _is_same_leaf(twin, leaf):
            found = "absent" if twin is None else _show(twin)
            return f"leaf {leaf['path']} is {found} in the checkpoint, expected {_show(leaf)}"
    for leaf in saved_by_path.values():
        return f"leaf {leaf['path']} ({_show(leaf)}) of the checkpoint is not expected"
    return None


def _show(leaf: Leaf) -> str:
    return f"{leaf['dtype']}{leaf['shape']}"


def _is_same_leaf(saved: Leaf, expected: Leaf) -> bool:
    if saved["shape"] != expected["shape"]:
        return False
    is_exact = bool(saved["dtype"] == expected["dtype"])
    if not expected["dtype"].startswith("Python ") or saved["dtype"].startswith(("Python", "key<")):
        return is_exact
    # A counter may start as a Python number and come back from a jitted chunk as a scalar array.
    kinds = {"b": "bool", "i": "int", "u": "int", "f": "float", "c": "complex"}
    return f"Python {kinds.get(np.dtype(saved['dtype']).kind)}" == str(expected["dtype"])
