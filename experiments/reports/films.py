"""Zero-shot episodes of a trained policy as films, successes apart from failures (paper figure 8).

They are episodes of `evaluate`. On the host they are played twice, see `_host_episodes`; inside jit
their states are kept and drawn.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from experiments.pipeline.flags import UsageError
from experiments.pipeline.training import Trainer, load_state, load_trainer
from experiments.reports import plots
from experiments.reports.episode import play_episodes
from experiments.reports.host_episodes import check_film, play_host_episodes
from experiments.reports.plots import Metric
from experiments.reports.video import write_video
from jaxnew.ppo import TrainState
from jaxnew.task import Filming, MakeFilm

SUCCESS, FAILURE = "success", "failure"
_FILE = "episode-{:03d}"
_NUM_COLUMNS = 5
_GOOD, _BAD = "#1b7f4d", "#b3382c"


@dataclass(frozen=True)
class FilmedEpisode:
    """An episode and its pictures.

    Attributes:
      number: i of the evaluation.
      is_success: how it ended.
      action_ids: what was chosen.
      metrics: at its end.
      frames: uint8[height, width, 3] each.
      page: HTML, if it was asked for.
    """

    number: int
    is_success: bool
    action_ids: Sequence[int]
    metrics: dict[str, float]
    frames: Sequence[np.ndarray]
    page: str | None = None

    @property
    def outcome(self) -> str:
        """Of its folder."""
        return SUCCESS if self.is_success else FAILURE


@dataclass(frozen=True)
class Still:
    """What a sheet shows of an episode.

    Attributes:
      number, is_success: of the episode.
      value: of the task's selection metric, at its end.
      picture: uint8[height, width, 3] its last one.
    """

    number: int
    is_success: bool
    value: float
    picture: np.ndarray


def film_run(
    path: Path,
    out: Path,
    count: int,
    size: int = 512,
    suffix: str = ".gif",
    title: str = "",
    num_workers: int = 0,
    with_pages: bool = False,
) -> list[Path]:
    """Films of the best checkpoint's first episodes on sets of test actions.

    Into `out/success` and `out/failure` go, for every episode, its film, its first and its last
    picture, and its page; earlier ones are removed. Beside `out`, a sheet of the last pictures and
    a table.

    Args:
      path: a run of `train` or a member of `sweep`.
      out: folder.
      count: episodes.
      size: pixels of the pictures' height.
      suffix: .gif or .mp4.
      title: of the sheet.
      num_workers: processes for environments; 0: one per core.
      with_pages: whether to make an interactive page of each episode as well.

    Returns:
      The sheet, the table and the films.

    Raises:
      UsageError: the task's episodes cannot be drawn, or not as pages.
      ImportError: a package that films or pages need is missing.
      RuntimeError: an episode went another way when it was played again.
    """
    run, trainer, _ = load_trainer(path, num_workers)
    task = trainer.task
    with closing(trainer):
        state, _ = load_state(run, trainer, "best")
        episodes = filmed(trainer, state, count, size, with_pages)
        clear(out)
        rows, stills, films = [], [], []
        for episode in episodes:
            films.append(write_episode(episode, out, suffix))
            value = episode.metrics[task.selection_metric]
            stills.append(Still(episode.number, episode.is_success, value, episode.frames[-1]))
            rows.append(_row(episode, films[-1].relative_to(out.parent)))
    table = out.with_suffix(".csv")
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    if task.filming is not None and task.filming.criterion:
        metric = Metric.of(task.selection_metric)
        picture = ranked_sheet(stills, metric, task.filming.criterion, title)
    else:
        picture = sheet(stills, title)
    return [*plots.save(picture, out.with_suffix(".png")), table, *films]


def _row(episode: FilmedEpisode, film: Path) -> dict[str, Any]:
    """An episode in the table."""
    return {
        "episode": episode.number,
        "outcome": episode.outcome,
        "num_actions": len(episode.action_ids),
        **episode.metrics,
        "action_ids": " ".join(map(str, episode.action_ids)),
        "film": film,
    }


def filmed(
    trainer: Trainer, state: TrainState, count: int, size: int, with_pages: bool = False
) -> Iterator[FilmedEpisode]:
    """The first episodes on sets of test actions; each is drawn when it is asked for.

    Raises:
      UsageError: the task's episodes cannot be drawn, or not as pages.
    """
    host, filming = trainer.task.host, trainer.task.filming
    if with_pages and (filming is None or filming.make_page is None):
        raise UsageError(f"Task {trainer.task.name} has no interactive pages; omit --film_pages.")
    if host is not None and host.make_film is not None:
        return _filmed_on_host(host.make_film, trainer, state, count, size)
    if filming is not None:
        return _filmed_inside_jit(filming, trainer, state, count, size, with_pages)
    raise UsageError(f"Episodes of task {trainer.task.name} cannot be filmed.")


def _filmed_on_host(
    make_film: MakeFilm, trainer: Trainer, state: TrainState, count: int, size: int
) -> Iterator[FilmedEpisode]:
    for episode in play_host_episodes(trainer, state, "test", count):
        film = make_film(episode.seed, episode.ids, episode.positions, size=size)
        check_film(episode, film)
        is_success = episode.metrics[trainer.task.selection_metric] > 0
        ids = episode.ids.tolist()
        yield FilmedEpisode(episode.number, is_success, ids, episode.metrics, film.frames)


def _filmed_inside_jit(
    filming: Filming,
    trainer: Trainer,
    state: TrainState,
    count: int,
    size: int,
    with_pages: bool,
) -> Iterator[FilmedEpisode]:
    env = trainer.evaluator.env
    for e in play_episodes(trainer, state, "test", 0, count):
        frames = filming.draw(env, e.states, e.actions, e.rewards, size=size)
        page = None
        if with_pages and filming.make_page is not None:
            page = filming.make_page(env, e.states, e.actions)
        yield FilmedEpisode(e.number, e.is_success, e.action_ids, e.metrics, frames, page)


def clear(out: Path) -> None:
    """Removes films and pictures of an earlier call."""
    for outcome in (SUCCESS, FAILURE):
        (out / outcome).mkdir(parents=True, exist_ok=True)
        for file in (out / outcome).glob("episode-*"):
            file.unlink()


def write_episode(episode: FilmedEpisode, out: Path, suffix: str) -> Path:
    """An episode's film; beside it its first and last picture and its page. Returns the film."""
    stem = out / episode.outcome / _FILE.format(episode.number)
    for word, frame in (("start", episode.frames[0]), ("end", episode.frames[-1])):
        Image.fromarray(frame).save(stem.with_name(f"{stem.name}-{word}.png"))
    if episode.page is not None:
        stem.with_suffix(".html").write_text(episode.page, encoding="utf-8")
    return write_video(episode.frames, stem.with_suffix(suffix))


