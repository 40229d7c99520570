"""Things that are found by name or by place: tasks, methods, budgets; and places for output."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

from jaxnew.storage.files import make_writable
from jaxnew.storage.progress import say

PRETRAINED = "pretrained"
_SHIPPED = Path(__file__).parents[1] / PRETRAINED

Budget = TypeVar("Budget")
_TRUSTS: ContextVar[bool] = ContextVar("trusts", default=False)


class UsageError(ValueError):
    """The command was asked for something that does not exist or does not fit."""


def load_place(place: str, what: str, allowed: str) -> Any:
    """The object at `package.module:NAME`, wherever Python finds that module.

    Args:
      place: where it is.
      what: what was asked for, and `allowed`: what may be asked for; for the message.

    Raises:
      UsageError: `place` is not of that form, or there is no such module or object.
    """
    module_name, _, attribute = place.partition(":")
    if not all(part.isidentifier() for part in [*module_name.split("."), attribute]):
        raise UsageError(f"Unknown {what}: {place!r} is not a package.module:NAME. {allowed}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as err:
        if err.name is None or not f"{module_name}.".startswith(f"{err.name}."):
            raise  # The module is there, and what it imports is not.
        raise UsageError(
            f"Unknown {what}: there is no module {module_name} (it has to be importable from "
            f"{Path.cwd()} or installed). {allowed}"
        ) from err
    if not hasattr(module, attribute):
        similar = difflib.get_close_matches(attribute, vars(module), 1, 0.0)
        hint = f"; did you mean {module_name}:{similar[0]}?" if similar else "."
        raise UsageError(f"Unknown {what}: {module_name} has no {attribute}{hint} {allowed}")
    return getattr(module, attribute)


@contextlib.contextmanager
def trusting(trust: bool = True) -> Iterator[None]:
    """Within, `import_recorded` imports whatever is named, if `trust`."""
    token = _TRUSTS.set(trust or _TRUSTS.get())
    try:
        yield
    finally:
        _TRUSTS.reset(token)


def import_recorded(place: str) -> None:
    """Imports the module of `package.module:NAME` that a run names, and says so.

    To import is to run, and somebody else may have written the run: what is neither installed nor
    imported already, as by whoever named it himself, has to be trusted.

    Raises:
      UsageError: it is not.
    """
    module = place.partition(":")[0]
    top = module.partition(".")[0]
    if module in sys.modules or not top.isidentifier():
        return
    spec = importlib.util.find_spec(top)
    if spec is None:
        return  # Whoever needs it says that it is missing.
    origin = spec.origin or ", ".join(spec.submodule_search_locations or ())
    is_installed = {*sys.stdlib_module_names, *importlib.metadata.packages_distributions()}
    if top not in is_installed and not _TRUSTS.get():
        raise UsageError(
            f"The run names {place}, which is not installed; it would be imported from {origin}, "
            "and thereby run. If you know what it does: --trust (trust=True)."
        )
    say(f"Importing {module}, which the run names, from {origin}.")
    with contextlib.suppress(ModuleNotFoundError):
        importlib.import_module(module)


def file_of(name: str, allowed: str) -> Path:
    """The file called `name`, with its whole path.

    Raises:
      UsageError: there is none; it says what is `allowed`.
    """
    path = Path(name).expanduser().resolve()
    try:
        if path.is_file():
            return path
    except OSError as err:  # Such as a name that is too long.
        raise UsageError(f"{name!r} is no file ({err.strerror}). {allowed}") from err
    raise UsageError(f"There is no file {name!r}. {allowed}")


def place_of(path: Path | str) -> Path:
    """Where `pretrained:NAME` lies, which comes with jaxnew; any other path as it is.

    Raises:
      UsageError: nothing of that name comes with jaxnew.
    """
    kind, _, name = str(path).partition(":")
    if kind != PRETRAINED:
        return Path(path)
    names = sorted(folder.name for folder in _SHIPPED.iterdir() if folder.is_dir())
    if name not in names:
        raise UsageError(f"There is no {path}; there is {', '.join(names)}.")
    return _SHIPPED / name


def check_output(folder: Path | str, instead: str = "choose another folder") -> Path:
    """The folder, which is made if absent: before work is done whose result goes there.

    Args:
      instead: what to do where nothing can be written, for the message.

    Raises:
      UsageError: nothing can be written there.
    """
    folder = Path(folder)
    try:
        make_writable(folder)
    except OSError as err:
        raise UsageError(
            f"Nothing can be written in {folder} ({err.strerror}); {instead}."
        ) from err
    return folder


def budget_of(presets: Mapping[str, Budget], name: str, what: str) -> Budget:
    """The preset called `name`.

    Raises:
      UsageError: there is none of that name.
    """
    if name not in presets:
        raise UsageError(f"{what} has no budget {name!r}; choose one of {', '.join(presets)}.")
    return presets[name]
