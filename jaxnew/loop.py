"""The loop around compiled chunks: progress, metrics, evaluation, checkpoints, resume, stop.

Both stages and fine-tuning use it. Killing the process at any instant and running again gives the
same states and the same metrics as one undisturbed run (bit for bit where the chunk is
deterministic), because a `latest` checkpoint at step s is written after everything that belongs to
steps <= s, and a resumed run removes everything that belongs to later ones. Only a run that never
had a `latest` checkpoint is begun anew; one that has lost it is refused and left as it is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import math
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew import finiteness
from jaxnew.storage.checkpoint import KINDS, Checkpointer, CheckpointError, Kind
from jaxnew.storage.metrics import TIME_PREFIX, MetricsLog, read
from jaxnew.storage.progress import ProgressDisplay, duration, say
from jaxnew.storage.run_directory import RunDirectory

State = TypeVar("State")
Scalars = Mapping[str, Any]
CHECKPOINT_EVERY_S = 300.0  # Of wall clock, whatever the rhythm.


@dataclass(frozen=True)
class LoopResult(Generic[State]):
    """How a run ended.

    Attributes:
      state: after the last finished chunk.
      step: its step.
      best_metric, best_step: the highest value of the selection metric and the first step that
        reached it; None if nothing was evaluated. The `best` checkpoint holds that state.
      interrupted_by: number of the signal that arrived while the run went on; None if none did.
      was_resumed: the run started from a checkpoint.
      last_evaluation: what the last evaluation of this process returned, or None.
    """

    state: State
    step: int
    best_metric: float | None
    best_step: int | None
    interrupted_by: int | None
    was_resumed: bool
    last_evaluation: dict[str, float] | None

    @property
    def was_interrupted(self) -> bool:
        """A signal asked the run, and what would follow it, to end; run again to go on."""
        return self.interrupted_by is not None


@dataclass(frozen=True)
class Rhythm:
    """When a run does what, in steps of its state.

    Attributes:
      total_steps: at the end.
      chunk_steps: per call.
      checkpoint_every: between `latest` checkpoints, which are five minutes apart at most.
      evaluate_every: between evaluations; None: nothing is evaluated.

    Raises:
      ValueError: one of them is below 1.
    """

    total_steps: int
    chunk_steps: int
    checkpoint_every: int
    evaluate_every: int | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None and value < 1:
                raise ValueError(f"{field.name} must be at least 1, got {value}.")


@dataclass(frozen=True)
class Display:
    """What is shown of a run.

    Attributes:
      title: what runs.
      unit: what a step is called.
      work_per_step: e.g. environment steps per update, for the reported rate in `work_unit`.
      work_unit: see there.
      metrics: names of those shown beside the progress bar.
    """

    title: str
    unit: str = "updates"
    work_per_step: float | None = None
    work_unit: str = "env steps"
    metrics: tuple[str, ...] = ()


def run(
    state: State,
    chunk: Callable[[State, int], tuple[State, Scalars]],
    run_directory: RunDirectory,
    rhythm: Rhythm,
    display: Display,
    *,
    evaluate: Callable[[State], Scalars] | None = None,
    selection_metric: str | None = None,
    may_be_nan: Sequence[str] = ("episode/*",),
) -> LoopResult[State]:
    """Runs `chunk` until the end, resuming from the run directory if it holds a checkpoint.

    Evaluations and checkpoints happen at the end of the first chunk that reaches or passes a
    multiple of their interval, and at the end of the run; a checkpoint also at the end of the first
    chunk that ends five minutes after the last one, so that a kill loses five minutes and a chunk
    at most. A new best evaluation is checkpointed at once. SIGINT and SIGTERM let the chunk finish,
    save, and return; a second one stops at once, which loses only what came after the last
    checkpoint.

    Args:
      state: freshly initialised pytree at step 0, replaced by the checkpoint when resuming. Its
        `step` counts the finished steps; its `params`, if it has any, must be finite to be saved.
      chunk: `(state, n) -> (state, metrics)`: n steps, n static, and scalars reduced over them. It
        sees at most two values of n: `chunk_steps`, and the rest at the end. Random numbers must
        come from the state alone.
      run_directory: open for writing.
      rhythm: when to do what.
      display: what to show.
      evaluate: `state -> {name: float}`; must not change or donate the state and must draw from
        fixed keys.
      selection_metric: name in the evaluation; the highest value wins, the first of equal ones.
      may_be_nan: patterns of metric names that are NaN where no episode ended.

    Raises:
      NonFiniteError: a metric that may not be NaN is not finite, a `nonfinite/*` count is above
        zero, or `params` are not finite. The checkpoints hold earlier, good states.
      CheckpointError: there are checkpoints but none that is readable and fits the state, or the
        `latest` ones were lost.
      MetricsError: `metrics.jsonl` is not what it was when the checkpoint was saved.
      ValueError: arguments do not fit together, or the evaluation lacks the selection metric.
    """
    total_steps, title = rhythm.total_steps, display.title
    if (evaluate is None) != (rhythm.evaluate_every is None):
        raise ValueError("Give both evaluate and evaluate_every, or neither.")
    if selection_metric is not None and evaluate is None:
        raise ValueError(f"selection_metric={selection_metric!r} needs evaluate.")
    if not run_directory.is_writable:
        raise ValueError(
            f"{run_directory.path} is open for reading; open it with RunDirectory.open_or_create."
        )
    session: _Session[State] = _Session(
        state,
        run_directory,
        may_be_nan=tuple(may_be_nan),
        selection_metric=selection_metric,
    )
    if session.step > total_steps:
        raise ValueError(
            f"{run_directory.path} is at step {session.step}, past total_steps={total_steps}. Ask "
            "for more steps or choose another --workdir."
        )
    progress = ProgressDisplay(title, total_steps, display.unit, session.step)
    if session.was_resumed:
        is_done = session.step == total_steps
        where = f"{run_directory.path} at step {session.step} of {total_steps}"
        progress.say(f"{title}: {'already complete' if is_done else 'resuming'}, {where}.")
    is_slow = False  # Which is said once.
    with progress, session.log, _interruption() as received:
        session.start_clock()
        if session.step < total_steps:
            first = min(rhythm.chunk_steps, total_steps - session.step)
            progress.update(session.step, f"compiling, and the first {first}")
        while session.step < total_steps and not received:
            before = session.step
            metrics = session.advance(chunk, min(rhythm.chunk_steps, total_steps - before))
            rate = session.report(metrics, before, display)
            if session.chunk_s > CHECKPOINT_EVERY_S and not is_slow:
                is_slow = True
                progress.say(
                    f"{title}: a chunk of {session.step - before} {display.unit} takes "
                    f"{duration(session.chunk_s)}, and a kill loses as much. Shorter ones lose "
                    "less; those of a policy are set by --set=loop.chunk_updates=N."
                )
            if session.is_first_chunk:
                progress.restart_clock(session.step)
            progress.update(session.step, _note(rate, metrics, display.metrics))
            is_last = session.step >= total_steps
            is_due = is_passed(rhythm.checkpoint_every, before, session.step) or session.is_overdue
            if evaluate is not None and (
                is_last or is_passed(rhythm.evaluate_every, before, session.step)
            ):
                is_due = session.evaluate(evaluate) or is_due
            if is_due:
                session.save_latest()
        if session.lacks_best and evaluate is not None and session.step == total_steps:
            session.evaluate(evaluate, is_recorded=False)
        session.save_latest()
        if received:
            progress.say(f"{title}: stopped at step {session.step}; run again to go on.")
    return LoopResult(
        state=session.state,
        step=session.step,
        best_metric=session.best_metric,
        best_step=session.best_step,
        interrupted_by=received[0] if received else None,
        was_resumed=session.was_resumed,
        last_evaluation=session.last_evaluation,
    )


def is_passed(interval: int | None, before: int, after: int) -> bool:
    """Whether a multiple of `interval` lies in (before, after]."""
    return interval is not None and after // interval > before // interval


def _note(rate: str, metrics: Mapping[str, float], shown: Sequence[str]) -> str:
    values = [f"{name} {metrics[name]:.4g}" for name in shown if name in metrics]
    return "  ".join([rate, *values])


@contextlib.contextmanager
def _interruption() -> Iterator[list[int]]:
    """Yields what lists SIGINT and SIGTERM once they arrive; the second one acts as ever.

    Outside the main thread signals keep their meaning.
    """
    previous: dict[int, Any] = {}
    received: list[int] = []

    def note(number: int, frame: Any) -> None:
        received.append(number)
        say("Finishing the chunk, then saving; once more to stop at once.")
        for which, handler in previous.items():
            signal.signal(which, handler or signal.SIG_DFL)

    try:
        for which in (signal.SIGINT, signal.SIGTERM):
            previous[which] = signal.signal(which, note)
    except ValueError:  # Not the main thread.
        previous = {}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)


class InterruptedRunError(Exception):
    """Work that others need was stopped by a signal; the same call again goes on.

    Attributes:
      number: of the signal.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number


