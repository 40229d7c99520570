"""The runs that tests of Shape Stacking's commands look at, and how they are made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs_mjx.shape_stacking import published_split
from jaxnew.actions import ActionSplit
from jaxnew.storage import metrics
from tests.experiments.commands import read_json
from tests.experiments.several import run_several
from tests.experiments.stacking_probes import EPISODES

WIDTH = 21  # Of every representation, so that policies share their programs.
WATCHED = "tests.experiments.stacking_probes:watched"
EMBED = "shape_stacking/embed-{}-default-smoke-31"
SHORT = ("--set=num_updates=1",)


@dataclass(frozen=True)
class Run:
    """A run of `train`; `representation` may be a path below the folder of all runs."""

    variant: str = ""
    method: str = "ours"
    representation: str = "gt21"
    flags: tuple[str, ...] = SHORT
    split: str = "default"

    @property
    def task(self) -> str:
        return f"shape_stacking{self.variant}"

    @property
    def action_split(self) -> ActionSplit:
        return published_split(self.split)

    def training(self, runs: Path, workdir: Path) -> tuple[str, ...]:
        """Flags of `train`."""
        given = runs / self.representation
        return (
            f"--task={self.task}",
            f"--method={self.method}",
            "--budget=smoke",
            f"--split={self.split}",
            f"--representation={given if given.exists() else self.representation}",
            f"--workdir={workdir}",
            *self.flags,
        )


ALIKE = {"line": Run(flags=())}
# The first three have the program of `line`, the others each their own.
OTHERS = {
    "encoded": Run(representation=EMBED.format("hvae")),
    "no-entropy": Run(method="no-entropy"),
    "full": Run(split="full"),
    "no-place": Run("-no-place", "nearest-neighbour", "random-21"),
    "2d-place": Run(
        "-2d-place",
        representation=EMBED.format("hvae-oracle"),
        flags=(*SHORT, "--set=conditions_position=true"),
    ),
    "clusters": Run(
        method="modulated",
        representation=EMBED.format("vae"),
        flags=(*SHORT, "--set=num_clusters=10"),
    ),
    "no-subsampling": Run("-2d-place", "no-subsampling", EMBED.format("vae-oracle")),
    "continuous": Run(method="continuous", representation="mine.npz"),
    "random": Run("-no-place", "random"),
}
RUNS = ALIKE | OTHERS


def embed(runs: Path, names: Iterable[str], *flags: str) -> list[str]:
    """Trains encoders, each of a picture per shape."""
    jobs = []
    for name in names:
        size = "observation_latent" if name.startswith("vae") else "action_latent"
        jobs.append(
            (
                "--task=shape_stacking",
                "--budget=smoke",
                f"--representation={name}",
                "--recordings=1",
                "--set=model.recordings_per_action=1",
                f"--set=model.{size}={WIDTH}",
                f"--runs={runs}",
                *flags,
            )
        )
    return run_several("embed", jobs)


def train(runs: Path, names: Iterable[str]) -> dict[str, str]:
    """What `train` prints for each of `RUNS`."""
    names = list(names)
    jobs = [RUNS[name].training(runs, runs / name) for name in names]
    outputs = run_several("train", jobs, probe=WATCHED)
    return dict(zip(names, outputs, strict=True))


def evaluate(runs: Path, names: Iterable[str], more: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """What `evaluate` prints, and for more jobs.

    For each of `RUNS` on train and test shapes.
    """
    jobs = {name: (f"--run={runs / name}", "--sets=train,test") for name in names} | dict(more)
    flags = [(*job, f"--episodes={EPISODES}") for job in jobs.values()]
    return dict(zip(jobs, run_several("evaluate", flags, probe=WATCHED), strict=True))


def evaluation(path: Path, name: str = "test") -> dict[str, Any]:
    """What `evaluate` found on a list of shapes."""
    (file,) = (path / "evaluation").glob(f"{name}-best-sampled-m*.json")
    found: dict[str, Any] = read_json(file)
    return found


def means(path: Path, name: str = "test") -> dict[str, float]:
    return {key: row["mean"] for key, row in evaluation(path, name)["metrics"].items()}


def logged(path: Path, step: int, prefix: str) -> dict[str, float]:
    """The metrics `PREFIX/...` that a run logged at a step."""
    return {
        name.removeprefix(f"{prefix}/"): value
        for line in metrics.read(path)
        if line["step"] == step
        for name, value in line.items()
        if name.startswith(f"{prefix}/")
    }


def save_own_table(path: Path) -> np.ndarray:
    """A table of the user's own; returns its vectors."""
    vectors = np.random.default_rng(0).normal(size=(810, WIDTH)).astype(np.float32)
    np.savez(path, ids=np.arange(len(vectors)), vectors=vectors)
    return vectors
