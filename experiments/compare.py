"""How far apart two ways of training are, by runs of the same splits and seeds.

python -m experiments.compare --run=A31,A41 --against=B31,B41 --sets=test

Each run plays the same episodes as the other one of its split and seed; the interval is a bootstrap
over splits, seeds and episodes. Nothing is trained or recorded.
"""

from __future__ import annotations

from experiments.flags import Arguments
from jaxnew.comparison import compare
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.run import Run
from jaxnew.task.places import UsageError

ARGUMENTS = Arguments(__doc__, "trust")
ARGUMENTS.define("list", "run", [], "Run directories of train.")
ARGUMENTS.define("list", "against", [], "As many, of the same splits and seeds.")
ARGUMENTS.define("list", "sets", ["test"], "Parts of the split: train, validation, test.")
ARGUMENTS.define("integer", "episodes", 5000, "Episodes of every run.", lower_bound=1)
ARGUMENTS.define("integer", "evaluation_seed", EVALUATION_SEED, "Seed of the episodes.")


def main() -> None:
    if not ARGUMENTS.run or not ARGUMENTS.against:
        raise UsageError(
            "Say what to compare with what: --run=DIRECTORY,... --against=DIRECTORY,..."
        )
    runs, others = (
        [Run.load(path) for path in given] for given in (ARGUMENTS.run, ARGUMENTS.against)
    )
    for part in ARGUMENTS.sets:
        asked = {"episodes": ARGUMENTS.episodes, "seed": ARGUMENTS.evaluation_seed}
        print(compare(runs, others, part, **asked), flush=True)


if __name__ == "__main__":
    ARGUMENTS.start(main)
