"""Records what every action does, in the play environment (resumable).

    python -m experiments.collect --task=grid_world --budget=laptop
    python -m experiments.collect --task=create-push --representation=hvae-video --frames=stored

    python -m experiments.collect --task=create-push --universe=3-degrees --ids=new --output=new.npz

Recordings of another kind than the task's first are asked for by a representation that is learned
from them. The last form records some actions, of any universe, into one file that an encoder reads.
"""

from __future__ import annotations

from experiments.flags import Arguments
from jaxnew.observations import Recordings
from jaxnew.recording import collect, parse_representation, record, stores
from jaxnew.task.domain import Domain, load_task

ARGUMENTS = Arguments(
    __doc__,
    "task",
    "representation",
    "budget",
    "runs",
    "recordings",
    "frames",
    "universe",
    "debug_nans",
)
ARGUMENTS.define(
    "string",
    "ids",
    "all",
    "Actions to record into --output: all, new (those that the task's own universe lacks), train, "
    "validation, test, or a file of ids.",
)
ARGUMENTS.define("string", "output", None, "One file (.npz) for the recordings; resumable.")
ARGUMENTS.define("bool", "overwrite", False, "Replace the file of --output.")


def main() -> None:
    if ARGUMENTS.output is not None:
        ARGUMENTS.refuse(["runs", "frames"], "with --output, which makes one file")
        made = record(
            ARGUMENTS.task,
            ARGUMENTS.ids,
            representation=ARGUMENTS.representation if ARGUMENTS.is_given("representation") else "",
            num_recordings=ARGUMENTS.recordings,
            **ARGUMENTS.of("output", "universe", "budget", "overwrite"),
        )
        describe(made)
        return
    ARGUMENTS.refuse(["ids", "universe", "overwrite"], "without --output")
    domain = Domain.of(load_task(ARGUMENTS.task))
    play = domain.play
    if ARGUMENTS.is_given("representation"):
        play = parse_representation(domain, ARGUMENTS.representation).play
    budget = domain.stage_one(play, ARGUMENTS.budget)
    recordings = collect(
        domain,
        ARGUMENTS.runs,
        ARGUMENTS.recordings or budget.num_recordings,
        play,
        stores(play, budget, ARGUMENTS.stores_drawn),
    )
    for each in (recordings.recorded, recordings.drawn):
        if each is not None:
            describe(each)


def describe(recordings: Recordings) -> None:
    """Prints what was recorded."""
    print(
        f"{recordings.num_actions} actions x {recordings.num_recordings} recordings of "
        f"{recordings.format.shape} {recordings.format.dtype}, hash {recordings.hash}."
    )


if __name__ == "__main__":
    ARGUMENTS.start(main)
