"""Goes on learning with the test actions, or learns them from scratch (figures 10 and 19).

    python -m experiments.finetune --run=RUN
    python -m experiments.finetune --run=RUN --scratch

RUN is a run of `train` with `--method=ours` or `--method=nearest-neighbour`. Its policy is trained
with all test actions as one fixed set; the learning rate starts anew. From a utility policy
everything is kept; from a discrete policy all but its categorical heads: that of the actions, which
has one logit per action, and that of the stop bit. The running statistics of observations are kept
and frozen. `--scratch` keeps nothing.
"""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import TABLE_FILE
from experiments.pipeline.machinery import pool_assignments
from experiments.pipeline.methods import adapted
from experiments.pipeline.training import (
    TrainConfig,
    Trainer,
    load_state,
    load_trainer,
    save_inputs,
)
from jaxnew import config as config_lib
from jaxnew import loop
from jaxnew.actions import ActionSplit
from jaxnew.ppo import TrainState
from jaxnew.representation.table import RepresentationTable
from jaxnew.run_directory import RunDirectory
from jaxnew.task import Task

RUN = flags.DEFINE_string("run", None, "Run directory of train.")
SCRATCH = flags.DEFINE_bool("scratch", False, "Start from fresh parameters.")

# Method of the pretrained run -> method that is trained with the test actions.
_CONTINUED = {"ours": "no-subsampling", "nearest-neighbour": "nearest-neighbour"}
_PART = "test"


def main() -> None:
    if RUN.value is None:
        raise flag.UsageError("Say which run to fine-tune: --run=DIRECTORY.")
    source_path = Path(RUN.value)
    pool, assignments = pool_assignments(flag.SET.value)
    source_run, source, split = load_trainer(source_path, flag.WORKERS.value, pool)
    table = RepresentationTable.load(source_path / TABLE_FILE)
    config = config_of(
        source.config, source.task, split, flag.BUDGET.value, SCRATCH.value, flag.SEED.value
    ).with_set(assignments)
    trainer = Trainer.of(config, source.task, split, table, flag.WORKERS.value)
    state = trainer.init()
    if not SCRATCH.value:
        state = warm_start(state, load_state(source_run, source, "best")[0], trainer)
    name = f"finetune-{'scratch' if SCRATCH.value else 'warm'}-{flag.BUDGET.value}-{config.seed}"
    path = Path(flag.WORKDIR.value) if flag.WORKDIR.value else source_path / name
    plain = config_lib.to_dict(config)
    with (
        closing(trainer),
        RunDirectory.open_or_create(path, plain, flag.OVERWRITE.value) as run,
    ):
        save_inputs(run, split, table)
        print(f"{name}: {config.num_updates} updates with {_PART} actions in {path}.")
        metric = source.task.selection_metric
        loop.run(
            state,
            chunk=trainer.chunk,
            run_directory=run,
            total_steps=config.num_updates,
            chunk_steps=config.loop.chunk_updates,
            checkpoint_every=config.loop.checkpoint_every,
            title=name,
            work_per_step=config.ppo.steps_per_update,
            shown_metrics=(f"episode/{metric}", "policy/entropy"),
        )


def config_of(
    source: TrainConfig,
    task: Task,
    split: ActionSplit,
    budget_name: str,
    is_scratch: bool,
    seed: int,
) -> TrainConfig:
    """The config of a run that goes on from `source`.

    Raises:
      UsageError: the source's method has no such continuation, or there is no such budget.
    """
    if source.method not in _CONTINUED or source.trained_on != "train":
        raise flag.UsageError(
            f"A run of --method={source.method} on {source.trained_on} actions cannot be "
            f"fine-tuned; give one of --method={' or '.join(_CONTINUED)}."
        )
    method = _CONTINUED[source.method]
    budget = flag.budget_of(task.stage_two, budget_name, "Stage two")
    budget = adapted(budget, method, task, split)
    rollout = dataclasses.replace(budget.ppo.rollout, freezes_observation_statistics=not is_scratch)
    return dataclasses.replace(
        source,
        method=method,
        seed=seed,
        num_updates=max(1, round(budget.num_updates * task.baselines.finetune_share)),
        ppo=dataclasses.replace(budget.ppo, rollout=rollout),
        hyperparameters=budget.hyperparameters,
        loop=budget.loop,
        trained_on=_PART,
        start="fresh parameters" if is_scratch else f"{source.method}, seed {source.seed}",
    )


def warm_start(state: TrainState, source: TrainState, trainer: Trainer) -> TrainState:
    """A fresh state with the parameters and the observation statistics of a trained one.

    Of a discrete policy the categorical heads stay fresh (spec method 9).
    """
    params: dict[str, Any] = jax.tree.map(lambda x: x, source.params)
    if "logits" in params.get("policy", {}):
        params["policy"]["logits"] = state.params["policy"]["logits"]
        heads = params.get("auxiliary", {}).get("heads", {})
        if "stop" in heads:
            heads["stop"] = state.params["auxiliary"]["heads"]["stop"]
    state = dataclasses.replace(state, params=params)
    statistics = source.rollout.observation_statistics
    return trainer.machinery.restarted(state, trainer.training_pool, statistics)


if __name__ == "__main__":
    flag.run_command(main)
