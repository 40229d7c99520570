"""The figures of the paper, each made of runs that are found or made (experiments spec 2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import TABLE_FILE, Domain, find_table
from experiments.pipeline.evaluation import evaluate_run
from experiments.reports import plots
from experiments.reports.anchors import notes_of
from experiments.reports.comparison import compare_curves, comparison_csv, comparison_markdown
from experiments.reports.drawing import (
    BAR_SPLITS,
    bars_figure,
    curves_figure,
    environment_of,
    representations_figure,
    standard_rows,
)
from experiments.reports.figure_list import FIGURES, PaperFigure, number_of
from experiments.reports.films import film_run
from experiments.reports.finetuning import finetune_figure, finetune_seconds, make_finetuned
from experiments.reports.jobs import Job, announce, embed_job, evaluation_seconds, training_jobs
from experiments.reports.production import Cell, Source, find
from experiments.reports.results import ResultRow, as_csv, as_markdown, result_rows
from experiments.reports.runs import Group, Run, group_runs, read_runs
from experiments.reports.studies import lacking_values, study_runs
from experiments.reports.study_report import write_study
from jaxnew.representation.table import RepresentationTable

Setting = tuple[Source, Cell]  # A cell, and where its runs come from.


def define_flags() -> None:
    """Flags of `figures` that say which figures of the paper are wanted, and of which runs."""
    numbers = ", ".join(FIGURES)
    flags.DEFINE_list("figure", [], f"Figures of the paper to find or make runs for: {numbers}.")
    flags.DEFINE_list("seeds", ["31", "41", "51", "61", "71"], "Seeds of the policies.")
    flags.DEFINE_float("steps", 0.0, "Environment steps of each run; 0: those of --budget.")
    flags.DEFINE_float("finetune_steps", 0.0, "The same of fine-tuning.")
    flags.DEFINE_integer("episodes", 5000, "Episodes of each evaluation.")
    flags.DEFINE_multi_string(
        "given",
        [],
        "NAME=PATH: a table (.npz) or run of embed to take for a representation; NAME@SPLIT=PATH "
        "or NAME@VARIANT=PATH where a figure has one of another split or of other actions (7a, 15: "
        "hvae@full; 9a-c: hvae-oracle@analysis).",
    )
    flags.DEFINE_string(
        "representation_budget", None, "Budget of representations to be trained; default: --budget."
    )
    flags.DEFINE_bool("dry_run", False, "Only say what is missing and how long it takes.")
    flags.DEFINE_integer("films", 20, "Episodes that figure 8 shows.", lower_bound=1)
    flags.DEFINE_integer("film_size", 512, "Pixels of their side.", lower_bound=16)
    flags.DEFINE_enum("film_format", "gif", ["gif", "mp4"], "Of their files; mp4: jaxnew[video].")
    flags.DEFINE_bool("film_pages", False, "Interactive pages as well, of stacking; needs Brax.")


def make(values: Any) -> list[Path]:
    """Finds or makes the runs of the figures that the flags name, and draws them.

    Raises:
      UsageError: there is no such figure, or not for this task; or a run was stopped.
    """
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    numbers = list(dict.fromkeys(number_of(number, task.name) for number in values.figure))
    source = Source(
        domain=domain,
        folder=Path(flag.RUNS.value),
        budget=flag.BUDGET.value,
        stage_one=values.representation_budget or flag.BUDGET.value,
        steps=values.steps,
        seeds=tuple(map(int, values.seeds)),
        assignments=tuple(flag.SET.value),
        given=parse_given(values.given),
        workers=flag.WORKERS.value,
    )
    figures = [FIGURES[number] for number in numbers]
    settings = [settings_of(figure, source) for figure in figures]
    work = list(zip(figures, settings, strict=True))
    jobs = unique_jobs([job for f, own in work for job in missing_jobs(f, own)])
    episodes = sum(missing_episodes(f, own, values.episodes) for f, own in work)
    tuned = [
        finetune_seconds(own[0][0], values.finetune_steps)
        for f, own in work
        if f.kind == "finetune"
    ]
    announce(jobs, episodes, evaluation_seconds(source, episodes), tuned)
    if values.dry_run:
        return []
    for job in jobs:
        job.run()
    out = Path(values.out) if values.out else domain.folder(source.folder) / "figures"
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for number, (figure, own) in zip(numbers, work, strict=True):
        written += draw(number, figure, own, out, values)
    return written


def film_given(values: Any) -> list[Path]:
    """Figure 8 of a run that is given.

    Raises:
      UsageError: several are given, or it is no run of the task or of a policy.
    """
    if len(values.run) != 1:
        raise flag.UsageError(f"Figure 8 shows one run; {len(values.run)} were given.")
    (run,) = read_runs([Path(values.run[0])])
    task = flag.load_task(flag.TASK.value)
    if not run.is_policy or run.config["task"] != task.reference:
        raise flag.UsageError(
            f"{run.path} is no run of train of task {task.name}; say which with --task."
        )
    (group,) = group_runs([run])
    out = Path(values.out) if values.out else run.path / "figures"
    title = f"Figure 8, {environment_of([group])}: {group.label}"
    return films_of(run.path, out / "figure_8", title, flag.WORKERS.value, values)


def films_of(path: Path, out: Path, title: str, workers: int, values: Any) -> list[Path]:
    """The films of a run, as the flags of figure 8 say."""
    suffix, with_pages = f".{values.film_format}", values.film_pages
    return film_run(path, out, values.films, values.film_size, suffix, title, workers, with_pages)


def settings_of(figure: PaperFigure, source: Source) -> list[Setting]:
    """The cells of a figure for the source's task, each with its own source.

    One with the preset of the figure, where the task has it; of films, the first seed alone.
    """
    name = source.budget + figure.budget
    if name in source.domain.task.stage_two:
        source = replace(source, budget=name)
    if figure.kind == "films":
        source = replace(source, seeds=source.seeds[:1])
    return [(source.of(cell), cell) for cell in figure.cells[source.domain.task.name]]


def parse_given(entries: Sequence[str]) -> dict[str, Path]:
    """Representation -> path, from `NAME=PATH` entries.

    Raises:
      UsageError: an entry is not of that form, or there is nothing at its path.
    """
    given = {}
    for entry in entries:
        name, _, path = entry.partition("=")
        if not path or not Path(path).exists():
            raise flag.UsageError(f"--given={entry} must be NAME=PATH of a table or embed run.")
        given[name] = Path(path)
    return given


def missing_jobs(figure: PaperFigure, settings: Sequence[Setting]) -> list[Job]:
    """What must be made before the figure's runs can be evaluated, in order."""
    jobs = [embed_job(source, cell.representation) for source, cell in settings]
    if figure.kind != "representations":
        for source, cell in settings:
            found = find(source, cell)
            lacking = [seed for seed in source.seeds if seed not in found]
            jobs += training_jobs(source, cell, lacking)
    return [job for job in jobs if job is not None]