class NonFiniteError(ArithmeticError):
    """A metric or a parameter is not finite; the state that has it is never saved."""


class _Session(Generic[State]):
    """The state of a run with its bookkeeping, from a checkpoint or from the start."""

    def __init__(
        self,
        state: State,
        run_directory: RunDirectory,
        *,
        may_be_nan: tuple[str, ...],
        selection_metric: str | None,
    ) -> None:
        self._directory = run_directory
        self.log = log = MetricsLog(run_directory.path)
        self._checkpointer = checkpointer = Checkpointer(run_directory.checkpoints)
        self._may_be_nan, self._selection_metric = may_be_nan, selection_metric
        self.last_evaluation: dict[str, float] | None = None
        self.best_metric: float | None = None
        self.best_step: int | None = None
        self._elapsed_s = 0.0
        self.was_resumed = bool(checkpointer.steps("latest"))
        self.is_first_chunk, self.chunk_s = False, 0.0
        self._saved_at = time.monotonic()
        self._num_chunks = 0
        if self.was_resumed:
            state, metadata = checkpointer.restore("latest", state)
            self._elapsed_s = metadata["elapsed_s"]
            read(run_directory.path, metadata.get("metrics"))
            run_directory.note_saved()
        else:
            self._check_is_new()
        self.state = state
        self.step = _step_of(state)
        self._saved_step = self.step if self.was_resumed else None
        # Whatever was recorded after the checkpoint is made again, identically.
        checkpointer.discard_after(self.step if self.was_resumed else -1)
        log.cut_back(self.step if self.was_resumed else -1)
        for kind in KINDS:
            checkpointer.clean(kind)
        self.lacks_best = False
        if self.was_resumed and metadata["best_step"] is not None:
            self._find_best(metadata["best_step"])
        self.start_clock()

    def _check_is_new(self) -> None:
        """Raises CheckpointError if the run has lost its `latest` checkpoint."""
        found = self._checkpointer.steps("best"), self.log.mark["lines"]
        if any(found) and self._directory.has_been_saved:
            raise CheckpointError(
                f"{self._checkpointer.directory / 'latest'} is lost: the run was saved before, and "
                f"still has {found[1]} reports and {len(found[0])} `best` checkpoints, which are "
                "left as they are. Restore `latest` from a copy, use what is there with evaluate, "
                "or start anew with --overwrite, which deletes all of it."
            )

    def _find_best(self, recorded: int) -> None:
        """The best checkpoint that is whole; without the recorded one, a new one is looked for."""
        self._checkpointer.set_aside_damaged("best", self.state)
        steps = self._checkpointer.steps("best")
        if steps:
            metadata = self._checkpointer.metadata("best")
            self.best_metric, self.best_step = metadata["best_metric"], metadata["best_step"]
        self.lacks_best = self.best_step is None or self.best_step < recorded
        if self.lacks_best:
            warnings.warn(
                f"The `best` checkpoint of step {recorded} in {self._checkpointer.directory} is "
                f"lost; now it is that of step {self.best_step}, until an evaluation is better: "
                "the next one of training, or that of the state at its end.",
                stacklevel=2,
            )

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
        before, start = self.step, time.monotonic()
        state, metrics = chunk(self.state, n)
        self.state = state
        values = _floats(metrics)
        self.chunk_s = time.monotonic() - start
        self.step = _step_of(state)
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
        cause = finiteness.cause_of(values)
        if cause is not None:
            what, advice = finiteness.CAUSES[cause]
            name = finiteness.PREFIX + cause
            said = f"{what}, before anything else ({name} is {values[name]:g})"
            self._stop(said, values, advice)
        for name, value in values.items():
            may_be_nan = any(fnmatch.fnmatchcase(name, pattern) for pattern in self._may_be_nan)
            if not math.isfinite(value) and not may_be_nan:
                self._stop(f"{name} is {value}", values)

    def _stop(
        self,
        what: str,
        values: Mapping[str, float],
        advice: str = finiteness.CAUSES["parameter"][1],
    ) -> None:
        self.log.sync()
        steps = self._checkpointer.steps("latest")
        last = f"the checkpoint of step {steps[-1]} is good" if steps else "none was saved before"
        listed = ", ".join(f"{name}={value:.4g}" for name, value in values.items())
        raise NonFiniteError(
            f"{what} at step {self.step}; {last}. {advice}{f' Metrics: {listed}' * bool(values)}"
        )

    def report(self, metrics: Mapping[str, float], before: int, display: Display) -> str:
        """Records the metrics of a chunk; returns the rate, for display."""
        lap_s = max(self._lap(), 1e-9)
        rate = (self.step - before) / lap_s
        times = {"elapsed_s": self._elapsed_s, "steps_per_s": rate}
        text = f"{rate:,.3g} {display.unit}/s"
        if display.work_per_step is not None:
            times["work_per_s"] = rate * display.work_per_step
            text = f"{times['work_per_s']:,.0f} {display.work_unit}/s"
        timed = {TIME_PREFIX + name: value for name, value in times.items()}
        self.log.write(self.step, {**metrics, **timed})
        return f"{duration(self._elapsed_s)}  {text}"

    def evaluate(self, evaluate: Callable[[State], Scalars], is_recorded: bool = True) -> bool:
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
        if is_recorded:
            self.log.write(self.step, {**found, **lap})
        if selected is None or (
            self.best_metric is not None and found[selected] <= self.best_metric
        ):
            return False
        self.best_metric, self.best_step = found[selected], self.step
        self._save("best")
        return True

    @property
    def is_overdue(self) -> bool:
        """The last checkpoint is five minutes old."""
        return time.monotonic() - self._saved_at >= CHECKPOINT_EVERY_S

    def save_latest(self) -> None:
        """Saves the state from which a later process goes on, unless that was done already."""
        if self._saved_step != self.step:
            self._save("latest")
            self._saved_step, self._saved_at = self.step, time.monotonic()
            self._directory.note_saved()

    def _save(self, kind: Kind) -> None:
        for path, leaf in jax.tree_util.tree_leaves_with_path(getattr(self.state, "params", ())):
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
            "metrics": self.log.mark,
        }
        self._checkpointer.save(kind, self.step, self.state, metadata)


def _step_of(state: Any) -> int:
    return int(state.step)


def _floats(scalars: Scalars) -> dict[str, float]:
    values = jax.device_get(dict(scalars))
    for name, value in values.items():
        if np.ndim(value):
            raise ValueError(
                f"Metric {name} has shape {np.shape(value)}; chunks and evaluations return scalars."
            )
    return {name: float(value) for name, value in values.items()}
