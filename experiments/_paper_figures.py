"""The figures of the paper, each made of runs that are found or made (experiments spec 2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from absl import flags

from experiments import _flags as flag
from experiments import _plots as plots
from experiments._artifacts import TABLE_FILE, Domain, find_table
from experiments._comparison import compare_curves, comparison_csv, comparison_markdown
from experiments._drawing import (
    BAR_SPLITS,
    bars_figure,
    curves_figure,
    environment_of,
    representations_figure,
    standard_rows,
)
from experiments._evaluation import evaluate_run
from experiments._finetuning import finetune_figure, finetune_seconds, make_finetuned
from experiments._production import (
    Cell,
    Job,
    Source,
    duration,
    embed_job,
    evaluation_seconds,
    find,
    sweep_job,
)
from experiments._results import ResultRow, as_csv, as_markdown, result_rows
from experiments._runs import Group, Run, group_runs
from jaxnew.representation.table import RepresentationTable

_BASELINES = ("ours", "continuous", "nearest-neighbour")
_ABLATIONS = ("ours", "no-entropy", "no-subsampling")
_ALL = ("ours", "continuous", "nearest-neighbour", "no-entropy", "no-subsampling")


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper.

    Attributes:
      kind: bars, curves, finetune or representations.
      title: what it shows.
      cells: its settings, by task. Of a picture of representations, only these count.
      budget: suffix of the preset of its runs.
    """

    kind: str
    title: str
    cells: Mapping[str, tuple[Cell, ...]]
    budget: str = ""


def _cells(methods: Sequence[str], representation: str, *more: str) -> tuple[Cell, ...]:
    """Methods on one representation, then ours on further ones."""
    extra = tuple(Cell("ours", name) for name in more)
    return (*(Cell(method, representation) for method in methods), *extra)


FIGURES: dict[str, PaperFigure] = {
    "4": PaperFigure(
        "bars",
        "baselines",
        {
            "grid_world": _cells(_BASELINES, "hvae", "vae"),
            "recommender": _cells(_BASELINES, "product"),
        },
    ),
    "6": PaperFigure(
        "bars",
        "ablations",
        {
            "grid_world": _cells(_ABLATIONS, "hvae"),
            "recommender": _cells(_ABLATIONS, "product"),
        },
    ),
    "7b": PaperFigure(
        "bars",
        "alternate representations",
        {"grid_world": _cells(("ours",), "hvae", "hvae-onehot", "gt12", "hvae-oracle")},
    ),
    "14": PaperFigure(
        "representations",
        "held-out actions",
        {"grid_world": _cells((), "hvae", "hvae", "vae", "hvae-onehot", "gt12")},
    ),
    "19": PaperFigure(
        "finetune",
        "training on new actions",
        {
            "grid_world": _cells(("ours", "nearest-neighbour"), "hvae"),
            "recommender": _cells(("ours", "nearest-neighbour"), "product"),
        },
    ),
    "22": PaperFigure(
        "bars",
        "fully observable",
        {"recommender": _cells(_ALL, "product-mu")},
        budget="-mu",
    ),
    "24": PaperFigure(
        "curves",
        "learning curves",
        {
            "grid_world": _cells(_ALL, "hvae", "vae"),
            "recommender": _cells(_ALL, "product"),
        },
    ),
}
_SAME = {"10": "19"}  # Figure 10 is figure 19 for CREATE Push.


def define_flags() -> None:
    """Flags of `figures` that say which figures of the paper are wanted, and of which runs."""
    numbers = ", ".join(FIGURES)
    flags.DEFINE_list("figure", [], f"Figures of the paper to find or make runs for: {numbers}.")
    flags.DEFINE_list("seeds", ["31", "41", "51", "61", "71"], "Seeds of the policies.")
    flags.DEFINE_float("steps", 0.0, "Environment steps of each run; 0: those of --budget.")
    flags.DEFINE_float("finetune_steps", 0.0, "The same of fine-tuning.")
    flags.DEFINE_integer("episodes", 5000, "Episodes of each evaluation.")
    flags.DEFINE_multi_string(
        "given", [], "NAME=PATH: a table (.npz) or run of embed to take for a representation."
    )
    flags.DEFINE_string(
        "representation_budget", None, "Budget of representations to be trained; default: --budget."
    )
    flags.DEFINE_bool("dry_run", False, "Only say what is missing and how long it takes.")


