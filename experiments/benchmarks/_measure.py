"""How everything here is measured, recorded and printed. Needs jax and absl-py only.

Subjects that are compared run in one process, in alternation: one call of each per round, at least
five rounds, every round with a key of its own. Compilation is timed apart. Wall and processor time
are both kept: on a shared machine the second is the one to trust.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
from absl import app, flags, logging

from jaxnew.storage.provenance import describe_session

QUICK = flags.DEFINE_bool("quick", False, "Tiny sizes: checks that it runs; the times say nothing.")
OUTPUT = flags.DEFINE_string("output", None, "File that results are appended to, as JSON lines.")
REPEATS = flags.DEFINE_integer("repeats", 5, "Timed calls of each subject.", lower_bound=5)

# What every line of the output has. See `Report`.
FIELDS = (
    "benchmark",
    "case",
    "num_envs",
    "includes",
    "how",
    "repeats",
    "wall_s",
    "cpu_s",
    "compile_s",
    "rates",
    "values",
    "quick",
    "started",
    "command",
    "revision",
    "versions",
    "machine",
    "devices",
    "precision",
)


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum of repeated measurements."""

    median: float
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Cost:
    """Seconds of wall clock and of processor, all threads of the process together."""

    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class Subject:
    """Something to time.

    Attributes:
      call: takes what `inputs` made; its result is waited for.
      inputs: consumes the key of a round and makes the arguments of the call, outside the clock.
      compilation: what lowering and compiling took, or None if `call` is not one compiled program.
    """

    call: Callable[..., Any]
    inputs: Callable[[jax.Array], tuple[Any, ...]]
    compilation: Cost | None = None


@dataclass(frozen=True)
class Timing:
    """Repeated measurements of a subject, one entry per round."""

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]
    compilation: Cost | None = None


