"""Typed configuration: a tree of frozen dataclasses, its plain JSON form, and `path=value` edits.

Legal field types: int, float, bool, str, `Literal`, `X | None`, tuples, and further frozen
dataclasses. An int is accepted where a float is asked for, never the other way round, and a bool
is never a number. Every error names the full path of the field.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar, Union

Config = TypeVar("Config")
Difference = tuple[str, Any, Any]
Assignments = Sequence[str] | Mapping[str, Any]


class ConfigError(ValueError):
    """A configuration has a field that does not exist, is missing, or has an illegal value."""


class _Absent:
    """Stands for a field that one of two compared configurations does not have."""

    def __repr__(self) -> str:
        return "(absent)"


ABSENT = _Absent()


def _field_types(cls: type) -> dict[str, Any]:
    """The annotation of each field of `cls` that can be given, by name."""
    hints = typing.get_type_hints(cls)
    fields = dataclasses.fields(cls)
    return {field.name: hints[field.name] for field in fields if field.init}


def _type_name(annotation: Any) -> str:
    plain_class = isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias)
    return annotation.__name__ if plain_class else str(annotation).replace("typing.", "")


def _options(annotation: Any) -> tuple[Any, ...] | None:
    """The members of a union, or None if `annotation` is not one."""
    is_union = typing.get_origin(annotation) in (Union, types.UnionType)
    return typing.get_args(annotation) if is_union else None


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _wrong_type(path: str, annotation: Any, value: Any) -> ConfigError:
    return ConfigError(
        f"{path or 'config'} must be {_type_name(annotation)}, got {value!r} "
        f"({type(value).__name__})."
    )


def _element_types(annotation: Any, count: int, path: str) -> list[Any]:
    """The type of each of `count` elements of a tuple annotation."""
    elements = typing.get_args(annotation)
    if len(elements) == 2 and elements[1] is Ellipsis:
        return [elements[0]] * count
    if len(elements) != count:
        raise ConfigError(f"{path} must have {len(elements)} elements, got {count}.")
    return list(elements)


def _build(annotation: Any, value: Any, path: str) -> Any:
    """`value` (plain JSON, or what a dataclass holds) as a checked value of type `annotation`."""
    options = _options(annotation)
    if options is not None:
        return _build_union(annotation, options, value, path)
    if dataclasses.is_dataclass(annotation):
        return _build_dataclass(annotation, value, path)
    if annotation is type(None):
        if value is not None:
            raise ConfigError(f"{path} has nothing to set, got {value!r}.")
        return None
    if typing.get_origin(annotation) is tuple:
        if not isinstance(value, list | tuple):
            raise _wrong_type(path, annotation, value)
        kinds = _element_types(annotation, len(value), path)
        pairs = enumerate(zip(kinds, value, strict=True))
        return tuple(_build(kind, element, f"{path}[{i}]") for i, (kind, element) in pairs)
    if typing.get_origin(annotation) is Literal:
        return _build_literal(annotation, value, path)
    return _build_scalar(annotation, value, path)


def _build_union(annotation: Any, options: tuple[Any, ...], value: Any, path: str) -> Any:
    if value is None and type(None) in options:
        return None
    rest = [option for option in options if option is not type(None)]
    if len(rest) == 1 and dataclasses.is_dataclass(rest[0]):
        return _build(rest[0], value, path)
    for option in rest:
        with contextlib.suppress(ConfigError):
            return _build(option, value, path)
    raise _wrong_type(path, annotation, value)


def _build_literal(annotation: Any, value: Any, path: str) -> Any:
    for choice in typing.get_args(annotation):
        if type(choice) is type(value) and choice == value:
            return choice
    choices = ", ".join(repr(choice) for choice in typing.get_args(annotation))
    raise ConfigError(f"{path} must be one of {choices}, got {value!r}.")


def _build_scalar(annotation: Any, value: Any, path: str) -> Any:
    if annotation is float and type(value) in (int, float):
        if not math.isfinite(value):
            raise ConfigError(f"{path} must be a finite float, got {value!r}.")
        return float(value)
    if annotation not in (int, float, bool, str):
        raise TypeError(
            f"{path or 'config'} is annotated {_type_name(annotation)}, which configurations do "
            "not support; use int, float, bool, str, Literal, X | None, tuple or a dataclass."
        )
    if type(value) is not annotation:
        raise _wrong_type(path, annotation, value)
    return value


def _build_dataclass(cls: Any, value: Any, path: str) -> Any:
    if not isinstance(value, Mapping):
        raise _wrong_type(path, cls, value)
    fields = _field_types(cls)
    where = path or cls.__name__
    for name in value:
        if name not in fields:
            raise ConfigError(
                f"{_join(path, str(name))} does not exist; {where} has: {', '.join(fields)}."
                + _nearest(str(name), list(fields))
            )
    missing = [_join(path, name) for name in fields if name not in value]
    if missing:
        raise ConfigError(f"{', '.join(missing)} is missing; {where} needs every field.")
    arguments = {
        name: _build(kind, value[name], _join(path, name)) for name, kind in fields.items()
    }
    try:
        return cls(**arguments)
    except (ValueError, TypeError) as err:
        raise ConfigError(f"{where}: {err}") from err


def plain(value: Any) -> Any:
    """The plain form of a configuration, or of a part of one, unchecked."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {name: plain(getattr(value, name)) for name in _field_types(type(value))}
    return [plain(element) for element in value] if isinstance(value, tuple) else value


