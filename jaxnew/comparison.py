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
      means: of both, over splits of the mean over seeds.
      difference: of these, with its interval of `paired_interval`.
    """

    metric: str
    part: str
    num_episodes: int
    pairs: Mapping[tuple[int, int], tuple[float, float]]
    means: tuple[float, float]
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
        mean, other = self.means
        lines.append(f"{'mean':>17} {mean:>9.4f} {other:>9.4f} {mean - other:>+11.4f}")
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
      runs: of one task and kind of split, each of its own split seed and seed.
      others: as many, of the same splits and seeds.
      part: of the split, `train`, `validation` or `test`.
      episodes: of each run.
      seed: of the episodes.

    Raises:
      UsageError: the runs make no such pairs, or would play other episodes than their partners.
    """
    first, second = _by_place(runs), _by_place(others)
    if not first or first.keys() != second.keys():
        raise UsageError(
            "Give runs, and for each of them another one of its task, split and seed to compare it "
            f"with; got {_listed(first)} against {_listed(second)}."
        )
    if len({place[:2] for place in first}) > 1:
        raise UsageError(f"Compare runs of one task and one kind of split; got {_listed(first)}.")
    for place in first:
        mine, theirs = (found[place].config.environment for found in (first, second))
        if mine != theirs:
            raise UsageError(
                f"{first[place].path} and {second[place].path} have other environments: {mine} and "
                f"{theirs}."
            )
    actions = {run.path: run.trainer.actions(part) for run in (*runs, *others)}
    sizes = {of.set_size for of in actions.values()}
    if len(sizes) > 1:
        raise UsageError(
            f"With {part} actions these runs play sets of {sorted(sizes)} actions; compare runs "
            "whose sets are of one size."
        )
    metric = runs[0].task.selection_metric

    def values_of(run: Run) -> np.ndarray:
        played = measure(run.trainer.rollout, run.policy, actions[run.path], episodes, seed)
        return played[metric].astype(np.float64)

    pairs, by_split = {}, dict[int, list[tuple[np.ndarray, np.ndarray]]]()
    for place in sorted(first):
        both = values_of(first[place]), values_of(second[place])
        pairs[place[2:]] = float(both[0].mean()), float(both[1].mean())
        by_split.setdefault(place[2], []).append(both)
    means = np.mean([np.mean(of_split, axis=(0, 2)) for of_split in by_split.values()], axis=0)
    differences = [[mine - theirs for mine, theirs in of_split] for of_split in by_split.values()]
    return Comparison(
        metric,
        part,
        episodes,
        pairs,
        (float(means[0]), float(means[1])),
        paired_interval(differences),
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
