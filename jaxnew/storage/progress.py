"""One progress display for every long-running command: a bar on a terminal, lines elsewhere.

What is shown never ends what runs: see `LastingStream`.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import IO, Any, Self, cast

_PLAIN_EVERY_S = 10.0
_MOVES_EVERY_S = 1.0


class LastingStream:
    """A stream of text for people that takes everything, whatever becomes of its reader.

    Letters that a terminal does not have are replaced; once nobody reads, such as behind a pipe
    whose other end was closed, text is dropped. All else is as of the stream inside.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Writes what can be written; returns the length of all."""
        with self._whatever_happens():
            try:
                self._stream.write(text)
            except UnicodeEncodeError as err:
                self._stream.write(text.encode(err.encoding, "replace").decode(err.encoding))
        return len(text)

    def flush(self) -> None:
        with self._whatever_happens():
            self._stream.flush()

    @contextlib.contextmanager
    def _whatever_happens(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            # What is left in the buffers would be an error again, at the latest when Python ends.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            with contextlib.suppress(OSError, ValueError):
                os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError, RuntimeError):
            pass  # A full disk, a terminal that is gone; a closed file; a signal within a print.


def lasting(stream: IO[str]) -> IO[str]:
    """`LastingStream`, for whoever asks for a file."""
    return cast(IO[str], LastingStream(stream))


def say(message: str) -> None:
    """Prints a line that may be lost, but ends nothing."""
    print(message, file=lasting(sys.stdout), flush=True)


def _rich_bar() -> Any | None:
    """A rich progress bar if rich is installed and the output is a terminal, else None."""
    try:
        from rich.console import Console
    except ImportError:
        return None
    console = Console(file=lasting(sys.stdout))
    return bar_on(console) if console.is_terminal else None


def bar_on(console: Any) -> Any:
    """A rich progress bar: a line that fits 80 columns, and its note on a line of its own."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Column
    from rich.text import Text

    class Bar(Progress):
        def get_renderables(self) -> Iterable[Any]:
            yield self.make_tasks_table(self.tasks)
            for task in self.tasks:
                yield Text(f"  {task.fields['note']}", no_wrap=True, overflow="ellipsis")

    title = Column(ratio=2, no_wrap=True, overflow="ellipsis")
    count = "{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}"
    return Bar(
        TextColumn("{task.description}", markup=False, table_column=title),
        BarColumn(None, table_column=Column(ratio=1, min_width=8)),
        TextColumn(count, markup=False, table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=console,
        expand=True,
    )


def duration(seconds: float) -> str:
    """`1:02:03` or `2:03`."""
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"


class ProgressDisplay:
    """Shows how far a job is. A context manager; `update` may be called as often as wanted.

    Between two calls it moves by itself, at the rate so far and no further than the last call moved
    it, and says `about`.

    Args:
      title: what runs.
      total: the number of steps at the end.
      unit: what a step is called.
      start: steps done before this process started; they do not count into the rate.
    """

    def __init__(self, title: str, total: int, unit: str, start: int = 0) -> None:
        self._title, self._total, self._unit = title, total, unit
        self._mark = (start, time.monotonic())
        self._now = self._mark  # Of the last update.
        self._step, self._note = 0, ""
        self._has_ended = threading.Event()
        self._mover = threading.Thread(target=self._move, daemon=True)
        self._last_line_s = float("-inf")
        self._bar = _rich_bar()
        self._task = (
            None
            if self._bar is None
            else self._bar.add_task(title, total=total, completed=start, unit=unit, note="")
        )

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        self._mover.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._has_ended.set()
        self._mover.join()
        if self._bar is not None:
            self._bar.stop()

    def _move(self) -> None:
        while not self._has_ended.wait(_MOVES_EVERY_S):
            done, since = self._now
            waited = time.monotonic() - since
            if done >= self._total:
                continue
            if self._rate:
                moved = min(self._rate * waited, 0.99 * min(self._step, self._total - done))
                self._show(done + moved, self._note, "about ")
            else:
                self._show(done, f"{self._note} for {duration(waited)}")

    @property
    def _rate(self) -> float:
        """Steps per second up to the last update; 0 before there is one."""
        (start, since), (done, now) = self._mark, self._now
        return (done - start) / (now - since) if now > since else 0.0

    def restart_clock(self, done: int) -> None:
        """Leaves what was done so far, such as compilation, out of the time-left estimate."""
        self._mark = (done, time.monotonic())

    def say(self, message: str) -> None:
        """Prints a line of its own, above the bar if there is one."""
        if self._bar is not None:
            self._bar.console.print(message, markup=False, highlight=False)
        else:
            say(message)

    def update(self, done: int, note: str = "") -> None:
        """Moves to `done` steps, with a short note such as key metrics."""
        self._step, self._note = done - self._now[0] or self._step, note
        self._now = (done, time.monotonic())
        self._show(done, note)

    def _show(self, done: float, note: str, about: str = "") -> None:
        if self._bar is not None:
            self._bar.update(self._task, completed=done, note=note)
            return
        now = time.monotonic()
        if now - self._last_line_s < _PLAIN_EVERY_S and done < self._total:
            return
        self._last_line_s = now
        rate = self._rate
        left = f", {duration((self._total - done) / rate)} left" if rate > 0 else ""
        where = f"{about}{int(done)}/{self._total} {self._unit}"
        say(f"{self._title}: {where}{left}{'  ' + note if note else ''}")
