"""Files that are whole or absent, whatever kills the process. Standard library only.

What the system refuses (no permission, no space, a folder in place of a file) is a `StorageError`,
which says why and what to do; that the content of a file is damaged is said by who reads it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_PERMISSION = (errno.EACCES, errno.EPERM)
_ADVICE = {
    errno.EROFS: "Its disk can only be read; choose a place that can be written.",
    errno.EISDIR: "There is a folder where a file should be; move it away.",
    errno.ENOTDIR: "A part of this path is a file; choose another path, or move that file away.",
    errno.ELOOP: "It is a link, which is not followed; put the file itself there.",
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.ENOENT: "Its folder does not exist; make it, or choose another path.",
}
_TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}")  # Names that `write_bytes_atomically` gives.


class StorageError(ValueError):
    """The system refuses to read or write a path; nothing says that what is there is damaged."""

    @classmethod
    def of(cls, path: Path, doing: str, err: OSError) -> StorageError:
        """Says why and what to do; `doing` is `read` or `written`."""
        reason = os.strerror(err.errno) if err.errno else str(err)
        return cls(f"{path} cannot be {doing}: {reason}. {_advice(path, err.errno)}")


def _advice(path: Path, number: int | None) -> str:
    if number in _NO_SPACE:
        return (
            f"{_free(path)}Make room there (or raise the quota, or the limit on the size of files) "
            "and run the same command again: it goes on from what is whole."
        )
    if number in _NO_PERMISSION:
        return (
            f"{_owner(path)}Get the permission, or choose a place of your own; nothing is known to "
            "be damaged."
        )
    return _ADVICE.get(
        number or 0, "Nothing is known to be damaged: look at the disk, and try again."
    )


def _free(path: Path) -> str:
    with contextlib.suppress(OSError):
        folder = next(folder for folder in path.absolute().parents if folder.exists())
        found = os.statvfs(folder)
        return f"{megabytes(found.f_bavail * found.f_frsize)} are free in {folder}. "
    return ""


def _owner(path: Path) -> str:
    with contextlib.suppress(OSError):
        return f"It belongs to user {os.lstat(path).st_uid}, this process to {os.geteuid()}. "
    return ""


def megabytes(size: int) -> str:
    """A number of bytes for messages, e.g. `3.142 MB`."""
    return f"{size / 1e6:,.3f} MB"


@contextlib.contextmanager
def access(path: Path, doing: Literal["read", "written"] = "read") -> Iterator[None]:
    """What the system refuses within is raised as a `StorageError`.

    A missing file is none where it was to be read: that stays a `FileNotFoundError`.

    Args:
      path: what is read or written, where the error does not name a file.
      doing: see there.
    """
    try:
        yield
    except OSError as err:
        if isinstance(err, FileNotFoundError) and doing == "read":
            raise
        named = Path(os.fsdecode(err.filename)) if err.filename else path
        is_own = _TEMPORARY.fullmatch(named.name) is None
        raise StorageError.of(named if is_own else path, doing, err) from err


def check_name(path: Path) -> None:
    """Raises StorageError unless the bytes of a path are UTF-8, as Orbax needs them."""
    try:
        str(path).encode()
    except UnicodeEncodeError as err:
        raise StorageError(
            f"{os.fsencode(path)!r} cannot be used: checkpoints are stored under names in UTF-8 "
            "only. Rename the folder, or choose another."
        ) from err


def check_no_link(path: Path) -> Path:
    """`path`, which is going to be written to.

    Raises:
      StorageError: it is a link: what is behind it may belong to something else.
    """
    if path.is_symlink():
        raise StorageError(
            f"{path} is a link to {os.readlink(path)}, which is not followed for writing. Put a "
            "folder or file of its own there, or write elsewhere."
        )
    return path


def check_new(path: Path, overwrite: bool) -> None:
    """To be called before the work that ends in a file.

    Raises:
      StorageError: the file exists and is not to be overwritten, or its folder cannot be written.
    """
    with access(path, "written"):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "", str(path))
        if os.path.lexists(path) and not overwrite:
            raise StorageError(
                f"{path} exists already. Name another --output, or give --overwrite to replace it."
            )
        make_writable(path.parent)


def make_writable(folder: Path) -> None:
    """Makes the folder if it is absent.

    Raises:
      OSError: nothing can be written there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


def read_json(path: Path, error: type[ValueError], kind: type = dict) -> Any:
    """What a JSON file holds.

    Args:
      error: raised where the file is damaged.
      kind: what it must hold.

    Raises:
      FileNotFoundError: it is missing.
      StorageError: the system refuses to read it.
    """
    with access(path):
        content = path.read_bytes()
    try:
        found = json.loads(content.decode())
        if not isinstance(found, kind):
            raise ValueError(f"it must hold a {kind.__name__}, got a {type(found).__name__}")
    except ValueError as err:
        raise error(f"{path} is damaged ({err}). Restore it from a copy.") from err
    return found


def sync_folder(folder: Path) -> None:
    """Makes renames in `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Replaces the file at `path`: a reader, or a crash, sees the old content or the new, whole.

    A link at `path` is replaced, not followed.

    Raises:
      StorageError: the system refuses, e.g. because the disk is full.
    """
    with access(path, "written"):
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


def remove_temporaries(folder: Path) -> None:
    """Removes what `write_bytes_atomically` left in `folder` when its process was killed.

    To be called by a process that alone writes there.
    """
    for file in folder.iterdir():
        if _TEMPORARY.fullmatch(file.name) and file.is_file():
            file.unlink()


def write_json_atomically(path: Path, content: Any) -> None:
    """`write_bytes_atomically` of `content` as JSON.

    Raises:
      ValueError, TypeError: `content` is not plain JSON (NaN and infinities are not).
      StorageError: see there.
    """
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_bytes_atomically(path, text.encode())


def take_lock(path: Path) -> int:
    """Takes the lock file at `path`, which is made if absent.

    Returns:
      A descriptor. The lock is held until it is closed, at the latest when the process ends.

    Raises:
      BlockingIOError: another descriptor holds the lock; the message names its process.
      StorageError: the system refuses, or `path` is a link.
    """
    with access(path, "written"):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_current = path.exists() and os.path.samestat(os.fstat(descriptor), os.stat(path))
        if not is_current:
            raise BlockingIOError("it replaced the directory just now")
    except BlockingIOError as err:
        owner = os.read(descriptor, 200).decode(errors="replace").strip()
        os.close(descriptor)
        raise BlockingIOError(owner or "process unknown") from err
    with contextlib.suppress(OSError):  # A full disk does not loosen the lock.
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {platform.node()}".encode())
    return descriptor
