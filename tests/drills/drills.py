"""Kills, full disks, lost workers and damaged files at random; `docs/reliability.md` has totals.

python -m tests.drills --seed=1 --kills=50 --full_disks=10 --worker_faults=50 --damages=100

Each drill disturbs runs that take seconds and compares them with undisturbed ones. What it does
follows from the seed alone, but for the instants of kills. The first promise that is not kept ends
it with an AssertionError that says what was done.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from envs_host.pool import HostPool
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage.checkpoint import KINDS, Checkpointer
from tests.envs_host.pool_toys import CHAOTIC
from tests.experiments.commands import ENVIRONMENT, ROOT, as_user, command_line
from tests.experiments.create_runs import saved, timeless

# Commands of a few seconds: inside jit, on the host, of stage one with its recordings, a sweep.
JOBS: Mapping[str, str] = {
    "train": "train --representation=gt12 --budget=smoke",
    "train on the host": "train --task=tests.toy_task:TASK --representation=gt4 --budget=smoke",
    "collect and embed": "embed --representation=hvae --budget=smoke",
    "sweep": "sweep --representation=gt12 --budget=smoke --seeds=1,2",
}
# Files of a run that say how it was made, and which nothing that is computed depends on.
UNREAD = ("provenance.json", ".lock", "tensorboard", "events.out")


@dataclass
class Drills:
    """Drills in a folder of their own.

    Attributes:
      root: the folder.
      seed: of all that is random.
      totals: how often which end was seen, by drill.
    """

    root: Path
    seed: int
    totals: dict[str, Counter[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._calm: dict[str, tuple[dict[str, Any], float]] = {}

    def kills(self, count: int) -> None:
        """SIGKILL to commands, half of them with `--overwrite`, which are then run to their end."""
        rng, seen = self._begin("kills")
        while seen.total() < count:
            name = str(rng.choice(list(JOBS)))
            expected, seconds = self.calm(name)
            runs = self._folder("killed")
            if is_replaced := bool(name.startswith("train") and rng.random() < 0.5):
                run_job(name, runs)
            while seen.total() < count and rng.random() < 0.8:
                more = ("--overwrite",) if is_replaced else ()
                with started(name, runs, *more) as process:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(rng.uniform(0.2, 1.0) * seconds)
                    if process.poll() is None:
                        os.killpg(process.pid, signal.SIGKILL)
                        seen[f"{name}{' --overwrite' * is_replaced}: same bits"] += 1
            output = run_job(name, runs)
            assert results(runs) == expected, self._told(name, output)
            left = [path for path in runs.rglob(".*") if path.name != ".lock"]
            assert not left, self._told(name, f"{left} are left")

    def full_disks(self, count: int) -> None:
        """Commands on a file system that is too small; then it is larger, and they go on.

        Raises:
          PermissionError: this process may not mount one.
        """
        rng, seen = self._begin("full disks")
        while seen.total() < count:
            name = str(rng.choice(list(JOBS)))
            expected, _ = self.calm(name)
            whole = sum(p.stat().st_size for p in self._calm_runs(name).rglob("*") if p.is_file())
            runs = self._folder("disk")
            with small_disk(runs, int(whole * rng.uniform(0.1, 0.8))) as grow:
                with started(name, runs) as process:
                    output, _ = process.communicate()
                if process.returncode == 0:
                    continue  # It had room: nothing was seen.
                assert "Traceback" not in output, self._told(name, output)
                assert "Event loop" not in output, self._told(name, output)
                assert "space" in output.splitlines()[-1] + output.splitlines()[-2], output
                grow(10 * whole)
                output = run_job(name, runs)
                assert results(runs) == expected, self._told(name, output)
            seen[f"{name}: one line, then same bits"] += 1

    def worker_faults(self, count: int) -> None:
        """Workers of a pool that are killed or stopped at any time, and replaced."""
        rng, seen = self._begin("worker faults")
        num_envs, num_steps = 4, 20
        while seen.total() < count:
            ids = rng.integers(0, 10, (num_steps, num_envs))
            positions = rng.uniform(-1, 1, (num_steps, num_envs, 2))
            with HostPool(CHAOTIC, {}, num_envs, 1, self.seed) as pool:
                expected = [pool.reset().copy()]
                for t in range(num_steps):
                    expected += observed(pool.step(ids[t], positions[t]))
            with HostPool(
                CHAOTIC,
                {},
                num_envs,
                2,
                self.seed,
                on_worker_death="restart",
                max_restarts=num_steps,
                timeout_s=3.0,
            ) as pool:
                found = [pool.reset().copy()]
                for t in range(num_steps):
                    if seen.total() < count and rng.random() < 0.2:
                        fault = signal.SIGKILL if rng.random() < 0.8 else signal.SIGSTOP
                        os.kill(int(rng.choice(pool.worker_pids)), fault)
                        seen[f"{fault.name}: replaced exactly"] += 1
                        time.sleep(rng.uniform(0.0, 0.01))
                    found += observed(pool.step(ids[t], positions[t]))
            for x, y in zip(found, expected, strict=True):
                np.testing.assert_array_equal(x, y)

    def damages(self, count: int) -> None:
        """A file of a run is flipped, cut, emptied, exchanged or removed; then it is used."""
        rng, seen = self._begin("damages")
        names = ("train", "train on the host")
        expected = {name: self._answers(name) for name in names if count}
        while seen.total() < count:
            name = str(rng.choice(names))
            runs = self._folder("damaged")
            shutil.copytree(self._calm_runs(name), runs, dirs_exist_ok=True)
            (run,) = (path.parent for path in runs.rglob("provenance.json"))
            files = [path for path in sorted(run.rglob("*")) if path.is_file() and is_read(path)]
            path = files[rng.integers(len(files))]
            what = damage(path, rng)
            before = contents(run)
            module, *flags = self._uses(name, run)[rng.integers(3)]
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always", UserWarning)
                output, has_failed = as_user(module, flags)
            output += "".join(f"{each.message}\n" for each in warned)
            told = self._told(name, f"{what} {path.relative_to(run)}, {module}: {output}")
            assert "Traceback" not in output, told
            kept = contents(run)
            is_named = str(path) in output or any(str(p) in output for p in self._places(path, run))
            if has_failed:
                assert is_named, told
                assert kept == before, told
                seen[f"{module}: refused by name"] += 1
            elif is_named:
                seen[f"{module}: named, and went on"] += 1
            else:
                assert answers(output, run) == expected[name][module], told
                lost = [p for p in before if p not in kept and p != str(path.relative_to(run))]
                assert not lost, f"{told}{lost}"
                seen[f"{module}: same"] += 1

    def calm(self, name: str) -> tuple[dict[str, Any], float]:
        """What an undisturbed command leaves, and the seconds it takes."""
        if name not in self._calm:
            run_job(name, self._folder("warm-up"))  # Programs are compiled.
            start = time.monotonic()
            run_job(name, self._calm_runs(name))
            self._calm[name] = results(self._calm_runs(name)), time.monotonic() - start
        return self._calm[name]

    def _answers(self, name: str) -> dict[str, str]:
        self.calm(name)
        (run,) = (path.parent for path in self._calm_runs(name).rglob("provenance.json"))
        uses = self._uses(name, run)
        for module, *flags in uses:  # Once more, as all is there then that they write.
            as_user(module, flags)
        return {module: answers(as_user(module, flags)[0], run) for module, *flags in uses}

    def _uses(self, name: str, run: Path) -> list[tuple[str, ...]]:
        module, *flags = JOBS[name].split()
        return [
            ("evaluate", f"--run={run}", "--episodes=7"),
            (module, *flags, f"--workdir={run}"),
            ("figures", f"--run={run}"),
        ]

    def _places(self, path: Path, run: Path) -> list[Path]:
        """Folders of a run that stand for a file in them."""
        return [folder for folder in path.parents if folder.is_relative_to(run) and folder != run]

    def _calm_runs(self, name: str) -> Path:
        return self.root / f"calm-{name.replace(' ', '-')}"

    def _folder(self, name: str) -> Path:
        folder = self.root / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def _begin(self, drill: str) -> tuple[np.random.Generator, Counter[str]]:
        print(f"{drill}, seed {self.seed}", flush=True)
        seen = self.totals.setdefault(drill, Counter())
        return np.random.default_rng([self.seed, len(self.totals)]), seen

    def _told(self, name: str, output: str) -> str:
        return f"seed {self.seed}, {name}, after {dict(self.totals)}:\n{output}"


@contextlib.contextmanager
def started(name: str, runs: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    """A job in a process group of its own, which is gone at the end."""
    process = subprocess.Popen(
        command_line(*JOBS[name].split(), f"--runs={runs}", *more),
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def run_job(name: str, runs: Path) -> str:
    """What a job prints that is left alone until its end."""
    with started(name, runs) as process:
        output, _ = process.communicate()
    assert process.returncode == 0, output
    return output


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Any]:
    """A file system of so many bytes in `folder`; yields what gives it another size."""

    def mount(*options: str) -> None:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", ",".join(options), "drill", str(folder)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise PermissionError(f"No file system can be mounted: {done.stderr.strip()}")

    mount(f"size={size}")
    try:
        yield lambda larger: mount("remount", f"size={larger}")
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def results(runs: Path) -> dict[str, Any]:
    """All that is reproduced to the bit of what lies in a folder, by place."""
    found: dict[str, Any] = {}
    for path in sorted(runs.rglob("*")):
        place = str(path.relative_to(runs))
        if path.name == "provenance.json":
            checkpointer = Checkpointer(path.parent / "checkpoints")
            kinds = [kind for kind in KINDS if checkpointer.steps(kind)]
            found[place] = timeless(path.parent), {k: saved(path.parent, k) for k in kinds}
        elif path.name in ("config.json", "split.json"):
            found[place] = path.read_bytes()
        elif path.name == "table.npz":
            found[place] = RepresentationTable.load(path).hash
    return found


def observed(step: Any) -> list[np.ndarray]:
    """Numbers of a step of a pool, copied: the pool overwrites them."""
    return [step.observations.copy(), step.rewards.copy(), step.terminated.copy()]


def is_read(path: Path) -> bool:
    """Whether anything that is computed depends on a file."""
    return not any(word in str(path) for word in UNREAD)


def contents(run: Path) -> dict[str, str]:
    """A hash of each file that is read."""
    files = [path for path in run.rglob("*") if path.is_file() and is_read(path)]
    return {str(p.relative_to(run)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def damage(path: Path, rng: np.random.Generator) -> str:
    """Does something bad to a file; returns what."""
    content = bytearray(path.read_bytes())
    what = str(rng.choice(["flipped a bit of", "cut", "emptied", "removed"]))
    if what == "flipped a bit of" and content:
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    elif what == "cut":
        del content[rng.integers(len(content) + 1) :]
    else:
        content.clear()
    path.write_bytes(content)
    if what == "removed":
        path.unlink()
    return what


def answers(output: str, run: Path) -> str:
    """What a command says of a run, wherever that lies."""
    return output.replace(str(run), "RUN")
