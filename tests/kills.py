"""Kills at every instant: a process that is dead changes nothing on disk any more."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import pytest


class Killed(BaseException):
    """Stands for the end of the process."""


def dying(after: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Wraps functions that work so many times, all together; each call after that is a kill."""
    calls = itertools.count()

    def wrapped(real: Callable[..., Any]) -> Callable[..., Any]:
        def function(*arguments: Any, **named: Any) -> Any:
            if next(calls) >= after:
                raise Killed
            return real(*arguments, **named)

        return function

    return wrapped


def is_killed(work: Callable[[], object], after: int, functions: Iterable[tuple[Any, str]]) -> bool:
    """Whether `work` is killed before its end, after so many calls of the (module, name)s."""
    wrapped = dying(after)
    with pytest.MonkeyPatch.context() as patch:
        for module, name in functions:
            patch.setattr(module, name, wrapped(getattr(module, name)))
        try:
            work()
        except Killed:
            return True
    return False
