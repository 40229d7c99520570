"""The loop: a run killed anywhere and resumed equals one undisturbed run, bit for bit.

Run as a script, `test_loop.py DIRECTORY`, it is the toy run that the tests kill.
"""

from __future__ import annotations

import functools
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from jaxnew import loop
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer, CheckpointError
from jaxnew.storage.run_directory import RunDirectory
from tests.kills import Killed

ROOT = Path(__file__).resolve().parents[2]
RHYTHM = loop.Rhythm(total_steps=47, chunk_steps=5, checkpoint_every=10, evaluate_every=5)
DISPLAY = loop.Display("toy")
OPTIMIZER = optax.adam(1e-2)
TRACED: list[int] = []


@struct.dataclass
class Toy:
    step: jax.Array
    key: jax.Array
    params: jax.Array
    opt_state: Any
    num_episodes: jax.Array


def init() -> Toy:
    params = jnp.zeros(3)
    return Toy(jnp.int32(0), jax.random.key(0), params, OPTIMIZER.init(params), jnp.asarray(0))


@functools.partial(jax.jit, static_argnums=1)
def chunk(state: Toy, n: int) -> tuple[Toy, dict[str, jax.Array]]:
    TRACED.append(n)

    def update(toy: Toy, _: None) -> tuple[Toy, jax.Array]:
        noise = jax.random.normal(jax.random.fold_in(toy.key, toy.step), (3,))
        change, opt_state = OPTIMIZER.update(toy.params - noise, toy.opt_state)
        params = optax.apply_updates(toy.params, change)
        return Toy(toy.step + 1, toy.key, params, opt_state, toy.num_episodes + 2), noise.sum()

    state, losses = jax.lax.scan(update, state, None, length=n)
    values = {"loss": losses.mean(), "nonfinite/loss": jnp.sum(~jnp.isfinite(losses))}
    return state, {**values, "episode/return": jnp.nan, "episode/count": state.num_episodes}


def evaluate(state: Toy) -> dict[str, float]:
    # 0.2 at step 5, then higher each time until 1.0 at 35, 40, 45 and 47: the first must win.
    return {"validation/success": float(np.round(np.sin(float(state.step) / 25), 1)), "other": 1.0}


def train(path: Path, chunk: Any = chunk, **changes: Any) -> loop.LoopResult[Toy]:
    """Changes of the rhythm, or of other arguments of the loop."""
    others = {"evaluate": evaluate, "selection_metric": "validation/success"}
    others |= {name: value for name, value in changes.items() if name not in vars(RHYTHM)}
    rhythm = replace(RHYTHM, **{name: changes[name] for name in changes if name in vars(RHYTHM)})
    with RunDirectory.open_or_create(path, {"seed": 0}) as run_directory:
        return loop.run(init(), chunk, run_directory, rhythm, DISPLAY, **others)


def reports(path: Path) -> list[dict[str, Any]]:
    """The metrics without wall-clock fields."""
    return [
        {name: value for name, value in report.items() if not name.startswith("time/")}
        for report in metrics.read(path)
    ]


def digest(state: Any) -> str:
    leaves = [
        np.asarray(jax.random.key_data(leaf) if leaf.dtype == init().key.dtype else leaf)
        for leaf in jax.tree.leaves(state)
    ]
    return hashlib.sha256(b"".join(leaf.tobytes() for leaf in leaves)).hexdigest()


def outcome(path: Path) -> dict[str, Any]:
    """Everything that a finished run left behind and that must not depend on its history."""
    checkpointer = Checkpointer(path / "checkpoints")
    found: dict[str, Any] = {"metrics": reports(path)}
    for kind in ("latest", "best"):
        state, metadata = checkpointer.restore(kind, init())
        metadata.pop("elapsed_s")
        metadata.pop("metrics")  # Of which times are a part.
        found[kind] = (int(state.step), digest(state), metadata)
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("undisturbed")
    result = train(path)
    found = outcome(path)
    assert found["latest"][1] == digest(result.state)
    return found


