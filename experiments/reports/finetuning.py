"""Fine-tuning: four ways to learn the test actions, zero-shot beside them (figures 10 and 19)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.reports import plots
from experiments.reports.asking import Asked, answers_of
from experiments.reports.curves import RunCurve, reference_curves
from experiments.reports.jobs import Job, duration, training_seconds
from experiments.reports.paper import paper_value
from experiments.reports.production import Cell, Source
from experiments.reports.runs import Group, read_runs
from jaxnew.results import Question
from jaxnew.task.methods import trained_ids, variant_of
from jaxnew.training import CONTINUED

_KINDS = {"warm": "fine-tuned", "scratch": "from scratch"}


@dataclass(frozen=True)
class Tuning:
    """How the runs of a source are fine-tuned.

    Attributes:
      source: of the pretrained runs.
      steps: environment steps; 0 for the preset's share.
    """

    source: Source
    steps: float

    def size(self, method: str) -> tuple[int, int]:
        """Updates, and environment steps of each, of a pretrained method's continuation."""
        config = replace(self.source, steps=0).config_of(Cell(CONTINUED[method], "any"))
        updates = config.num_updates * self.source.domain.task.baselines.finetune_share
        if self.steps:
            updates = self.steps / config.ppo.steps_per_update
        return max(1, math.ceil(updates)), config.ppo.steps_per_update

    def job(self, path: Path, method: str, seed: int, kind: str) -> Job:
        """The command that fine-tunes one run, or trains beside it from scratch."""
        source, (updates, steps_per_update) = self.source, self.size(method)
        folder = path / f"finetune-{kind}-{updates}"
        command = (
            "finetune",
            f"--run={path}",
            f"--budget={source.budget}",
            f"--seed={seed}",
            *(f"--set={text}" for text in (*source.assignments, f"num_updates={updates}")),
            f"--workdir={folder}",
            *(["--scratch"] if kind == "scratch" else []),
            *(["--trust"] if source.domain.task.place else []),  # Whoever asks named it.
            *([f"--workers={source.workers}"] if source.workers else []),
        )
        seconds = training_seconds(source, CONTINUED[method], updates * steps_per_update)
        title = f"{variant_of(method).policy}, {kind}, seed {seed}"
        return Job(title, command, duration(seconds), seconds, folder)

    @property
    def seconds(self) -> float | None:
        """How long all four curves of all seeds take; None if nobody measured it."""
        each = [self.job(Path("RUN"), method, 0, "warm").seconds for method in CONTINUED]
        known = [seconds for seconds in each if seconds is not None]
        times = len(_KINDS) * len(self.source.seeds)
        return times * sum(known) if len(known) == len(each) else None


def make_finetuned(tuning: Tuning, groups: Sequence[Group]) -> dict[str, list[RunCurve]]:
    """Finds or makes the fine-tuning runs of pretrained groups; of each kind of them its curves of
    the training episodes, one per seed, under a label such as `ours, fine-tuned`.
    """
    curves = {}
    for group in groups:
        method, metric = group.config["method"], f"episode/{group.task.selection_metric}"
        for kind, name in _KINDS.items():
            runs = []
            for run in group.runs:
                job = tuning.job(run.path, method, run.config["seed"], kind)
                if not job.is_done:
                    job.run()
                (found,) = read_runs([job.folder])
                runs.append(RunCurve(*found.curve(metric)))
            curves[f"{variant_of(method).policy}, {name}"] = runs
    return curves


def zero_shot(source: Source, group: Group, num_episodes: int) -> dict[str, float]:
    """On sets as in training, and on all test actions at once; jaxnew's and the paper's."""
    domain, usual = source.domain, group.standard("test")
    whole = len(trained_ids("no-subsampling", domain.task, domain.split, "test"))
    whole += len(domain.split.always_available)
    questions = {"sets as in training": usual, "all at once": Question("test", whole)}
    published = ("ours_zero_shot", "ours_zero_shot_whole_test_set")
    asked = [Asked.part(question) for question in questions.values()]
    rows = [answers_of(run, asked, num_episodes, source.workers) for run in group.runs]
    references = {}
    for number, (name, question) in enumerate(questions.items()):
        means = [r[number]["metrics"][group.task.selection_metric]["mean"] for r in rows]
        references[f"jaxnew, zero-shot, {name} ({question.set_size})"] = float(np.mean(means))
        if group.paper_environment is not None:
            paper = paper_value(group.paper_environment, published[number], "test")
            if paper is not None:
                references[f"paper, zero-shot, {name}"] = paper.mean
    return references


def finetune_figure(
    tuning: Tuning, groups: Sequence[Group], num_episodes: int, title: str
) -> Figure:
    """The curves of the training episodes, and the zero-shot lines.

    Args:
      groups: pretrained, one of `ours` and one of `nearest-neighbour`.
      num_episodes: of the evaluations behind the lines.
    """
    curves = make_finetuned(tuning, groups)
    ours = next(group for group in groups if group.config["method"] == "ours")
    lines = zero_shot(tuning.source, ours, num_episodes)
    palette = plots.hls_palette(10)
    colors = [palette[place] for place in (3, 2, 9, 8)]
    settings = list(zip(curves, colors, curves.values(), strict=True))
    return reference_curves(settings, list(lines.items()), ours.metric, title)
