"""Evaluates a trained policy on action sets, with no further training (paper algorithm 2).

python -m experiments.evaluate --run=RUN --sets=train,validation,test --episodes=5000
python -m experiments.evaluate --run=RUN --ids=ids.txt
python -m experiments.evaluate --run=RUN --table=new_table.npz
python -m experiments.evaluate --run=RUN --unseen_ratio=0.4
"""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.evaluation import evaluate_on, record
from experiments.pipeline.training import EVALUATION_SEED, load_state, load_trainer
from jaxnew.actions import ActionSplit, ActionUniverse, load_ids, mixture_ids
from jaxnew.representation.table import RepresentationTable

RUN = flags.DEFINE_string("run", None, "Run directory of train, or a checkpoint in it.")
CHECKPOINT = flags.DEFINE_enum("checkpoint", "best", ["best", "latest"], "Which checkpoint.")
SETS = flags.DEFINE_list("sets", ["test"], "Parts of the split: train, validation, test, all.")
EPISODES = flags.DEFINE_integer("episodes", 5000, "Episodes per set.")
DETERMINISTIC = flags.DEFINE_bool("deterministic", False, "Take the most likely action.")
SET_SIZE = flags.DEFINE_integer("set_size", None, "Actions per set; default: as in training.")
GROWS_FROM = flags.DEFINE_integer(
    "grows_from", 0, "Actions of a set at the first step; the set grows during the episode."
)
GROWTH = flags.DEFINE_integer("growth", 1, "Actions that a growing set gains at every step.")
IDS = flags.DEFINE_string("ids", None, "File of action ids to draw sets from.")
TABLE = flags.DEFINE_string("table", None, ".npz table whose actions are drawn and represented.")
UNSEEN_RATIO = flags.DEFINE_float("unseen_ratio", None, "Share of test actions among train ones.")
EVALUATION_KEY = flags.DEFINE_integer("evaluation_seed", EVALUATION_SEED, "Seed of the episodes.")


def main() -> None:
    if RUN.value is None:
        raise flag.UsageError("Say which run to evaluate: --run=DIRECTORY.")
    path, kind = locate(Path(RUN.value))
    kind = kind or CHECKPOINT.value
    run, trainer, split = load_trainer(path, flag.WORKERS.value, flag.SET.value)
    if TABLE.value is not None:
        new = RepresentationTable.load(Path(TABLE.value))
        trainer = dataclasses.replace(trainer, table=with_new_rows(trainer.table, new))
    state, step = load_state(run, trainer, kind)
    rows = {}
    with closing(trainer):
        for name, ids in action_lists(trainer.task.make_universe(), split).items():
            rows[name] = evaluate_on(
                trainer,
                state,
                name,
                ids,
                split,
                num_episodes=EPISODES.value,
                set_size=SET_SIZE.value,
                first_size=GROWS_FROM.value,
                growth=GROWTH.value,
                deterministic=DETERMINISTIC.value,
                seed=EVALUATION_KEY.value,
            )
            record(run, name, kind, step, rows[name])
    print_table(rows, f"{path}, {kind} checkpoint (update {step})")


def locate(path: Path) -> tuple[Path, Any]:
    """The run directory that `path` is or lies in, and the kind of checkpoint that it names."""
    for folder in (path, *path.parents):
        if (folder / "config.json").is_file():
            inside = path.relative_to(folder).parts
            return folder, inside[1] if len(inside) > 1 and inside[0] == "checkpoints" else None
    raise flag.UsageError(f"{path} is neither a run directory nor in one (no config.json).")


def action_lists(universe: ActionUniverse, split: ActionSplit) -> dict[str, np.ndarray]:
    """Name -> ids of each list of actions that the flags ask for."""
    chosen = [f for f in (IDS, TABLE, UNSEEN_RATIO) if f.value is not None]
    if len(chosen) > 1:
        raise flag.UsageError(
            "Give one of --ids, --table, --unseen_ratio; each of them says where sets come from."
        )
    if IDS.value is not None:
        return {f"ids-{Path(IDS.value).stem}": load_ids(Path(IDS.value), universe)}
    if TABLE.value is not None:
        new = RepresentationTable.load(Path(TABLE.value))
        return {f"table-{Path(TABLE.value).stem}": new.ids}
    if UNSEEN_RATIO.value is not None:
        ids = mixture_ids(split.train, split.test, UNSEEN_RATIO.value)
        return {f"unseen-{UNSEEN_RATIO.value:g}": ids}
    return {name: split.ids(name) for name in SETS.value}


def with_new_rows(table: jax.Array, new: RepresentationTable) -> jax.Array:
    """The policy's table with the rows of `new` in place of its own.

    Raises:
      UsageError: the new rows have another width, or ids that the environment does not have.
    """
    if new.vectors.shape[1] != table.shape[1] or new.ids.max() >= table.shape[0]:
        raise flag.UsageError(
            f"The new table has {new.vectors.shape[1]} numbers per action and ids up to "
            f"{new.ids.max()}; the policy reads {table.shape[1]} numbers, and the environment has "
            f"ids 0..{table.shape[0] - 1}."
        )
    return table.at[jnp.asarray(new.ids)].set(jnp.asarray(new.vectors))


def print_table(rows: dict[str, dict[str, Any]], title: str) -> None:
    """The results, one line per list of actions, with 95 % intervals over episodes."""
    print(f"{title}; mean [95 % interval over episodes]")
    for name, row in rows.items():
        metrics = "  ".join(
            f"{metric} {value['mean']:.4f} [{value['low']:.4f}, {value['high']:.4f}]"
            for metric, value in row["metrics"].items()
        )
        print(f"{name:>12} ({row['num_episodes']} episodes, {row['policy']}): {metrics}")


if __name__ == "__main__":
    flag.run_command(main)