@pytest.mark.unit
def test_an_undisturbed_run(tmp_path: Path) -> None:
    TRACED.clear()
    jax.clear_caches()
    result = train(tmp_path)
    assert TRACED == [5, 2]
    assert (result.step, result.was_interrupted, result.was_resumed) == (47, False, False)
    evaluations = [r for r in reports(tmp_path) if "other" in r]
    assert [r["step"] for r in evaluations] == [5, 10, 15, 20, 25, 30, 35, 40, 45, 47]
    updates = [r for r in reports(tmp_path) if "loss" in r]
    assert [r["step"] for r in updates] == [5, 10, 15, 20, 25, 30, 35, 40, 45, 47]
    assert all(r["episode/return"] is None for r in updates)
    assert (result.best_step, result.best_metric) == (35, 1.0)
    assert result.last_evaluation == {"validation/success": 1.0, "other": 1.0}
    checkpointer = Checkpointer(tmp_path / "checkpoints")
    assert checkpointer.steps("best") == [25, 30, 35]
    assert int(checkpointer.restore("best", init())[0].step) == 35
    assert checkpointer.steps("latest") == [40, 47]
    timed = metrics.read(tmp_path)[0]
    assert timed["time/elapsed_s"] > 0
    assert timed["time/steps_per_s"] > 0


@pytest.mark.unit
def test_chunks_that_step_over_an_interval_are_followed_by_what_was_due(tmp_path: Path) -> None:
    train(tmp_path, total_steps=10, chunk_steps=3, checkpoint_every=100, evaluate_every=4)
    evaluated = [r["step"] for r in reports(tmp_path) if "validation/success" in r]
    # Chunks end at 3, 6, 9 and 10: 4 and 8 are passed, 10 is the end.
    assert evaluated == [6, 9, 10]


@pytest.mark.unit
@pytest.mark.parametrize(
    ("chunk_s", "saved"),
    [
        (100.0, [15, 30, 45, 47]),
        (350.0, [5, 10, 15, 20, 25, 30, 35, 40, 45, 47]),
        (1.0, [47]),
    ],
)
def test_checkpoints_are_five_minutes_apart_at_most(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    undisturbed: dict[str, Any],
    chunk_s: float,
    saved: list[int],
) -> None:
    """Whatever the rhythm; a longer chunk is said once; the state is the same."""
    now = [0.0]
    kept: list[int] = []
    save = Checkpointer.save

    def lasting(state: Toy, n: int) -> Any:
        now[0] += chunk_s
        return chunk(state, n)

    def noted(self: Checkpointer, kind: Any, step: int, *rest: Any) -> Any:
        kept.extend([step] * (kind == "latest"))
        return save(self, kind, step, *rest)

    monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(Checkpointer, "save", noted)
    unseen = {"evaluate": None, "evaluate_every": None, "selection_metric": None}
    result = train(tmp_path, chunk=lasting, checkpoint_every=1000, **unseen)
    assert kept == saved
    assert capsys.readouterr().out.count("a chunk of 5 updates takes 5:50") == (chunk_s > 300)
    assert digest(result.state) == undisturbed["latest"][1]


@pytest.mark.unit
def test_elapsed_time_goes_on_where_the_checkpoint_left_it(tmp_path: Path) -> None:
    train(tmp_path, total_steps=10)
    checkpointer = Checkpointer(tmp_path / "checkpoints")
    state, metadata = checkpointer.restore("latest", init())
    checkpointer.discard_after(-1)
    checkpointer.save("latest", 10, state, {**metadata, "elapsed_s": 1000.0})
    train(tmp_path, total_steps=15)
    found = [r["time/elapsed_s"] for r in metrics.read(tmp_path) if "time/elapsed_s" in r]
    assert 1000.0 <= found[-1] < 1100.0


@pytest.mark.unit
def test_a_complete_run_returns_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train(tmp_path)
    before = outcome(tmp_path)
    capsys.readouterr()
    again = train(tmp_path, chunk=None)
    assert "already complete" in capsys.readouterr().out
    assert again.was_resumed
    assert digest(again.state) == digest(first.state)
    assert (again.best_step, again.best_metric) == (first.best_step, first.best_metric)
    assert outcome(tmp_path) == before


