"""What policies without training reach, kept in files that the figures of runs find."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experiments.pipeline.flags import UsageError
from experiments.reports.plots import Metric
from experiments.reports.runs import Group

FOLDER = "anchors"  # Beside the runs of the task.

# Metric -> mean, low and high, as of `jaxnew.evaluation.summarize`.
Summary = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Anchors:
    """The anchors of one task on one split and one engine.

    Attributes:
      task, split, engine: their names.
      set_size: actions in a set.
      num_episodes: of every policy on every part of the split.
      seed: of the episodes, which are those of `evaluate`.
      values: by policy and part of the split.
    """

    task: str
    split: str
    engine: str
    set_size: int
    num_episodes: int
    seed: int
    values: Mapping[str, Mapping[str, Summary]]

    def save(self, folder: Path) -> Path:
        """Writes them into a folder, in place of those of the same split and engine."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.split}-{self.engine}.json"
        path.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")
        return path

    @classmethod
    def load(cls, path: Path) -> Anchors:
        """Reads what `save` wrote.

        Raises:
          UsageError: the file holds something else.
        """
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except (TypeError, ValueError) as err:
            raise UsageError(
                f"{path} is damaged ({err}); delete it, and make it anew with experiments.anchors."
            ) from err


def anchors_of(group: Group) -> list[Anchors]:
    """Those of a group's task and split with sets as in its training, of all engines.

    They are looked for in the folder of the task that holds the runs.
    """
    parents = group.runs[0].path.parents
    folder = next((p / FOLDER for p in parents if p.name == group.task.name), None)
    files = [] if folder is None else sorted(folder.glob("*.json"))
    every = [Anchors.load(file) for file in files]
    size = int(group.config["ppo"]["rollout"]["set_size"])
    wanted = group.task.name, group.config["split"], size
    return [a for a in every if (a.task, a.split, a.set_size) == wanted]


def lines_of(group: Group, part: str = "test") -> dict[str, float]:
    """Means of the selection metric on a part of the split, by policy (and engine, of several)."""
    found = anchors_of(group)
    lines = {}
    for anchors in found:
        end = f" ({anchors.engine})" if len(found) > 1 else ""
        for policy, parts in anchors.values.items():
            if part in parts:
                lines[policy + end] = float(parts[part][group.task.selection_metric]["mean"])
    return lines


def notes_of(groups: Sequence[Group]) -> list[str]:
    """The anchors of several groups as text below a table of results."""
    distinct = {
        (anchors.task, anchors.split, anchors.engine): anchors
        for group in groups
        for anchors in anchors_of(group)
    }
    return [markdown(anchors) for anchors in distinct.values()]


def markdown(anchors: Anchors) -> str:
    """Every policy on every part of the split, as a table under a line that says what they are."""
    rows = [
        table_row(policy, part, summary)
        for policy, parts in anchors.values.items()
        for part, summary in parts.items()
    ]
    metrics = next(iter(next(iter(anchors.values.values())).values()))
    title = (
        f"Policies without training, {anchors.task}, split {anchors.split}, engine "
        f"{anchors.engine}: {anchors.num_episodes:,} episodes each on sets of {anchors.set_size}."
    )
    return "\n".join([title, "", *table_header(list(metrics)), *rows])


def table_header(metrics: Sequence[str]) -> list[str]:
    """The first two lines of a table of anchors."""
    names = [f"{Metric.of(metric).name.lower()} [95 % interval]" for metric in metrics]
    return [_line(["policy", "actions", *names]), _line(["---"] * (2 + len(names)))]


def table_row(policy: str, part: str, summary: Summary) -> str:
    """One policy on one part of the split."""
    cells = []
    for name, values in summary.items():
        mean, low, high = (Metric.of(name).text(values[key]) for key in ("mean", "low", "high"))
        cells.append(f"{mean} [{low}, {high}]")
    return _line([policy, part, *cells])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
