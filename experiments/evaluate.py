"""Evaluates a trained policy on action sets, with no further training (paper algorithm 2).

python -m experiments.evaluate --run=RUN --sets=train,validation,test --episodes=5000
python -m experiments.evaluate --run=RUN --ids=ids.txt
python -m experiments.evaluate --run=RUN --table=new_table.npz
python -m experiments.evaluate --run=RUN --unseen_ratio=0.4

RUN may be a sweep: all its runs are evaluated, and shown in one table by what was varied.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from experiments.flags import Arguments
from experiments.reports.sweeps import show_sweep
from jaxnew.actions import load_ids
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Evaluation
from jaxnew.run import Run, locate
from jaxnew.runs import MEMBERS, Runs, is_sweep
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError, check_output, file_of

ARGUMENTS = Arguments(__doc__, "workers", "set", "universe", "trust", "debug_nans")
ARGUMENTS.define("string", "run", None, "Run directory of train or sweep, or a checkpoint in it.")
ARGUMENTS.define(
    "enum",
    "checkpoint",
    None,
    "Which checkpoint; default: the one that --run names, or best.",
    choices=["best", "latest"],
)
ARGUMENTS.define("list", "sets", ["test"], "Parts of the split: train, validation, test, all.")
ARGUMENTS.define("integer", "episodes", 5000, "Episodes per set.")
ARGUMENTS.define("bool", "deterministic", False, "Take the most likely action.")
ARGUMENTS.define("integer", "set_size", None, "Actions per set; default: the run's sets.size.")
ARGUMENTS.define(
    "integer",
    "grows_from",
    0,
    "Actions of a set at the first step; the set grows during the episode.",
)
ARGUMENTS.define("integer", "growth", 1, "Actions that a growing set gains at every step.")
ARGUMENTS.define("string", "ids", None, "File of action ids to draw sets from.")
ARGUMENTS.define("string", "table", None, ".npz table whose actions are drawn and represented.")
ARGUMENTS.define(
    "list",
    "allow",
    [],
    "Of --table: other-encoder (its vectors are not those of the run's encoder), unknown-actions "
    "(it does not say what its actions are; its ids are those of the universe).",
)
ARGUMENTS.define("float", "unseen_ratio", None, "Share of test actions among train ones.")
ARGUMENTS.define("integer", "evaluation_seed", EVALUATION_SEED, "Seed of the episodes.")
ARGUMENTS.define(
    "string",
    "output",
    None,
    "Folder of the results (.json), for a run that you may not write; default: the run's own.",
)


def main() -> None:
    if ARGUMENTS.run is None:
        raise UsageError("Say which run to evaluate: --run=DIRECTORY.")
    if not ARGUMENTS.grows_from:
        ARGUMENTS.refuse(("growth",), "without --grows_from")
    found = locate(ARGUMENTS.run)
    directory = RunDirectory.load(found.path)
    if is_sweep(directory):
        if found.kind is not None:
            raise UsageError(
                f"{ARGUMENTS.run} holds all members of a sweep at once; give the sweep, or one of "
                f"{directory.path / MEMBERS}."
            )
        evaluate_sweep(Runs.load(directory.path))
        return
    with Run.load(
        ARGUMENTS.run, ARGUMENTS.checkpoint, num_workers=ARGUMENTS.workers, set=ARGUMENTS.set
    ) as run:
        show(evaluated(run, ARGUMENTS.output or True))


def evaluate_sweep(runs: Runs) -> None:
    """Every run of a sweep, and one table."""
    ARGUMENTS.refuse(("workers", "set"), "for a sweep, which has no environments on the host")
    out = Path(ARGUMENTS.output) if ARGUMENTS.output else None
    if out is None:
        check_output(runs.path / "figures", "give another folder with --output")
    for run in runs.load_each(ARGUMENTS.checkpoint or "best"):
        show(evaluated(run, True if out is None else out / run.path.name))
    for row in runs.diverged:
        print(f"{row['path']} diverged by update {row['diverged_at']}; not evaluated.")
    if out is None:
        for file in show_sweep(runs):
            print(file)


def show(evaluation: Evaluation) -> None:
    """Prints it; the command fails if something is not on record."""
    print(evaluation, flush=True)
    if evaluation.problems:
        sys.exit(1)


def evaluated(run: Run, record: bool | Path | str) -> Evaluation:
    """What the flags ask of a run."""
    return run.evaluate(
        record=record,
        **ARGUMENTS.of("episodes", "set_size", "grows_from", "growth"),
        greedy=ARGUMENTS.deterministic,
        seed=ARGUMENTS.evaluation_seed,
        **drawn_from(run),
    )


def drawn_from(run: Run) -> dict[str, Any]:
    """Arguments of `Run.evaluate` that say what sets are drawn from."""
    chosen = [name for name in ("ids", "table", "unseen_ratio") if ARGUMENTS.is_given(name)]
    if len(chosen) + ARGUMENTS.is_given("sets") > 1:
        raise UsageError(
            "Give one of --sets, --ids, --table, --unseen_ratio; each of them says where sets come "
            "from."
        )
    if ARGUMENTS.table is None:
        ARGUMENTS.refuse(["universe", "allow"], "without --table")
    if ARGUMENTS.ids is not None:
        path = file_of(ARGUMENTS.ids, "--ids takes a text file of action ids.")
        ids = load_ids(path, run.task.make_universe())
        return {"ids": {f"ids-{Path(ARGUMENTS.ids).stem}": ids}}
    if ARGUMENTS.table is not None:
        path = Path(ARGUMENTS.table)
        return {
            "table": RepresentationTable.load(path),
            "table_name": path.stem,
            "universe": ARGUMENTS.universe,
            "allow": ARGUMENTS.allow,
        }
    if ARGUMENTS.unseen_ratio is not None:
        return {"unseen_ratio": ARGUMENTS.unseen_ratio}
    return {"parts": ARGUMENTS.sets}


if __name__ == "__main__":
    ARGUMENTS.start(main)