@pytest.mark.unit
def test_resuming_compiles_nothing_new(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jax.clear_caches()
    train(tmp_path, total_steps=20)
    TRACED.clear()
    result = train(tmp_path, total_steps=40)
    assert "resuming" in capsys.readouterr().out
    assert result.step == 40
    assert TRACED == []


class _Deaths:
    """Kills the run at the n-th of the instants at which something reaches the disk."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int) -> None:
        self.count, self._at = 0, at
        for owner, name in (
            (os, "rename"),
            (os, "replace"),
            (shutil, "rmtree"),
            (metrics.MetricsLog, "write"),
            (metrics.MetricsLog, "sync"),
        ):
            patch.setattr(owner, name, self._dying(getattr(owner, name)))

    def _dying(self, real: Any) -> Any:
        def function(*arguments: Any, **named: Any) -> Any:
            self.count += 1
            if self.count > self._at:
                raise Killed
            return real(*arguments, **named)

        return function


@pytest.mark.integration
@pytest.mark.parametrize("seed", range(4))
def test_killed_at_many_instants_and_resumed(
    tmp_path: Path, undisturbed: dict[str, Any], seed: int
) -> None:
    rng = random.Random(seed)
    num_kills = 0
    for _ in range(60):
        with pytest.MonkeyPatch.context() as patch:
            deaths = _Deaths(patch, at=rng.randrange(1, 60))
            try:
                train(tmp_path)
                break
            except Killed:
                num_kills += 1
                assert deaths.count
    train(tmp_path)
    assert num_kills >= 1
    assert outcome(tmp_path) == undisturbed


@pytest.mark.integration
def test_killed_between_best_and_latest(tmp_path: Path, undisturbed: dict[str, Any]) -> None:
    """A `best` newer than the restored `latest` is dropped and made again, identically."""
    real = Checkpointer.save

    def save(self: Checkpointer, kind: Any, step: int, *rest: Any) -> Any:
        if kind == "latest" and self.steps("best")[-1:] == [step] and step > 5:
            raise Killed
        return real(self, kind, step, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpointer, "save", save)
        with pytest.raises(Killed):
            train(tmp_path)
    checkpointer = Checkpointer(tmp_path / "checkpoints")
    assert checkpointer.steps("best")[-1] > checkpointer.steps("latest")[-1]
    train(tmp_path)
    assert outcome(tmp_path) == undisturbed


@pytest.mark.integration
def test_a_damaged_latest_costs_steps_but_not_exactness(
    tmp_path: Path, undisturbed: dict[str, Any]
) -> None:
    train(tmp_path)
    checkpointer = Checkpointer(tmp_path / "checkpoints")
    newest = tmp_path / "checkpoints" / "latest" / f"{checkpointer.steps('latest')[-1]:012d}"
    (newest / "record" / "metadata").write_text("{")
    with pytest.warns(UserWarning, match="is damaged"):
        result = train(tmp_path)
    assert result.was_resumed
    assert outcome(tmp_path) == undisturbed


@pytest.mark.unit
def test_unreadable_checkpoints_are_not_started_over(tmp_path: Path) -> None:
    train(tmp_path, total_steps=5)
    (tmp_path / "checkpoints/latest/000000000005/record/metadata").write_text("{")
    before = reports(tmp_path)
    with pytest.raises(CheckpointError, match="No readable checkpoint"):
        train(tmp_path, total_steps=5)
    assert reports(tmp_path) == before


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_chunk_saves_and_returns(
    tmp_path: Path, undisturbed: dict[str, Any], number: signal.Signals
) -> None:
    def interrupted(state: Toy, n: int) -> Any:
        if int(state.step) == 40:
            os.kill(os.getpid(), number)
        return chunk(state, n)

    handler = signal.getsignal(number)
    result = train(tmp_path, chunk=interrupted)
    assert result.was_interrupted
    assert result.interrupted_by == number
    assert signal.getsignal(number) is handler
    # Not a multiple of checkpoint_every, nor a new best: saved because of the signal.
    assert result.step == 45
    assert Checkpointer(tmp_path / "checkpoints").steps("latest")[-1] == 45
    assert train(tmp_path).was_resumed
    assert outcome(tmp_path) == undisturbed


@pytest.mark.unit
@pytest.mark.parametrize("last", [0, 47])
def test_a_signal_before_the_first_or_in_the_last_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: int
) -> None:
    """What is there is saved, and who called hears of it: nothing is to follow."""
    start_clock = loop._Session.start_clock

    def interrupted(self: Any) -> None:
        start_clock(self)
        if last == 0 and signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
            signal.raise_signal(signal.SIGTERM)

    def in_the_last(state: Toy, n: int) -> Any:
        if n == 2:
            signal.raise_signal(signal.SIGTERM)
        return chunk(state, n)

    monkeypatch.setattr(loop._Session, "start_clock", interrupted)
    result = train(tmp_path, chunk=in_the_last)
    assert (result.step, result.interrupted_by) == (last, signal.SIGTERM)
    assert Checkpointer(tmp_path / "checkpoints").steps("latest")[-1] == last


@pytest.mark.unit
def test_a_second_signal_stops_at_once(tmp_path: Path) -> None:
    def stubborn(state: Toy, n: int) -> Any:
        # To this thread: two signals to the process may count as one before either is seen.
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        time.sleep(10.0)
        pytest.fail("the second signal was ignored")

    # What a shell starts in its background ignores SIGINT.
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, chunk=stubborn)
    finally:
        signal.signal(signal.SIGINT, previous)


def _spoiled(name: str, value: float, at: int) -> Any:
    def spoiled(state: Toy, n: int) -> Any:
        state, values = chunk(state, n)
        is_bad = int(state.step) == at
        if is_bad:
            state = state.replace(params=state.params * jnp.nan)
        return state, {**values, name: value if is_bad else values.get(name, 0.0)}

    return spoiled


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("loss", float("nan"), "loss is nan at step 20; the checkpoint of step 10 is good"),
        ("loss", float("-inf"), "loss is -inf at step 20"),
        (
            "nonfinite/gradient",
            3.0,
            r"The gradient was not .* \(nonfinite/gradient is 3\) at step 20; .* learning rate",
        ),
        (
            "nonfinite/reward",
            2.0,
            r"A reward was NaN .* \(nonfinite/reward is 2\) at step 20; .* the environment returns",
        ),
        ("nonfinite/gradient", float("nan"), r"nonfinite/gradient is nan\) at step 20"),
        # Nothing in the metrics tells of it: the parameters themselves are looked at.
        ("episode/length", 1.0, "of the state is not finite at step 20"),
    ],
)
def test_non_finite_numbers_stop_the_run(
    tmp_path: Path, name: str, value: float, text: str
) -> None:
    with pytest.raises(loop.NonFiniteError, match=text):
        train(
            tmp_path,
            chunk=_spoiled(name, value, 20),
            evaluate=None,
            evaluate_every=None,
            selection_metric=None,
        )
    state, _ = Checkpointer(tmp_path / "checkpoints").restore("latest", init())
    assert int(state.step) == 10
    assert np.isfinite(np.asarray(state.params)).all()
    train(tmp_path)
    assert reports(tmp_path)[-1]["step"] == 47


@pytest.mark.unit
def test_a_bad_state_is_not_best_either(tmp_path: Path) -> None:
    with pytest.raises(loop.NonFiniteError, match="of the state is not finite"):
        train(tmp_path, chunk=_spoiled("episode/length", 1.0, 5))
    assert Checkpointer(tmp_path / "checkpoints").steps("best") == []


@pytest.mark.unit
def test_metrics_that_may_be_nan_are_a_list(tmp_path: Path) -> None:
    result = train(
        tmp_path, chunk=_spoiled("x/y", float("nan"), -1), may_be_nan=["episode/*", "x/*"]
    )
    assert result.step == 47
    with pytest.raises(loop.NonFiniteError, match="episode/return is nan"):
        train(tmp_path / "other", may_be_nan=[])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"chunk_steps": 0}, "chunk_steps must be at least 1, got 0"),
        ({"total_steps": 0}, "total_steps must be at least 1, got 0"),
        ({"checkpoint_every": -1}, "checkpoint_every must be at least 1, got -1"),
        ({"evaluate_every": 0}, "evaluate_every must be at least 1, got 0"),
        ({"evaluate_every": None}, "both evaluate and evaluate_every"),
        ({"evaluate": None, "evaluate_every": None}, "needs evaluate"),
        (
            {"selection_metric": "test/x"},
            "'test/x' is not in the evaluation, which has: other, valid",
        ),
        (
            {"evaluate": lambda s: {"validation/success": np.zeros(3)}},
            r"validation/success has shape \(3,\)",
        ),
        (
            {"chunk": lambda s, n: (s.replace(step=s.step + n + 1), {})},
            "asked for 5 steps from 0 and ended at 6",
        ),
    ],
)
def test_wrong_arguments(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        train(tmp_path, **changes)


@pytest.mark.unit
def test_a_run_past_its_end_or_open_for_reading_is_refused(tmp_path: Path) -> None:
    train(tmp_path, total_steps=10)
    with pytest.raises(ValueError, match="at step 10, past total_steps=5"):
        train(tmp_path, total_steps=5)
    with pytest.raises(ValueError, match="open for reading"):
        loop.run(init(), chunk, RunDirectory.load(tmp_path), loop.Rhythm(5, 5, 5), DISPLAY)


@struct.dataclass
class Counter:
    """Counts with a Python number, and has no `params`."""

    step: int
    x: np.ndarray


@pytest.mark.unit
def test_other_counters_and_states(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDirectory.open_or_create(tmp_path, {}) as run_directory:
        result = loop.run(
            Counter(0, np.zeros(2)),
            lambda s, n: (Counter(s.step + n, s.x + n), {"loss": 1.0}),
            run_directory,
            loop.Rhythm(total_steps=7, chunk_steps=3, checkpoint_every=3),
            loop.Display("counting", "beans", work_per_step=10, work_unit="peas"),
        )
    assert result.state.step == 7
    assert result.state.x.tolist() == [7.0, 7.0]
    assert (result.best_metric, result.last_evaluation) == (None, None)
    assert metrics.read(tmp_path)[0]["time/work_per_s"] > 0
    shown = capsys.readouterr().out
    assert "counting" in shown
    assert "beans" in shown


def _newest_checkpoint(path: Path) -> str:
    folder = path / "checkpoints" / "latest"
    names = os.listdir(folder) if folder.exists() else []
    return max((name for name in names if name.isdecimal()), default="")


@pytest.mark.integration
def test_sigkilled_processes_resume_exactly(tmp_path: Path, undisturbed: dict[str, Any]) -> None:
    path, rng, num_kills, num_resumed = tmp_path / "run", random.Random(0), 0, 0
    for _ in range(10):
        before = _newest_checkpoint(path)
        with subprocess.Popen(
            [sys.executable, __file__, str(path)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            if num_kills < 2:
                while process.poll() is None and _newest_checkpoint(path) == before:
                    time.sleep(0.002)
                time.sleep(rng.uniform(0.0, 0.1))
                if process.poll() is None:
                    process.kill()
                    num_kills += 1
            assert process.stdout is not None
            num_resumed += "resuming" in process.stdout.read()
        if process.returncode == 0:
            break
        assert process.returncode == -signal.SIGKILL
    assert num_kills >= 1
    assert num_resumed >= 1
    assert outcome(path) == undisturbed


if __name__ == "__main__":

    def slowly(state: Toy, n: int) -> Any:
        time.sleep(0.05)
        return chunk(state, n)

    train(Path(sys.argv[1]), chunk=slowly)
