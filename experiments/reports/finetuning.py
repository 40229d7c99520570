"""Fine-tuning: four ways to learn the test actions, zero-shot beside them (spec method 9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.pipeline.evaluation import evaluate_run
from experiments.pipeline.methods import trained_ids
from experiments.reports import plots
from experiments.reports.curves import RunCurve, reference_curves
from experiments.reports.jobs import Job, duration, training_seconds
from experiments.reports.paper import paper_value
from experiments.reports.plots import Color, Metric
from experiments.reports.production import Source
from experiments.reports.runs import Group, read_runs
from jaxnew.task import StageTwoBudget

# Method of the pretrained run -> (what `finetune` trains, name of its two curves).
VARIANTS = {
    "ours": ("no-subsampling", "ours"),
    "nearest-neighbour": ("nearest-neighbour", "discrete"),
}


@dataclass(frozen=True)
class FinetuneCurve:
    """One of the four curves.

    Attributes:
      label: e.g. `ours, fine-tuned`.
      runs: one per seed, of the training episodes.
    """

    label: str
    runs: tuple[RunCurve, ...]


@dataclass(frozen=True)
class Reference:
    """A horizontal line: a policy that learns nothing on the test actions."""

    label: str
    mean: float


@dataclass(frozen=True)
class FinetuneCurves:
    """All that the figure shows."""

    curves: tuple[FinetuneCurve, ...]
    references: tuple[Reference, ...]
    metric: Metric


def finetune_budget(source: Source, method: str, steps: float) -> StageTwoBudget:
    """What fine-tuning of a pretrained method spends; `steps=0` for the preset's share."""
    budget = replace(source, steps=0).budget_of(VARIANTS[method][0])
    updates = budget.num_updates * source.domain.task.baselines.finetune_share
    if steps:
        updates = steps / budget.ppo.steps_per_update
    return replace(budget, num_updates=max(1, math.ceil(updates)))


def finetune_job(
    source: Source, path: Path, method: str, seed: int, kind: str, steps: float
) -> Job:
    """The command that fine-tunes one run, or trains beside it from scratch."""
    budget = finetune_budget(source, method, steps)
    command = (
        "finetune",
        f"--run={path}",
        f"--budget={source.budget}",
        f"--seed={seed}",
        *(f"--set={text}" for text in source.budget_assignments),
        f"--set=num_updates={budget.num_updates}",
        f"--workdir={finetune_folder(path, budget, kind)}",
        *(["--scratch"] if kind == "scratch" else []),
        *([f"--workers={source.workers}"] if source.workers else []),
    )
    trained = VARIANTS[method][0]
    seconds = training_seconds(source, trained, budget.num_updates * budget.ppo.steps_per_update, 1)
    return Job(f"{VARIANTS[method][1]}, {kind}, seed {seed}", command, duration(seconds), seconds)


def finetune_folder(path: Path, budget: StageTwoBudget, kind: str) -> Path:
    """Where a fine-tuning run of these many updates is kept."""
    return path / f"finetune-{kind}-{budget.num_updates}"


def finetune_seconds(source: Source, steps: float) -> float | None:
    """How long all four curves of all seeds take."""
    jobs = [
        finetune_job(source, Path("RUN"), method, seed, kind, steps)
        for method in VARIANTS
        for kind in ("warm", "scratch")
        for seed in source.seeds
    ]
    known = [job.seconds for job in jobs if job.seconds is not None]
    return sum(known) if len(known) == len(jobs) else None


def make_finetuned(
    source: Source, groups: Sequence[Group], steps: float, num_episodes: int
) -> FinetuneCurves:
    """Finds or makes the fine-tuning runs of pretrained groups, and the zero-shot lines.

    Args:
      groups: one of `ours` and one of `nearest-neighbour`.
      steps: environment steps of fine-tuning; 0 for those of the preset.
      num_episodes: of the evaluations behind the lines.
    """
    curves = []
    for group in groups:
        method = group.config["method"]
        for kind, name in (("warm", "fine-tuned"), ("scratch", "from scratch")):
            runs = []
            for run in group.runs:
                job = finetune_job(source, run.path, method, run.config["seed"], kind, steps)
                budget = finetune_budget(source, method, steps)
                folder = finetune_folder(run.path, budget, kind)
                wanted = budget.num_updates * budget.ppo.steps_per_update
                if not (folder / "config.json").exists() or _curve(folder, group)[0] < wanted:
                    job.run()
                runs.append(_curve(folder, group)[1])
            curves.append(FinetuneCurve(f"{VARIANTS[method][1]}, {name}", tuple(runs)))
    ours = groups[[group.config["method"] for group in groups].index("ours")]
    return FinetuneCurves(
        tuple(curves), tuple(_references(source, ours, num_episodes)), ours.metric
    )


def _curve(folder: Path, group: Group) -> tuple[int, RunCurve]:
    """Steps so far, and the metric of the training episodes."""
    (run,) = read_runs([folder])
    return run.trained_steps, RunCurve(*run.curve(f"episode/{group.task.selection_metric}"))


def _references(source: Source, group: Group, num_episodes: int) -> list[Reference]:
    """Zero-shot: on sets as in training, and on all test actions at once; ours and the paper's."""
    domain = source.domain
    whole = len(trained_ids("no-subsampling", domain.task, domain.split, "test"))
    whole += len(domain.split.always_available)
    sizes = {"sets as in training": group.set_size("test"), "all at once": whole}
    references = []
    for (name, size), published in zip(
        sizes.items(), ("ours_zero_shot", "ours_zero_shot_whole_test_set"), strict=True
    ):
        means = [
            _zero_shot(run.path, size, group, num_episodes, source.workers) for run in group.runs
        ]
        references.append(Reference(f"ours, zero-shot, {name} ({size})", float(np.mean(means))))
        if group.paper_environment is not None:
            paper = paper_value(group.paper_environment, published, "test")
            if paper is not None:
                references.append(Reference(f"paper, zero-shot, {name}", paper.mean))
    return references


def _zero_shot(
    path: Path, set_size: int | None, group: Group, num_episodes: int, num_workers: int
) -> float:
    """Mean of a run on test sets of a size; evaluated now if it is not there."""

    def found() -> list[float]:
        (run,) = read_runs([path])
        return [
            e["metrics"][group.task.selection_metric]["mean"]
            for e in run.evaluations
            if (e["actions"], e["checkpoint"], e["policy"]) == ("test", "best", "sampled")
            and e["set_size"] == set_size
            and e["num_episodes"] >= num_episodes
        ]

    if not found():
        print(f"Evaluating {path} on test sets of {set_size}.", flush=True)
        evaluate_run(path, {"test": set_size}, num_episodes, num_workers)
    return found()[0]


def finetune_figure(content: FinetuneCurves, title: str) -> Figure:
    """The curves of the training episodes, and the zero-shot lines."""
    palette = plots.hls_palette(10)
    colors: list[Color] = [palette[3], palette[2], palette[9], palette[8]]
    settings = [
        (curve.label, color, curve.runs)
        for curve, color in zip(content.curves, colors, strict=True)
    ]
    lines = [(reference.label, reference.mean) for reference in content.references]
    return reference_curves(settings, lines, content.metric, title)