def to_dict(config: Any) -> dict[str, Any]:
    """The plain JSON form (dicts, lists, numbers, strings, None) of a configuration.

    Raises:
      ConfigError: a value does not have its annotated type, or a float is not finite.
    """
    checked = _build_dataclass(type(config), plain(config), "")
    return typing.cast(dict[str, Any], plain(checked))


def from_dict(cls: type[Config], plain: Mapping[str, Any]) -> Config:
    """Inverse of `to_dict`: `from_dict(type(config), to_dict(config)) == config`.

    Raises:
      ConfigError: a field is unknown, missing or of the wrong type, or the class's own
        `__post_init__` refuses the values; the message names the path.
    """
    return typing.cast(Config, _build_dataclass(cls, plain, ""))


def _paths(config: Any, path: str = "") -> Iterator[str]:
    """The full path of every field that can be named, groups included."""
    for name in _field_types(type(config)):
        yield _join(path, name)
        if dataclasses.is_dataclass(getattr(config, name)):
            yield from _paths(getattr(config, name), _join(path, name))


def _nearest(wrong: str, paths: Sequence[str]) -> str:
    """` Did you mean ...?` with the path most like `wrong`, or nothing."""
    by_path = difflib.get_close_matches(wrong, paths, n=1, cutoff=0.6)
    last = {path: path.rpartition(".")[2] for path in paths}
    by_name = difflib.get_close_matches(wrong.rpartition(".")[2], last.values(), n=1, cutoff=0.7)
    if by_name and (not by_path or last[by_path[0]] != by_name[0]):
        by_path = [next(path for path, name in last.items() if name == by_name[0])]
    return f" Did you mean {by_path[0]}?" if by_path else ""


def _resolve(config: Any, path: str) -> Any:
    """The annotation of the field at `path`."""
    node, annotation, walked = config, type(config), ""
    for name in path.split("."):
        if node is None:
            raise ConfigError(f"{path} cannot be set: {walked} is None in this configuration.")
        fields = _field_types(type(node)) if dataclasses.is_dataclass(node) else {}
        if name not in fields:
            legal = ", ".join(_join(walked, field) for field in fields)
            known = list(_paths(config))
            has = f"legal here: {legal}." if fields else f"{walked} is not a group of fields."
            raise ConfigError(f"{path} does not exist; {has}{_nearest(path, known)}")
        annotation, node, walked = fields[name], getattr(node, name), _join(walked, name)
    if dataclasses.is_dataclass(node):
        fields_of_group = ", ".join(_join(walked, field) for field in _field_types(type(node)))
        raise ConfigError(f"{path} is a group of fields; set one of them: {fields_of_group}.")
    return annotation


