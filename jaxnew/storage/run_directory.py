"""The directory of one run: it explains itself, belongs to one process, and is never half-written.

config.json       what the run is
provenance.json   what made it: revision, versions, devices, command line of each session
metrics.jsonl     one line per report (`metrics.py`); TensorBoard events in tensorboard/
checkpoints/      `checkpoint.py`
figures/  evaluation/*.json

Beside the directory NAME there are, only while a process makes or replaces it:

.NAME.new-TOKEN        the run that is being made, locked by its maker
.NAME.replaced-TOKEN   the run that the one of the same token replaces

A new run is made whole in `.NAME.new-TOKEN` and renamed to NAME. With `overwrite`, NAME is renamed
to `.NAME.replaced-TOKEN` between the two, and deleted last. So whatever kills the process:

NAME     new    replaced   what was killed, and what opening NAME for writing does
absent   yes    no         the making: removes `new`
there    yes    no         the making of a replacement: removes `new`; NAME is the old run
absent   yes    yes        between the two renames: renames `replaced` back, removes `new`
there    no     yes        the deleting: removes `replaced`; NAME is the new run
absent   no     yes        the deleting, and NAME was deleted since: removes `replaced`

What a living process has locked is left alone. NAME alone is ever read, so a run either is there
whole or is not there.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import reprlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from jaxnew.storage.config import Difference, differences
from jaxnew.storage.files import (
    StorageError,
    access,
    check_name,
    check_no_link,
    read_json,
    remove_temporaries,
    sync_folder,
    take_lock,
    write_bytes_atomically,
    write_json_atomically,
)
from jaxnew.storage.session import describe_session

_KIND = "jaxnew run directory"
_FORMAT_VERSION = 1
_LOCK = ".lock"
_FOLDERS = ("tensorboard", "checkpoints", "figures", "evaluation")
_OF_SWEEPS = ("members", "members.partial")
_HASH = "hash"  # In files of evaluations.
_PRIVATE = ("command", "machine", "devices")  # What a session records that is not exported.

_SHORT = reprlib.Repr()  # Cuts groups of fields and long lists.
_SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 16, 200, 200


class RunDirectoryError(ValueError):
    """A path cannot be used as a run directory, or its files are damaged."""


class RunDirectoryInUse(RunDirectoryError):
    """Another process writes this run directory."""


class ConfigMismatch(RunDirectoryError):
    """The run directory belongs to a run with another configuration.

    Attributes:
      differences: `(path, recorded value, asked-for value)` of each field that differs.
    """

    def __init__(self, path: Path, found: list[Difference]) -> None:
        self.differences = found
        lines = [
            f"  {name}: {_SHORT.repr(old)} recorded, {_SHORT.repr(new)} asked for"
            for name, old, new in found
        ]
        super().__init__(
            f"{path} holds a run with another configuration:\n" + "\n".join(lines) + "\n"
            "Choose another --workdir to keep that run, or --overwrite to delete it and start anew."
        )


def _read_object(path: Path) -> dict[str, Any]:
    try:
        return dict(read_json(path, RunDirectoryError))
    except FileNotFoundError as err:
        raise RunDirectoryError(
            f"{path.parent} is not a run directory: {path.name} is missing. Give the --workdir of "
            "a run."
        ) from err


def _hash_of(content: Mapping[str, Any]) -> str:
    """Of a configuration or an evaluation, as it is recorded."""
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _lock(folder: Path) -> int:
    """Takes the lock of a run directory; returns the descriptor that holds it."""
    try:
        return take_lock(folder / _LOCK)
    except BlockingIOError as err:
        raise RunDirectoryInUse(
            f"{folder} is being written by another process ({err}). Wait until it ends, stop it, "
            "or choose another --workdir."
        ) from err


class RunDirectory:
    """A run on disk. Made by `open_or_create` (for writing, locked) or `load` (for reading).

    Attributes:
      path: the directory.
      config: the plain configuration of the run.
      is_resumed: whether the run existed when it was opened for writing.
    """

    def __init__(
        self, path: Path, config: dict[str, Any], is_resumed: bool, lock: int | None
    ) -> None:
        self.path, self.config, self.is_resumed = path, config, is_resumed
        # Released by close, when the object is dropped, and by the end of the process.
        self._release = None if lock is None else weakref.finalize(self, os.close, lock)

    @classmethod
    def open_or_create(
        cls,
        path: Path | str,
        config: Mapping[str, Any],
        overwrite: bool = False,
        extra_provenance: Mapping[str, Any] | None = None,
        upgrade: Callable[[Mapping[str, Any]], Mapping[str, Any]] = dict,
    ) -> RunDirectory:
        """Opens the run of `config` for writing; makes it where there is none.

        Args:
          path: absent or empty (a new run), or a run directory with the same configuration (it is
            resumed).
          config: plain JSON, e.g. of `config.to_dict`.
          overwrite: replace an existing run. It is deleted after the new one is in place.
          extra_provenance: recorded with this session, e.g. hashes of the split and the table.
          upgrade: a recorded configuration in today's form, to be compared with `config`.

        Raises:
          ConfigMismatch: the run there has another configuration.
          RunDirectoryInUse: another process writes it.
          RunDirectoryError: the path holds something else, or a damaged run.
          StorageError: the system refuses, or a folder of the run is a link.
        """
        path = Path(os.path.abspath(path))
        check_name(path)
        plain = json.loads(json.dumps(config, allow_nan=False))
        with access(path, "written"):
            _settle(path)
            is_empty = not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))
            if is_empty:
                run = cls(path, plain, False, _create(path, plain))
            elif overwrite:
                run = cls(path, plain, False, _replace(path, plain))
            else:
                run = _resume(cls, path, plain, upgrade)
            try:
                run._record_session(extra_provenance or {})
            except BaseException:
                run.close()
                raise
        return run

    @classmethod
    def load(cls, path: Path | str) -> RunDirectory:
        """Opens an existing run for reading; takes no lock and changes nothing.

        Raises:
          RunDirectoryError: `path` is not a run directory, or it is damaged.
          StorageError: the system refuses to read it.
        """
        path = Path(path)
        check_name(path)
        with access(path):
            _check_marker(path)
            return cls(path, _recorded_config(path), True, None)

    @property
    def is_writable(self) -> bool:
        """Whether this object holds the lock."""
        return self._release is not None and self._release.alive

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def figures(self) -> Path:
        """Where its figures go.

        Raises:
          StorageError: it is a link.
        """
        return check_no_link(self.path / "figures")

    @property
    def has_been_saved(self) -> bool:
        """Whether it had a `latest` checkpoint at any time; runs of 0.2.0 and before do not tell,
        and count as such.
        """
        return bool(self.provenance.get("has_been_saved", True))

    def note_saved(self) -> None:
        """Records that there is a `latest` checkpoint: without one the run is never begun anew."""
        self._check_writable()
        if not self.has_been_saved:
            provenance = {**self.provenance, "has_been_saved": True}
            write_json_atomically(self.path / "provenance.json", provenance)

    @property
    def provenance(self) -> dict[str, Any]:
        """What `provenance.json` holds; `["sessions"]` lists each process that wrote the run."""
        return _read_object(self.path / "provenance.json")

    def add_provenance(self, **entries: Any) -> None:
        """Adds plain JSON entries to the record of this session."""
        self._check_writable()
        provenance = self.provenance
        provenance["sessions"][-1].update(entries)
        write_json_atomically(self.path / "provenance.json", provenance)

    def record_evaluation(self, name: str, content: Mapping[str, Any]) -> Path:
        """Writes `evaluation/NAME.json`, replacing an earlier one, with a hash. Needs no lock.

        Raises:
          ValueError: `name` is not a plain file name, or `content` is not plain JSON.
          StorageError: the system refuses, or the folder is a link.
        """
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise ValueError(
                f"Evaluation name {name!r} must consist of letters, digits, '.', '_' and '-'."
            )
        file = check_no_link(self.path / "evaluation") / f"{name}.json"
        with access(file, "written"):
            file.parent.mkdir(exist_ok=True)
        write_json_atomically(file, {**content, _HASH: _hash_of(content)})
        return file

    def evaluation(self, name: str) -> dict[str, Any]:
        """What `record_evaluation` wrote.

        Raises:
          FileNotFoundError: there is none of that name.
          RunDirectoryError: the file was damaged or edited. Those of 0.2.0 and before have no hash.
        """
        file = self.path / "evaluation" / f"{name}.json"
        content = dict(read_json(file, RunDirectoryError))
        recorded = content.pop(_HASH, None)
        if recorded not in (None, _hash_of(content)):
            raise RunDirectoryError(
                f"{file} was edited or damaged: its hash is {_hash_of(content)}, it says "
                f"{recorded}. Restore it from a copy, or move it away and evaluate again."
            )
        return content

    def evaluations(self) -> dict[str, dict[str, Any]]:
        """All evaluations on record by name, in the order of names.

        Raises:
          RunDirectoryError: see `evaluation`.
        """
        with access(self.path / "evaluation"):
            names = sorted(file.stem for file in self.path.glob("evaluation/[!.]*.json"))
        return {name: self.evaluation(name) for name in names}

    def export(
        self, folder: Path, files: Sequence[str], write_more: Callable[[Path], None]
    ) -> None:
        """Copies what others need into a new folder, which can be loaded like the run.

        Of each session its hashes, revision and versions; no commands, machines or checkpoints.

        Args:
          files: names of the files to be copied.
          write_more: called with the folder before it is one that can be loaded.

        Raises:
          StorageError: the folder exists, or the system refuses.
        """
        check_name(folder)
        provenance = self.provenance
        provenance["sessions"] = [
            {name: session[name] for name in session if name not in _PRIVATE}
            for session in provenance["sessions"]
        ]
        with access(folder, "written"):
            folder.mkdir(parents=True)
            for name in ("config.json", *files):
                write_bytes_atomically(folder / name, (self.path / name).read_bytes())
            write_more(folder)
            write_json_atomically(folder / "provenance.json", provenance)  # Now it is a run.

    def close(self) -> None:
        """Releases the lock; the object can still be read."""
        if self._release is not None:
            self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check_writable(self) -> None:
        if not self.is_writable:
            raise RunDirectoryError(
                f"{self.path} is open for reading only; use RunDirectory.open_or_create to write."
            )

    def _record_session(self, extra: Mapping[str, Any]) -> None:
        provenance = self.provenance
        provenance["sessions"].append({**describe_session(), **extra})
        write_json_atomically(self.path / "provenance.json", provenance)


def _check_marker(path: Path) -> None:
    """Raises unless `path` is a directory that `_create` made."""
    if not path.is_dir():
        raise RunDirectoryError(f"{path} is not a directory. Give the --workdir of a run.")
    for name in ("config.json", "provenance.json"):
        if not (path / name).exists():
            raise RunDirectoryError(
                f"{path} is not a run directory: it has no {name}. Give the directory of a run, or "
                "for a new one a --workdir that does not exist yet or is empty."
            )
    kind = _read_object(path / "provenance.json")
    if kind.get("kind") != _KIND or kind.get("format_version") != _FORMAT_VERSION:
        raise RunDirectoryError(
            f"{path} is not a run directory of format {_FORMAT_VERSION}: provenance.json says "
            f"{kind.get('kind')!r}, {kind.get('format_version')!r}. Choose another --workdir."
        )


def _recorded_config(path: Path) -> dict[str, Any]:
    """The configuration of a run, checked to be what was written; before 0.3.0 none had a hash."""
    config = _read_object(path / "config.json")
    recorded = _read_object(path / "provenance.json").get("config_hash")
    if recorded not in (None, _hash_of(config)):
        raise RunDirectoryError(
            f"{path / 'config.json'} was edited or damaged: its hash is {_hash_of(config)}, "
            f"provenance.json says {recorded}. Restore it from a copy."
        )
    return config


def _resume(
    cls: type[RunDirectory],
    path: Path,
    config: dict[str, Any],
    upgrade: Callable[[Mapping[str, Any]], Mapping[str, Any]],
) -> RunDirectory:
    _check_marker(path)
    found = differences(upgrade(_recorded_config(path)), config)
    if found:
        raise ConfigMismatch(path, found)
    for name in (*_FOLDERS, *_OF_SWEEPS):
        check_no_link(path / name)
    lock = _lock(path)
    remove_temporaries(path)
    return cls(path, config, True, lock)


def _create(path: Path, config: dict[str, Any]) -> int:
    """Makes the run at `path`, which is absent or empty, in one step; returns its lock."""
    folder, lock = _make(path, config)
    try:
        os.rename(folder, path)
    except BaseException as err:
        os.close(lock)
        if not isinstance(err, OSError):
            raise
        shutil.rmtree(folder, ignore_errors=True)
        raise RunDirectoryError(
            f"Cannot make the run directory {path}: {err.strerror}. Choose a --workdir that does "
            "not exist yet or is empty; it must not be a mount point or a link."
        ) from err
    sync_folder(path.parent)
    return lock


def _make(path: Path, config: dict[str, Any]) -> tuple[Path, int]:
    """Makes the run that is going to be at `path`, beside it; returns its folder and lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.new-"))
    try:
        os.chmod(folder, 0o755)
        lock = _lock(folder)
        try:
            for name in _FOLDERS:
                (folder / name).mkdir()
            marker = {"kind": _KIND, "format_version": _FORMAT_VERSION, "has_been_saved": False}
            marker |= {"config_hash": _hash_of(config), "sessions": []}
            write_json_atomically(folder / "provenance.json", marker)
            write_json_atomically(folder / "config.json", config)
        except BaseException:
            os.close(lock)
            raise
    except Exception:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder, lock


