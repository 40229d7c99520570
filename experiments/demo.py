"""Both stages on Grid World within minutes on a laptop, and what came out, in pictures.

make demo
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments import figures
from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import (
    TABLE_FILE,
    Domain,
    find_table,
    print_report,
    train_representation,
)
from experiments.pipeline.evaluation import evaluate_on, record
from experiments.pipeline.training import load_state, load_trainer, train_policy
from experiments.reports.paper import paper_value
from jaxnew.ppo import TrainState
from jaxnew.representation.table import RepresentationTable

_SPLITS = ("train", "validation", "test")
# Relative coordinates: raw ones take hours of training to tell skills apart (README, Gotchas).
_REPRESENTATION = "hvae-relative"


def main() -> None:
    start = time.perf_counter()
    domain = Domain.of(flag.load_task("grid_world"), None)
    runs, budget = Path(flag.RUNS.value), flag.BUDGET.value
    encoder = train_representation(domain, runs, _REPRESENTATION, budget)
    table = find_table(domain, runs, _REPRESENTATION, budget)
    path, result = train_policy(
        domain, runs, table, _REPRESENTATION, budget, overwrite=flag.OVERWRITE.value
    )
    if result.was_interrupted:
        return
    print_report(domain, encoder, RepresentationTable.load(encoder.path / TABLE_FILE))
    print_success(path, flag.budget_of(domain.task.stage_two, budget, "Stage two").final_episodes)
    for file in figures.make_figures([path], path / "figures"):
        print(f"  {file}")
    figures.episode_animation(path, path / "figures" / "zero_shot_episode.gif")
    print(f"{(time.perf_counter() - start) / 60:.1f} minutes. Everything is in {path}.")


def print_success(path: Path, num_episodes: int) -> None:
    """Success of the best checkpoint and of random play on every split, beside the paper's."""
    run, trainer, split = load_trainer(path)
    state, step = load_state(run, trainer, "best")
    print(f"\nSuccess in %, {num_episodes} sampled episodes each [95 % interval over episodes]")
    print(f"{'skills':>12}  {'this run':>20}  {'random play':>20}  {'paper, 4e7 steps':>17}")
    for name in _SPLITS:
        cells = []
        for actor, kind in ((state, "best"), (uniform(state), "random-play")):
            row = evaluate_on(
                trainer, actor, name, split.ids(name), split, num_episodes=num_episodes
            )
            record(run, name, kind, step, row)
            success = row["metrics"]["is_success"]
            mean, low, high = (100 * success[part] for part in ("mean", "low", "high"))
            cells.append(f"{mean:5.2f} [{low:5.2f}, {high:5.2f}]")
        paper = paper_value("Grid World", "ours", name)
        published = f"{100 * paper[0]:.1f} +- {100 * paper[1]:.1f}" if paper else "-"
        print(f"{name:>12}  {cells[0]:>20}  {cells[1]:>20}  {published:>17}")
    print("Random play over all skills succeeds in 0.27 % of episodes (spec grid_world 6).\n")


def uniform(state: TrainState) -> TrainState:
    """The state of a policy that gives every action the same utility."""
    utility = {**state.params["utility"]}
    utility["score"] = jax.tree.map(jnp.zeros_like, utility["score"])
    return dataclasses.replace(state, params={**state.params, "utility": utility})


if __name__ == "__main__":
    flag.run_command(main)
