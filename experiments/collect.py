"""Records what every action does, in the play environment (resumable).

    python -m experiments.collect --task=grid_world --budget=laptop
    python -m experiments.collect --task=create-push --representation=hvae-video --frames=stored

Recordings of another kind than the task's first are asked for by a representation that is learned
from them.
"""

from __future__ import annotations

from pathlib import Path

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import Domain, collect_observations, parse_representation
from experiments.pipeline.stage_one_flags import NUM_RECORDINGS, stores_drawn


def main() -> None:
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    play = domain.play
    if flag.REPRESENTATION.present:
        play = parse_representation(domain, flag.REPRESENTATION.value).play
    budget = domain.stage_one(play, flag.BUDGET.value)
    are_stored = stores_drawn()
    recordings = collect_observations(
        domain,
        Path(flag.RUNS.value),
        NUM_RECORDINGS.value or budget.num_recordings,
        play,
        budget.stores_drawn if are_stored is None else are_stored,
    )
    for made in (recordings.recorded, recordings.drawn):
        if made is not None:
            print(
                f"{made.num_actions} actions x {made.num_recordings} recordings of "
                f"{made.format.shape} {made.format.dtype}, hash {made.hash}."
            )


if __name__ == "__main__":
    flag.run_command(main)
