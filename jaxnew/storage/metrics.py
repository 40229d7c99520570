"""Metrics of a run as JSON lines and TensorBoard events."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from jaxnew.storage.files import write_bytes_atomically

FILE_NAME = "metrics.jsonl"
TIME_PREFIX = "time/"  # Wall-clock fields; all others are reproduced exactly by a resumed run.


class MetricsError(ValueError):
    """A metrics file is damaged elsewhere than at its end."""


def _plain_number(value: Any) -> float | int | str | None:
    """A JSON value: NaN becomes None, an infinity becomes the string `inf` or `-inf`."""
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, bool | int):
        return int(number)
    number = float(number)
    if math.isnan(number):
        return None
    return number if math.isfinite(number) else str(number)


def _lines(path: Path) -> list[dict[str, Any]]:
    """The reports in a file; a half-written last line, as a killed process leaves, is left out."""
    if not path.exists():
        return []
    *whole, _ = path.read_bytes().split(b"\n")
    reports = []
    for number, line in enumerate(whole, 1):
        try:
            report = json.loads(line)
            int(report["step"])
        except (ValueError, TypeError, KeyError) as err:
            raise MetricsError(
                f"{path}, line {number} is not a report of a run ({err}). Repair or remove the "
                "line, or start the run anew with --overwrite."
            ) from err
        reports.append(report)
    return reports


def read(path: Path | str) -> list[dict[str, Any]]:
    """Reports in the order they were written, each `{"step": int, name: float or None, ...}`.

    None means that there was nothing to report, such as no finished episode.

    Args:
      path: a run directory, or the metrics file in it. An absent file holds no reports.

    Raises:
      MetricsError: a line other than a half-written last one is damaged.
    """
    path = Path(path)
    reports = _lines(path / FILE_NAME if path.is_dir() else path)
    for report in reports:
        for name, value in report.items():
            if value in ("inf", "-inf"):
                report[name] = float(value)
    return reports


class MetricsLog:
    """Appends reports to `metrics.jsonl` and, if tensorboardX is installed, `tensorboard/`."""

    def __init__(self, run_directory: Path | str) -> None:
        self._folder = Path(run_directory)
        self._path = self._folder / FILE_NAME
        self._last_step = max((report["step"] for report in _lines(self._path)), default=-1)
        self._file: Any = None
        self._events: Any = None

    def cut_back(self, step: int) -> int:
        """Removes the reports of later steps, and a half-written last one; returns how many.

        TensorBoard hides the events of those steps.
        """
        self.close()
        content = self._path.read_bytes() if self._path.exists() else b""
        reports = _lines(self._path)
        kept = [report for report in reports if report["step"] <= step]
        if len(kept) < len(reports) or (content and not content.endswith(b"\n")):
            text = "".join(json.dumps(report) + "\n" for report in kept)
            write_bytes_atomically(self._path, text.encode())
        self._last_step = step
        return len(reports) - len(kept)

    def write(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        """Appends one report.

        Args:
          step: >= 0; which step the values describe.
          values: scalars by name. NaN is recorded as None: nothing to report.
          prefix: put before each name, e.g. `validation/`.
        """
        report = {prefix + name: _plain_number(value) for name, value in values.items()}
        if "step" in report:
            raise ValueError("A metric may not be called `step`, which the report has of its own.")
        self._open()
        self._file.write((json.dumps({"step": int(step), **report}) + "\n").encode())
        self._file.flush()
        self._last_step = max(self._last_step, step)
        if self._events is not None:
            for name, value in report.items():
                if isinstance(value, float | int):
                    self._events.add_scalar(name, value, step)
            self._events.flush()

    def sync(self) -> None:
        """Forces the reports to disk; called before a checkpoint that relies on them."""
        if self._file is not None:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the files; a later `write` opens them again."""
        if self._file is not None:
            self._file.close()
        if self._events is not None:
            self._events.close()
        self._file = self._events = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self) -> None:
        if self._file is not None:
            return
        self._file = self._path.open("ab")
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            return
        purge_step = self._last_step + 1 if self._last_step >= 0 else None
        self._events = SummaryWriter(str(self._folder / "tensorboard"), purge_step=purge_step)
