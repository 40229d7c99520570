"""Figures and a table of results from run directories, with the paper's numbers beside ours.

    python -m experiments.figures --run=RUN,RUN,RUN --out=DIRECTORY
    python -m experiments.figures --figure=4,6,24 --task=grid_world --budget=paper
    python -m experiments.figures --figure=8 --task=create-push --run=RUN
    python -m experiments.figures --figure=8 --task=shape_stacking --run=RUN --film_size=400

With `--run`, whatever the directories hold is drawn; nothing is trained or evaluated. Runs that
differ in their seed only are drawn as one setting; a sweep stands for its members, and a run of
`embed` has the pictures of its representations only.

With `--figure`, the runs that a figure of the paper needs are looked for below `--runs`. Those that
are missing are made, after a list of them with the time that they take (`--dry_run`: the list
only); stopped and called again, it goes on where it was. Runs of domains inside jit are made by
`sweep`, all seeds in one program, those of domains on the host by `train`, one after the other.

Figure 8 are films of zero-shot episodes, of a run that is given or else of the first seed's. Bars
have lines for policies without training where `experiments.anchors` has measured them.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments.pipeline import flags as flag
from experiments.reports import paper_figures, plots
from experiments.reports.anchors import notes_of
from experiments.reports.drawing import (
    BAR_SPLITS,
    CURVE_SPLITS,
    bars_figure,
    curves_figure,
    environment_of,
    standard_rows,
    tsne_figures,
)
from experiments.reports.episode import episode_animation
from experiments.reports.results import ResultRow, as_csv, as_markdown, result_rows
from experiments.reports.runs import Group, group_runs, read_runs

__all__ = ["episode_animation", "make_figures"]


def define_flags() -> None:
    """Flags of the command; not at import, since `demo` imports this beside other commands."""
    flags.DEFINE_list("run", [], "Run directories of train, sweep or embed.")
    flags.DEFINE_string("out", None, "Where to write; default: `figures/` of the one run.")
    flags.DEFINE_bool("pdf", False, "Also write every figure as PDF.")
    flags.DEFINE_bool("episode", False, "Also play a zero-shot episode and write it as a GIF.")
    paper_figures.define_flags()


def main() -> None:
    values = flags.FLAGS
    if values.figure == ["8"] and values.run:
        for file in paper_figures.film_given(values):
            print(file)
        return
    if values.figure and values.run:
        raise flag.UsageError("Give --run, to draw these runs, or --figure, to find and make them.")
    if values.figure:
        for file in paper_figures.make(values):
            print(file)
        return
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
        standard = standard_rows(rows[group.label])
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
        "results.md": as_markdown(
            environment_of(groups), flat, groups[0].metric, [*notes, *notes_of(groups)]
        ),
        "results.csv": as_csv(flat),
    }
    for name, text in contents.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in contents]


if __name__ == "__main__":
    define_flags()
    flag.run_command(main)
