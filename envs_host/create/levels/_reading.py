"""Reads fields of parsed JSON and says exactly what is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from envs_host.create.geometry import Point
from envs_host.create.levels.object_types import POSITION, Parameter, Value

MAX_ITEMS = 1000  # Of a list: a world with as many things still takes about a second to draw.
_MISSING = object()


class LevelError(ValueError):
    """A level file that cannot be used; names the file, the field and what is allowed."""


class Reader:
    """One JSON object of a level file, read field by field."""

    def __init__(self, record: object, source: str, path: str = "") -> None:
        self.source = source
        self.path = path
        if not isinstance(record, dict):
            raise self.error("", record, "an object { ... }")
        self.record: dict[str, Any] = record
        self._known: set[str] = set()

    def error(self, name: str, got: object, allowed: str) -> LevelError:
        """The error for a field, to be raised."""
        place = ".".join(part for part in (self.path, name) if part) or "the level"
        text = repr(got)
        text = text if len(text) < 100 else f"{text[:100]}..."
        return LevelError(f"{self.source}: {place} is {text}; it must be {allowed}.")

    def finish(self) -> None:
        """Raises if the object holds a field that nobody has asked for."""
        unknown = sorted(set(self.record) - self._known)
        if unknown:
            place = ".".join(part for part in (self.path, unknown[0]) if part)
            raise LevelError(
                f"{self.source}: {place} is not a field; allowed here: {sorted(self._known)}."
            )

    def child(self, name: str, optional: bool = False) -> Reader:
        """The object in a field; an empty one if it is optional and missing."""
        value = self._take(name, {} if optional else _MISSING)
        return Reader(value, self.source, self._place(name))

    def children(self, name: str) -> list[Reader]:
        """The objects in a list; none if it is missing."""
        items = self._list(name, [])
        return [
            Reader(item, self.source, f"{self._place(name)}[{i}]") for i, item in enumerate(items)
        ]

    def text(self, name: str) -> str:
        value = self._take(name)
        if not isinstance(value, str) or not value:
            raise self.error(name, value, "a text")
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        values = self._list(name)
        if not values or not all(isinstance(value, str) for value in values):
            raise self.error(name, values, "a list of texts, at least one")
        return tuple(values)

    def flag(self, name: str) -> bool:
        """True or false; false if missing."""
        value = self._take(name, False)
        if not isinstance(value, bool):
            raise self.error(name, value, "true or false")
        return value

    def choice(self, name: str, choices: Sequence[Any], default: Any = _MISSING) -> Any:
        value = self._take(name, default)
        if isinstance(value, bool) or value not in choices:
            raise self.error(name, value, f"one of {tuple(choices)}")
        return value

    def whole(self, name: str, default: int, low: int, high: int) -> int:
        value = self._take(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.error(name, value, f"a whole number from {low} to {high}")
        return value

    def point(self, name: str) -> Point:
        return self._pair(name, self._take(name), POSITION)

    def points(self, name: str) -> tuple[Point, ...]:
        """A list of positions; none if it is missing."""
        items = self._list(name, [])
        return tuple(self._pair(f"{name}[{i}]", item, POSITION) for i, item in enumerate(items))

    def interval(self, name: str) -> Point:
        low, high = self.point(name)
        if low > high:
            raise self.error(name, [low, high], "[low, high] with low <= high")
        return low, high

    def parameter(self, name: str, parameter: Parameter) -> Value:
        """A parameter of an object, with its default and its range."""
        default = _MISSING if parameter.default is None else parameter.default
        value = self._take(name, default, parameter.allowed)
        if parameter.kind == "pair":
            return self._pair(name, value, parameter)
        if parameter.kind == "choice":
            if value not in parameter.choices:
                raise self.error(name, value, parameter.allowed)
            return value
        return self._number(name, value, parameter)

    def _take(self, name: str, default: Any = _MISSING, allowed: str = "given") -> Any:
        self._known.add(name)
        value = self.record.get(name, default)
        if value is _MISSING:
            raise LevelError(
                f"{self.source}: {self._place(name)} is missing; it must be {allowed}."
            )
        return value

    def _list(self, name: str, default: Any = _MISSING) -> list:
        value = self._take(name, default)
        if not isinstance(value, list):
            raise self.error(name, value, "a list [ ... ]")
        if len(value) > MAX_ITEMS:
            raise LevelError(
                f"{self.source}: {self._place(name)} has {len(value):,} entries; it must have "
                f"{MAX_ITEMS:,} at most."
            )
        return value

    def _number(self, name: str, value: object, parameter: Parameter) -> float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        # False for NaN; whole numbers of any size can be compared.
        if not is_number or not parameter.low <= value <= parameter.high:  # type: ignore[operator]
            raise self.error(name, value, parameter.allowed)
        return float(value)  # type: ignore[arg-type]

    def _pair(self, name: str, value: object, parameter: Parameter) -> Point:
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise self.error(name, value, parameter.allowed)
        each = replace(parameter, kind="number")
        return self._number(f"{name}[0]", value[0], each), self._number(
            f"{name}[1]", value[1], each
        )

    def _place(self, name: str) -> str:
        return f"{self.path}.{name}" if self.path else name
