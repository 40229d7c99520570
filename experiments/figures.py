"""Figures and a table of results from run directories, with the paper's numbers beside jaxnew's.

    python -m experiments.figures --run=RUN,RUN,RUN --out=DIRECTORY
    python -m experiments.figures --figure=4,6,24 --task=grid_world --budget=paper
    python -m experiments.figures --figure=4 --add=RUN,SWEEP
    python -m experiments.figures --figure=8 --run=RUN
    python -m experiments.figures --figure=8 --run=RUN --film_size=400 --film_pages

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

from experiments.flags import Arguments
from experiments.reports import paper_figures, plots, tables
from experiments.reports.anchors import notes_of
from experiments.reports.drawing import (
    BAR_SPLITS,
    CURVE_SPLITS,
    bars_figure,
    curves_figure,
    tsne_figures,
)
from experiments.reports.figure_list import FIGURES, number_of
from experiments.reports.films import FilmOptions, animate_run, film_run
from experiments.reports.paper_figures import ADDED_TO, Options
from experiments.reports.production import Source
from experiments.reports.results import as_csv, as_markdown, result_rows
from experiments.reports.runs import Group, group_runs, policies, read_runs
from experiments.reports.sweeps import show_sweep, sweep_figure
from jaxnew.runs import MEMBERS, Runs, is_sweep
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError, check_output

ARGUMENTS = Arguments(
    __doc__,
    "task",
    "split",
    "split_seed",
    "budget",
    "representation_budget",
    "runs",
    "workers",
    "set",
    "trust",
    "debug_nans",
)
ARGUMENTS.define("list", "run", [], "Run directories of train, sweep or embed.")
ARGUMENTS.define(
    "list", "figure", [], f"Figures of the paper to find or make runs for: {', '.join(FIGURES)}."
)
ARGUMENTS.define(
    "list",
    "add",
    [],
    "Finished runs or sweeps to show in figures of bars, curves, studies and representations, "
    "beside the paper's settings: one's own method, head or representation.",
)
ARGUMENTS.define("string", "out", None, "Where to write; default: `figures/` of the one run.")
ARGUMENTS.define("bool", "pdf", False, "Also write every figure as PDF.")
ARGUMENTS.define("bool", "episode", False, "Also film a zero-shot episode of a run as a GIF.")
ARGUMENTS.define("integers", "seeds", [31, 41, 51, 61, 71], "Seeds of the policies.")
ARGUMENTS.define("float", "steps", 0.0, "Environment steps of each run; 0: those of --budget.")
ARGUMENTS.define("float", "finetune_steps", 0.0, "The same of fine-tuning.")
ARGUMENTS.define("integer", "episodes", 5000, "Episodes of each evaluation.")
ARGUMENTS.define(
    "multi_string",
    "given",
    [],
    "NAME=PATH: a table (.npz) or run of embed to take for a representation; NAME@SPLIT=PATH or "
    "NAME@VARIANT=PATH where a figure has one of another split or of other actions (7a, 15: "
    "hvae@full; 9a-c: hvae-oracle@analysis).",
)
ARGUMENTS.define("bool", "dry_run", False, "Only say what is missing and how long it takes.")
ARGUMENTS.define("integer", "films", 20, "Episodes that figure 8 shows.", lower_bound=1)
ARGUMENTS.define(
    "integer", "film_size", 512, "Pixels of their side.", lower_bound=16, upper_bound=4096
)
ARGUMENTS.define(
    "enum", "film_format", "gif", "Of their files; mp4: jaxnew[video].", choices=["gif", "mp4"]
)
ARGUMENTS.define("bool", "film_pages", False, "Interactive pages as well, of stacking.")

# Flags that only some kinds of figures use.
_FILMS = ("films", "film_size", "film_format", "film_pages")
_OF_KINDS = {
    _FILMS: ("films",),
    ("finetune_steps",): ("finetune",),
    ("episodes",): ("bars", "study", "finetune"),
    ("pdf",): ("bars", "curves", "finetune", "representations", "study"),
    ("seeds", "steps", "set", "workers"): ("bars", "curves", "finetune", "films", "study"),
    ("add",): ADDED_TO,
}
# Flags that are about runs yet to be made.
_PRODUCTION = (
    *("split", "split_seed", "budget", "representation_budget", "runs", "set", "seeds", "steps"),
    *("finetune_steps", "episodes", "given", "dry_run", "add"),
)


def main() -> None:
    paths = [Path(path) for path in ARGUMENTS.run]
    if ARGUMENTS.figure and paths and ARGUMENTS.figure != ["8"]:
        raise UsageError("Give --run, to draw these runs, or --figure, to find and make them.")
    if ARGUMENTS.figure and paths:
        files = film_given(paths)
    elif ARGUMENTS.figure:
        ARGUMENTS.refuse(("episode",), "with --figure")
        out = Path(ARGUMENTS.out) if ARGUMENTS.out else None
        source = Source.asked_for(ARGUMENTS, paper_figures.parse_given(ARGUMENTS.given))
        refuse_unused(source.domain.task.name)
        files = paper_figures.make(ARGUMENTS.figure, source, options(), out, ARGUMENTS.dry_run)
    else:
        files = draw_given(paths)
    for file in files:
        print(file)


def refuse_unused(task: str) -> None:
    """Refuses flags that none of the figures uses.

    Raises:
      UsageError: one is given, or there is no such figure of the task.
    """
    shown = {FIGURES[number_of(number, task)].kind for number in ARGUMENTS.figure}
    for names, kinds in _OF_KINDS.items():
        if not shown.intersection(kinds):
            ARGUMENTS.refuse(names, f"for figures of {', '.join(sorted(shown))}")


def options() -> Options:
    """What is asked of the paper's figures."""
    suffix = f".{ARGUMENTS.film_format}"
    films = FilmOptions(ARGUMENTS.films, ARGUMENTS.film_size, suffix, ARGUMENTS.film_pages)
    added = tuple(map(Path, ARGUMENTS.add))
    return Options(ARGUMENTS.episodes, ARGUMENTS.finetune_steps, ARGUMENTS.pdf, films, added)


