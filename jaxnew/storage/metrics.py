"""Metrics of a run as JSON lines and TensorBoard events.

Each line of `metrics.jsonl` ends with the field `chain`, a short hash of the line and of all before
it, so that a line that was altered, lost or moved is noticed; `read` checks it and leaves it out.
Other readers get it as one more column, which they may drop. Lines of 0.2.0 and before have none.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

from jaxnew.storage.files import access, write_bytes_atomically

FILE_NAME = "metrics.jsonl"
_CHAIN = "chain"
TIME_PREFIX = "time/"  # Wall-clock fields; all others are reproduced exactly by a resumed run.


class MetricsError(ValueError):
    """A metrics file is damaged elsewhere than at its end, or is not that of its run."""


class _Line(NamedTuple):
    """A report, and the chain of it and all before it."""

    report: dict[str, Any]
    chain: str


def _plain_number(value: Any) -> float | int | str | None:
    """A JSON value: NaN becomes None, an infinity becomes the string `inf` or `-inf`."""
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, bool | int):
        return int(number)
    number = float(number)
    if math.isnan(number):
        return None
    return number if math.isfinite(number) else str(number)


def _next(chain: str, report: Mapping[str, Any]) -> str:
    """The chain of a report that follows `chain`."""
    return hashlib.sha256(f"{chain} {json.dumps(report)}".encode()).hexdigest()[:12]


def _text(line: _Line) -> bytes:
    return (json.dumps({**line.report, _CHAIN: line.chain}) + "\n").encode()


def _lines(path: Path) -> list[_Line]:
    """What a file holds; a half-written last line, as a killed process leaves, is left out."""
    try:
        with access(path):
            *whole, _ = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    lines: list[_Line] = []
    for number, text in enumerate(whole, 1):
        try:
            report = json.loads(text)
            int(report["step"])
            chain = _next(lines[-1].chain if lines else "", report_of(report))
            if report.pop(_CHAIN, chain) != chain:
                raise ValueError("it, or a line before it, was altered or lost")
        except (ValueError, TypeError, KeyError) as err:
            raise MetricsError(
                f"{path}, line {number} is not what was written ({err}). Restore the file from a "
                "copy."
            ) from err
        lines.append(_Line(report, chain))
    return lines


def report_of(line: Mapping[str, Any]) -> dict[str, Any]:
    """A line without its chain."""
    return {name: value for name, value in line.items() if name != _CHAIN}


def read(path: Path | str, mark: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """Reports in the order they were written, each `{"step": int, name: float or None, ...}`.

    None means that there was nothing to report, such as no finished episode.

    Args:
      path: a run directory, or the metrics file in it. An absent file holds no reports.
      mark: `MetricsLog.mark` at some time, as in the `metrics` of a checkpoint's metadata; the
        reports of that time have to be there.

    Raises:
      MetricsError: a line other than a half-written last one is damaged, or `mark` is not met.
    """
    path = Path(path)
    path = path / FILE_NAME if os.path.isdir(path) else path
    lines = _lines(path)
    if mark is not None:
        _check(path, lines, mark)
    reports = [line.report for line in lines]
    for report in reports:
        for name, value in report.items():
            if value in ("inf", "-inf"):
                report[name] = float(value)
    return reports


def _check(path: Path, lines: list[_Line], mark: Mapping[str, Any]) -> None:
    """Raises unless the reports of the time of `mark` are there."""
    count = mark["lines"]
    if not count or [line.chain for line in lines[count - 1 : count]] == [mark[_CHAIN]]:
        return
    if path.exists() and path.stat().st_size == 0:
        warnings.warn(f"{path} is empty: its first {count} reports were given up.", stacklevel=3)
        return
    found = f"holds {len(lines)}" if path.exists() else "is missing"
    found = "holds others" if len(lines) >= count else found
    raise MetricsError(
        f"{path} {found}; the run had written {count} reports when its latest checkpoint was "
        "saved. Restore the file from a copy, or put an empty file there to do without the reports "
        "so far."
    )


class _Events:
    """A file for TensorBoard, written here: `SummaryWriter` of tensorboardX has a thread for that,
    which a full disk ends, and then waits for the thread for ever.

    Args:
      folder: of the file; made if absent.
      step: later events of files that are there are hidden from this step on.

    Raises:
      ImportError: tensorboardX is not installed.
    """

    def __init__(self, folder: Path, step: int) -> None:
        from tensorboardX import summary
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._event, self._scalar = Event, summary.scalar
        folder.mkdir(exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"))
        if step:
            self._add(step, session_log=SessionLog(status=SessionLog.START))

    def _add(self, step: int, **content: Any) -> None:
        self._writer.write_event(self._event(wall_time=time.time(), step=step, **content))

    def write(self, step: int, report: Mapping[str, Any]) -> None:
        for name, value in report.items():
            if isinstance(value, float | int):
                self._add(step, summary=self._scalar(name, value))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class MetricsLog:
    """Appends reports to `metrics.jsonl` and, if tensorboardX is installed, `tensorboard/`."""

    def __init__(self, run_directory: Path | str) -> None:
        self._folder = Path(run_directory)
        self._path = self._folder / FILE_NAME
        self._file: Any = None
        self._events: _Events | None = None
        self._has_events = True
        self._set(_lines(self._path))

    def _set(self, lines: list[_Line]) -> None:
        self._num_lines = len(lines)
        self._chain = lines[-1].chain if lines else ""
        self._last_step = max((line.report["step"] for line in lines), default=-1)

    @property
    def mark(self) -> dict[str, Any]:
        """What there is so far, as plain JSON; see `read`."""
        return {"lines": self._num_lines, _CHAIN: self._chain}

    def cut_back(self, step: int) -> int:
        """Removes the reports of later steps, and a half-written last one; returns how many.

        TensorBoard hides the events of those steps.
        """
        self.close()
        content = self._path.read_bytes() if self._path.exists() else b""
        lines = _lines(self._path)
        kept: list[_Line] = []
        for line in lines:
            if line.report["step"] <= step:
                before = kept[-1].chain if kept else ""
                kept.append(_Line(line.report, _next(before, line.report)))
        if len(kept) < len(lines) or (content and not content.endswith(b"\n")):
            write_bytes_atomically(self._path, b"".join(map(_text, kept)))
        self._set(kept)
        self._last_step = step
        return len(lines) - len(kept)

    def write(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        """Appends one report.

        Args:
          step: >= 0; which step the values describe.
          values: scalars by name. NaN is recorded as None: nothing to report.
          prefix: put before each name, e.g. `validation/`.
        """
        report = {prefix + name: _plain_number(value) for name, value in values.items()}
        for name in ("step", _CHAIN):
            if name in report:
                raise ValueError(
                    f"A metric may not be called `{name}`, which the report has of its own."
                )
        self._open()
        report = {"step": int(step), **report}
        line = _Line(report, _next(self._chain, report))
        self._append(_text(line))
        self._num_lines, self._chain = self._num_lines + 1, line.chain
        self._last_step = max(self._last_step, step)
        values = {name: value for name, value in report.items() if name != "step"}
        self._show(lambda events: events.write(step, values))

    def _append(self, text: bytes) -> None:
        """Writes a line whole or not at all."""
        size = os.fstat(self._file.fileno()).st_size
        try:
            with access(self._path, "written"):
                while text:  # A full disk may take a part.
                    text = text[self._file.write(text) :]
        except BaseException:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), size)
            raise

    def sync(self) -> None:
        """Forces the reports to disk; called before a checkpoint that relies on them."""
        if self._file is not None:
            with access(self._path, "written"):
                os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the files; a later `write` opens them again."""
        if self._file is not None:
            self._file.close()
        self._show(_Events.close)
        self._file = self._events = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self) -> None:
        if self._file is not None:
            return
        with access(self._path, "written"):
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
            self._file = os.fdopen(os.open(self._path, flags, 0o644), "ab", buffering=0)
        if self._has_events:
            try:
                self._events = _Events(self._folder / "tensorboard", self._last_step + 1)
            except ImportError:
                self._has_events = False
            except OSError as err:
                self._give_up_events(err)

    def _show(self, use: Callable[[_Events], None]) -> None:
        """Uses the events, if there are any: without them the run goes on."""
        if self._events is not None:
            try:
                use(self._events)
            except OSError as err:
                self._give_up_events(err)

    def _give_up_events(self, err: OSError) -> None:
        folder = self._folder / "tensorboard"
        warnings.warn(f"{folder} cannot be written ({err}); nothing more goes there.", stacklevel=3)
        self._events, self._has_events = None, False