def _replace(path: Path, config: dict[str, Any]) -> int:
    """Puts a new run where one exists, and deletes the old one last; returns the new lock."""
    if path.is_symlink():
        raise RunDirectoryError(f"{path} is a link; give the directory itself to --overwrite it.")
    _check_marker(path)
    old_lock = _lock(path)
    try:
        folder, lock = _make(path, config)
        try:
            aside = folder.name.replace(f".{path.name}.new-", f".{path.name}.replaced-")
            os.rename(path, path.parent / aside)
            os.rename(folder, path)
            sync_folder(path.parent)
            shutil.rmtree(path.parent / aside, ignore_errors=True)
        except BaseException:
            os.close(lock)
            raise
    finally:
        os.close(old_lock)
    return lock


def _settle(path: Path) -> None:
    """Ends what killed processes began beside `path`, as the docstring of this module says."""
    if not path.parent.is_dir():
        return
    name = re.compile(rf"\.{re.escape(path.name)}\.(new|replaced)(-[a-z0-9_]{{8}})?")
    locks: dict[tuple[str, str], int] = {}
    try:
        for folder in path.parent.iterdir():
            if (found := name.fullmatch(folder.name)) and folder.is_dir():
                with contextlib.suppress(BlockingIOError, StorageError):  # Somebody else's.
                    locks[found[1], found[2] or ""] = take_lock(folder / _LOCK)
        for kind, token in sorted(locks):
            folder = path.parent / f".{path.name}.{kind}{token}"
            if kind == "new" and ("replaced", token) in locks and not os.path.lexists(path):
                os.rename(path.parent / f".{path.name}.replaced{token}", path)
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        for lock in locks.values():
            os.close(lock)
