"""The figures of the paper, each made of runs that are found or made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from experiments.reports import plots, tables
from experiments.reports.anchors import notes_of
from experiments.reports.asking import Asked, answers_of
from experiments.reports.comparison import compare_curves, comparison_csv, comparison_markdown
from experiments.reports.drawing import (
    BAR_SPLITS,
    bars_figure,
    curves_figure,
    domain_of,
    representations_figure,
)
from experiments.reports.figure_list import FIGURES, PaperFigure, number_of
from experiments.reports.films import FilmOptions, check_films, film_run
from experiments.reports.finetuning import Tuning, finetune_figure
from experiments.reports.jobs import Job, announce, embed_job, evaluation_seconds, training_jobs
from experiments.reports.production import Cell, Source, find
from experiments.reports.results import as_csv, as_markdown, result_rows
from experiments.reports.runs import (
    Group,
    RunRecord,
    group_runs,
    read_runs,
    with_distinct_labels,
)
from experiments.reports.studies import kind_of, study_runs
from experiments.reports.study_report import write_study
from jaxnew.embedding import TABLE_FILE, find_table
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Question
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError, check_output
from jaxnew.task.task import Task

Setting = tuple[Source, Cell]  # A cell, and where its runs come from.
ADDED_TO = ("bars", "curves", "representations", "study")


@dataclass(frozen=True)
class Options:
    """What is asked of the figures.

    Attributes:
      episodes: of each evaluation.
      finetune_steps: environment steps of fine-tuning; 0 for the preset's share.
      has_pdf: every figure is written as PDF, too.
      films: of figure 8.
      added: runs and sweeps that figures of the kinds `ADDED_TO` show as well.
    """

    episodes: int = 5000
    finetune_steps: float = 0.0
    has_pdf: bool = False
    films: FilmOptions = field(default_factory=FilmOptions)
    added: tuple[Path, ...] = ()


def make(
    numbers: Sequence[str],
    source: Source,
    options: Options,
    out: Path | None = None,
    is_dry: bool = False,
) -> list[Path]:
    """Finds or makes the runs of figures, and draws them.

    Args:
      numbers: of the figures.
      source: where their runs come from.
      options: of all figures.
      out: folder of the files; default: `figures/` beside the task's runs.
      is_dry: only says what is missing and how long it takes.

    Raises:
      UsageError: there is no such figure, or not for this task, or its files cannot be written; or
        a run was stopped.
    """
    task = source.domain.task
    chosen = list(dict.fromkeys(number_of(number, task.name) for number in numbers))
    work = {number: settings_of(FIGURES[number], source) for number in chosen}
    jobs, episodes, tuned = [], 0, []
    for number, settings in work.items():
        jobs += missing_jobs(FIGURES[number], settings)
        added = added_to(FIGURES[number], settings, options.added)
        episodes += missing_episodes(FIGURES[number], settings, options.episodes, added)
        if FIGURES[number].kind == "finetune":
            tuned.append(Tuning(settings[0][0], options.finetune_steps).seconds)
    jobs = unique_jobs(jobs)
    out = out or source.domain.folder(source.folder) / "figures"
    if not is_dry:
        check_output(out)
        if any(FIGURES[number].kind == "films" for number in work):
            check_films(task, options.films)
    announce(jobs, episodes, evaluation_seconds(source, episodes), tuned)
    if is_dry:
        return []
    for job in jobs:
        job.run()
    return [
        file for number, settings in work.items() for file in draw(number, settings, out, options)
    ]


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
            raise UsageError(f"--given={entry} must be NAME=PATH of a table or embed run.")
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
    return unique_jobs([job for job in jobs if job is not None])


def unique_jobs(jobs: Sequence[Job]) -> list[Job]:
    """Each command once: figures share runs."""
    return list({job.command: job for job in jobs}.values())


def missing_episodes(
    figure: PaperFigure,
    settings: Sequence[Setting],
    num_episodes: int,
    added: Sequence[RunRecord] = (),
) -> int:
    """Episodes of the evaluations that the figure still needs, also of runs yet to be made."""
    if figure.kind not in ("bars", "study"):
        return 0
    missing, groups = 0, group_runs(added)
    for source, cell in settings:
        task, found = source.domain.task, find(source, cell)
        asked = BAR_SPLITS if figure.kind == "bars" else task.shown.studies[figure.study].values
        missing += len(asked) * (len(source.seeds) - len(found))
        groups += [Group(cell.label, task, (run,)) for run in found.values()]
    for group in groups:
        questions = questions_of(figure, group)
        missing += sum(run.answer(q, num_episodes) is None for run in group.runs for q in questions)
    return missing * num_episodes


def questions_of(figure: PaperFigure, group: Group) -> list[Question]:
    """What a figure of bars or of a study asks of each run of a group."""
    if figure.kind == "bars":
        return [group.standard(part) for part in BAR_SPLITS]
    kind = kind_of(figure.study, group.task)
    return [kind.asked(group.runs[0], value).question for value in kind.values]


def draw(number: str, settings: Sequence[Setting], out: Path, options: Options) -> list[Path]:
    """The files of one figure; evaluates what is not evaluated yet."""
    figure, name, (first, _) = FIGURES[number], f"figure_{number}", settings[0]
    if figure.kind == "representations":
        panels = representation_panels(settings)
        for run in added_to(figure, settings, options.added):
            if run.table is not None:
                panels[f"{run.representation}, {run.path.name}"] = domain_of(run), run.table
        picture = representations_figure(panels, f"Figure {number}: {figure.title}")
        return plots.save(picture, out / f"{name}.png", options.has_pdf)
    groups = groups_of(figure, settings, options.added)
    title = f"Figure {number}, {groups[0].place}: {figure.title}"
    note = figure.notes.get(first.domain.task.name, figure.note)
    if figure.kind == "films":
        (run,) = groups[0].runs
        return film_run(run.path, out / name, title, options.films, first.workers)
    if figure.kind == "study":
        paths = [run.path for group in groups for run in group.runs]
        study = study_runs(figure.study, paths, (), options.episodes, num_workers=first.workers)
        return write_study(study, out, name, options.has_pdf)
    if figure.kind == "finetune":
        tuning = Tuning(first, options.finetune_steps)
        picture = finetune_figure(tuning, groups, options.episodes, title)
        return plots.save(picture, out / f"{name}.png", options.has_pdf)
    if figure.kind == "curves":
        return draw_curves(name, title, groups, out, options.has_pdf, note)
    for group in groups:
        asked = [Asked.part(question) for question in questions_of(figure, group)]
        for run in group.runs:
            answers_of(run, asked, options.episodes, first.workers)
    groups = groups_of(figure, settings, options.added)  # With what is on record now.
    rows = {g.label: [r for r in result_rows(g) if r.is_standard] for g in groups}
    drawn = bars_figure(groups, rows, title)
    files = plots.save(drawn, out / f"{name}.png", options.has_pdf) if drawn else []
    flat = [row for of_group in rows.values() for row in of_group]
    notes = [*([note] if note else []), *notes_of(groups)]
    text = as_markdown(title, flat, groups[0].metric, notes)
    return files + tables.write(out, name, text, as_csv(flat))


def added_to(
    figure: PaperFigure, settings: Sequence[Setting], paths: Sequence[Path]
) -> list[RunRecord]:
    """The runs that a figure shows beside its settings; none where its kind takes none.

    Raises:
      UsageError: one is of another task or other actions than the figure, is no run of a policy
        where policies are shown, or is not finished.
    """
    if not paths or figure.kind not in ADDED_TO:
        return []
    shows_policies = figure.kind != "representations"

    def shown_as(task: Task) -> str:
        own = None if shows_policies else task.actions_name
        return own or task.reference

    names = {shown_as(source.domain.task) for source, _ in settings}
    runs = read_runs(paths)
    for run in runs:
        name = shown_as(load_task(run.config["task"], is_recorded=True))
        if name not in names:
            raise UsageError(
                f"{run.path} is a run of {name}; the figure shows {', '.join(sorted(names))}."
            )
        if shows_policies and not run.is_policy:
            raise UsageError(f"{run.path} is a run of embed; train a policy on it, and add that.")
        if run.table is None or (shows_policies and not run.is_finished):
            raise UsageError(f"{run.path} is not finished; call its command again to go on.")
    return runs


def groups_of(
    figure: PaperFigure, settings: Sequence[Setting], added: Sequence[Path]
) -> list[Group]:
    """The runs of a figure's settings, and those that are added, each under a label of its own."""
    groups = [group_of(source, cell) for source, cell in settings]
    return with_distinct_labels([*groups, *group_runs(added_to(figure, settings, added))])


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
    points = compare_curves(groups)
    text = comparison_markdown(title, points, groups[0].metric, note)
    written = tables.write(out, name, text, comparison_csv(points))
    drawn = curves_figure(groups, title)
    files = plots.save(drawn, out / f"{name}.png", pdf) if drawn else []
    return [*files, *written]


def table_of(source: Source, representation: str) -> RepresentationTable:
    """A representation that is given, engineered or trained.

    Raises:
      SplitMismatch: the one that is given belongs to other actions or another split.
    """
    folder = source.embed_folder(representation)
    trained = folder if (folder / TABLE_FILE).exists() else representation
    place = source.given.get(representation, trained)
    return find_table(source.domain, source.folder, str(place), source.stage_one)


def group_of(source: Source, cell: Cell) -> Group:
    """The runs of a cell, all seeds.

    Raises:
      UsageError: some are missing, because a command was stopped.
    """
    found = find(source, cell)
    absent = [seed for seed in source.seeds if seed not in found]
    if absent:
        raise UsageError(
            f"{cell.label} is not finished for seeds {absent}; call the same command again to go "
            "on."
        )
    return Group(cell.label, source.domain.task, tuple(found[seed] for seed in source.seeds))
