"""Zero-shot episodes of a trained policy as films: many of them (paper figure 8), or one.

They are episodes of `evaluate`; a film that ends otherwise than its episode is refused.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from experiments.reports import plots, tables
from experiments.reports.plots import Metric
from experiments.reports.video import check_suffix, write_video
from jaxnew.rollout.contract import Episode
from jaxnew.rollout.device import DeviceRollout
from jaxnew.run import Run
from jaxnew.task.places import UsageError, check_output
from jaxnew.task.presentation import Film, Filming
from jaxnew.task.task import Task

SUCCESS, FAILURE = "success", "failure"
_NUM_COLUMNS = 5
_GOOD, _BAD = "#1b7f4d", "#b3382c"
_CANDIDATES = 50  # Episodes of which an animation shows the first success.
_SIZE = 360  # Pixels of an animation's height.


@dataclass(frozen=True)
class FilmOptions:
    """How the films of figure 8 are made.

    Attributes:
      count: episodes, from number 0.
      size: pixels of a side.
      suffix: .gif or .mp4.
      with_pages: an interactive page of each episode as well.
    """

    count: int = 20
    size: int = 512
    suffix: str = ".gif"
    with_pages: bool = False


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
    path: Path, out: Path, title: str = "", options: FilmOptions | None = None, num_workers: int = 0
) -> list[Path]:
    """Films the first episodes of a run's best checkpoint on sets of test actions.

    Args:
      path: of the run.
      out: folder of the films, in `success/` and `failure/`, with a first and a last picture beside
        each. `OUT.png` shows all last pictures, `OUT.csv` has a line per episode.
      title: of the sheet.
      options: default: 20 GIFs.
      num_workers: processes for environments on the host; 0: one per core.

    Returns:
      The sheet, the table and the films.

    Raises:
      UsageError: the task's episodes cannot be drawn, or not as pages; a package that films need is
        missing, or nothing can be written there.
      RuntimeError: an episode went another way when it was played again.
    """
    options = options or FilmOptions()
    with Run.load(path, "best", num_workers=num_workers) as run:
        filming, metric = check_films(run.task, options), run.task.selection_metric
        check_output(out)
        rows, stills, films = [], [], []
        # Films of an earlier call are there until all new ones are.
        with tempfile.TemporaryDirectory(dir=out, prefix=".new-") as name:
            for episode, film in filmed(run, run.play(count=options.count), options.size):
                value = episode.metrics[metric]
                still = Still(episode.number, filming.is_success(value), value, film.frames[-1])
                stills.append(still)
                outcome = SUCCESS if still.is_success else FAILURE
                file = _write(Path(name) / outcome, episode.number, film, filming, options)
                films.append(out / outcome / file.name)
                rows.append(_row(episode, outcome, films[-1].relative_to(out.parent)))
            _replace_films(out, Path(name))
    table = out.with_suffix(".csv")
    table.write_text(tables.csv_text(rows), encoding="utf-8")
    ranked = (Metric.of(metric), filming.criterion) if filming.criterion else ()
    picture = sheet(stills, title, *ranked)
    return [*plots.save(picture, out.with_suffix(".png")), table, *films]


def filming_of(task: Task) -> Filming:
    """How a task's episodes are shown.

    Raises:
      UsageError: they cannot be drawn.
    """
    if task.shown.filming is None:
        raise UsageError(f"Episodes of task {task.name} cannot be filmed.")
    return task.shown.filming


def check_films(task: Task, options: FilmOptions) -> Filming:
    """How a task's episodes are shown, if films of them can be made as they are asked for.

    Raises:
      UsageError: they cannot.
    """
    filming = filming_of(task)
    if options.with_pages and not filming.has_pages:
        raise UsageError(f"Task {task.name} has no interactive pages; omit --film_pages.")
    try:
        check_suffix(options.suffix)
    except ImportError as err:
        raise UsageError(str(err)) from err
    return filming


def filmed(run: Run, episodes: Sequence[Episode], size: int) -> Iterator[tuple[Episode, Film]]:
    """Episodes of a run, each with its film, which is drawn when it is asked for.

    Raises:
      UsageError: the task's episodes cannot be drawn.
      RuntimeError: one went another way when it was played again.
    """
    filming, rollout = filming_of(run.task), run.trainer.rollout
    place = rollout.env if isinstance(rollout, DeviceRollout) else run.task.environment
    for episode in episodes:
        film = filming.draw(place, episode, size=size)
        check_film(episode, film)
        yield episode, film


def check_film(episode: Episode, film: Film) -> None:
    """Refuses a film that does not end as its episode did.

    Raises:
      RuntimeError: it does not.
    """
    played = {name: value for name, value in episode.metrics.items() if name != "num_steps"}
    shown = {name: film.metrics[name] for name in played}
    if not np.allclose(list(shown.values()), list(played.values()), atol=1e-5, equal_nan=True):
        raise RuntimeError(
            f"Episode {episode.number} ended with {played}, and with {shown} when it was played "
            "again; the environment is not a function of its seed and its actions."
        )


def _replace_films(out: Path, new: Path) -> None:
    """Puts new films and pictures in the place of those of an earlier call."""
    for outcome in (SUCCESS, FAILURE):
        (out / outcome).mkdir(parents=True, exist_ok=True)
        for file in (out / outcome).glob("episode-*"):
            file.unlink()
        for file in (new / outcome).glob("episode-*"):
            file.rename(out / outcome / file.name)


def _write(folder: Path, number: int, film: Film, filming: Filming, options: FilmOptions) -> Path:
    """An episode's film; beside it its first and last picture and its page. Returns the film."""
    folder.mkdir(exist_ok=True)
    stem = folder / f"episode-{number:03d}"
    for word, frame in (("start", film.frames[0]), ("end", film.frames[-1])):
        Image.fromarray(frame).save(stem.with_name(f"{stem.name}-{word}.png"))
    if options.with_pages and film.make_page is not None:
        stem.with_suffix(".html").write_text(film.make_page(), encoding="utf-8")
    return write_video(film.frames, stem.with_suffix(options.suffix), filming.frame_ms)


