"""How everything here is measured, recorded and printed. Needs jax, NumPy and absl-py only.

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
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax

from experiments.flags import Arguments
from jaxnew.storage.session import describe_session

RATIO = "time of the first over time of the second"

# What every line of the output has. See `Report`.
FIELDS = (
    *("benchmark", "case", "num_envs", "includes", "how"),
    *("repeats", "wall_s", "cpu_s", "compile_s", "rates", "values", "quick"),
    *("started", "command", "revision", "versions", "machine", "devices", "precision"),
)


class Benchmark(Arguments):
    """The flags of a benchmark, and how it begins: programs are compiled anew, not cached.

    Args:
      doc: the docstring of its module.
    """

    def __init__(self, doc: str) -> None:
        super().__init__(doc)
        self.define("bool", "quick", False, "Tiny sizes: does it run? The times say nothing.")
        self.define("string", "output", None, "File that JSON lines are appended to.")
        self.define("integer", "repeats", 5, "Timed calls of each subject.", lower_bound=5)

    def start(self, main: Callable[[], int | None], arguments: list[str] | None = None) -> None:
        """Runs `main`; see `Arguments.start`."""

        def compiling() -> int | None:
            jax.config.update("jax_enable_compilation_cache", False)
            jax.config.update("jax_disable_most_optimizations", self.quick)
            return main()

        super().start(compiling, arguments)


@dataclass(frozen=True)
class Cost:
    """Seconds of wall clock and of processor, all threads of the process together."""

    wall_s: float
    cpu_s: float

    @classmethod
    def median(cls, costs: Sequence[Cost]) -> Cost:
        """Of each of the two."""
        walls, cpus = ([getattr(cost, name) for cost in costs] for name in ("wall_s", "cpu_s"))
        return cls(statistics.median(walls), statistics.median(cpus))

    def __mul__(self, factor: float) -> Cost:
        return Cost(self.wall_s * factor, self.cpu_s * factor)

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __sub__(self, other: Cost) -> Cost:
        return self + other * -1.0


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

    costs: tuple[Cost, ...]
    compilation: Cost | None = None

    @property
    def median(self) -> Cost:
        """The median of each clock."""
        return Cost.median(self.costs)


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


def measure(subjects: Mapping[str, Subject], repeats: int) -> dict[str, Timing]:
    """Times every subject `repeats` times, in alternation, after one call that is not counted."""
    costs: dict[str, list[Cost]] = {name: [] for name in subjects}
    for round_ in range(repeats + 1):
        key = jax.random.fold_in(jax.random.key(0), round_)
        for name, subject in subjects.items():
            arguments = jax.block_until_ready(subject.inputs(key))
            costs[name].append(timed(partial(subject.call, *arguments))[1])
    return {
        name: Timing(tuple(costs[name][1:]), subject.compilation)
        for name, subject in subjects.items()
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, minimum and maximum of repeated measurements."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


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
    rounds = [
        one.wall_s / other.wall_s
        for one, other in zip(numerator.costs, denominator.costs, strict=True)
    ]
    return {
        "wall": numerator.median.wall_s / denominator.median.wall_s,
        "cpu": numerator.median.cpu_s / denominator.median.cpu_s,
        "wall_min": min(rounds),
        "wall_max": max(rounds),
    }


def share_saved(whole: Timing, without: Timing, of: Timing | None = None) -> dict[str, float]:
    """What goes away with a part, as a share of `of` (default: the whole), by both clocks' medians.

    Negative where the stand-in of the part costs more than the part, or where noise is larger.
    """
    saved, base = whole.median - without.median, (of or whole).median
    return {"wall": saved.wall_s / base.wall_s, "cpu": saved.cpu_s / base.cpu_s}


class Report:
    """Prints results as rows and, with `--output`, appends each as a JSON line with `FIELDS`.

    A line is a timing (`wall_s`, `cpu_s`, `compile_s` and `rates` per second; `compile_s` is None
    for what is no single program) or derived numbers (`values`; the others None or empty).
    """

    def __init__(self, benchmark: str, arguments: Benchmark) -> None:
        self._benchmark, self._output = benchmark, arguments.output
        self.is_quick: bool = arguments.quick
        self.repeats: int = arguments.repeats
        jax.devices()  # Makes the devices known before the session is described.
        self._session = describe_session()
        print(f"\n{benchmark}: {', '.join(self._session['devices'])}")

    def measure(self, subjects: Mapping[str, Subject]) -> dict[str, Timing]:
        """See `measure`."""
        return measure(subjects, self.repeats)

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
        walls = [cost.wall_s for cost in timing.costs]
        wall, cpu = spread(walls), spread([cost.cpu_s for cost in timing.costs])
        rates = {unit: spread([amount / s for s in walls]) for unit, amount in work.items()}
        compilation = timing.compilation
        self._write(
            case=case,
            num_envs=num_envs,
            includes=list(includes),
            how=how,
            repeats=len(walls),
            wall_s=wall,
            cpu_s=cpu,
            compile_s=compilation and {"wall": compilation.wall_s, "cpu": compilation.cpu_s},
            rates=rates,
        )
        low, middle, high = (1e3 * wall[name] for name in ("min", "median", "max"))
        shown = [f"{middle:,.2f} ms [{low:,.2f}, {high:,.2f}], cpu {1e3 * cpu['median']:,.2f} ms"]
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

    def ratio(self, case: str, one: Timing, other: Timing, *, how: str = RATIO) -> None:
        """How many times longer one subject takes than the other."""
        self.values(case, ratio(one, other), how=how)

    def _print(self, case: str, shown: Sequence[str]) -> None:
        print(f"  {case:<58} {'   '.join(shown)}", flush=True)

    def _write(self, **entries: Any) -> None:
        record: dict[str, Any] = dict.fromkeys(FIELDS)
        record |= {"includes": [], "rates": {}, "values": {}}
        record |= {name: self._session[name] for name in FIELDS if name in self._session}
        record |= {"benchmark": self._benchmark, "quick": self.is_quick, **entries}
        if self._output is not None:
            path = Path(self._output)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a") as file:
                file.write(json.dumps(record) + "\n")
