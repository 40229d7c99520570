"""What evaluations of a run found: as tables, and on record in its directory."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.storage.checkpoint import KINDS, Checkpointer
from jaxnew.storage.run_directory import RunDirectory, RunDirectoryError

_WIDTH = 80  # Columns of a terminal.
_SLUG = 80  # Letters of a file's name that say what sets were drawn from.
# What tells questions about a run apart; answers differ in step and number of episodes as well.
_QUESTION = (
    *("actions", "checkpoint", "policy", "set_size", "first_size", "growth"),
    "evaluation_seed",
)


@dataclass(frozen=True)
class Question:
    """What an evaluation tells: how a policy does on sets of some actions.

    Attributes:
      actions: name of what sets are drawn from, such as a part of the split.
      set_size: m; None for all that there are.
      first_size, growth: of a set that grows during the episode, see `Actions.first_size`.
      checkpoint: whose policy.
      policy: `sampled` or `greedy`.
    """

    actions: str
    set_size: int | None
    first_size: int = 0
    growth: int = 1
    checkpoint: str = "best"
    policy: str = "sampled"

    def is_answered_by(self, evaluation: Mapping[str, Any], episodes: int = 1) -> bool:
        """Whether an evaluation on record is the one.

        Args:
          evaluation: what `Run.record` wrote.
          episodes: it has at least so many, of the seed that all runs share.
        """
        size, whole = evaluation["set_size"], evaluation.get("num_actions", float("inf"))
        first_size = evaluation.get("first_size", 0)
        return (
            (evaluation["actions"], evaluation["checkpoint"], evaluation["policy"])
            == (self.actions, self.checkpoint, self.policy)
            and (size >= whole if self.set_size is None else size == self.set_size)
            and first_size == self.first_size
            and (not first_size or evaluation["growth"] == self.growth)
            and evaluation["num_episodes"] >= episodes
            and evaluation.get("evaluation_seed", EVALUATION_SEED) == EVALUATION_SEED
        )


@dataclass(frozen=True)
class Evaluation:
    """Numbers of one checkpoint, by list of actions; prints as a table of 80 columns.

    Attributes:
      title: which checkpoint of which run.
      rows: by name of the actions what `to_dict` returns.
      problems: why results are not on record that should be.
    """

    title: str
    rows: Mapping[str, Mapping[str, Any]]
    problems: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """By name of the actions: `metrics`, that of selection first, each with `mean`, `low`,
        `high` and the kind of `interval` over episodes; `num_episodes`, `num_actions`, `set_size`,
        `policy`, `evaluation_seed` and `seconds`.
        """
        return {name: dict(row) for name, row in self.rows.items()}

    def __str__(self) -> str:
        rows = self.rows.values()
        played = dict.fromkeys(f"{r['num_episodes']:,} {r['policy']}" for r in rows)
        about = f"{', '.join(played)} episodes each; mean [95 % interval over episodes]"
        names = ["", *self.rows]
        columns = []
        for metric in dict.fromkeys(metric for row in rows for metric in row["metrics"]):
            columns.append([metric, *(_cell(row["metrics"].get(metric)) for row in rows)])
        lines = [self.title, about, *_table(names, columns)]
        lines += [
            f"{name}: {row['num_actions']} actions of {row['universe']}, {row['num_seen']} seen in "
            f"training, e.g. {'; '.join(row['examples'])}"
            for name, row in self.rows.items()
            if "num_seen" in row
        ]
        return "\n".join([*lines, *self.problems])


def _cell(value: Mapping[str, Any] | None) -> str:
    """A metric with its interval."""
    if value is None:
        return "-"
    return "{} [{}, {}]".format(*(_number(value[key]) for key in ("mean", "low", "high")))


def _number(value: float) -> str:
    """About four digits, of shares the decimals."""
    digits = len(str(int(abs(value)))) if math.isfinite(value) and abs(value) >= 1 else 0
    return f"{value:.{max(1, 4 - digits)}f}"


def _table(names: Sequence[str], columns: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; columns that do not fit a terminal stand below, after the names again."""
    lines: list[str] = []
    first, width = max(map(len, names)), 0
    for cells in columns:
        size = max(map(len, cells))
        if not lines or width + 2 + size > _WIDTH:
            lines += [name.ljust(first) for name in names]
            width = first
        width += 2 + size
        here = len(lines) - len(names)
        lines[here:] = [
            f"{line}  {cell:>{size}}" for line, cell in zip(lines[here:], cells, strict=True)
        ]
    return lines


def label(content: Mapping[str, Any]) -> str:
    """A question in words: about what, of which policy, on sets of how many."""
    known = {"evaluation_seed": EVALUATION_SEED, **content}
    words = "{actions}-{checkpoint}-{policy}-m{set_size}".format(**known)
    if "first_size" in known:
        words += "-from{first_size}-by{growth}".format(**known)
    if known["evaluation_seed"] != EVALUATION_SEED:
        words += "-seed{evaluation_seed}".format(**known)
    return words


def question_of(content: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a result answers; of several answers, that with more episodes says more."""
    known = {"evaluation_seed": EVALUATION_SEED, **content}
    return tuple(known.get(name) for name in _QUESTION)


def file_stem(content: Mapping[str, Any]) -> str:
    """What a result is called: words, and a hash by which different questions have files of their
    own, whatever letters the names have that a user gave.
    """
    words = label({**content, "actions": str(content["actions"])[:_SLUG]})
    slug = re.sub(r"[^A-Za-z0-9._]+", "-", words).strip("-._") or "actions"
    question = [*question_of(content), content.get("step"), content.get("num_episodes")]
    return f"{slug}-{hashlib.sha256(json.dumps(question).encode()).hexdigest()[:8]}"


def on_record(path: Path) -> list[dict[str, Any]]:
    """The answers in a run directory that are about its checkpoints as they are now: to each
    question the one with most episodes, and for a policy by another name that of the latest step.

    Raises:
      RunDirectoryError: a file is damaged.
    """
    checkpointer = Checkpointer(path / "checkpoints")
    newest = {kind: max(checkpointer.steps(kind), default=None) for kind in KINDS}
    found = []
    for name, content in RunDirectory.load(path).evaluations().items():
        if "actions" not in content or "metrics" not in content:
            continue
        _check_intervals(path / "evaluation" / f"{name}.json", content["metrics"])
        now = newest.get(content["checkpoint"])
        if now in (None, content.get("step")):
            found.append(content)
    found.sort(key=lambda content: (content.get("step", 0), content["num_episodes"]))
    return list({question_of(content): content for content in found}.values())


def _check_intervals(file: Path, metrics: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises unless every mean lies in its interval, but for what rounding does."""
    for name, value in metrics.items():
        low, mean, high = (float(value.get(key, math.nan)) for key in ("low", "mean", "high"))
        slack = 1e-6 * (1.0 + abs(mean))
        if not low - slack <= mean <= high + slack:
            raise RunDirectoryError(
                f"{file} is damaged: the mean of {name}, {mean:g}, is not in its interval "
                f"[{low:g}, {high:g}]. Restore it from a copy, or move it away and evaluate again."
            )