def make(values: Any) -> list[Path]:
    """Finds or makes the runs of the figures that the flags name, and draws them.

    Raises:
      UsageError: there is no such figure, or not for this task; or a run was stopped.
    """
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    chosen = {}
    for number in values.figure:
        chosen[_SAME.get(number, number)] = figure_of(number, task.name)
    source = Source(
        domain=domain,
        folder=Path(flag.RUNS.value),
        budget=flag.BUDGET.value,
        stage_one=values.representation_budget or flag.BUDGET.value,
        steps=values.steps,
        seeds=tuple(map(int, values.seeds)),
        assignments=tuple(flag.SET.value),
        given=parse_given(values.given),
    )
    work = [
        (figure, _source_of(source, figure), figure.cells[task.name]) for figure in chosen.values()
    ]
    jobs = unique_jobs([job for f, s, cells in work for job in missing_jobs(f, s, cells)])
    evaluations = sum(missing_evaluations(f, s, cells, values.episodes) for f, s, cells in work)
    tuned = [finetune_seconds(s, values.finetune_steps) for f, s, _ in work if f.kind == "finetune"]
    announce(jobs, evaluations, evaluation_seconds(source, evaluations), tuned)
    if values.dry_run:
        return []
    for job in jobs:
        job.run()
    out = Path(values.out) if values.out else domain.folder(source.folder) / "figures"
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for (number, figure), (_, own, cells) in zip(chosen.items(), work, strict=True):
        written += draw(number, figure, own, cells, out, values)
    return written


def figure_of(number: str, task: str) -> PaperFigure:
    """A figure by its number.

    Raises:
      UsageError: there is none, or it does not show the task.
    """
    figure = FIGURES.get(_SAME.get(number, number))
    if figure is None:
        raise flag.UsageError(f"No figure {number!r}; choose of {', '.join([*FIGURES, *_SAME])}.")
    if task not in figure.cells:
        raise flag.UsageError(
            f"Figure {number} does not show {task}; it shows {', '.join(figure.cells)}."
        )
    return figure


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


def _source_of(source: Source, figure: PaperFigure) -> Source:
    """The source with the preset of the figure, where the task has it."""
    name = source.budget + figure.budget
    has_own = name in source.domain.task.stage_two
    return replace(source, budget=name if has_own else source.budget)


def missing_jobs(figure: PaperFigure, source: Source, cells: Sequence[Cell]) -> list[Job]:
    """What must be made before the figure's runs can be evaluated, in order."""
    jobs = [embed_job(source, cell.representation) for cell in cells]
    if figure.kind != "representations":
        for cell in cells:
            found = find(source, cell)
            lacking = [seed for seed in source.seeds if seed not in found]
            jobs += [sweep_job(source, cell, lacking)] if lacking else []
    return [job for job in jobs if job is not None]


def unique_jobs(jobs: Sequence[Job]) -> list[Job]:
    """Each command once: figures share runs."""
    return list({job.command: job for job in jobs}.values())


def missing_evaluations(
    figure: PaperFigure, source: Source, cells: Sequence[Cell], num_episodes: int
) -> int:
    """Episodes of the evaluations that the figure still needs, also of runs yet to be made."""
    if figure.kind != "bars":
        return 0
    missing = 0
    for cell in cells:
        found = find(source, cell)
        missing += sum(len(lacking_splits(run, num_episodes)) for run in found.values())
        missing += len(BAR_SPLITS) * (len(source.seeds) - len(found))
    return missing * num_episodes


def lacking_splits(run: Run, num_episodes: int) -> list[str]:
    """Parts of the split on which a run still must be evaluated for its bars."""
    (group,) = group_runs([run])
    rows = standard_rows(result_rows(group))
    return [s for s in BAR_SPLITS if s not in rows or rows[s].num_episodes < num_episodes]


