"""Both stages on Grid World within minutes on a laptop, and what came out, in pictures.

make demo
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments import figures
from experiments.embed import print_report
from experiments.flags import Arguments
from experiments.reports.films import animate_run
from experiments.reports.paper import paper_value
from jaxnew.embedding import embed
from jaxnew.rollout.contract import Policy
from jaxnew.run import Run
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.domain import load_task
from jaxnew.training import train

ARGUMENTS = Arguments(__doc__, "budget", "runs", "overwrite", "debug_nans")

_PARTS = ("train", "validation", "test")
_LENGTH = 0.5  # Its steps, in those of the budget: what ten minutes of a core allow.


def main() -> int | None:
    start = time.perf_counter()
    task, budget = load_task("grid_world"), ARGUMENTS.budget
    encoder = embed(task, "hvae-changes", budget=budget, runs=ARGUMENTS.runs)
    preset = task.budget(budget)
    num_updates = round(_LENGTH * preset.num_updates)
    run = train(
        task,
        encoder.table,
        method="modulated",
        budget=budget,
        set={
            "num_updates": num_updates,
            "ppo.lr_steps": num_updates * preset.ppo.steps_per_update,
        },
        workdir=Path(ARGUMENTS.runs) / task.name / f"demo-{budget}",
        runs=ARGUMENTS.runs,
        overwrite=ARGUMENTS.overwrite,
    )
    if run.was_interrupted:
        return run.interrupted_by
    print_report(encoder)
    print_success(run, preset.final_episodes)
    out = RunDirectory.load(run.path).figures
    for file in figures.make_figures([run.path], out):
        print(f"  {file}")
    animate_run(run.path, out / "zero_shot_episode.gif")
    print(f"{(time.perf_counter() - start) / 60:.1f} minutes. Everything is in {run.path}.")
    return None


def print_success(run: Run, num_episodes: int) -> None:
    """Success of a run and of random play on every part of the split, beside the paper's."""
    random = run.acting_as(uniform(run.policy), "random-play")
    rows = [actor.evaluate(_PARTS, episodes=num_episodes).rows for actor in (run, random)]
    print(f"\nSuccess in %, {num_episodes} sampled episodes each [95 % interval over episodes]")
    print(f"{'skills':>12}  {'this run':>20}  {'random play':>20}  {'paper, 4e7 steps':>17}")
    for part in _PARTS:
        cells = []
        for row in rows:
            success = row[part]["metrics"]["is_success"]
            mean, low, high = (100 * success[name] for name in ("mean", "low", "high"))
            cells.append(f"{mean:5.2f} [{low:5.2f}, {high:5.2f}]")
        paper = paper_value("Grid World", "ours", part)
        published = f"{100 * paper[0]:.1f} +- {100 * paper[1]:.1f}" if paper else "-"
        print(f"{part:>12}  {cells[0]:>20}  {cells[1]:>20}  {published:>17}")
    print("Random play over all skills succeeds in 0.27 % of episodes (docs/grid_world.md).\n")


def uniform(policy: Policy) -> Policy:
    """A policy that gives every action the same utility."""
    utility = jax.tree.map(jnp.zeros_like, policy.params["utility"])
    return replace(policy, params={**policy.params, "utility": utility})


if __name__ == "__main__":
    ARGUMENTS.start(main)
