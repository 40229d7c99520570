"""How far apart two ways of training are, by runs of the same splits and seeds.

python -m experiments.compare --run=A31,A41 --against=B31,B41 --sets=test

Each run plays the same episodes as the other one of its split and seed. Nothing is recorded.
"""

from __future__ import annotations

from contextlib import ExitStack

from experiments.flags import Arguments
from jaxnew.comparison import compare
from jaxnew.run import Run

ARGUMENTS = Arguments(__doc__, "workers", "trust", "debug_nans")
ARGUMENTS.define("list", "run", [], "Run directories of train.")
ARGUMENTS.define("list", "against", [], "As many, of the same splits and seeds.")
ARGUMENTS.define("list", "sets", ["test"], "Parts of the split: train, validation, test.")
ARGUMENTS.define("integer", "episodes", 5000, "Episodes of every run.", lower_bound=1)


def main() -> None:
    with ExitStack() as stack:
        runs, others = (
            [stack.enter_context(Run.load(path, num_workers=ARGUMENTS.workers)) for path in given]
            for given in (ARGUMENTS.run, ARGUMENTS.against)
        )
        for part in ARGUMENTS.sets:
            print(compare(runs, others, part, episodes=ARGUMENTS.episodes), flush=True)


if __name__ == "__main__":
    ARGUMENTS.start(main)
