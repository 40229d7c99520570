"""What policies without training reach, kept in files that the figures of runs find."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from experiments.reports import tables
from experiments.reports.plots import Metric
from experiments.reports.runs import Group
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.storage import config as config_lib
from jaxnew.storage.files import read_json, write_json_atomically
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.task.task import Task

FOLDER = "anchors"  # Beside the runs of the task.

# Metric -> mean, low and high, as of `jaxnew.evaluation.summarize`.
Summary = Mapping[str, Mapping[str, Any]]


class Line(NamedTuple):
    """One policy on one part of the split: what `Presentation.anchors` yields.

    It is called with a `Domain`, parts of the split, set sizes and a number of episodes (none and 0
    for its own choice), and settings of the environment.

    Attributes:
      policy, part: which.
      set_size, num_episodes: what was played.
      engine: that simulated, empty where there is one only.
      summary: the metrics that count.
    """

    policy: str
    part: str
    set_size: int
    num_episodes: int
    engine: str
    summary: Summary


@dataclass(frozen=True)
class Anchors:
    """The anchors of one task on one split, one engine and sets of one size.

    Attributes:
      task, split, engine: their names.
      set_size: actions in a set.
      num_episodes: of every policy on every part of the split.
      seed: of the episodes, which are those of `evaluate`.
      values: by policy and part of the split.
      split_seed: of the split.
      environment: settings that are not the task's.
    """

    task: str
    split: str
    engine: str
    set_size: int
    num_episodes: int
    seed: int
    values: dict[str, dict[str, Summary]]
    split_seed: int = 0
    environment: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, domain: Domain, settings: Any, line: Line) -> Anchors:
        """Those that a line belongs to, still without values."""
        changed = changed_settings(domain.task, config_lib.plain(settings))
        size, episodes, split = line.set_size, line.num_episodes, domain.split_name
        names = domain.task.name, split, line.engine
        return cls(*names, size, episodes, EVALUATION_SEED, {}, domain.split_seed, changed)

    def path(self, folder: Path) -> Path:
        """Their file in a folder."""
        words = [self.split, f"split{self.split_seed}" * bool(self.split_seed), self.engine]
        words += [f"{name}={value}" for name, value in self.environment.items()]
        return folder / f"{'-'.join(filter(None, words))}-m{self.set_size}.json"

    def save(self, folder: Path) -> Path:
        """Writes them into a folder, in place of those that are like them."""
        folder.mkdir(parents=True, exist_ok=True)
        path = self.path(folder)
        write_json_atomically(path, asdict(self))
        return path

    @classmethod
    def load(cls, path: Path) -> Anchors:
        """Reads what `save` wrote.

        Raises:
          UsageError: the file holds something else.
        """
        try:
            return cls(**read_json(path, UsageError))
        except TypeError as err:
            raise UsageError(
                f"{path} is damaged ({err}). Restore it from a copy, or make it anew with anchors."
            ) from err

    def heading(self, metrics: Sequence[str]) -> list[str]:
        """What they are, and the head of their table."""
        engine = f", engine {self.engine}" if self.engine else ""
        title = (
            f"Policies without training, {self.task}, split {self.split}{engine}: "
            f"{self.num_episodes:,} episodes each on sets of {self.set_size}."
        )
        names = [f"{Metric.of(metric).name.lower()} [95 % interval]" for metric in metrics]
        cells = ["policy", "actions", *names]
        return [title, "", *tables.table(cells, [])]


def changed_settings(task: Task, plain: Mapping[str, Any] | None) -> dict[str, Any]:
    """Those settings of an environment that are not the task's."""
    default = config_lib.plain(task.environment) or {}
    return {name: value for name, value in (plain or {}).items() if value != default.get(name)}


def anchors_of(group: Group) -> list[Anchors]:
    """Those of a group's task, split and settings with sets as in its training, of all engines.

    They are looked for in the folder of the task that holds the runs. Of several that are alike,
    the newest counts.
    """
    parents = group.runs[0].path.parents
    folder = next((p / FOLDER for p in parents if p.name == group.task.name), None)
    files = [] if folder is None else sorted(folder.glob("*.json"), key=lambda f: f.stat().st_mtime)
    config = group.config
    changed = changed_settings(group.task, config.get("environment"))
    wanted = group.task.name, config["split"], config.get("split_seed", 0), changed
    newest = {
        anchors.engine: anchors
        for anchors in map(Anchors.load, files)
        if (anchors.task, anchors.split, anchors.split_seed, anchors.environment) == wanted
        and anchors.set_size == config["sets"]["size"]
    }
    return [newest[engine] for engine in sorted(newest)]


def lines_of(group: Group, part: str = "test") -> dict[str, float]:
    """Means of the selection metric on a part of the split, by policy (and engine, of several)."""
    found = anchors_of(group)
    return {
        policy + (f" ({anchors.engine})" if len(found) > 1 else ""): float(
            parts[part][group.task.selection_metric]["mean"]
        )
        for anchors in found
        for policy, parts in anchors.values.items()
        if part in parts
    }


def notes_of(groups: Sequence[Group]) -> list[str]:
    """The anchors of several groups as text below a table of results."""
    return list(dict.fromkeys(markdown(a) for group in groups for a in anchors_of(group)))


def markdown(anchors: Anchors) -> str:
    """Every policy on every part of the split, as a table under a line that says what they are."""
    rows = [
        table_row(policy, part, summary)
        for policy, parts in anchors.values.items()
        for part, summary in parts.items()
    ]
    metrics = next(iter(next(iter(anchors.values.values())).values()))
    return "\n".join([*anchors.heading(list(metrics)), *rows])


def table_row(policy: str, part: str, summary: Summary) -> str:
    """One policy on one part of the split."""
    cells = []
    for name, values in summary.items():
        mean, low, high = (Metric.of(name).text(values[key]) for key in ("mean", "low", "high"))
        cells.append(f"{mean} [{low}, {high}]")
    return tables.line([policy, part, *cells])
