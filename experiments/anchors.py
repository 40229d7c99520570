"""What policies without training reach: anchors for the results.

    python -m experiments.anchors --sets=train,test --set_sizes=50,500
    python -m experiments.anchors --task=shape_stacking --sets=train,validation,test --episodes=500

Of the Recommender, those that know products and tastes; of Shape Stacking (and of
`shape_stacking-no-place` and `shape_stacking-2d-place`), stopping, random play and a script. The
anchors of Shape Stacking are kept beside its runs, where `figures` finds them.
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.training import EVALUATION_SEED
from experiments.reports.anchors import FOLDER, Anchors, Summary, table_header, table_row

_STACKING = "shape_stacking"


def define_flags() -> None:
    """Flags of the command; not at import, since other commands have flags of these names."""
    flags.DEFINE_list("sets", ["train", "test"], "Parts of the split.")
    flags.DEFINE_list("set_sizes", [], "Actions in a set; default: 50,500, or as in training.")
    flags.DEFINE_integer("episodes", 0, "Episodes of each anchor; 0: 5000, or 500 of stacking.")
    flags.DEFINE_string("physics", "auto", "Engine that stacks; see engines.make_engine.")
    flags.DEFINE_string("out", None, "Folder of the file; default: anchors/ beside the runs.")
    flags.set_default(flag.TASK, "recommender")


def main() -> None:
    values = flags.FLAGS
    task = flag.load_task(flag.TASK.value)
    sizes = [int(size) for size in values.set_sizes]
    if task.name == "recommender":
        domain = Domain.of(task, flag.SPLIT.value)
        recommend(domain, values.sets, sizes, values.episodes)
    elif task.actions_name == _STACKING:
        domain = Domain.of(task, flag.SPLIT.value)
        default = Path(flag.RUNS.value) / task.name / FOLDER
        out = Path(values.out) if values.out else default
        print(stack(domain, values.physics, values.sets, sizes, values.episodes, out))
    else:
        raise flag.UsageError(
            f"Task {task.name} has no anchors; there are those of recommender and {_STACKING}."
        )


def recommend(domain: Domain, parts: list[str], sizes: list[int], episodes: int) -> None:
    """Prints the anchors of the Recommender."""
    from experiments.untrained import recommender

    sizes, episodes = sizes or list(recommender.SET_SIZES), episodes or recommender.EPISODES
    for line in recommender.lines(domain, parts, sizes, episodes):
        print(line, flush=True)


def stack(
    domain: Domain, physics: str, parts: list[str], sizes: list[int], episodes: int, out: Path
) -> Path:
    """Prints the anchors of a variant of Shape Stacking and keeps them.

    Args:
      physics: see `engines.make_engine`.
      parts: of the split.
      sizes: none for sets as in training, or one.
      episodes: of each; 0 for the default.
      out: folder of the file, which is written anew after every line.

    Returns:
      The file.

    Raises:
      UsageError: several sizes.
    """
    from envs_mjx.shape_stacking.engines import make_engine
    from experiments.untrained import stacking

    if len(sizes) > 1:
        raise flag.UsageError(f"A file of anchors has sets of one size; got {sizes}.")
    engine = make_engine(physics)
    size = sizes[0] if sizes else domain.task.stage_two["paper"].ppo.rollout.set_size
    episodes = episodes or stacking.EPISODES
    print("\n".join(table_header(stacking.METRICS)), flush=True)
    found: dict[str, dict[str, Summary]] = {}
    path = out
    for policy, part, summary in stacking.summaries(domain, engine, parts, size, episodes):
        print(table_row(policy, part, summary), flush=True)
        found.setdefault(policy, {})[part] = summary
        names = domain.task.name, domain.split_name, engine.name
        path = Anchors(*names, size, episodes, EVALUATION_SEED, found).save(out)
    return path


if __name__ == "__main__":
    define_flags()
    flag.run_command(main)