def film_given(paths: Sequence[Path]) -> list[Path]:
    """Figure 8 of a run that is given.

    Raises:
      UsageError: several are given, or it is no run of a policy, or of another task than `--task`.
    """
    ARGUMENTS.refuse(("episode", "pdf", *_PRODUCTION), "with --figure=8 --run")
    runs = policies(paths)
    if len(runs) != 1:
        raise UsageError(f"Figure 8 shows one run; {len(runs)} were given.")
    (group,) = group_runs(runs)
    if ARGUMENTS.is_given("task") and load_task(ARGUMENTS.task).reference != group.task.reference:
        raise UsageError(f"{runs[0].path} is a run of {group.task.name}, not of {ARGUMENTS.task}.")
    out = Path(ARGUMENTS.out) if ARGUMENTS.out else RunDirectory.load(runs[0].path).figures
    title = f"Figure 8, {group.place}: {group.label}"
    return film_run(runs[0].path, out / "figure_8", title, options().films, ARGUMENTS.workers)


def draw_given(paths: Sequence[Path]) -> list[Path]:
    """All figures of runs that are given."""
    ARGUMENTS.refuse(("task", "workers", *_FILMS, *_PRODUCTION), "without --figure")
    if not ARGUMENTS.out and len(paths) > 1:
        raise UsageError("Several runs: say where their figures go with --out=DIRECTORY.")
    if not paths:
        raise UsageError("Say which runs: --run=DIRECTORY[,DIRECTORY...].")
    out = Path(ARGUMENTS.out) if ARGUMENTS.out else RunDirectory.load(paths[0]).figures
    animated = policies(paths)[0].path if ARGUMENTS.episode else None
    files = make_figures(paths, out, ARGUMENTS.pdf)
    if animated is not None:
        files += animate_run(animated, out / "zero_shot_episode.gif")
    return files


def make_figures(run_paths: Sequence[Path], out: Path, pdf: bool = False) -> list[Path]:
    """Learning curves, bars, t-SNE pictures and a table; says what is missing for the others.

    Args:
      run_paths: runs of `train` or `embed`, or sweeps, all of one task.
      out: folder of the files; made if absent.
      pdf: write every figure as PDF too.

    Returns:
      The files.

    Raises:
      UsageError: the runs are of several tasks, or cannot be drawn; or `out` cannot be written.
      RunDirectoryError: a path is no run directory.
    """
    check_output(out)
    runs = read_runs(run_paths)
    tasks = {run.config["task"] for run in runs}
    if len(tasks) > 1:
        raise UsageError(f"The runs are of several tasks, {sorted(tasks)}; draw one a time.")
    groups = group_runs([run for run in runs if run.is_policy])
    written = []
    if groups:
        rows = {group.label: result_rows(group) for group in groups}
        notes = list(dict.fromkeys(note for group in groups for note in missing_from(group)))
        for note in notes:
            print(note)
        for name, figure in (
            ("learning_curves", curves_figure(groups)),
            ("bars", bars_figure(groups, rows)),
        ):
            if figure is not None:
                written += plots.save(figure, out / f"{name}.png", pdf)
        flat = [row for of_group in rows.values() for row in of_group]
        notes += notes_of(groups)
        text = as_markdown(groups[0].place, flat, groups[0].metric, notes)
        written += tables.write(out, "results", text, as_csv(flat))
    for path in run_paths:
        if is_sweep(RunDirectory.load(path)):
            stem = "sweep" if len(run_paths) == 1 else f"sweep_{path.name}"
            sweep = Runs.load(path)
            written += sweep_figure(sweep, out, stem, pdf) + show_sweep(sweep, out, stem)
    for name, figure in tsne_figures(runs):
        written += plots.save(figure, out / f"{name}.png", pdf)
    return written


def missing_from(group: Group) -> list[str]:
    """A line for each run without any evaluation during training, or without one of the bars."""
    lines = []
    for run in group.runs:
        # All members of a sweep are evaluated by one command.
        path = run.path.parents[1] if run.path.parent.name == MEMBERS else run.path
        curves = [run.curve(f"{s}/{group.task.selection_metric}")[0] for s in CURVE_SPLITS]
        if not any(map(len, curves)):
            lines.append(
                f"{path} has no evaluations in its metrics.jsonl yet, so no learning curve."
            )
        lacking = [part for part in BAR_SPLITS if run.answer(group.standard(part)) is None]
        if lacking:
            lines.append(
                f"{path} has no evaluation on {' and '.join(lacking)} actions; make it "
                f"with: python -m experiments.evaluate --run={shlex.quote(str(path))} "
                f"--sets={','.join(lacking)} --episodes=5000"
            )
    return lines


if __name__ == "__main__":
    ARGUMENTS.start(main)