def sheet(stills: Sequence[Still], title: str = "") -> Figure:
    """The last pictures of all episodes, with their numbers and outcomes.

    Args:
      stills: of each.
      title: of the sheet; the share of successes is added.
    """
    figure, every = _grid(len(stills))
    for axes, still in zip(every, stills, strict=False):
        _show(axes, still)
        outcome = SUCCESS if still.is_success else FAILURE
        axes.set_title(f"episode {still.number}: {outcome}", fontsize=9, color=_color(still))
    _set_title(figure, title, stills, "successful")
    return figure


def ranked_sheet(
    stills: Sequence[Still], metric: Metric, criterion: str, title: str = ""
) -> Figure:
    """The last pictures of the best and of the worst episodes, with their metric below each.

    Args:
      stills: of all episodes; up to ten of them are shown, from best to worst.
      metric: of their values.
      criterion: of success.
      title: of the sheet; the share of successes is added.
    """
    ranked = sorted(stills, key=lambda still: -still.value)
    if len(ranked) > 2 * _NUM_COLUMNS:
        ranked = ranked[:_NUM_COLUMNS] + ranked[-_NUM_COLUMNS:]
    figure, every = _grid(len(ranked))
    for axes, still in zip(every, ranked, strict=False):
        _show(axes, still)
        text = f"{metric.text(still.value)}{metric.unit} (episode {still.number})"
        axes.set_xlabel(text, fontsize=9, color=_color(still))
    chosen = "" if len(ranked) == len(stills) else f", best and worst of {len(stills)}"
    _set_title(figure, f"{title}{chosen}", stills, criterion)
    return figure


def _grid(count: int) -> tuple[Figure, list[Axes]]:
    """A figure with room for so many pictures."""
    num_rows = -(-count // _NUM_COLUMNS)
    figure = plots.new_figure(2.4 * _NUM_COLUMNS, 2.6 * num_rows + 0.4)
    every = list(figure.subplots(num_rows, _NUM_COLUMNS, squeeze=False).ravel())
    for axes in every[count:]:
        axes.set_axis_off()
    return figure, every


def _show(axes: Axes, still: Still) -> None:
    axes.imshow(still.picture, interpolation="none")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color(plots.GRID_COLOR)


def _color(still: Still) -> str:
    return _GOOD if still.is_success else _BAD


def _set_title(figure: Figure, title: str, stills: Sequence[Still], criterion: str) -> None:
    share = f"{sum(still.is_success for still in stills)} of {len(stills)} {criterion}"
    plots.set_title(figure, f"{title} ({share})" if title else share)