def unique_jobs(jobs: Sequence[Job]) -> list[Job]:
    """Each command once: figures share runs."""
    return list({job.command: job for job in jobs}.values())


def missing_episodes(figure: PaperFigure, settings: Sequence[Setting], num_episodes: int) -> int:
    """Episodes of the evaluations that the figure still needs, also of runs yet to be made."""
    if figure.kind not in ("bars", "study"):
        return 0
    missing = 0
    for source, cell in settings:
        task = source.domain.task
        found = find(source, cell)
        of_new = len(BAR_SPLITS if figure.kind == "bars" else task.studies[figure.study].values)
        missing += of_new * (len(source.seeds) - len(found))
        for run in found.values():
            if figure.kind == "bars":
                missing += len(lacking_splits(run, num_episodes))
            else:
                missing += len(lacking_values(figure.study, run, task, num_episodes))
    return missing * num_episodes


def lacking_splits(run: Run, num_episodes: int) -> list[str]:
    """Parts of the split on which a run still must be evaluated for its bars."""
    (group,) = group_runs([run])
    rows = standard_rows(result_rows(group))
    return [s for s in BAR_SPLITS if s not in rows or rows[s].num_episodes < num_episodes]


def draw(
    number: str, figure: PaperFigure, settings: Sequence[Setting], out: Path, values: Any
) -> list[Path]:
    """The files of one figure; evaluates what is not evaluated yet."""
    name = f"figure_{number}"
    if figure.kind == "representations":
        panels = representation_panels(settings)
        picture = representations_figure(panels, f"Figure {number}: {figure.title}")
        return plots.save(picture, out / f"{name}.png", values.pdf)
    groups = [group_of(source, cell) for source, cell in settings]
    title = f"Figure {number}, {environment_of(groups)}: {figure.title}"
    first, _ = settings[0]
    note = figure.notes.get(first.domain.task.name, figure.note)
    if figure.kind == "films":
        (run,) = groups[0].runs
        return films_of(run.path, out / name, title, first.workers, values)
    if figure.kind == "study":
        paths = [run.path for group in groups for run in group.runs]
        study = study_runs(figure.study, paths, (), values.episodes, num_workers=first.workers)
        return write_study(study, out, name, values.pdf)
    if figure.kind == "finetune":
        curves = make_finetuned(first, groups, values.finetune_steps, values.episodes)
        return plots.save(finetune_figure(curves, title), out / f"{name}.png", values.pdf)
    if figure.kind == "curves":
        return draw_curves(name, title, groups, out, values.pdf, note)
    for group in groups:
        evaluate_missing(group, values.episodes, first.workers)
    groups = [group_of(source, cell) for source, cell in settings]
    rows = {g.label: [r for r in result_rows(g) if r.is_standard] for g in groups}
    drawn = bars_figure(groups, rows, title)
    files = plots.save(drawn, out / f"{name}.png", values.pdf) if drawn else []
    notes = [*([note] if note else []), *notes_of(groups)]
    return files + write_results(name, title, groups, rows, out, notes)


