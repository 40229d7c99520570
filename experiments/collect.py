"""Records what every action does, in the play environment (resumable).

    python -m experiments.collect --task=grid_world --budget=laptop
    python -m experiments.collect --task=create-push --representation=hvae-video --frames=stored

Recordings of another kind than the task's first are asked for by a representation that is learned
from them.
"""

from __future__ import annotations

from experiments.flags import Arguments
from jaxnew.embedding import collect, parse_representation, stores
from jaxnew.task.domain import Domain, load_task

ARGUMENTS = Arguments(
    __doc__, "task", "representation", "budget", "runs", "observations_per_action", "frames"
)


def main() -> None:
    domain = Domain.of(load_task(ARGUMENTS.task))
    play = domain.play
    if ARGUMENTS.is_given("representation"):
        play = parse_representation(domain, ARGUMENTS.representation).play
    budget = domain.stage_one(play, ARGUMENTS.budget)
    recordings = collect(
        domain,
        ARGUMENTS.runs,
        ARGUMENTS.observations_per_action or budget.num_recordings,
        play,
        stores(play, budget, ARGUMENTS.stores_drawn),
    )
    for made in (recordings.recorded, recordings.drawn):
        if made is not None:
            print(
                f"{made.num_actions} actions x {made.num_recordings} recordings of "
                f"{made.format.shape} {made.format.dtype}, hash {made.hash}."
            )


if __name__ == "__main__":
    ARGUMENTS.start(main)
