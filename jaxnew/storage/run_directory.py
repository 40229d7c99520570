"""The directory of one run: it explains itself, belongs to one process, and is never half-written.

config.json       what the run is
provenance.json   what made it: revision, versions, devices, command line of each session
metrics.jsonl     one line per report (`metrics.py`); TensorBoard events in tensorboard/
checkpoints/      `checkpoint.py`
figures/  evaluation/*.json
"""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import re
import reprlib
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from jaxnew.storage.config import Difference, differences
from jaxnew.storage.files import sync_folder, take_lock, write_json_atomically

_KIND = "jaxnew run directory"
_FORMAT_VERSION = 1
_LOCK = ".lock"
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "orbax-checkpoint", "mujoco", "pymunk")
_FOLDERS = ("tensorboard", "checkpoints", "figures", "evaluation")


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


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as err:
        raise RunDirectoryError(
            f"{path.parent} is not a run directory: {path.name} is missing. Give the --workdir of "
            "a run."
        ) from err
    except (json.JSONDecodeError, UnicodeDecodeError) as err:
        raise RunDirectoryError(
            f"{path} is damaged ({err}). Restore it from a copy, or start a new run in another "
            "--workdir."
        ) from err


def _read_object(path: Path) -> dict[str, Any]:
    content = _read_json(path)
    if not isinstance(content, dict):
        raise RunDirectoryError(
            f"{path} is damaged: it must hold a JSON object, got a {type(content).__name__}."
        )
    return content


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
        """
        path = Path(os.path.abspath(path))
        plain = json.loads(json.dumps(config, allow_nan=False))
        _restore_interrupted_overwrite(path)
        is_empty = not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))
        if is_empty:
            run = cls(path, plain, False, _create(path, plain))
        elif overwrite:
            run = cls(path, plain, False, _replace(path, plain))
        else:
            run = _resume(cls, path, plain, upgrade)
        try:
            if overwrite:
                shutil.rmtree(_aside(path), ignore_errors=True)
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
        """
        path = Path(path)
        _check_marker(path)
        return cls(path, _read_object(path / "config.json"), True, None)

    @property
    def is_writable(self) -> bool:
        """Whether this object holds the lock."""
        return self._release is not None and self._release.alive

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

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
        """Writes `evaluation/NAME.json`, replacing an earlier one. Needs no lock.

        Raises:
          ValueError: `name` is not a plain file name, or `content` is not plain JSON.
        """
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise ValueError(
                f"Evaluation name {name!r} must consist of letters, digits, '.', '_' and '-'."
            )
        file = self.path / "evaluation" / f"{name}.json"
        file.parent.mkdir(exist_ok=True)
        write_json_atomically(file, dict(content))
        return file

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
                f"{path} is not a run directory: it has no {name}. Choose a --workdir that does "
                "not exist yet or is empty."
            )
    kind = _read_object(path / "provenance.json")
    if kind.get("kind") != _KIND or kind.get("format_version") != _FORMAT_VERSION:
        raise RunDirectoryError(
            f"{path} is not a run directory of format {_FORMAT_VERSION}: provenance.json says "
            f"{kind.get('kind')!r}, {kind.get('format_version')!r}. Choose another --workdir."
        )


def _resume(
    cls: type[RunDirectory],
    path: Path,
    config: dict[str, Any],
    upgrade: Callable[[Mapping[str, Any]], Mapping[str, Any]],
) -> RunDirectory:
    _check_marker(path)
    found = differences(upgrade(_read_object(path / "config.json")), config)
    if found:
        raise ConfigMismatch(path, found)
    return cls(path, config, True, _lock(path))


def _create(path: Path, config: dict[str, Any]) -> int:
    """Makes the run at `path`, which is absent or empty, in one step; returns its lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.new-"))
    os.chmod(folder, 0o755)
    lock = _lock(folder)
    try:
        for name in _FOLDERS:
            (folder / name).mkdir()
        marker = {"kind": _KIND, "format_version": _FORMAT_VERSION, "sessions": []}
        write_json_atomically(folder / "provenance.json", marker)
        write_json_atomically(folder / "config.json", config)
        os.rename(folder, path)
    except BaseException as err:
        os.close(lock)
        shutil.rmtree(folder, ignore_errors=True)
        if not isinstance(err, OSError):
            raise
        raise RunDirectoryError(
            f"Cannot make the run directory {path}: {err}. Choose a --workdir inside a writable "
            "directory; it must not be a mount point or a link."
        ) from err
    sync_folder(path.parent)
    return lock


def _aside(path: Path) -> Path:
    """Where an existing run waits while the one that replaces it is put in place."""
    return path.parent / f".{path.name}.replaced"


def _restore_interrupted_overwrite(path: Path) -> None:
    """Undoes a replacement that was killed between its two renames."""
    if not os.path.lexists(path) and _aside(path).is_dir():
        os.rename(_aside(path), path)


def _replace(path: Path, config: dict[str, Any]) -> int:
    """Puts a new run where one exists, and deletes the old one last; returns the new lock."""
    if path.is_symlink():
        raise RunDirectoryError(f"{path} is a link; give the directory itself to --overwrite it.")
    _check_marker(path)
    old_lock = _lock(path)
    try:
        shutil.rmtree(_aside(path), ignore_errors=True)
        os.rename(path, _aside(path))
        try:
            return _create(path, config)
        finally:
            _restore_interrupted_overwrite(path)
    finally:
        os.close(old_lock)


def _git(*arguments: str) -> str | None:
    """Output of a git command in the folder of this file, or None where there is no answer."""
    command = ["git", "-C", str(Path(__file__).resolve().parent), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _revision() -> dict[str, Any] | None:
    """Revision of the source that runs and whether it was edited; None outside its repository."""
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    revision, status = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    return None if revision is None else {"git": revision, "is_dirty": bool(status)}


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions


def describe_session() -> dict[str, Any]:
    """What runs now: start time, command line, revision, versions, devices, and JAX's settings.

    Devices, precision and random numbers are JAX's and None in a process without it.
    """
    jax = sys.modules.get("jax")
    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": list(sys.orig_argv),
        "revision": _revision(),
        "versions": _versions(),
        "machine": {"platform": platform.platform(), "num_cpus": os.cpu_count()},
        "devices": None if jax is None else [f"{d.platform}: {d}" for d in jax.devices()],
        "precision": None
        if jax is None
        else {
            "matmul": str(jax.config.jax_default_matmul_precision or "default"),
            "x64": bool(jax.config.jax_enable_x64),
        },
        "random": None
        if jax is None
        else {
            "implementation": str(jax.config.jax_default_prng_impl),
            "is_partitionable": bool(jax.config.jax_threefry_partitionable),
        },
    }
