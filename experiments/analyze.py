"""Studies of a trained policy, and the paper's search grids.

    python -m experiments.analyze --study=set-size --run=RUN,RUN
    python -m experiments.analyze --study=unseen-ratio --run=RUN,RUN
    python -m experiments.analyze --study=growing-set --run=RUN,RUN
    python -m experiments.analyze --study=recordings --run=RUN,RUN --encoder=EMBED_RUN
    python -m experiments.analyze --study=entropy --representation=gt12 --budget=paper
    python -m experiments.analyze --study=batch-size --representation=gt12 --budget=paper

The first four, and a task's own studies (figures 9a to 9c: `angle`, `embedding` and `mix` of runs
of `create-push-analysis`), evaluate the best checkpoints of runs (a sweep stands for its members)
and train nothing; the last two train every value of the paper's grid with several seeds, and choose
by validation (paper appendix D, "Hyperparameter Search"), after a list of the commands with the
time that they take (`--dry_run`: the list only). What is done already is not done again.
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments.pipeline import flags as flag
from experiments.reports.searches import GRIDS, search
from experiments.reports.studies import STUDIES, study_runs
from experiments.reports.study_report import Study, write_study

STUDY = flags.DEFINE_string(
    "study", None, f"What to study: {', '.join([*STUDIES, *GRIDS])}, or one of the task's own."
)
RUN = flags.DEFINE_list("run", [], "Runs of train or sweep to evaluate.")
ENCODER = flags.DEFINE_string("encoder", None, "Run of embed, for --study=recordings.")
VALUES = flags.DEFINE_list("values", [], "Values of the horizontal axis; default: the study's.")
EPISODES = flags.DEFINE_integer("episodes", 5000, "Episodes of each evaluation.")
SEEDS = flags.DEFINE_list("seeds", ["31", "41", "51", "61", "71", "81"], "Seeds of a search.")
STEPS = flags.DEFINE_float("steps", 0.0, "Environment steps of a search's runs; 0: of --budget.")
DRY_RUN = flags.DEFINE_bool("dry_run", False, "Of a search, only say what is missing.")
REPRESENTATION_BUDGET = flags.DEFINE_string(
    "representation_budget", None, "Budget of a search's representation; default: --budget."
)
OUT = flags.DEFINE_string("out", None, "Where to write; default: `analysis/` beside the runs.")


def main() -> None:
    if STUDY.value is None:
        raise flag.UsageError(f"Say which: --study={'|'.join([*STUDIES, *GRIDS])}.")
    if STUDY.value in GRIDS:
        searched = search(
            STUDY.value,
            [int(seed) for seed in SEEDS.value],
            STEPS.value,
            [float(value) for value in VALUES.value],
            REPRESENTATION_BUDGET.value,
            DRY_RUN.value,
        )
        if searched is None:
            return
        study: Study = searched
        folder = Path(flag.RUNS.value) / flag.load_task(flag.TASK.value).name
    else:
        paths = [Path(path) for path in RUN.value]
        encoder = Path(ENCODER.value) if ENCODER.value else None
        values = [float(value) for value in VALUES.value]
        study = study_runs(STUDY.value, paths, values, EPISODES.value, encoder, flag.WORKERS.value)
        folder = paths[0].parent
    out = Path(OUT.value) if OUT.value else folder / "analysis"
    for file in write_study(study, out, study.name.replace("-", "_")):
        print(file)


if __name__ == "__main__":
    flag.run_command(main)
