"""Studies of a trained policy, and the paper's search grids.

    python -m experiments.analyze --study=set-size --run=RUN,RUN
    python -m experiments.analyze --study=unseen-ratio --run=RUN,RUN
    python -m experiments.analyze --study=growing-set --run=RUN,RUN
    python -m experiments.analyze --study=recordings --run=RUN,RUN --encoder=EMBED_RUN
    python -m experiments.analyze --study=measures --run=RUN,RUN,RUN
    python -m experiments.analyze --study=entropy --representation=gt12 --budget=paper
    python -m experiments.analyze --study=batch-size --representation=gt12 --budget=paper

The first four, and a task's own studies (figures 9a to 9c: `angle`, `embedding` and `mix` of runs
of `create-push-analysis`), evaluate the best checkpoints of runs (a sweep stands for its members)
and train nothing. So does `measures`, which says how well each number that `embed` prints orders
the test results of the runs' tables. The last two train every value of the paper's grid with
several seeds, and choose by validation (paper appendix D, "Hyperparameter Search"), after a list of
the commands with the time that they take (`--dry_run`: the list only). What is done already is not
done again.
"""

from __future__ import annotations

from pathlib import Path

from experiments.flags import TRAINED, Arguments
from experiments.reports import measures
from experiments.reports.production import Cell, Source
from experiments.reports.runs import policies
from experiments.reports.searches import GRIDS, search
from experiments.reports.studies import NAMES, study_runs
from experiments.reports.study_report import Study, write_study
from jaxnew.task.places import UsageError, check_output

ARGUMENTS = Arguments(__doc__, *TRAINED, "runs", "workers", "set", "trust", "debug_nans")
ARGUMENTS.define(
    "string",
    "study",
    None,
    f"What to study: {', '.join([*NAMES, measures.NAME, *GRIDS])}, or one of the task's own.",
)
ARGUMENTS.define("list", "run", [], "Runs of train or sweep to evaluate.")
ARGUMENTS.define("string", "encoder", None, "Run of embed, for --study=recordings.")
ARGUMENTS.define("floats", "values", [], "Values of the horizontal axis; default: the study's.")
ARGUMENTS.define("integer", "episodes", 5000, "Episodes of each evaluation.")
ARGUMENTS.define("integers", "seeds", [31, 41, 51, 61, 71, 81], "Seeds of a search.")
ARGUMENTS.define("float", "steps", 0.0, "Environment steps of a search's runs; 0: of --budget.")
ARGUMENTS.define("bool", "dry_run", False, "Of a search, only say what is missing.")
ARGUMENTS.define("string", "out", None, "Where to write; default: `analysis/` beside the runs.")

_OF_STUDIES = ("run", "encoder", "episodes")
_OF_SEARCHES = (*TRAINED, "runs", "set", "seeds", "steps", "dry_run")


def main() -> None:
    if ARGUMENTS.study is None:
        raise UsageError(f"Say which: --study={'|'.join([*NAMES, measures.NAME, *GRIDS])}.")
    if ARGUMENTS.study in GRIDS:
        ARGUMENTS.refuse(_OF_STUDIES, "for a search")
        cell, own = Cell(ARGUMENTS.method, ARGUMENTS.representation), Source.asked_for(ARGUMENTS)
        folder = own.domain.folder(own.folder)
        if not ARGUMENTS.dry_run:
            output(folder)
        study = search(ARGUMENTS.study, own, cell, ARGUMENTS.values, ARGUMENTS.dry_run)
        files = [] if study is None else write(study, folder)
    else:
        ARGUMENTS.refuse(_OF_SEARCHES, "for a study of runs")
        if ARGUMENTS.study != "recordings":
            ARGUMENTS.refuse(("encoder",), f"for --study={ARGUMENTS.study}")
        files = of_runs([Path(path) for path in ARGUMENTS.run])
    for file in files:
        print(file)


def of_runs(paths: list[Path]) -> list[Path]:
    """Studies runs; what was written."""
    policies(paths)
    folder = output(paths[0].parent)
    episodes, workers = ARGUMENTS.episodes, ARGUMENTS.workers
    if ARGUMENTS.study == measures.NAME:
        ARGUMENTS.refuse(("values",), "for --study=measures")
        return measures.study_measures(paths, episodes, folder, workers)
    encoder = Path(ARGUMENTS.encoder) if ARGUMENTS.encoder else None
    study = study_runs(ARGUMENTS.study, paths, ARGUMENTS.values, episodes, encoder, workers)
    return write(study, paths[0].parent)


def write(study: Study, folder: Path) -> list[Path]:
    """A study as files below `output`."""
    return write_study(study, output(folder), study.name.replace("-", "_"))


def output(folder: Path) -> Path:
    """Where a study is written, by default beside the runs."""
    return check_output(ARGUMENTS.out or folder / "analysis")


if __name__ == "__main__":
    ARGUMENTS.start(main)
