"""Questions about trained policies: answered from the record, else evaluated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.reports.runs import RunRecord
from jaxnew.results import Question
from jaxnew.run import Run
from jaxnew.task.places import check_output


@dataclass(frozen=True)
class Asked:
    """A question, and how it is evaluated.

    Attributes:
      question: what is asked.
      drawn_from: `run ->` arguments of `Run.evaluate` that say what sets are drawn from.
    """

    question: Question
    drawn_from: Callable[[Run], Mapping[str, Any]]

    @classmethod
    def part(cls, question: Question) -> Asked:
        """A question about a part of the split."""
        return cls(question, lambda run: {"parts": question.actions})

    def evaluate(self, run: Run, episodes: int) -> dict[str, Any]:
        """The answer, which goes on record."""
        asked = self.question
        evaluation = run.evaluate(
            **self.drawn_from(run),
            episodes=episodes,
            set_size=asked.set_size,
            grows_from=asked.first_size,
            growth=asked.growth,
            record=False,
        )
        (row,) = evaluation.rows.values()
        metric = run.task.selection_metric
        what = f"{asked.actions} actions, sets of {row['set_size']}"
        found = f"{metric} {row['metrics'][metric]['mean']:.4f}, done in {row['seconds']} s"
        print(f"{run.path}: {what}: {found}", flush=True)
        run.record(asked.actions, row)
        return dict(row)


def answers_of(
    record: RunRecord, asked: Sequence[Asked], episodes: int, num_workers: int = 0
) -> list[dict[str, Any]]:
    """An evaluation of a run's best checkpoint for each question.

    Args:
      record: of the run, which is loaded only if something is not on record.
      asked: the questions.
      episodes: at least so many of each.
      num_workers: processes for environments on the host; 0: one per core.
    """
    found = [record.answer(one.question, episodes) for one in asked]
    known = [row for row in found if row is not None]
    if len(known) == len(asked):
        return known
    check_output(record.path / "evaluation", "copy the run to where you may write")
    with Run.load(record.path, "best", num_workers=num_workers) as run:
        return [row or one.evaluate(run, episodes) for one, row in zip(asked, found, strict=True)]
