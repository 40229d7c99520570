"""Records what every action does, in the play environment (resumable).

python -m experiments.collect --task=grid_world --budget=laptop
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments import _flags as flag
from experiments._artifacts import Domain, collect_observations

NUM_RECORDINGS = flags.DEFINE_integer(
    "observations_per_action", None, "Recordings per action; default: what the budget says."
)


def main() -> None:
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    budget = flag.budget_of(task.stage_one, flag.BUDGET.value, "Stage one")
    recordings = collect_observations(
        domain, Path(flag.RUNS.value), NUM_RECORDINGS.value or budget.num_recordings
    )
    print(
        f"{recordings.num_actions} actions x {recordings.num_recordings} recordings of "
        f"{recordings.format.shape} {recordings.format.dtype}, hash {recordings.hash}."
    )


if __name__ == "__main__":
    flag.run_command(main)
