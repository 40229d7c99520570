"""The state of a run with its bookkeeping: what `loop.run` moves forward, chunk by chunk."""

from __future__ import annotations

import fnmatch
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew._progress import duration
from jaxnew.checkpoint import Checkpointer, Kind
from jaxnew.metrics import TIME_PREFIX, MetricsLog

State = TypeVar("State")
Scalars = Mapping[str, Any]


class NonFiniteError(ArithmeticError):
    """A metric or a parameter is not finite; the state that has it is never saved."""


class Session(Generic[State]):
    """The state of a run with its bookkeeping, from a checkpoint or from the start."""

    def __init__(
        self,
        state: State,
        checkpointer: Checkpointer,
        log: MetricsLog,
        *,
        step_of: Callable[[State], int],
        finite_part: Callable[[State], Any],
        may_be_nan: tuple[str, ...],
        selection_metric: str | None,
    ) -> None:
        self.log = log
        self._checkpointer = checkpointer
        self._step_of, self._finite_part = step_of, finite_part
        self._may_be_nan, self._selection_metric = may_be_nan, selection_metric
        self.last_evaluation: dict[str, float] | None = None
        self.best_metric: float | None = None
        self.best_step: int | None = None
        self._elapsed_s = 0.0
        self.was_resumed = bool(checkpointer.steps("latest"))
        self.is_first_chunk = False
        self._num_chunks = 0
        if self.was_resumed:
            state, metadata = checkpointer.restore("latest", state)
            self.best_metric, self.best_step = metadata["best_metric"], metadata["best_step"]
            self._elapsed_s = metadata["elapsed_s"]
        self.state = state
        self.step = self._saved_step = step_of(state)
        # Whatever was recorded after the checkpoint is made again, identically.
        checkpointer.discard_after(self.step if self.was_resumed else -1)
        log.cut_back(self.step if self.was_resumed else -1)
        self.start_clock()

    def start_clock(self) -> None:
        self._clock = time.monotonic()

    def _lap(self) -> float:
        """Seconds since the last lap, added to the run's elapsed time."""
        now = time.monotonic()
        lap, self._clock = now - self._clock, now
        self._elapsed_s += lap
        return lap

    def advance(
        self, chunk: Callable[[State, int], tuple[State, Scalars]], n: int
    ) -> dict[str, float]:
        """Runs one chunk of n steps; returns its metrics as floats, checked to be finite."""
        before = self.step
        state, metrics = chunk(self.state, n)
        self.state = state
        values = _floats(metrics)
        self.step = self._step_of(state)
        self._num_chunks += 1
        self.is_first_chunk = self._num_chunks == 1
        if self.step != before + n:
            raise ValueError(
                f"The chunk was asked for {n} steps from {before} and ended at {self.step}; the "
                "step counter of the state must count the loop's steps."
            )
        self._check_finite(values)
        return values

    def _check_finite(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            counted = name.startswith("nonfinite/") and value != 0
            may_be_nan = any(fnmatch.fnmatchcase(name, pattern) for pattern in self._may_be_nan)
            if counted or (not math.isfinite(value) and not may_be_nan):
                self._stop(f"{name} is {value}", values)

    def _stop(self, what: str, values: Mapping[str, float]) -> None:
        self.log.sync()
        steps = self._checkpointer.steps("latest")
        last = f"the checkpoint of step {steps[-1]} is good" if steps else "none was saved before"
        listed = ", ".join(f"{name}={value:.4g}" for name, value in values.items())
        raise NonFiniteError(
            f"{what} at step {self.step}; {last}. Lower the learning rate, or rerun with "
            f"--debug_nans to find the operation. Metrics: {listed}"
        )

    def report(
        self,
        metrics: Mapping[str, float],
        before: int,
        steps_unit: str,
        work_per_step: float | None,
        work_unit: str,
    ) -> str:
        """Records the metrics of a chunk; returns the rate, for display."""
        lap_s = max(self._lap(), 1e-9)
        rate = (self.step - before) / lap_s
        times = {"elapsed_s": self._elapsed_s, "steps_per_s": rate}
        text = f"{rate:,.3g} {steps_unit}/s"
        if work_per_step is not None:
            times["work_per_s"] = rate * work_per_step
            text = f"{rate * work_per_step:,.0f} {work_unit}/s"
        timed = {TIME_PREFIX + name: value for name, value in times.items()}
        self.log.write(self.step, {**metrics, **timed})
        return f"{duration(self._elapsed_s)}  {text}"

    def evaluate(
        self,
        evaluate: Callable[[State], Scalars],
        on_evaluation: Callable[[int, State, dict[str, float]], None] | None,
    ) -> bool:
        """Evaluates and records; saves a new best state and says whether there was one."""
        found = _floats(evaluate(self.state))
        self.last_evaluation = found
        selected = self._selection_metric
        if selected is not None and selected not in found:
            raise ValueError(
                f"selection_metric={selected!r} is not in the evaluation, which has: "
                f"{', '.join(found)}."
            )
        lap = {TIME_PREFIX + "evaluation_s": self._lap()}
        if selected is not None and not math.isfinite(found[selected]):
            self._stop(f"{selected} is {found[selected]}", found)
        self.log.write(self.step, {**found, **lap})
        if on_evaluation is not None:
            on_evaluation(self.step, self.state, found)
        if selected is None or (
            self.best_metric is not None and found[selected] <= self.best_metric
        ):
            return False
        self.best_metric, self.best_step = found[selected], self.step
        self._save("best")
        return True

    def save_latest(self) -> None:
        """Saves the state from which a later process goes on, unless that was done already."""
        if self._saved_step != self.step:
            self._save("latest")
            self._saved_step = self.step

    def _save(self, kind: Kind) -> None:
        for path, leaf in jax.tree_util.tree_leaves_with_path(self._finite_part(self.state)):
            value = np.asarray(leaf)
            is_float = jnp.issubdtype(value.dtype, jnp.inexact)
            if is_float and not np.isfinite(value).all():
                self._stop(f"{jax.tree_util.keystr(path)} of the state is not finite", {})
        self.log.sync()
        self._lap()
        metadata = {
            "best_metric": self.best_metric,
            "best_step": self.best_step,
            "elapsed_s": self._elapsed_s,
        }
        self._checkpointer.save(kind, self.step, self.state, metadata)


def _floats(scalars: Scalars) -> dict[str, float]:
    values = jax.device_get(dict(scalars))
    for name, value in values.items():
        if np.ndim(value):
            raise ValueError(
                f"Metric {name} has shape {np.shape(value)}; chunks and evaluations return scalars."
            )
    return {name: float(value) for name, value in values.items()}
