"""Trains an encoder of actions and makes the representation table; or encodes new actions.

    python -m experiments.embed --representation=hvae --budget=laptop
    python -m experiments.embed --checkpoint=RUN --observations=new.npz --output=new_table.npz

The second form trains nothing: a frozen encoder turns recordings of actions that need not have
existed before into representations (paper algorithm 2).
"""

from __future__ import annotations

from pathlib import Path

from experiments.flags import Arguments
from jaxnew.embedding import Encoder, embed
from jaxnew.observations import Recordings
from jaxnew.recording import REPRESENTATION_SEED
from jaxnew.storage.files import check_new
from jaxnew.task.places import UsageError

_OF_TRAINING = (
    *("task", "representation", "split", "split_seed", "budget", "seed", "workdir", "runs"),
    *("overwrite", "set", "recordings", "frames"),
)
ARGUMENTS = Arguments(__doc__, *_OF_TRAINING, "trust", "debug_nans")
ARGUMENTS.define("string", "checkpoint", None, "Run directory of a trained encoder.")
ARGUMENTS.define("string", "observations", None, ".npz of ids and recordings to encode.")
ARGUMENTS.define(
    "string",
    "output",
    None,
    "Where to write the table of the new actions (.npz); --overwrite replaces it.",
)


def main() -> int | None:
    given = [ARGUMENTS.checkpoint, ARGUMENTS.observations, ARGUMENTS.output]
    if all(given):
        unused = [name for name in _OF_TRAINING if name != "overwrite"]
        ARGUMENTS.refuse(unused, "with --checkpoint")
        encode_new_actions(*map(Path, given))
    elif any(given):
        raise UsageError(
            "Encoding new actions takes all of --checkpoint, --observations and --output."
        )
    else:
        encoder = embed(
            ARGUMENTS.task,
            ARGUMENTS.representation,
            budget=ARGUMENTS.budget,
            seed=ARGUMENTS.seed if ARGUMENTS.is_given("seed") else REPRESENTATION_SEED,
            split=ARGUMENTS.split,
            split_seed=ARGUMENTS.split_seed,
            set=ARGUMENTS.set,
            num_recordings=ARGUMENTS.recordings,
            stores_drawn=ARGUMENTS.stores_drawn,
            workdir=ARGUMENTS.path,
            runs=ARGUMENTS.runs,
            overwrite=ARGUMENTS.overwrite,
        )
        if encoder.is_finished:
            print_report(encoder)
        return encoder.interrupted_by
    return None


def encode_new_actions(checkpoint: Path, recordings: Path, output: Path) -> None:
    """Representations of recorded actions from a frozen encoder."""
    check_new(output, ARGUMENTS.overwrite)
    table = Encoder.load(checkpoint).encode(Recordings.load(recordings))
    table.save(output)
    print(f"{output}: {table.vectors.shape[0]} actions, {table.vectors.shape[1]} numbers each.")


def print_report(encoder: Encoder) -> None:
    """Prints purity and linear R2 of a table."""
    numbers = encoder.report()
    entries = numbers["entries"]
    explained = "".join(
        f"; linear R2 to {name} {value:.2f}" for name, value in numbers["linear_r2_mean"].items()
    )
    print(
        f"{encoder.table.source}: 5-NN purity {numbers['purity_all']:.3f}, held out "
        f"{numbers['purity_held_out']:.3f}{explained}; {entries['active_dimensions']} of "
        f"{entries['dimensions']} dimensions vary between actions (std > 0.1). All in "
        f"{encoder.path / 'evaluation' / 'representation.json'}."
    )


if __name__ == "__main__":
    ARGUMENTS.start(main)