def _row(episode: Episode, outcome: str, film: Path) -> dict[str, Any]:
    """An episode in the table."""
    return {
        "episode": episode.number,
        "outcome": outcome,
        "num_actions": len(episode.actions),
        **episode.metrics,
        "action_ids": " ".join(map(str, episode.action_ids)),
        "film": film,
    }


def animate_run(
    path: Path, out: Path, part: str = "test", episode: int | None = None
) -> list[Path]:
    """Films one episode of a run's best checkpoint and says how it went.

    Args:
      path: of the run.
      out: the animation, a GIF; its last picture has the same name with `.png`.
      part: of the split, that the available set is drawn from.
      episode: its number; None takes the first successful one of 0..49, and says so.

    Returns:
      The two files.

    Raises:
      UsageError: the task's episodes cannot be drawn.
    """
    with Run.load(path, "best") as run:
        filming, metric = filming_of(run.task), run.task.selection_metric
        check_output(out.parent)
        if episode is None:
            played = run.play(part, count=_CANDIDATES)
            number, how = choose([filming.is_success(e.metrics[metric]) for e in played])
            chosen = played[number]
        else:
            (chosen,) = run.play(part, episode)
            how = f"episode {episode}, as asked for"
        ((_, film),) = filmed(run, [chosen], _SIZE)
        names = run.task.make_universe().action_names
        seen = np.isin(chosen.available_ids, run.split.train).sum()
        outcome = "success" if filming.is_success(chosen.metrics[metric]) else "no success"
        print(
            f"{out}: {how}; sets of {len(chosen.available_ids)} {part} actions, {seen} of them "
            f"seen in training; {outcome} with {', '.join(names[i] for i in chosen.action_ids)}, "
            f"return {sum(chosen.rewards):.3f}."
        )
    write_video(film.frames, out, filming.frame_ms)
    Image.fromarray(film.frames[-1]).save(out.with_suffix(".png"))
    return [out, out.with_suffix(".png")]


def choose(successes: Sequence[bool]) -> tuple[int, str]:
    """The first success, or 0 if there is none; and how it was chosen."""
    numbers = f"episodes 0..{len(successes) - 1}"
    if not any(successes):
        return 0, f"episode 0: none of {numbers} was successful"
    first, share = successes.index(True), f"{sum(successes)} of {len(successes)} were"
    return first, f"episode {first}, first successful of {numbers} ({share})"


def sheet(
    stills: Sequence[Still],
    title: str = "",
    metric: Metric | None = None,
    criterion: str = "successful",
) -> Figure:
    """The last pictures of episodes in rows of five, labelled in the colours of their outcomes.

    Args:
      stills: of all episodes.
      title: of the sheet; the share of successes is added.
      metric: up to ten are shown, from best to worst, with their values of it. None: all of them,
        with their outcomes.
      criterion: of success.
    """
    share = f"{sum(still.is_success for still in stills)} of {len(stills)} {criterion}"
    if metric is None:
        shown = list(stills)
        labels = [f"episode {s.number}: {SUCCESS if s.is_success else FAILURE}" for s in shown]
    else:
        shown = sorted(stills, key=lambda still: -still.value)
        if len(shown) > 2 * _NUM_COLUMNS:
            shown = shown[:_NUM_COLUMNS] + shown[-_NUM_COLUMNS:]
            title += f", best and worst of {len(stills)}"
        labels = [f"{metric.text(s.value)}{metric.unit} (episode {s.number})" for s in shown]
    num_rows = -(-len(shown) // _NUM_COLUMNS)
    title = f"{title} ({share})" if title else share
    figure = plots.new_figure(2.4 * _NUM_COLUMNS, 2.6 * num_rows + 0.4, title)
    every = figure.subplots(num_rows, _NUM_COLUMNS, squeeze=False).ravel()
    for axes, still, label in zip(every, shown, labels, strict=False):
        axes.imshow(still.picture, interpolation="none")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_color(plots.GRID_COLOR)
        axes.set_title(label, fontsize=9, color=_GOOD if still.is_success else _BAD)
    for axes in every[len(shown) :]:
        axes.set_axis_off()
    return figure
