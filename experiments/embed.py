"""Trains an encoder of actions and makes the representation table; or encodes new actions.

    python -m experiments.embed --representation=hvae --budget=laptop
    python -m experiments.embed --checkpoint=RUN --observations=new.npz --output=new_table.npz

The second form trains nothing: a frozen encoder turns recordings of actions that need not have
existed before into representations (paper algorithm 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.flags import Arguments
from jaxnew.embedding import Encoder, embed
from jaxnew.observations import Recordings
from jaxnew.recording import REPRESENTATION_SEED
from jaxnew.representation.report import measures
from jaxnew.storage.files import check_new
from jaxnew.task.places import UsageError

_OF_TRAINING = (
    *("task", "representation", "split", "split_seed", "budget", "seed", "workdir", "runs"),
    *("overwrite", "set", "recordings", "frames"),
)
ARGUMENTS = Arguments(__doc__, *_OF_TRAINING, "trust", "debug_nans")
ARGUMENTS.define(
    "string", "checkpoint", None, "Run directory of a trained encoder, or pretrained:NAME."
)
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
        checkpoint, recordings, output = map(Path, given)
        check_new(output, ARGUMENTS.overwrite)
        table = Encoder.load(checkpoint).encode(Recordings.load(recordings))
        table.save(output)
        print(f"{output}: {table.vectors.shape[0]} actions, {table.vectors.shape[1]} numbers each.")
    elif any(given):
        raise UsageError(
            "Encoding new actions takes all of --checkpoint, --observations and --output."
        )
    else:
        encoder = embed(
            ARGUMENTS.task,
            ARGUMENTS.representation,
            seed=ARGUMENTS.seed if ARGUMENTS.is_given("seed") else REPRESENTATION_SEED,
            num_recordings=ARGUMENTS.recordings,
            stores_drawn=ARGUMENTS.stores_drawn,
            workdir=ARGUMENTS.path,
            **ARGUMENTS.of("budget", "split", "split_seed", "set", "runs", "overwrite"),
        )
        if encoder.is_finished:
            print_report(encoder)
        return encoder.interrupted_by
    return None


def print_report(encoder: Encoder) -> None:
    """Prints what a table tells of actions, beside random, untrained and engineered vectors."""
    tables = {"encoder": encoder.report(), **encoder.references()}
    rows = {name: _cells(numbers) for name, numbers in tables.items()}
    labels = list(rows["encoder"])
    width = max(map(len, labels))
    print(f"\n{encoder.table.source} (docs/method.md, Representation table and its report)")
    print(" " * width, *(f"{name:>9}" for name in rows))
    for label in labels:
        print(f"{label:<{width}}", *(f"{cells[label]:>9}" for cells in rows.values()))
    print(f"More in {encoder.path / 'evaluation' / 'representation.json'}.")


def _cells(numbers: Mapping[str, Any]) -> dict[str, str]:
    """The numbers of one table by what they are."""
    entries = numbers["entries"]
    active = f"{entries['active_dimensions']}/{entries['dimensions']}"
    shown = {k: "-" if v is None else f"{v:.3f}" for k, v in measures(numbers).items()}
    return shown | {"dimensions that vary": active}


if __name__ == "__main__":
    ARGUMENTS.start(main)
