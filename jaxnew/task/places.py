"""Things that are found by name or by place: tasks, methods, budgets."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

Budget = TypeVar("Budget")


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


def file_of(name: str, allowed: str) -> Path:
    """The file called `name`, with its whole path.

    Raises:
      UsageError: there is none; it says what is `allowed`.
    """
    path = Path(name).expanduser().resolve()
    if not path.is_file():
        raise UsageError(f"There is no file {name!r}. {allowed}")
    return path


def budget_of(presets: Mapping[str, Budget], name: str, what: str) -> Budget:
    """The preset called `name`.

    Raises:
      UsageError: there is none of that name.
    """
    if name not in presets:
        raise UsageError(f"{what} has no budget {name!r}; choose one of {', '.join(presets)}.")
    return presets[name]
