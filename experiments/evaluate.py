"""Evaluates a trained policy on action sets, with no further training (paper algorithm 2).

python -m experiments.evaluate --run=RUN --sets=train,validation,test --episodes=5000
python -m experiments.evaluate --run=RUN --ids=ids.txt
python -m experiments.evaluate --run=RUN --table=new_table.npz
python -m experiments.evaluate --run=RUN --unseen_ratio=0.4

RUN may be a sweep: all its runs are evaluated, and shown in one table by what was varied.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.flags import Arguments
from experiments.reports.sweeps import show_sweep
from jaxnew.actions import load_ids
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.representation.table import RepresentationTable
from jaxnew.run import Evaluation, Run, locate
from jaxnew.runs import Runs, is_sweep
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError

ARGUMENTS = Arguments(__doc__, "workers", "set", "universe")
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
ARGUMENTS.define("integer", "set_size", None, "Actions per set; default: as in training.")
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


def main() -> None:
    if ARGUMENTS.run is None:
        raise UsageError("Say which run to evaluate: --run=DIRECTORY.")
    if not ARGUMENTS.grows_from:
        ARGUMENTS.refuse(("growth",), "without --grows_from")
    directory = RunDirectory.load(locate(Path(ARGUMENTS.run))[0])
    if is_sweep(directory):
        evaluate_sweep(Runs.load(directory.path))
        return
    with Run.load(
        ARGUMENTS.run, ARGUMENTS.checkpoint, num_workers=ARGUMENTS.workers, set=ARGUMENTS.set
    ) as run:
        print(evaluated(run))


def evaluate_sweep(runs: Runs) -> None:
    """Every run of a sweep, and one table."""
    ARGUMENTS.refuse(("workers", "set"), "for a sweep, which has no environments on the host")
    for run in runs.load_each(ARGUMENTS.checkpoint or "best"):
        evaluated(run)
        print(f"{run.path} evaluated.", flush=True)
    for row in runs.diverged:
        print(f"{row['path']} diverged by update {row['diverged_at']}; not evaluated.")
    for file in show_sweep(runs):
        print(file)


def evaluated(run: Run) -> Evaluation:
    """What the flags ask of a run."""
    return run.evaluate(
        episodes=ARGUMENTS.episodes,
        set_size=ARGUMENTS.set_size,
        grows_from=ARGUMENTS.grows_from,
        growth=ARGUMENTS.growth,
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
        path = Path(ARGUMENTS.ids)
        return {"ids": {f"ids-{path.stem}": load_ids(path, run.task.make_universe())}}
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
