"""Levels by name, from a file, from a folder, from a text."""

from __future__ import annotations

import difflib
import json
from functools import cache
from importlib import resources
from pathlib import Path

from envs_host.create.levels.schema import Level, LevelError, read_level
from jaxnew.actions import read_text

TASK_NAMES = (
    "Push",
    "Navigate",
    "Ladder",
    "Cannon",
    "Obstacle",
    "Seesaw",
    "Belt",
    "Buckets",
    "Collide",
    "Moving",
    "Basket",
    "Funnel",
)
BUILT_IN_NAMES = (*TASK_NAMES, "GoalTest")

_registered: dict[str, Level] = {}


def level_names() -> tuple[str, ...]:
    """Names that `load_level` knows: the twelve tasks, GoalTest, then registered ones."""
    return (*BUILT_IN_NAMES, *_registered)


def load_level(name_or_path: str | Path) -> Level:
    """A level by its name, or from a JSON file (a path, or a text that ends in `.json`).

    Raises:
      LevelError: there is no such level, or its file is wrong.
    """
    if isinstance(name_or_path, Path) or name_or_path.endswith(".json"):
        return _read_file(Path(name_or_path))
    if name_or_path in _registered:
        return _registered[name_or_path]
    if name_or_path in BUILT_IN_NAMES:
        return _load_built_in(name_or_path)
    near = difflib.get_close_matches(name_or_path, level_names(), n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise LevelError(
        f"There is no level {name_or_path!r}; known are {level_names()}, or give a path of a .json "
        f"file.{hint}"
    )


def parse_level(text: str, source: str = "the text") -> Level:
    """A level from JSON text.

    Raises:
      LevelError: the text is not JSON, or not a level; `source` is named.
    """
    try:
        record = json.loads(text)
    except (ValueError, RecursionError) as err:
        raise LevelError(f"{source} is not JSON: {err}. See levels.schema for the fields.") from err
    return read_level(record, source)


def register_level(text: str) -> str:
    """Makes a level, given as JSON text, known to `load_level` in this process.

    Returns:
      its name.

    Raises:
      LevelError: the level is wrong, or its name is taken by another one.
    """
    return _register(parse_level(text), "the text")


def register_folder(path: str | Path) -> tuple[str, ...]:
    """Makes every `*.json` of a folder known to `load_level` in this process; all or none.

    Returns:
      their names, sorted by file.

    Raises:
      LevelError: the folder holds none, a file is wrong, or a name is taken.
    """
    files = sorted(Path(path).glob("*.json"))
    if not files:
        raise LevelError(f"{path} holds no level file (*.json).")
    levels = [(_read_file(file), str(file)) for file in files]
    for place, (level, source) in enumerate(levels):
        _check_free(level, source)
        if level.name in [earlier.name for earlier, _ in levels[:place]]:
            raise LevelError(f"{source}: name is {level.name!r}, which another file has, too.")
    return tuple(_register(level, source) for level, source in levels)


def _register(level: Level, source: str) -> str:
    _check_free(level, source)
    _registered[level.name] = level
    return level.name


def _check_free(level: Level, source: str) -> None:
    is_same = _registered.get(level.name) == level
    if level.name in BUILT_IN_NAMES or (level.name in _registered and not is_same):
        raise LevelError(
            f"{source}: name is {level.name!r}; it must not be one of those taken: {level_names()}."
        )


@cache
def _load_built_in(name: str) -> Level:
    file = resources.files("envs_host.create.levels") / f"{name}.json"
    return parse_level(file.read_text(), str(file))


def _read_file(path: Path) -> Level:
    if not path.is_file():
        raise LevelError(
            f"{path} is no file; give a level's name {level_names()} or its JSON file."
        )
    try:
        text = read_text(path)
    except OSError as err:
        raise LevelError(f"{path} cannot be read: {err.strerror}.") from err
    except ValueError as err:
        raise LevelError(str(err)) from err
    return parse_level(text, str(path))
