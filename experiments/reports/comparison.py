"""Learning curves of jaxnew against the paper's at equal environment steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from experiments.reports import tables
from experiments.reports.curves import mean_curve
from experiments.reports.drawing import CURVE_SPLITS, run_curves
from experiments.reports.paper import is_comparable, paper_curve
from experiments.reports.plots import Metric
from experiments.reports.runs import Group

_SHARES = (0.25, 0.5, 0.75, 1.0)  # Of our steps, at which the curves are compared.


@dataclass(frozen=True)
class CurvePoint:
    """One setting at one number of steps.

    Attributes:
      setting: label of the group.
      split: sets of `train` or `validation` actions.
      steps: environment steps of our evaluation.
      mean, std: jaxnew's, every seed held at its best evaluation as the paper draws them;
        population deviation over seeds.
      num_seeds: jaxnew's.
      paper_mean, paper_std: of the paper's curve, linear between its points; None before its first
        one or without a curve.
      verdict: `on` where the two means differ by at most the root of the summed variances, else
        `above` or `below` (jaxnew against the paper); None without a paper's value, or with one
        that nothing can be compared with.
    """

    setting: str
    split: str
    steps: float
    mean: float
    std: float
    num_seeds: int
    paper_mean: float | None
    paper_std: float | None
    verdict: str | None


def compare_curves(groups: Sequence[Group]) -> list[CurvePoint]:
    """Every group at quarters of its steps, on train and validation sets."""
    points = []
    for group in groups:
        for split in CURVE_SPLITS:
            runs = run_curves(group, split)
            if not runs:
                continue
            is_fair = is_comparable(group.paper_environment, group.paper_method, split)
            steps, mean, std = mean_curve([run.held_at_best() for run in runs])
            for share in _SHARES:
                index = int(np.argmin(np.abs(steps - share * steps[-1])))
                own = float(mean[index]), float(std[index])
                paper = _paper_at(group, split, steps[index])
                verdict = verdict_of(*own, *paper) if is_fair else None
                at = group.label, split, float(steps[index])
                points.append(CurvePoint(*at, *own, len(runs), *paper, verdict))
    return points


def _paper_at(group: Group, split: str, steps: float) -> tuple[float | None, float | None]:
    if group.paper_method is None or not group.is_default_split:  # There is no curve of another.
        return None, None
    curve = paper_curve(str(group.paper_environment), group.paper_method, split)
    if curve is None or not curve.steps[0] <= steps <= curve.steps[-1]:
        return None, None
    mean, std = (np.interp(steps, curve.steps, values) for values in (curve.mean, curve.std))
    return float(mean), float(std)


def verdict_of(
    mean: float, std: float, paper_mean: float | None, paper_std: float | None
) -> str | None:
    """`on`, `above` or `below` the paper; see `CurvePoint`."""
    if paper_mean is None or paper_std is None:
        return None
    if abs(mean - paper_mean) <= np.hypot(std, paper_std):
        return "on"
    return "above" if mean > paper_mean else "below"


def comparison_csv(points: Sequence[CurvePoint]) -> str:
    """The points with all fields."""
    return tables.csv_text([asdict(p) for p in points], [f.name for f in fields(CurvePoint)])


def comparison_markdown(
    title: str, points: Sequence[CurvePoint], metric: Metric, note: str = ""
) -> str:
    """The points for reading, and a note below them."""
    rows = []
    for point in points:
        own = f"{metric.text(point.mean)} ± {metric.text(point.std)} ({point.num_seeds} seeds)"
        paper = "-"
        if point.paper_mean is not None and point.paper_std is not None:
            paper = f"{metric.text(point.paper_mean)} ± {metric.text(point.paper_std)}"
        cells = [point.setting, point.split, f"{point.steps * 1e-6:.2f}", own, paper]
        rows.append([*cells, point.verdict or "-"])
    header = ["setting", "sets", "steps (million)", "jaxnew", "paper", "jaxnew is"]
    lines = [
        *(f"# {title}", "", *tables.table(header, rows), ""),
        f"{metric.name}; every seed held at its best evaluation so far, as the paper draws its "
        "curves; ± is the population standard deviation over seeds. `on`: the means differ by at "
        "most the root of the summed squares of the two deviations.",
        *(["", note] if note else []),
    ]
    return "\n".join(lines) + "\n"
