"""What policies without training reach: anchors for the results of a task that has some.

    python -m experiments.anchors --sets=train,test --set_sizes=50,500
    python -m experiments.anchors --task=shape_stacking --sets=train,validation,test --episodes=500

They play the episodes of `evaluate`. The numbers are kept beside the task's runs, where `figures`
finds them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from experiments.flags import Arguments
from experiments.reports.anchors import FOLDER, Anchors, Line, table_row
from jaxnew.storage import config as config_lib
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError, check_output, load_place

ARGUMENTS = Arguments(__doc__, "split", "split_seed", "runs", "debug_nans")
ARGUMENTS.define("string", "task", "recommender", "Task name, or package.module:TASK.")
ARGUMENTS.define("list", "sets", ["train", "test"], "Parts of the split.")
ARGUMENTS.define("integers", "set_sizes", [], "Actions in a set; default: the task's own choice.")
ARGUMENTS.define("integer", "episodes", 0, "Of each anchor; 0: the task's own choice.")
ARGUMENTS.define("string", "out", None, "Folder of the files; default: anchors/ beside the runs.")
ARGUMENTS.define("multi_string", "set", [], "environment.FIELD=value, settings of the environment.")


def main() -> None:
    domain = Domain.of(load_task(ARGUMENTS.task), ARGUMENTS.split, ARGUMENTS.split_seed)
    out = Path(ARGUMENTS.out or domain.folder(Path(ARGUMENTS.runs)) / FOLDER)
    for file in measure_anchors(
        domain, ARGUMENTS.sets, ARGUMENTS.set_sizes, ARGUMENTS.episodes, out, ARGUMENTS.set
    ):
        print(file)


def measure_anchors(
    domain: Domain,
    parts: list[str],
    sizes: list[int],
    episodes: int,
    out: Path,
    assignments: config_lib.Assignments = (),
) -> list[Path]:
    """Prints the anchors of a task, and keeps them in a file for each size of sets.

    Args:
      domain: the task and its split.
      parts: of the split.
      sizes: of sets; none for the task's own choice.
      episodes: of each anchor on each part; 0 likewise.
      out: folder of the files, which are written anew after every line.
      assignments: `environment.FIELD`, settings of the environment.

    Raises:
      UsageError: the task has no anchors, or nothing can be written there.
      ConfigError: there is no such setting, or it takes no such value.
    """
    task = domain.task
    if task.shown.anchors is None:
        raise UsageError(f"Task {task.name} has no policies without training to measure.")
    measure = load_place(task.shown.anchors, f"anchors of {task.name}", "See Task.shown.anchors.")
    config_type = dataclasses.make_dataclass(
        "AnchorConfig", [("environment", type(task.environment))], frozen=True
    )
    settings = config_lib.set_paths(config_type(task.environment), assignments).environment
    found: dict[int, Anchors] = {}
    line: Line
    check_output(out)
    for line in measure(domain, parts, sizes, episodes, settings):
        if line.set_size not in found:
            found[line.set_size] = Anchors.of(domain, settings, line)
            print("\n".join(["", *found[line.set_size].heading(list(line.summary))]))
        anchors = found[line.set_size]
        anchors.values.setdefault(line.policy, {})[line.part] = line.summary
        print(table_row(line.policy, line.part, line.summary), flush=True)
        anchors.save(out)
    return [anchors.path(out) for anchors in found.values()]


if __name__ == "__main__":
    ARGUMENTS.start(main)
