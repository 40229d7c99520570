"""Figures and a table of results from run directories, with the paper's numbers beside ours.

    python -m experiments.figures --run=RUN
    python -m experiments.figures --run=RUN,RUN,RUN --out=DIRECTORY

Runs that differ in their seed only are drawn as one setting; a sweep stands for its members, and a
run of `embed` has the pictures of its representations only. Nothing is trained or evaluated here.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from absl import flags
from matplotlib.figure import Figure

from experiments import _flags as flag
from experiments import _plots as plots
from experiments._curves import CurveSetting, RunCurve, learning_curves
from experiments._episode import episode_animation
from experiments._paper import PaperCurve, paper_curve
from experiments._plots import Bar, BarSetting, Color
from experiments._results import ResultRow, as_csv, as_markdown, result_rows
from experiments._runs import Group, Run, group_runs, read_runs
from jaxnew.representation import report

__all__ = ["episode_animation", "make_figures"]

CURVE_SPLITS = ("train", "validation")
BAR_SPLITS = ("train", "test")
MAX_TSNE_ACTIONS = 400
MIN_TSNE_ACTIONS = 11  # More than its perplexity.
TSNE_PARTS = {"heldout": ("validation", "test"), "train": ("train",), "all": ("all",)}

# Place of the paper's methods in its palette of ten colours (spec method 11).
_COLOR_INDEX = {
    "ours_no_entropy": 0,
    "ours_no_subsampling": 2,
    "ours": 3,
    "ours_engineered": 4,
    "ours_onehot": 5,
    "ours_oracle_hvae": 6,
    "vae": 7,
    "continuous_output": 8,
    "nearest_neighbor": 9,
}


def define_flags() -> None:
    """Flags of the command; not at import, since `demo` imports this beside other commands."""
    flags.DEFINE_list("run", [], "Run directories of train, sweep or embed.")
    flags.DEFINE_string("out", None, "Where to write; default: `figures/` of the one run.")
    flags.DEFINE_bool("pdf", False, "Also write every figure as PDF.")
    flags.DEFINE_bool("episode", False, "Also play a zero-shot episode and write it as a GIF.")


def main() -> None:
    values = flags.FLAGS
    paths = [Path(path) for path in values.run]
    if not values.out and len(paths) > 1:
        raise flag.UsageError("Several runs: say where their figures go with --out=DIRECTORY.")
    out = Path(values.out) if values.out else Path(values.run[0] if paths else ".") / "figures"
    files = make_figures(paths, out, pdf=values.pdf)
    if values.episode:
        policies = [run for run in read_runs(paths) if run.is_policy]
        if not policies:
            raise flag.UsageError("--episode needs a run of train; the runs given are of embed.")
        files += episode_animation(policies[0].path, out / "zero_shot_episode.gif")
    for file in files:
        print(file)


def make_figures(run_paths: Sequence[Path], out: Path, pdf: bool = False) -> list[Path]:
    """Learning curves, bars, t-SNE pictures and a table; says what is missing for the others.

    Args:
      run_paths: runs of `train` or `embed`, or sweeps, all of one task.
      out: folder of the files; made if absent.
      pdf: write every figure as PDF too.

    Returns:
      The files.

    Raises:
      UsageError: the runs are of several tasks, or cannot be drawn.
      RunDirectoryError: a path is no run directory.
    """
    runs = read_runs(run_paths)
    tasks = {run.config["task"] for run in runs}
    if len(tasks) > 1:
        raise flag.UsageError(f"The runs are of several tasks, {sorted(tasks)}; draw one a time.")
    groups = group_runs([run for run in runs if run.is_policy])
    out.mkdir(parents=True, exist_ok=True)
    written = []
    if groups:
        rows = {group.label: result_rows(group) for group in groups}
        notes = [*missing_curves(groups), *missing_evaluations(groups, rows)]
        for note in notes:
            print(note)
        for name, figure in (
            ("learning_curves", curves_figure(groups)),
            ("bars", bars_figure(groups, rows)),
        ):
            if figure is not None:
                written += plots.save(figure, out / f"{name}.png", pdf)
        written += write_table(groups, rows, out, notes)
    for name, figure in tsne_figures(runs):
        written += plots.save(figure, out / f"{name}.png", pdf)
    return written


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


def curves_figure(groups: Sequence[Group]) -> Figure | None:
    """Train and validation curves of all groups; None if nothing was evaluated in training."""
    settings = []
    for group, color in zip(groups, setting_colors(groups), strict=True):
        curves = {split: _run_curves(group, split) for split in CURVE_SPLITS}
        if any(curves.values()):
            settings.append(CurveSetting(group.label, color, curves, *_paper_curves(group)))
    if not settings:
        return None
    title = f"{_environment(groups)}: learning curves"
    return learning_curves(settings, groups[0].metric, CURVE_SPLITS, title)


def _run_curves(group: Group, split: str) -> list[RunCurve]:
    curves = [run.curve(f"{split}/{group.task.selection_metric}") for run in group.runs]
    return [RunCurve(steps, values) for steps, values in curves if len(steps)]


def _paper_curves(group: Group) -> tuple[dict[str, PaperCurve], str]:
    """The paper's curves beside a group, and their label.

    The paper shows none for the other representations of its own method; those get the curves of
    its default representation, under that name.
    """
    method = group.paper_method
    if method is None:
        return {}, ""
    environment = str(group.task.paper_environment)
    label = f"paper, {method}"
    if paper_curve(environment, method, CURVE_SPLITS[0]) is None:
        method, label = (
            "ours",
            f"paper, ours on HVAE (none for {group.runs[0].representation})",
        )
    found = {split: paper_curve(environment, method, split) for split in CURVE_SPLITS}
    return {split: curve for split, curve in found.items() if curve is not None}, label


def bars_figure(groups: Sequence[Group], rows: dict[str, list[ResultRow]]) -> Figure | None:
    """Train and test bars of the groups with a test evaluation; None if there is no such group."""
    settings, errors = [], []
    for group, color in zip(groups, setting_colors(groups), strict=True):
        by_split = standard_rows(group, rows[group.label])
        if "test" not in by_split:
            continue
        ours = {split: Bar(row.mean, row.low, row.high) for split, row in by_split.items()}
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
        settings.append(BarSetting(group.label, color, ours, paper, *notes))
        episodes = f" ({test.num_episodes:,} episodes a bar)" if test.num_seeds == 1 else ""
        errors.append(f"ours, {test.error}{episodes}")
    if not settings:
        return None
    if any(setting.paper for setting in settings):
        errors.append("paper, population std over seeds")
    footnote = "Error bars: " + ";\n".join(dict.fromkeys(errors)) + "."
    metric = groups[0].metric
    title = f"{_environment(groups)}: generalization to unseen actions"
    return plots.bars(settings, metric, title, footnote)


def standard_rows(group: Group, rows: Sequence[ResultRow]) -> dict[str, ResultRow]:
    """By split, the evaluations that the bars show: made as the paper's."""
    set_size = group.config["ppo"]["rollout"]["set_size"]
    return {
        row.actions: row
        for row in rows
        if row.is_standard and row.set_size == set_size and row.actions in BAR_SPLITS
    }


