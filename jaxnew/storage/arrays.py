"""Files of arrays, `.npz`."""

from __future__ import annotations

import errno
import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnew.storage.files import StorageError, access, write_bytes_atomically

# All that `numpy.load` was seen to raise on cut or foreign files.
_DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    AttributeError,
    TypeError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)


def write_arrays(path: Path, arrays: Mapping[str, Any], is_compressed: bool = False) -> None:
    """Writes the file, whole or not at all."""
    buffer = io.BytesIO()
    (np.savez_compressed if is_compressed else np.savez)(buffer, **arrays)
    write_bytes_atomically(path, buffer.getvalue())


def read_arrays(path: Path, names: Sequence[str], error: type[ValueError]) -> dict[str, np.ndarray]:
    """The arrays of a file that has at least those of some names.

    Args:
      error: raised where the file is missing, damaged or lacks an array.

    Raises:
      StorageError: the system refuses to read it.
    """
    wanted = f"an .npz file with the arrays {' and '.join(f'`{name}`' for name in names)}"
    try:
        with access(path):
            file = path.open("rb")
    except FileNotFoundError as err:
        raise error(f"{path} is missing; it must be {wanted}.") from err
    try:
        with file, np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except _DAMAGE as err:
        if isinstance(err, OSError) and err.errno not in (None, errno.EINVAL):
            raise StorageError.of(path, "read", err) from err
        raise error(
            f"{path} is damaged ({err}); it must be {wanted}. Restore it from a copy, or make it "
            "again."
        ) from err
    for name in names:
        if name not in arrays:
            raise error(f"{path} lacks the array {name!r}; it has {sorted(arrays)}.")
    return arrays
