"""How a domain is shown: films, studies, anchors, and where it stands in the paper's results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxnew.actions import ActionUniverse
from jaxnew.rollout.contract import Episode


@dataclass(frozen=True)
class ActionStudy:
    """Pools of actions that a trained policy is evaluated on, from easy to hard.

    Attributes:
      axis: what `values` are.
      values: the paper's.
      ids: `(table f32[A, d], value) -> int32[n]` actions that sets are drawn from.
      note: the rule, for readers of the table.
      paper_method: `value ->` name of the row in the paper's results, or None if it has none.
      figure: number of the paper's figure, or empty.
    """

    axis: str
    values: tuple[float, ...]
    ids: Callable[[np.ndarray, float], np.ndarray]
    note: str
    paper_method: Callable[[float], str] | None = None
    figure: str = ""


@dataclass(frozen=True)
class Measured:
    """Speeds on one core of the machine that `docs/budgets.md` names; for foretelling durations.

    Attributes:
      training: environment steps per second by method; one that is absent is taken as `ours`.
      evaluation: episodes per second.
    """

    training: Mapping[str, float]
    evaluation: float


class Film(NamedTuple):
    """An episode to look at.

    Attributes:
      frames: uint8[height, width, 3] each, all of one size; the last one shows the end.
      metrics: of the episode, at the end; where it was played again they must be the same.
      make_page: makes the same as an interactive page, HTML; None where there is none.
    """

    frames: list[np.ndarray]
    metrics: Mapping[str, float]
    make_page: Callable[[], str] | None = None


class DrawEpisode(Protocol):
    """Draws an episode of `Run.play`.

    Args:
      environment: where it was played, or on the host its settings (`Task.environment`).
      episode: its states inside jit; on the host it is played again from its seed and actions.
      size: pixels of the frames' height, about.
    """

    def __call__(self, environment: Any, episode: Episode, /, *, size: int) -> Film: ...


@dataclass(frozen=True)
class Filming:
    """How episodes are shown.

    Attributes:
      draw: see `DrawEpisode`.
      success_from: an episode whose `Task.selection_metric` is at least this is a success.
      criterion: the same in words, where the metric is not success itself. The sheet of an
        evaluation's last pictures then shows the best and the worst of them.
      frame_ms: milliseconds that a frame is shown.
      has_pages: films come with a page, see `Film`.
    """

    draw: DrawEpisode
    success_from: float = 1.0
    criterion: str = ""
    frame_ms: int = 60
    has_pages: bool = False

    def is_success(self, value: float) -> bool:
        """Whether an episode with this value of `Task.selection_metric` is shown as a success."""
        return value >= self.success_from


@dataclass(frozen=True)
class Presentation:
    """What reports need of a domain. Nothing that is trained or evaluated depends on it.

    Attributes:
      paper_environment: name of the domain in the paper's results, or None.
      paper_variant: what the paper's results append to the names of methods for this variant of the
        domain, such as `no_subgoal_reward`; empty for the domain itself.
      measured: speeds, or None where nobody measured them.
      representation_targets: `universe -> {name: f[A, k]}`, what a linear map of a good
        representation should explain.
      studies: what `analyze` offers for this task beside what it offers for every one.
      filming: how episodes are shown, or None where they cannot be drawn.
      anchors: `package.module:NAME` of what `anchors` plays without training; None: nothing.
    """

    paper_environment: str | None = None
    paper_variant: str = ""
    measured: Measured | None = None
    representation_targets: Callable[[ActionUniverse], Mapping[str, np.ndarray]] | None = None
    studies: Mapping[str, ActionStudy] = field(default_factory=dict)
    filming: Filming | None = None
    anchors: str | None = None
