"""Two sets of runs on the same splits, seeds and episodes, and how far apart they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxnew.evaluation import EVALUATION_SEED, Interval, measure
from jaxnew.run import Run
from jaxnew.task.places import UsageError

NUM_RESAMPLES = 2_000


@dataclass(frozen=True)
class Comparison:
    """A metric of runs less that of others; prints as a table.

    Attributes:
      metric: the task's metric of selection.
      part: what sets are drawn from, a part of the split.
      num_episodes: of every run.
      pairs: by seed of the split and seed of the runs, the mean of the one and that of the other.
      difference: mean over splits of the mean over seeds, with its interval of `paired_interval`.
    """

    metric: str
    part: str
    num_episodes: int
    pairs: Mapping[tuple[int, int], tuple[float, float]]
    difference: Interval

    def __str__(self) -> str:
        lines = [
            f"{self.metric}, {self.part} actions, {self.num_episodes:,} episodes of each run",
            f"{'split seed':>10} {'seed':>6} {'runs':>9} {'others':>9} {'difference':>11}",
        ]
        lines += [
            f"{split:>10} {seed:>6} {mean:>9.4f} {other:>9.4f} {mean - other:>+11.4f}"
            for (split, seed), (mean, other) in self.pairs.items()
        ]
        means = np.mean([*self.pairs.values()], axis=0)
        lines.append(
            f"{'mean':>17} {means[0]:>9.4f} {means[1]:>9.4f} {np.subtract(*means):>+11.4f}"
        )
        shown = "{:+.4f} [{:+.4f}, {:+.4f}]".format(*self.difference)
        return "\n".join([*lines, f"{shown}, bootstrap over splits, seeds and episodes, 95 %"])


def compare(
    runs: Sequence[Run],
    others: Sequence[Run],
    part: str = "test",
    *,
    episodes: int = 5000,
    seed: int = EVALUATION_SEED,
) -> Comparison:
    """Plays the same episodes with each run and with the other one of its split and seed.

    Args:
      runs: of one task; no two of one split and seed.
      others: as many, of the same splits and seeds.
      part: of the split, `train`, `validation` or `test`.
      episodes: of each run.
      seed: of the episodes.

    Raises:
      UsageError: the runs make no such pairs.
    """
    first, second = _by_place(runs), _by_place(others)
    if not first or first.keys() != second.keys():
        raise UsageError(
            "Give runs, and for each of them another one of its task, split and seed to compare it "
            f"with; got {_listed(first)} against {_listed(second)}."
        )
    sizes = {run.config.sets.size for run in (*runs, *others)}
    if len({run.config.task for run in runs}) > 1 or len(sizes) > 1:
        raise UsageError("Compare runs of one task, with sets of one size.")
    metric = runs[0].task.selection_metric
    played = {
        place: [
            measure(run.trainer.rollout, run.policy, run.trainer.actions(part), episodes, seed)[
                metric
            ].astype(np.float64)
            for run in (first[place], second[place])
        ]
        for place in sorted(first)
    }
    differences: dict[tuple[str, str, int], list[np.ndarray]] = {}
    for place, (mine, theirs) in played.items():
        differences.setdefault(place[:3], []).append(mine - theirs)
    return Comparison(
        metric,
        part,
        episodes,
        {
            (split_seed, of_run): (float(mine.mean()), float(theirs.mean()))
            for (_, _, split_seed, of_run), (mine, theirs) in played.items()
        },
        paired_interval([*differences.values()]),
    )


def paired_interval(
    differences: Sequence[Sequence[np.ndarray]], num_resamples: int = NUM_RESAMPLES
) -> Interval:
    """The mean over splits of the mean over seeds of paired differences, with the percentiles 2.5
    and 97.5 of a bootstrap that draws splits, then seeds of each of them, then episodes of each of
    those (Efron and Tibshirani, *An Introduction to the Bootstrap*, 1993, chapters 8 and 13).

    Few splits or seeds say little of how much they vary: of one, nothing.

    Args:
      differences: by split and seed, f[n] of the same episodes of two policies.
      num_resamples: how many means are drawn; always the same ones.
    """
    rng = np.random.default_rng(0)

    def drawn_mean(values: Sequence[np.ndarray]) -> float:
        chosen = rng.integers(len(values), size=len(values))
        return float(np.mean([rng.choice(values[i], len(values[i])).mean() for i in chosen]))

    means = [
        np.mean(
            [
                drawn_mean(differences[i])
                for i in rng.integers(len(differences), size=len(differences))
            ]
        )
        for _ in range(num_resamples)
    ]
    low, high = np.percentile(means, [2.5, 97.5])
    mean = np.mean([np.mean([values.mean() for values in of_split]) for of_split in differences])
    return Interval(float(mean), float(low), float(high))


def _by_place(runs: Sequence[Run]) -> dict[tuple[str, str, int, int], Run]:
    """By task, split, its seed and the run's; refuses two in one place."""
    found: dict[tuple[str, str, int, int], Run] = {}
    for run in runs:
        config = run.config
        place = (config.task, config.split, config.split_seed, config.seed)
        if place in found:
            raise UsageError(f"{run.path} and {found[place].path} are of one split and seed.")
        found[place] = run
    return found


def _listed(runs: Mapping[tuple[str, str, int, int], Run]) -> str:
    texts = [f"{task}, {split} split {of}, seed {seed}" for task, split, of, seed in sorted(runs)]
    return "; ".join(texts) or "no run"