def announce(
    jobs: Sequence[Job], episodes: int, evaluation: float | None, tuned: Sequence[float | None]
) -> None:
    """Says what will be made and how long it takes."""
    if not jobs and not episodes and not tuned:
        print("All runs and evaluations are there.")
        return
    print("Missing:")
    for job in jobs:
        print(f"  {job.title}: {job.cost}\n    {job.text}")
    if episodes:
        print(f"  {episodes:,} episodes of evaluation: {duration(evaluation)}")
    for seconds in tuned:
        print(f"  fine-tuning and its zero-shot lines, where not there: up to {duration(seconds)}")
    numbers = [job.seconds for job in jobs] + ([evaluation] if episodes else []) + list(tuned)
    known = [seconds for seconds in numbers if seconds is not None]
    unknown = f", and {len(numbers) - len(known)} unmeasured" if len(known) < len(numbers) else ""
    print(
        f"  In all {duration(sum(known))}{unknown}. It can be stopped, and called again to go on."
    )


def draw(
    number: str,
    figure: PaperFigure,
    source: Source,
    cells: Sequence[Cell],
    out: Path,
    values: Any,
) -> list[Path]:
    """The files of one figure; evaluates what is not evaluated yet."""
    name = f"figure_{number}"
    if figure.kind == "representations":
        tables = {cell.representation: table_of(source, cell.representation) for cell in cells}
        picture = representations_figure(source.domain, tables, f"Figure {number}: {figure.title}")
        return plots.save(picture, out / f"{name}.png", values.pdf)
    groups = [group_of(source, cell) for cell in cells]
    title = f"Figure {number}, {environment_of(groups)}: {figure.title}"
    if figure.kind == "finetune":
        curves = make_finetuned(source, groups, values.finetune_steps, values.episodes)
        return plots.save(finetune_figure(curves, title), out / f"{name}.png", values.pdf)
    if figure.kind == "curves":
        comparison = compare_curves(groups)
        (out / f"{name}.csv").write_text(comparison_csv(comparison), encoding="utf-8")
        text = comparison_markdown(title, comparison, groups[0].metric)
        (out / f"{name}.md").write_text(text, encoding="utf-8")
        drawn = curves_figure(groups, title)
        files = plots.save(drawn, out / f"{name}.png", values.pdf) if drawn else []
        return [*files, out / f"{name}.md", out / f"{name}.csv"]
    for group in groups:
        evaluate_missing(group, values.episodes)
    groups = [group_of(source, cell) for cell in cells]
    rows = {g.label: [r for r in result_rows(g) if r.is_standard] for g in groups}
    drawn = bars_figure(groups, rows, title)
    files = plots.save(drawn, out / f"{name}.png", values.pdf) if drawn else []
    return files + write_results(name, title, groups, rows, out)


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
            f"{cell.method} on {cell.representation} is not finished for seeds {lacking}; call the "
            "same command again to go on."
        )
    runs = tuple(found[seed] for seed in source.seeds)
    return Group(f"{cell.method}, {cell.representation}", source.domain.task, runs)


def evaluate_missing(group: Group, num_episodes: int) -> None:
    """Evaluates every run of a group where its bars need it."""
    for run in group.runs:
        lacking = lacking_splits(run, num_episodes)
        if lacking:
            print(f"Evaluating {run.path} on {' and '.join(lacking)} actions.", flush=True)
            evaluate_run(run.path, {name: group.set_size(name) for name in lacking}, num_episodes)


def write_results(
    name: str,
    title: str,
    groups: Sequence[Group],
    rows: Mapping[str, Sequence[ResultRow]],
    out: Path,
) -> list[Path]:
    """The numbers of the bars as Markdown and CSV."""
    flat = [row for group in groups for row in rows[group.label]]
    (out / f"{name}.md").write_text(as_markdown(title, flat, groups[0].metric, []), "utf-8")
    (out / f"{name}.csv").write_text(as_csv(flat), "utf-8")
    return [out / f"{name}.md", out / f"{name}.csv"]
