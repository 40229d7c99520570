"""The figures of groups of runs, the paper's numbers beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from experiments.reports import plots
from experiments.reports.anchors import lines_of
from experiments.reports.curves import CurveSetting, RunCurve, learning_curves
from experiments.reports.paper import PaperCurve, paper_curve, paper_method
from experiments.reports.plots import Bar, BarSetting, Color, Scatter
from experiments.reports.results import ResultRow
from experiments.reports.runs import Group, RunRecord
from jaxnew.recording import REPRESENTATION_SEED
from jaxnew.representation import report
from jaxnew.representation.table import RepresentationTable
from jaxnew.task.domain import Domain, load_task

CURVE_SPLITS = ("train", "validation")
BAR_SPLITS = ("train", "test")
MAX_TSNE_ACTIONS = 400
MIN_TSNE_ACTIONS = 11  # More than its perplexity.
TSNE_PARTS = {"heldout": ("validation", "test"), "train": ("train",), "all": ("all",)}

# Place of the paper's methods in its palette of ten colours (docs/method.md, "Figures").
_COLOR_INDEX = {
    "ours_no_entropy": 0,
    "ours_no_subsampling": 2,
    "ours": 3,
    "ours_engineered": 4,
    "ours_onehot": 5,
    "ours_video": 5,
    "ours_oracle_hvae": 6,
    "vae": 7,
    "continuous_output": 8,
    "nearest_neighbor": 9,
}


def setting_colors(groups: Sequence[Group]) -> list[Color]:
    """The paper's colour of each group's method; settings without one get colours left over."""
    palette = plots.hls_palette(10)
    wanted = [_COLOR_INDEX.get(group.paper_method or "") for group in groups]
    left = [i for i in (1, 6, 8, 0, 2, 9, 4, 7, 5, 3) if i not in wanted]
    chosen: list[int] = []
    for index in wanted:
        is_free = index is not None and index not in chosen
        chosen.append(index if index is not None and is_free else left.pop(0) if left else 1)
    return [palette[index] for index in chosen]


def curves_figure(groups: Sequence[Group], title: str = "") -> Figure | None:
    """Train and validation curves of all groups; None if nothing was evaluated in training."""
    settings = []
    for group, color in zip(groups, setting_colors(groups), strict=True):
        curves = {split: run_curves(group, split) for split in CURVE_SPLITS}
        if any(curves.values()):
            settings.append(CurveSetting(group.label, color, curves, *_paper_curves(group)))
    if not settings:
        return None
    title = title or f"{groups[0].place}: learning curves"
    return learning_curves(settings, groups[0].metric, CURVE_SPLITS, title)


def run_curves(group: Group, split: str) -> list[RunCurve]:
    """The evaluations during training of every run of a group; runs without any are left out."""
    curves = [run.curve(f"{split}/{group.task.selection_metric}") for run in group.runs]
    return [RunCurve(steps, values) for steps, values in curves if len(steps)]


def _paper_curves(group: Group) -> tuple[dict[str, PaperCurve], str]:
    """The paper's curves beside a group, and their label.

    The paper shows none for the other representations and variants of its own method; those get the
    curves of its default, under that name.
    """
    method = group.paper_method
    if method is None or not group.is_default_split:  # There is no curve of another split.
        return {}, ""
    environment = str(group.paper_environment)
    label = f"paper, {method}"
    if paper_curve(environment, method, CURVE_SPLITS[0]) is None:
        is_variant = paper_method("ours", group.representation) == "ours"
        lacking = method if is_variant else group.representation
        method, label = "ours", f"paper, ours on HVAE (none for {lacking})"
    found = {split: paper_curve(environment, method, split) for split in CURVE_SPLITS}
    return {split: curve for split, curve in found.items() if curve is not None}, label


def bars_figure(
    groups: Sequence[Group], rows: Mapping[str, Sequence[ResultRow]], title: str = ""
) -> Figure | None:
    """Train and test bars of the groups with a test evaluation; None if there is no such group."""
    settings, errors = [], []
    for group, color in zip(groups, setting_colors(groups), strict=True):
        standard = [row for row in rows[group.label] if row.is_standard]
        by_split = {row.actions: row for row in standard if row.actions in BAR_SPLITS}
        if "test" not in by_split:
            continue
        own = {split: Bar(row.mean, row.low, row.high) for split, row in by_split.items()}
        paper = {
            split: Bar(
                row.paper_mean, row.paper_mean - row.paper_std, row.paper_mean + row.paper_std
            )
            for split, row in by_split.items()
            if row.paper_mean is not None and row.paper_std is not None
        }
        test = by_split["test"]
        paper_seeds = [row.paper_num_seeds for row in by_split.values() if row.paper_num_seeds]
        notes = (
            _note([row.num_seeds for row in by_split.values()], test.trained_steps),
            _note(paper_seeds, test.paper_steps) if paper else "",
        )
        settings.append(BarSetting(group.label, color, own, paper, *notes, lines_of(group)))
        episodes = f" ({test.num_episodes:,} episodes a bar)" if test.num_seeds == 1 else ""
        errors.append(f"jaxnew, {test.error}{episodes}")
    if not settings:
        return None
    if any(setting.paper for setting in settings):
        errors.append("paper, population std over seeds")
    footnote = "Error bars: " + ";\n".join(dict.fromkeys(errors)) + "."
    if any(setting.anchors for setting in settings):
        footnote += "\nLines: policies without training, on sets of test actions."
    metric = groups[0].metric
    title = title or f"{groups[0].place}: generalization to unseen actions"
    return plots.bars(settings, metric, title, footnote)


def _note(num_seeds: Sequence[int], steps: float | None) -> str:
    """Seeds and training steps, below a bar."""
    low, high = min(num_seeds), max(num_seeds)
    number = str(high) if low == high else f"{low}-{high}"
    seeds = f"{number} seed{'s' if high > 1 else ''}"
    return seeds if steps is None else f"{seeds}\n{plots.amount(steps)}"


def tsne_figures(runs: Sequence[RunRecord]) -> list[tuple[str, Figure]]:
    """Names and figures of the distinct representation tables; runs without one are named."""
    distinct: dict[str, RunRecord] = {}
    for run in runs:
        if run.table is None or run.split is None:
            print(f"{run.path} has no representation table yet, so no picture of it.")
        else:
            distinct.setdefault(f"{run.table.hash} {run.split.hash}", run)
    figures = []
    for number, run in enumerate(distinct.values()):
        suffix = "" if len(distinct) == 1 else f"_{number}_{run.representation}"
        for part in TSNE_PARTS:
            figure = tsne_figure(run, part)
            if figure is not None:
                figures.append((f"tsne_{part}{suffix}", figure))
    return figures


def tsne_figure(run: RunRecord, part: str) -> Figure | None:
    """Representations of one part of the split, by class; None if it has too few actions."""
    if run.table is None or run.split is None:
        return None
    domain = domain_of(run)
    panel = tsne_panel(domain, run.table, part, int(run.config["seed"]))
    if panel is None:
        print(f"{run.path}: too few actions for a picture of part {part!r}.")
        return None
    name = {"heldout": "held-out"}.get(part, part)
    title = f"{run.representation}: {name} actions"
    return plots.tsne_scatter([panel], domain.universe.class_names, title)


def domain_of(run: RunRecord) -> Domain:
    """The domain of a run, with the split that the run kept."""
    config = run.config
    domain = Domain.of(
        load_task(config["task"], is_recorded=True), config["split"], config["split_seed"]
    )
    return replace(domain, split=run.split or domain.split)


def tsne_panel(
    domain: Domain, table: RepresentationTable, part: str, seed: int, name: str = ""
) -> Scatter | None:
    """Representations of one part of the split; None if it has too few actions.

    At most 400 actions are drawn, chosen with the seed; the purity is that of all of them.
    """
    ids = np.concatenate([domain.split.ids(split) for split in TSNE_PARTS[part]])
    ids = np.intersect1d(ids, table.ids)
    if len(ids) < MIN_TSNE_ACTIONS:
        return None
    labels = domain.universe.class_labels[ids]
    purity = report.neighbour_purity(table.rows(ids), labels)
    chance = float(np.sum(np.square(np.bincount(labels) / len(labels))))
    size = min(len(ids), MAX_TSNE_ACTIONS)
    drawn = np.sort(np.random.default_rng(seed).choice(len(ids), size, replace=False))
    points = report.tsne(table.rows(ids[drawn]), seed)
    purities = f"t-SNE of {size} of {len(ids)} actions; 5-NN purity {purity:.3f}"
    subtitle = f"{purities} (chance {chance:.2f})"
    return Scatter(points, labels[drawn], f"{name}\n{subtitle}" if name else subtitle)


def representations_figure(
    tables: Mapping[str, tuple[Domain, RepresentationTable]], title: str
) -> Figure:
    """Held-out actions as each table places them; domains may differ in their splits."""
    panels = [
        tsne_panel(domain, table, "heldout", REPRESENTATION_SEED, name)
        for name, (domain, table) in tables.items()
    ]
    shown = [panel for panel in panels if panel is not None]
    ((domain, _), *_) = tables.values()
    return plots.tsne_scatter(shown, domain.universe.class_names, title)
