"""Evaluations as `evaluate` and `demo` make and keep them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.pipeline.training import EVALUATION_SEED, Trainer, load_state, load_trainer
from jaxnew.actions import ActionSplit
from jaxnew.evaluation import summarize
from jaxnew.ppo import TrainState
from jaxnew.run_directory import RunDirectory
from jaxnew.sampling import ActionPool


def evaluate_on(
    trainer: Trainer,
    state: TrainState,
    name: str,
    ids: np.ndarray,
    split: ActionSplit,
    *,
    num_episodes: int,
    set_size: int | None = None,
    first_size: int = 0,
    growth: int = 1,
    deterministic: bool = False,
    seed: int = EVALUATION_SEED,
) -> dict[str, Any]:
    """Episodes on sets drawn from `ids`: metrics with intervals over episodes.

    Args:
      name: of the ids.
      set_size: actions per set; None for as many as in training, which are all of them on the part
        that a method with one fixed set was trained with (`Trainer.on_split`).
      first_size, growth: of a set that grows during the episode, see `Evaluator`.
    """
    start = time.perf_counter()
    evaluator = trainer.evaluator
    pool = ActionPool.of(ids, capacity=len(trainer.table), always_available=split.always_available)
    if set_size is not None:
        evaluator = replace(evaluator, set_size=set_size, padded_set_size=0)
    elif name in trainer.pools:
        evaluator, pool = trainer.on_split(name, evaluator)
    if first_size:
        evaluator = replace(evaluator, first_size=first_size, growth=growth)
    episodes = evaluator.run(
        state.params,
        state.rollout.observation_statistics,
        trainer.table,
        pool,
        jax.random.key(seed),
        num_episodes,
        deterministic,
    )
    return {
        "metrics": summarize(episodes),
        "num_episodes": num_episodes,
        "num_actions": int(pool.size),
        "set_size": evaluator.set_size,
        **({"first_size": first_size, "growth": growth} if first_size else {}),
        "policy": "greedy" if deterministic else "sampled",
        "evaluation_seed": seed,
        "seconds": round(time.perf_counter() - start, 2),
    }


def record(run: RunDirectory, name: str, kind: str, step: int, row: dict[str, Any]) -> None:
    """Keeps one result in the run directory."""
    content = {"checkpoint": kind, "step": step, "actions": name, **row}
    run.record_evaluation(file_stem(content), content)


def file_stem(content: dict[str, Any]) -> str:
    """What a result is called: results that were made differently have files of their own."""
    grown = f"-from{content['first_size']}-by{content['growth']}" if "first_size" in content else ""
    stem = "{actions}-{checkpoint}-{policy}-m{set_size}".format(**content)
    return f"{stem}{grown}"


def evaluate_run(
    path: Path, set_sizes: Mapping[str, int | None], num_episodes: int, num_workers: int = 0
) -> None:
    """Evaluates the best checkpoint of a run on parts of its split, and keeps the results.

    Args:
      set_sizes: by part, actions per set; None for as many as in training.
      num_workers: processes for environments on the host; 0: one per core.
    """
    run, trainer, split = load_trainer(path, num_workers)
    with closing(trainer):
        state, step = load_state(run, trainer, "best")
        for name, set_size in set_sizes.items():
            row = evaluate_on(
                trainer,
                state,
                name,
                split.ids(name),
                split,
                num_episodes=num_episodes,
                set_size=set_size,
            )
            record(run, name, "best", step, row)