def _parse(annotation: Any, text: str, path: str) -> Any:
    """The value that `text` from a command line means for a field of type `annotation`."""
    options = _options(annotation)
    if options is not None:
        if type(None) in options and text.lower() in ("none", "null"):
            return None
        rest = [option for option in options if option is not type(None)]
        for option in rest[:-1]:
            try:
                return _parse(option, text, path)
            except ConfigError:
                continue
        return _parse(rest[-1], text, path)
    if typing.get_origin(annotation) is tuple:
        parts = [part.strip() for part in text.strip().strip("()[]").split(",")]
        parts = parts[:-1] if parts[-1] == "" else parts
        kinds = _element_types(annotation, len(parts), path)
        return tuple(_parse(kind, part, path) for kind, part in zip(kinds, parts, strict=True))
    if typing.get_origin(annotation) is Literal:
        named = {str(choice): choice for choice in typing.get_args(annotation)}
        return _build_literal(annotation, named.get(text, text), path)
    if annotation is bool:
        if text.lower() not in ("true", "false", "1", "0"):
            raise ConfigError(f"{path} must be bool (true or false), got {text!r}.")
        return text.lower() in ("true", "1")
    if annotation in (int, float):
        try:
            return annotation(text)
        except ValueError as err:
            raise ConfigError(f"{path} must be {annotation.__name__}, got {text!r}.") from err
    return text


def set_paths(config: Config, assignments: Assignments) -> Config:
    """A copy of `config` with every assignment applied at once.

    Fields that are legal only together may be set together.

    Args:
      assignments: `{path.to.field: value}`, or texts `path.to.field=value`. Text is read by the
        type of the field: `none` for `X | None`, `64,64` for tuples, `true` and `false` for bools.

    Raises:
      ConfigError: a path does not exist (names the nearest), a value has the wrong type, or the
        new configuration is refused by a `__post_init__`.
    """
    tree = to_dict(config)
    pairs = split_assignments(assignments)
    for path, value in pairs:
        annotation = _resolve(config, path)
        if isinstance(value, str):
            value = _parse(annotation, value.strip(), path)
        *groups, name = path.split(".")
        functools.reduce(lambda node, group: node[group], groups, tree)[name] = plain(value)
    try:
        return from_dict(type(config), tree)
    except ConfigError as err:
        given = " ".join(f"{path}={value}" for path, value in pairs)
        raise ConfigError(f"{given}: {err}") from err


def split_assignments(assignments: Assignments) -> list[tuple[str, Any]]:
    """(path, value) of each assignment.

    Raises:
      ConfigError: a text is not of the form `path=value`.
    """
    if isinstance(assignments, Mapping):
        return [(str(path), value) for path, value in assignments.items()]
    pairs = []
    for text in assignments:
        path, equals, value = text.partition("=")
        if not equals or not path.strip():
            raise ConfigError(f"{text!r} must look like path.to.field=value.")
        pairs.append((path.strip(), value))
    return pairs


def vary(config: Config, changes: Mapping[str, Any]) -> Config:
    """A copy with some fields changed at once; `group__field` is the path `group.field`.

    Raises:
      ConfigError: see `set_paths`.
    """
    return set_paths(config, {name.replace("__", "."): value for name, value in changes.items()})


def differences(old: Any, new: Any, path: str = "") -> list[Difference]:
    """`(path, old value, new value)` of each field in which two configurations differ.

    Either side is a configuration or its plain form; a field of one side only is `ABSENT` in the
    other. Of lists of configurations, such as those of a sweep's members, it is the distinct values
    of a field that differ.
    """
    old = to_dict(old) if dataclasses.is_dataclass(old) else old
    new = to_dict(new) if dataclasses.is_dataclass(new) else new
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        found = []
        for name in [*old, *(name for name in new if name not in old)]:
            pair = old.get(name, ABSENT), new.get(name, ABSENT)
            found += differences(*pair, _join(path, str(name)))
        return found
    old = list(old) if isinstance(old, tuple) else old
    new = list(new) if isinstance(new, tuple) else new
    if _are_groups(old) and _are_groups(new) and old != new:
        pair = _values(old), _values(new)
        return differences(*pair, path) or [(path, "the same values", "in another order")]
    is_same = old == new and isinstance(old, bool) == isinstance(new, bool)
    return [] if is_same else [(path, old, new)]


def _are_groups(value: Any) -> bool:
    """Whether a value is a list of configurations."""
    return isinstance(value, list) and bool(value) and isinstance(value[0], Mapping)


def _values(configs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """By path, the value that all configurations have, or the list of their distinct ones."""
    found: dict[str, list[Any]] = {}
    for config in configs:
        for path, value in _leaves(config):
            of_path = found.setdefault(path, [])
            of_path += [value] * (value not in of_path)
    return {path: values[0] if len(values) == 1 else values for path, values in found.items()}


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Path and value of every field of a plain configuration that is no group."""
    if isinstance(value, Mapping):
        for name in value:
            yield from _leaves(value[name], _join(path, str(name)))
    else:
        yield path, value