def representation_panels(
    settings: Sequence[Setting],
) -> dict[str, tuple[Domain, RepresentationTable]]:
    """What a picture of representations shows, by the name above it."""
    panels = {}
    for source, cell in settings:
        name = f"{cell.representation}, split {cell.split}" if cell.split else cell.representation
        panels[name] = source.domain, table_of(source, cell.representation)
    return panels


def draw_curves(
    name: str, title: str, groups: Sequence[Group], out: Path, pdf: bool = False, note: str = ""
) -> list[Path]:
    """Learning curves, and tables of where they stand beside the paper's."""
    comparison = compare_curves(groups)
    (out / f"{name}.csv").write_text(comparison_csv(comparison), encoding="utf-8")
    text = comparison_markdown(title, comparison, groups[0].metric, note)
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    drawn = curves_figure(groups, title)
    files = plots.save(drawn, out / f"{name}.png", pdf) if drawn else []
    return [*files, out / f"{name}.md", out / f"{name}.csv"]


def table_of(source: Source, representation: str) -> RepresentationTable:
    """A representation that is given, engineered or trained."""
    given = source.table_of(representation)
    if given is not None:
        return given
    path = source.embed_folder(representation) / TABLE_FILE
    if path.exists():
        return RepresentationTable.load(path)
    return find_table(source.domain, source.folder, representation, source.stage_one)


def group_of(source: Source, cell: Cell) -> Group:
    """The runs of a cell, all seeds.

    Raises:
      UsageError: some are missing, because a command was stopped.
    """
    found = find(source, cell)
    lacking = [seed for seed in source.seeds if seed not in found]
    if lacking:
        raise flag.UsageError(
            f"{cell.label} is not finished for seeds {lacking}; call the same command again to go "
            "on."
        )
    runs = tuple(found[seed] for seed in source.seeds)
    return Group(cell.label, source.domain.task, runs)


def evaluate_missing(group: Group, num_episodes: int, num_workers: int = 0) -> None:
    """Evaluates every run of a group where its bars need it."""
    for run in group.runs:
        lacking = lacking_splits(run, num_episodes)
        if lacking:
            print(f"Evaluating {run.path} on {' and '.join(lacking)} actions.", flush=True)
            sizes = {name: group.set_size(name) for name in lacking}
            evaluate_run(run.path, sizes, num_episodes, num_workers)


def write_results(
    name: str,
    title: str,
    groups: Sequence[Group],
    rows: Mapping[str, Sequence[ResultRow]],
    out: Path,
    notes: Sequence[str] = (),
) -> list[Path]:
    """The numbers of the bars as Markdown and CSV."""
    flat = [row for group in groups for row in rows[group.label]]
    (out / f"{name}.md").write_text(as_markdown(title, flat, groups[0].metric, notes), "utf-8")
    (out / f"{name}.csv").write_text(as_csv(flat), "utf-8")
    return [out / f"{name}.md", out / f"{name}.csv"]