def timed(function: Callable[[], Any]) -> tuple[Any, Cost]:
    """The result of a call, waited for, and what it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(function())
    return result, Cost(time.perf_counter() - wall, time.process_time() - cpu)


def compiled(
    function: Callable[..., Any], inputs: Callable[[jax.Array], tuple[Any, ...]]
) -> Subject:
    """`function` as one compiled program, its compilation timed."""
    example = inputs(jax.random.key(0))
    program, cost = timed(lambda: jax.jit(function).lower(*example).compile())
    return Subject(program, inputs, cost)


def measure(subjects: Mapping[str, Subject], repeats: int, seed: int = 0) -> dict[str, Timing]:
    """Times every subject `repeats` times, in alternation, after one call that is not counted."""
    costs: dict[str, list[Cost]] = {name: [] for name in subjects}
    for round_ in range(repeats + 1):
        key = jax.random.fold_in(jax.random.key(seed), round_)
        for name, subject in subjects.items():
            arguments = jax.block_until_ready(subject.inputs(key))
            _, cost = timed(partial(subject.call, *arguments))
            if round_ > 0:
                costs[name].append(cost)
    return {
        name: Timing(
            tuple(cost.wall_s for cost in costs[name]),
            tuple(cost.cpu_s for cost in costs[name]),
            subject.compilation,
        )
        for name, subject in subjects.items()
    }


def cpu_s_of(pids: Sequence[int]) -> float:
    """Processor time of other processes since they began; NaN where it is not known."""
    files = [Path(f"/proc/{pid}/schedstat") for pid in pids]
    if not all(file.exists() for file in files):
        return math.nan
    return sum(int(file.read_text().split()[0]) for file in files) / 1e9


def ratio(numerator: Timing, denominator: Timing) -> dict[str, float]:
    """How many times longer the numerator takes.

    Of the medians, for both clocks; and the extremes of the wall-clock ratio within one round,
    which say how far to trust it.
    """
    rounds = [a / b for a, b in zip(numerator.wall_s, denominator.wall_s, strict=True)]
    return {
        "wall": statistics.median(numerator.wall_s) / statistics.median(denominator.wall_s),
        "cpu": statistics.median(numerator.cpu_s) / statistics.median(denominator.cpu_s),
        "wall_min": min(rounds),
        "wall_max": max(rounds),
    }


def share_saved(whole: Timing, without: Timing) -> dict[str, float]:
    """The share of `whole` that goes away with a part, by the medians of both clocks.

    Negative where the stand-in of the part costs more than the part, or where noise is larger.
    """
    return {
        "wall": 1.0 - statistics.median(without.wall_s) / statistics.median(whole.wall_s),
        "cpu": 1.0 - statistics.median(without.cpu_s) / statistics.median(whole.cpu_s),
    }


class Report:
    """Prints results as rows and, with `--output`, appends each as a JSON line with `FIELDS`.

    A line is a timing (`wall_s`, `cpu_s`, `compile_s` and `rates` per second; `compile_s` is None
    for what is no single program) or derived numbers (`values`; the others None or empty).
    """

    def __init__(self, benchmark: str) -> None:
        self._benchmark = benchmark
        jax.devices()  # Makes the devices known before the session is described.
        self._session = describe_session()
        print(f"\n{benchmark}: {', '.join(self._session['devices'])}")

    def add_versions(self, *packages: str) -> None:
        """Records the versions of further packages."""
        for package in packages:
            self._session["versions"][package] = importlib.metadata.version(package)

    def timing(
        self,
        case: str,
        timing: Timing,
        *,
        work: Mapping[str, float],
        num_envs: int | None = None,
        includes: Sequence[str] = (),
        how: str = "",
    ) -> None:
        """A measured subject.

        Args:
          case: what was measured.
          timing: of it.
          work: what one call does, {unit: amount}; becomes rates per second of wall clock.
          num_envs: parallel environments, None where there are none.
          includes: which of auto-reset, policy, update, rendering, ... the time covers.
          how: anything that a reader must know to repeat or to interpret it.
        """
        wall, cpu = Spread.of(timing.wall_s), Spread.of(timing.cpu_s)
        rates = {
            unit: asdict(Spread.of([amount / seconds for seconds in timing.wall_s]))
            for unit, amount in work.items()
        }
        compilation = timing.compilation
        self._write(
            case=case,
            num_envs=num_envs,
            includes=list(includes),
            how=how,
            repeats=len(timing.wall_s),
            wall_s=asdict(wall),
            cpu_s=asdict(cpu),
            compile_s=None
            if compilation is None
            else {"wall": compilation.wall_s, "cpu": compilation.cpu_s},
            rates=rates,
        )
        shown = [f"{_milliseconds(wall)}, cpu {cpu.median * 1e3:,.2f} ms"]
        shown += [f"{rate['median']:,.4g} {unit}/s" for unit, rate in rates.items()]
        if compilation is not None:
            shown.append(f"compiled in {compilation.wall_s:.2f} s")
        self._print(case, shown)

    def values(
        self, case: str, values: Mapping[str, float], *, how: str, num_envs: int | None = None
    ) -> None:
        """Numbers that follow from timings or from shapes."""
        self._write(case=case, num_envs=num_envs, how=how, values=dict(values))
        self._print(case, [f"{name} {value:,.4g}" for name, value in values.items()])

    def note(self, text: str) -> None:
        """A line for the reader; not recorded."""
        print(f"  {text}")

    def _print(self, case: str, shown: Sequence[str]) -> None:
        print(f"  {case:<58} {'   '.join(shown)}", flush=True)

    def _write(self, **entries: Any) -> None:
        record: dict[str, Any] = dict.fromkeys(FIELDS)
        record |= {"includes": [], "rates": {}, "values": {}}
        record |= {name: self._session[name] for name in FIELDS if name in self._session}
        record |= {"benchmark": self._benchmark, "quick": QUICK.value, **entries}
        if OUTPUT.value is not None:
            path = Path(OUTPUT.value)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a") as file:
                file.write(json.dumps(record) + "\n")


def _milliseconds(spread: Spread) -> str:
    low, middle, high = (1e3 * x for x in (spread.min, spread.median, spread.max))
    return f"{middle:,.2f} ms [{low:,.2f}, {high:,.2f}]"


def run_benchmark(main: Callable[[], None]) -> None:
    """Runs a benchmark's `main` after parsing the flags. Programs are compiled anew, not cached."""

    def wrapped(arguments: Sequence[str]) -> None:
        if len(arguments) > 1:
            raise app.UsageError(f"Unknown argument {arguments[1]!r}; options are --flag=value.")
        logging.set_verbosity(logging.WARNING)
        jax.config.update("jax_enable_compilation_cache", False)
        jax.config.update("jax_disable_most_optimizations", QUICK.value)
        main()

    app.run(wrapped)