def _note(num_seeds: Sequence[int], steps: float | None) -> str:
    """Seeds and training steps, below a bar."""
    low, high = min(num_seeds), max(num_seeds)
    number = str(high) if low == high else f"{low}-{high}"
    seeds = f"{number} seed{'s' if high > 1 else ''}"
    if steps is None:
        return seeds
    amount = f"{1e-6 * steps:.3g} M" if steps >= 1e6 else f"{1e-3 * steps:.3g} k"
    return f"{seeds}\n{amount} steps"


def _environment(groups: Sequence[Group]) -> str:
    return groups[0].task.paper_environment or groups[0].task.name


def missing_curves(groups: Sequence[Group]) -> list[str]:
    """A line for each run without any evaluation during training."""
    return [
        f"{run.path} has no evaluations in its metrics.jsonl yet, so no learning curve."
        for group in groups
        for run in group.runs
        if not any(len(run.curve(f"{s}/{group.task.selection_metric}")[0]) for s in CURVE_SPLITS)
    ]


def missing_evaluations(groups: Sequence[Group], rows: dict[str, list[ResultRow]]) -> list[str]:
    """For each run that lacks an evaluation of the bars, the command that makes it."""
    lines = []
    for group in groups:
        standard = standard_rows(group, rows[group.label])
        for run in group.runs:
            lacking = [
                split
                for split in BAR_SPLITS
                if split not in standard or str(run.path) not in standard[split].runs
            ]
            if lacking:
                lines.append(
                    f"{run.path} has no evaluation on {' and '.join(lacking)} actions; make it "
                    f"with: python -m experiments.evaluate --run={shlex.quote(str(run.path))} "
                    f"--sets={','.join(lacking)} --episodes=5000"
                )
    return lines


def write_table(
    groups: Sequence[Group], rows: dict[str, list[ResultRow]], out: Path, notes: Sequence[str]
) -> list[Path]:
    """`results.md` and `results.csv`: every evaluation of every group, beside the paper's."""
    flat = [row for group in groups for row in rows[group.label]]
    contents = {
        "results.md": as_markdown(_environment(groups), flat, groups[0].metric, notes),
        "results.csv": as_csv(flat),
    }
    for name, text in contents.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in contents]


def tsne_figures(runs: Sequence[Run]) -> list[tuple[str, Figure]]:
    """Names and figures of the distinct representation tables; runs without one are named."""
    distinct: dict[str, Run] = {}
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


def tsne_figure(run: Run, part: str) -> Figure | None:
    """Representations of one part of the split, by class; None if it has too few actions.

    At most 400 actions are drawn, chosen with the run's seed; the purity is that of all of them.
    """
    if run.table is None or run.split is None:
        return None
    ids = np.concatenate([run.split.ids(name) for name in TSNE_PARTS[part]])
    ids = np.intersect1d(ids, run.table.ids)
    if len(ids) < MIN_TSNE_ACTIONS:
        print(f"{run.path}: {len(ids)} actions are too few for a picture of part {part!r}.")
        return None
    seed = int(run.config["seed"])
    universe = flag.load_task(run.config["task"]).make_universe()
    labels = universe.class_labels[ids]
    purity = report.neighbour_purity(run.table.rows(ids), labels)
    chance = float(np.sum(np.square(np.bincount(labels) / len(labels))))
    size = min(len(ids), MAX_TSNE_ACTIONS)
    drawn = np.sort(np.random.default_rng(seed).choice(len(ids), size, replace=False))
    points = report.tsne(run.table.rows(ids[drawn]), seed)
    name = {"heldout": "held-out"}.get(part, part)
    return plots.tsne_scatter(
        points,
        labels[drawn],
        universe.class_names,
        f"{run.representation}: {name} actions",
        f"t-SNE of {size} of {len(ids)} actions; 5-NN purity {purity:.3f} (chance {chance:.2f})",
    )


if __name__ == "__main__":
    define_flags()
    flag.run_command(main)
