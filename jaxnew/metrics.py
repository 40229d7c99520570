"""Metrics of a run as JSON lines and TensorBoard events, and confidence intervals."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from jaxnew._files import write_bytes_atomically

FILE_NAME = "metrics.jsonl"
TIME_PREFIX = "time/"  # Wall-clock fields; all others are reproduced exactly by a resumed run.
_Z_95 = 1.959963984540054


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


class Interval(NamedTuple):
    """An estimate with a 95 % confidence interval."""

    mean: float
    low: float
    high: float


def wilson_interval(successes: int, trials: int) -> Interval:
    """Wilson's 95 % score interval for a proportion: inside [0, 1], sound for rare events.

    Raises:
      ValueError: not 0 <= successes <= trials, or no trial.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(
            f"A proportion needs trials >= 1 and 0 <= successes <= trials, got {successes} of "
            f"{trials}."
        )
    share, z2 = successes / trials, _Z_95**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z_95 * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    half /= 1 + z2 / trials
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    return Interval(share, low, 1.0 if successes == trials else min(1.0, centre + half))


def mean_interval(values: np.ndarray) -> Interval:
    """Mean with its normal 95 % interval, `mean +- 1.96 s / sqrt(n)`; no width for one value.

    Args:
      values: f[n], n >= 1, independent (episodes of one policy, or one number per seed).

    Raises:
      ValueError: `values` is not a non-empty vector.
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"Need a non-empty vector of values, got shape {values.shape}.")
    mean = float(values.mean())
    spread = float(values.std(ddof=1)) if values.size > 1 else 0.0
    half = _Z_95 * spread / math.sqrt(values.size)
    return Interval(mean, mean - half, mean + half)
