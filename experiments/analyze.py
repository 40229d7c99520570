"""Studies of a trained policy, and the paper's search grids.

    python -m experiments.analyze --study=set-size --run=RUN,RUN
    python -m experiments.analyze --study=unseen-ratio --run=RUN,RUN
    python -m experiments.analyze --study=growing-set --run=RUN,RUN
    python -m experiments.analyze --study=recordings --run=RUN,RUN --encoder=EMBED_RUN
    python -m experiments.analyze --study=entropy --representation=gt12 --budget=paper
    python -m experiments.analyze --study=batch-size --representation=gt12 --budget=paper

The first four evaluate the best checkpoints of runs (a sweep stands for its members) and train
nothing; the last two train every value of the paper's grid with several seeds, and choose by
validation (paper appendix D, "Hyperparameter Search"). What is done already is not done again.
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments import _flags as flag
from experiments import _plots as plots
from experiments._studies import (
    GRIDS,
    STUDIES,
    Study,
    as_csv,
    as_markdown,
    search,
    study_figure,
    study_runs,
)

STUDY = flags.DEFINE_string(
    "study", None, f"What to study: {', '.join([*STUDIES, *GRIDS])}, or one of the task's own."
)
RUN = flags.DEFINE_list("run", [], "Runs of train or sweep to evaluate.")
ENCODER = flags.DEFINE_string("encoder", None, "Run of embed, for --study=recordings.")
VALUES = flags.DEFINE_list("values", [], "Values of the horizontal axis; default: the study's.")
EPISODES = flags.DEFINE_integer("episodes", 5000, "Episodes of each evaluation.")
SEEDS = flags.DEFINE_list("seeds", ["31", "41", "51", "61", "71", "81"], "Seeds of a search.")
STEPS = flags.DEFINE_float("steps", 0.0, "Environment steps of a search's runs; 0: of --budget.")
OUT = flags.DEFINE_string("out", None, "Where to write; default: `analysis/` beside the runs.")


def main() -> None:
    if STUDY.value is None:
        raise flag.UsageError(f"Say which: --study={'|'.join([*STUDIES, *GRIDS])}.")
    if STUDY.value in GRIDS:
        study = search(
            STUDY.value,
            [int(seed) for seed in SEEDS.value],
            STEPS.value,
            [float(value) for value in VALUES.value],
        )
        folder = Path(flag.RUNS.value) / flag.load_task(flag.TASK.value).name
    else:
        paths = [Path(path) for path in RUN.value]
        encoder = Path(ENCODER.value) if ENCODER.value else None
        values = [float(value) for value in VALUES.value]
        study = study_runs(STUDY.value, paths, values, EPISODES.value, encoder)
        folder = paths[0].parent
    for file in write(study, Path(OUT.value) if OUT.value else folder / "analysis"):
        print(file)


def write(study: Study, out: Path) -> list[Path]:
    """The study as a picture and as two tables."""
    name = study.name.replace("-", "_")
    out.mkdir(parents=True, exist_ok=True)
    text = as_markdown(study)
    print(text)
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    (out / f"{name}.csv").write_text(as_csv(study), encoding="utf-8")
    figures = plots.save(study_figure(study), out / f"{name}.png")
    return [*figures, out / f"{name}.md", out / f"{name}.csv"]


if __name__ == "__main__":
    flag.run_command(main)
