"""The loop around compiled chunks: progress, metrics, evaluation, checkpoints, resume, stop.

Both stages and fine-tuning use it. Killing the process at any instant and running again gives the
same states and the same metrics as one undisturbed run (bit for bit where the chunk is
deterministic), because a `latest` checkpoint at step s is written after everything that belongs to
steps <= s, and a resumed run removes everything that belongs to later ones.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from jaxnew._progress import ProgressDisplay
from jaxnew._session import NonFiniteError, Scalars, Session
from jaxnew.checkpoint import Checkpointer
from jaxnew.metrics import MetricsLog
from jaxnew.run_directory import RunDirectory

State = TypeVar("State")

__all__ = ["LoopResult", "NonFiniteError", "run"]


@dataclass(frozen=True)
class LoopResult(Generic[State]):
    """How a run ended.

    Attributes:
      state: after the last finished chunk.
      step: its step.
      best_metric, best_step: the highest value of the selection metric and the first step that
        reached it; None if nothing was evaluated. The `best` checkpoint holds that state.
      was_interrupted: a signal stopped the run before `total_steps`; run again to go on.
      was_resumed: the run started from a checkpoint.
      last_evaluation: what the last evaluation of this process returned, or None.
    """

    state: State
    step: int
    best_metric: float | None
    best_step: int | None
    was_interrupted: bool
    was_resumed: bool
    last_evaluation: dict[str, float] | None


def _default_step_of(state: Any) -> int:
    return int(state.step)


def _default_finite_part(state: Any) -> Any:
    return getattr(state, "params", ())


def run(
    state: State,
    *,
    chunk: Callable[[State, int], tuple[State, Scalars]],
    run_directory: RunDirectory,
    total_steps: int,
    chunk_steps: int,
    checkpoint_every: int,
    title: str,
    evaluate: Callable[[State], Scalars] | None = None,
    evaluate_every: int | None = None,
    selection_metric: str | None = None,
    on_evaluation: Callable[[int, State, dict[str, float]], None] | None = None,
    steps_unit: str = "updates",
    work_per_step: float | None = None,
    work_unit: str = "env steps",
    shown_metrics: Sequence[str] = (),
    may_be_nan: Sequence[str] = ("episode/*",),
    step_of: Callable[[State], int] = _default_step_of,
    finite_part: Callable[[State], Any] = _default_finite_part,
    checkpointer: Checkpointer | None = None,
) -> LoopResult[State]:
    """Runs `chunk` until `total_steps`, resuming from the run directory if it holds a checkpoint.

    Evaluations and checkpoints happen at the end of the first chunk that reaches or passes a
    multiple of their interval, and at the end of the run. A new best evaluation is checkpointed at
    once. SIGINT and SIGTERM let the chunk finish, save, and return; a second one stops at once,
    which loses only what came after the last checkpoint.

    Args:
      state: freshly initialised pytree at step 0; replaced by the checkpoint when resuming.
      chunk: `(state, n) -> (state, metrics)`: n steps, n static, and scalars reduced over them. It
        sees at most two values of n: `chunk_steps`, and the rest at the end. Random numbers must
        come from the state alone.
      run_directory: open for writing.
      total_steps, chunk_steps, checkpoint_every: in steps of the state.
      title: shown by the progress display.
      evaluate: `state -> {name: float}`; must not change or donate the state and must draw from
        fixed keys.
      evaluate_every: steps between evaluations; with `evaluate` only.
      selection_metric: name in the evaluation; the highest value wins, the first of equal ones.
      on_evaluation: called as `(step, state, evaluation)` after the evaluation is recorded. After
        a crash it may be called again for the same step.
      steps_unit: what a step is called.
      work_per_step: e.g. environment steps per update, for the reported rate in `work_unit`.
      shown_metrics: names shown beside the progress bar.
      may_be_nan: patterns of metric names that are NaN where no episode ended.
      step_of: the number of finished steps of a state.
      finite_part: the part of the state that must be finite to be saved; `params` by default.
      checkpointer: default: one on the run directory's `checkpoints/`.

    Raises:
      NonFiniteError: a metric that may not be NaN is not finite, a `nonfinite/*` count is above
        zero, or `finite_part` is not finite. The checkpoints hold earlier, good states.
      CheckpointError: there are checkpoints but none that is readable and fits the state.
      ValueError: an argument is out of range, or the evaluation lacks the selection metric.
    """
    _check_intervals(total_steps, chunk_steps, checkpoint_every, evaluate_every)
    if (evaluate is None) != (evaluate_every is None):
        raise ValueError("Give both evaluate and evaluate_every, or neither.")
    if selection_metric is not None and evaluate is None:
        raise ValueError(f"selection_metric={selection_metric!r} needs evaluate.")
    if not run_directory.is_writable:
        raise ValueError(
            f"{run_directory.path} is open for reading; open it with RunDirectory.open_or_create."
        )
    session: Session[State] = Session(
        state,
        checkpointer or Checkpointer(run_directory.checkpoints),
        MetricsLog(run_directory.path),
        step_of=step_of,
        finite_part=finite_part,
        may_be_nan=tuple(may_be_nan),
        selection_metric=selection_metric,
    )
    if session.step > total_steps:
        raise ValueError(
            f"{run_directory.path} is at step {session.step}, past total_steps={total_steps}. Ask "
            "for more steps or choose another --workdir."
        )
    progress = ProgressDisplay(title, total_steps, steps_unit, session.step)
    if session.was_resumed:
        is_done = session.step == total_steps
        where = f"{run_directory.path} at step {session.step} of {total_steps}"
        progress.say(f"{title}: {'already complete' if is_done else 'resuming'}, {where}.")
    was_interrupted = False
    with progress, session.log, _interruption() as is_interrupted:
        session.start_clock()
        while session.step < total_steps:
            if is_interrupted():
                was_interrupted = True
                break
            before = session.step
            metrics = session.advance(chunk, min(chunk_steps, total_steps - before))
            rate = session.report(metrics, before, steps_unit, work_per_step, work_unit)
            if session.is_first_chunk:
                progress.restart_clock(session.step)
            progress.update(session.step, _note(rate, metrics, shown_metrics))
            is_last = session.step >= total_steps
            is_due = _is_passed(checkpoint_every, before, session.step)
            if evaluate is not None and (
                is_last or _is_passed(evaluate_every, before, session.step)
            ):
                is_due = session.evaluate(evaluate, on_evaluation) or is_due
            if is_due:
                session.save_latest()
        session.save_latest()
        if was_interrupted:
            progress.say(f"{title}: stopped at step {session.step}; run again to go on.")
    return LoopResult(
        state=session.state,
        step=session.step,
        best_metric=session.best_metric,
        best_step=session.best_step,
        was_interrupted=was_interrupted,
        was_resumed=session.was_resumed,
        last_evaluation=session.last_evaluation,
    )


def _check_intervals(total: int, chunk: int, checkpoint: int, evaluation: int | None) -> None:
    intervals = {
        "total_steps": total,
        "chunk_steps": chunk,
        "checkpoint_every": checkpoint,
        "evaluate_every": 1 if evaluation is None else evaluation,
    }
    for name, value in intervals.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")


def _is_passed(interval: int | None, before: int, after: int) -> bool:
    """Whether a multiple of `interval` lies in (before, after]."""
    return interval is not None and after // interval > before // interval


def _note(rate: str, metrics: Mapping[str, float], shown: Sequence[str]) -> str:
    values = [f"{name} {metrics[name]:.4g}" for name in shown if name in metrics]
    return "  ".join([rate, *values])


@contextlib.contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether SIGINT or SIGTERM arrived; the second one acts as ever.

    Outside the main thread signals keep their meaning.
    """
    previous: dict[int, Any] = {}
    received: list[int] = []

    def note(number: int, frame: Any) -> None:
        received.append(number)
        print("Finishing the chunk, then saving; once more to stop at once.", flush=True)
        for which, handler in previous.items():
            signal.signal(which, handler or signal.SIG_DFL)

    try:
        for which in (signal.SIGINT, signal.SIGTERM):
            previous[which] = signal.signal(which, note)
    except ValueError:  # Not the main thread.
        previous = {}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)
