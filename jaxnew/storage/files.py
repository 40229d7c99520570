"""Files that are whole or absent, whatever kills the process. Standard library only."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

# All that `numpy.load` was seen to raise on missing, cut or foreign files.
UNREADABLE_NPZ = (
    OSError,
    ValueError,
    EOFError,
    AttributeError,
    TypeError,
    zipfile.BadZipFile,
    zlib.error,
)


def sync_folder(folder: Path) -> None:
    """Makes renames in `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Replaces the file at `path`: a reader, or a crash, sees the old content or the new, whole."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
    sync_folder(path.parent)


def write_json_atomically(path: Path, content: Any) -> None:
    """`write_bytes_atomically` of `content` as JSON.

    Raises:
      ValueError, TypeError: `content` is not plain JSON (NaN and infinities are not).
    """
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_bytes_atomically(path, text.encode())


def take_lock(path: Path) -> int:
    """Takes the lock file at `path`, which is made if absent.

    Returns:
      A descriptor. The lock is held until it is closed, at the latest when the process ends.

    Raises:
      BlockingIOError: another descriptor holds the lock; the message names its process.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_current = path.exists() and os.path.samestat(os.fstat(descriptor), os.stat(path))
        if not is_current:
            raise BlockingIOError("it replaced the directory just now")
    except BlockingIOError as err:
        owner = os.read(descriptor, 200).decode(errors="replace").strip()
        os.close(descriptor)
        raise BlockingIOError(owner or "process unknown") from err
    os.ftruncate(descriptor, 0)
    os.write(descriptor, f"process {os.getpid()} on {platform.node()}".encode())
    return descriptor
