"""Trains an encoder of actions and makes the representation table; or encodes new actions.

    python -m experiments.embed --representation=hvae --budget=laptop
    python -m experiments.embed --checkpoint=RUN --observations=new.npz --output=new_table.npz

The second form trains nothing: a frozen encoder turns recordings of actions that need not have
existed before into representations (paper algorithm 2).
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import (
    REPRESENTATION_SEED,
    TABLE_FILE,
    Domain,
    load_encoder,
    print_report,
    train_representation,
)
from experiments.pipeline.stage_one_flags import NUM_RECORDINGS, stores_drawn
from jaxnew import observations
from jaxnew.representation.table import RepresentationTable

CHECKPOINT = flags.DEFINE_string("checkpoint", None, "Run directory of a trained encoder.")
OBSERVATIONS = flags.DEFINE_string("observations", None, ".npz of ids and recordings to encode.")
OUTPUT = flags.DEFINE_string("output", None, "Where to write the table of the new actions (.npz).")


def main() -> None:
    given = [f.value is not None for f in (CHECKPOINT, OBSERVATIONS, OUTPUT)]
    if all(given):
        encode_new_actions(Path(CHECKPOINT.value), Path(OBSERVATIONS.value), Path(OUTPUT.value))
    elif any(given):
        raise flag.UsageError(
            "Encoding new actions takes all of --checkpoint, --observations and --output."
        )
    else:
        train()


def train() -> None:
    """Stage one of the task, and the report on its table."""
    domain = Domain.of(flag.load_task(flag.TASK.value), flag.SPLIT.value)
    run = train_representation(
        domain,
        Path(flag.RUNS.value),
        flag.REPRESENTATION.value,
        flag.BUDGET.value,
        seed=flag.SEED.value if flag.SEED.present else REPRESENTATION_SEED,
        assignments=flag.SET.value,
        workdir=Path(flag.WORKDIR.value) if flag.WORKDIR.value else None,
        overwrite=flag.OVERWRITE.value,
        num_recordings=NUM_RECORDINGS.value,
        stores_drawn=stores_drawn(),
    )
    if (run.path / TABLE_FILE).exists():
        table = RepresentationTable.load(run.path / TABLE_FILE)
        print_report(domain, run, table)


def encode_new_actions(checkpoint: Path, recordings: Path, output: Path) -> None:
    """Representations of recorded actions from a frozen encoder."""
    config, learner, state, play_format = load_encoder(checkpoint)
    new = observations.load_npz(recordings, play_format)
    table = RepresentationTable(
        vectors=learner.encode(state, new.data),
        ids=new.ids,
        universe_hash=new.universe_hash,
        split_hash=config.split_hash,
        source=f"{config.representation} of {checkpoint}, recordings of {recordings}",
    )
    table.save(output)
    print(f"{output}: {table.vectors.shape[0]} actions, {table.vectors.shape[1]} numbers each.")


if __name__ == "__main__":
    flag.run_command(main)
