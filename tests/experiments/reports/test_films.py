"""Films of zero-shot episodes show the episodes of the evaluation."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from envs_host.create.films import episode_frames
from envs_host.create.hosting import CreateHost
from envs_host.create.illustration import RenderOptions
from envs_mjx.shape_stacking import ShapeStacking
from envs_mjx.shape_stacking import films as towers
from envs_mjx.shape_stacking.camera import task_camera
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.reports import films
from experiments.reports.films import FilmOptions, Still, animate_run, check_film, choose, film_run
from experiments.reports.plots import Metric
from jaxnew import trainer as trainer_module
from jaxnew.evaluation import measure
from jaxnew.rollout.contract import Episode, Rollout
from jaxnew.rollout.device import DeviceRollout
from jaxnew.run import Run
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from jaxnew.task.presentation import Film, Filming
from jaxnew.task.task import Task
from jaxnew.trainer import rollout_of
from tests.experiments.handwritten import untrained

HEIGHT = "final_height"


def measured(path: Path, count: int) -> dict[str, np.ndarray]:
    """The metrics of a run's first episodes on test sets."""
    with Run.load(path) as run:
        return measure(run.trainer.rollout, run.policy, run.trainer.actions("test"), count)


def last_frame(path: Path) -> np.ndarray:
    with Image.open(path) as film:
        film.seek(film.n_frames - 1)
        return np.asarray(film.convert("RGB"))


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("toy") / "run", "tests.toy_task:TASK", "gt4")


@pytest.mark.integration
def test_films_are_sorted_by_the_outcome_that_they_show(toy: Path, tmp_path: Path) -> None:
    old = tmp_path / "figure_8" / "success" / "episode-999.gif"
    old.parent.mkdir(parents=True)
    old.touch()
    files = film_run(toy, tmp_path / "figure_8", "Toy", FilmOptions(40, 16), 1)
    assert [file.name for file in files[:2]] == ["figure_8.png", "figure_8.csv"]
    assert not old.exists()
    expected = measured(toy, 40)
    with (tmp_path / "figure_8.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["is_success"]) for row in rows] == expected["is_success"].tolist()
    assert [float(row["num_actions"]) for row in rows] == expected["num_steps"].tolist()
    assert [float(r["episode_return"]) for r in rows] == expected["episode_return"].tolist()
    assert 0 < expected["is_success"].sum() < 40  # Both kinds, so that there is what to sort.
    for number, is_success in enumerate(expected["is_success"]):
        outcome, other = ("success", "failure") if is_success else ("failure", "success")
        film = tmp_path / "figure_8" / outcome / f"episode-{number:03d}.gif"
        assert rows[number]["film"] == f"figure_8/{outcome}/{film.name}"
        # The toy's last frame is green after a success and black otherwise.
        green = int(last_frame(film)[..., 1].min())
        assert (green > 200) == bool(is_success)
        end = np.asarray(Image.open(film.with_name(f"episode-{number:03d}-end.png")))
        assert end[0, 0].tolist() == ([0, 255, 0] if is_success else [0, 0, 0])
        start = np.asarray(Image.open(film.with_name(f"episode-{number:03d}-start.png")))
        assert start[..., 0].max() == 255
        assert not (tmp_path / "figure_8" / other / film.name).exists()


@pytest.mark.integration
def test_a_film_of_another_end_is_refused(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(environment: Any, episode: Episode, *, size: int) -> Film:
        other = {**episode.metrics, "is_success": 1.0 - episode.metrics["is_success"]}
        return Film([np.zeros((size, size, 3), np.uint8)], other)

    monkeypatch.setattr(films, "filming_of", lambda run: Filming(draw))
    old = tmp_path / "out" / "success" / "episode-000.gif"
    old.parent.mkdir(parents=True)
    old.write_text("a film of an earlier call")
    with pytest.raises(RuntimeError, match=r"Episode 0 ended with .* when it was played again"):
        film_run(toy, tmp_path / "out", options=FilmOptions(1, 16), num_workers=1)
    assert list((tmp_path / "out").rglob("*.*")) == [old], "it is there until there is another"


@pytest.mark.integration
def test_episodes_inside_jit_are_drawn_from_their_states(tmp_path: Path) -> None:
    path = untrained(tmp_path / "run", "grid_world", "gt12")
    film_run(path, tmp_path / "out", "Grid", FilmOptions(12, 90))
    expected = measured(path, 12)
    with (tmp_path / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in ("is_success", "episode_return", "episode_length"):
        assert [float(row[name]) for row in rows] == expected[name].tolist()
    for row, is_success, moves in zip(
        rows, expected["is_success"], expected["episode_length"], strict=True
    ):
        outcome = "success" if is_success else "failure"
        assert row["outcome"] == outcome
        assert row["film"] == f"out/{outcome}/episode-{int(row['episode']):03d}.gif"
        film = Image.open(tmp_path / row["film"])
        # A frame for every move, the start and the whole path; the format joins frames that are the
        # same.
        assert 0.5 * moves < film.n_frames <= 2 + moves
        end = np.asarray(
            Image.open((tmp_path / row["film"]).with_name(Path(row["film"]).stem + "-end.png"))
        )
        assert end.shape[1:] == (90, 3)


@pytest.mark.unit
def test_a_film_that_ends_otherwise_is_no_film_of_the_episode() -> None:
    metrics = {"is_success": 1.0, "r": 0.5, "num_steps": 2.0}
    played = Episode(3, [], [], metrics, np.zeros(0, np.int32))
    film = Film([], {"is_success": 1.0, "r": 0.5, "more": 7.0})
    check_film(played, film)
    lost = replace(played, metrics={**metrics, "is_success": 0.0})
    with pytest.raises(RuntimeError, match=r"Episode 3 ended with .* when it was played again"):
        check_film(lost, film)
    check_film(lost, Film([], {"is_success": 0.0, "r": 0.5}))


@pytest.mark.unit
def test_a_sheet_names_every_episode() -> None:
    stills = [
        Still(number, number == 1, 0.0, np.full((8, 8, 3), 20 * number, np.uint8))
        for number in range(7)
    ]
    figure = films.sheet(stills, "Figure 8")
    assert figure.get_suptitle() == "Figure 8 (1 of 7 successful)"
    shown = [(axes.get_title(), axes.images[0].get_array()[0, 0, 0]) for axes in figure.axes[:7]]
    assert shown[1] == ("episode 1: success", 20)
    assert shown[6] == ("episode 6: failure", 120)
    assert len(figure.axes) == 10
    assert not figure.axes[9].images


@pytest.mark.unit
def test_a_ranked_sheet_shows_the_best_and_the_worst() -> None:
    values = [0.5, 3.25, 1.0, 2.0, 0.25, 1.5, 2.5, 0.75, 3.0, 1.25, 1.75, 2.25]
    stills = [
        Still(number, value >= 1.5, value, np.full((8, 8, 3), 20 * number, np.uint8))
        for number, value in enumerate(values)
    ]
    figure = films.sheet(stills, "Figure 8", Metric.of("final_height"), "at least 1.5 m")
    title = "Figure 8, best and worst of 12 (7 of 12 at least 1.5 m)"
    assert figure.get_suptitle() == title
    shown = [(a.get_title(), int(a.images[0].get_array()[0, 0, 0]) // 20) for a in figure.axes]
    best = [1, 8, 6, 11, 3]
    worst = [9, 2, 7, 0, 4]
    assert [number for _, number in shown] == best + worst
    assert shown[0][0] == "3.250 m (episode 1)"
    assert shown[9][0] == "0.250 m (episode 4)"
    colors = [axes.title.get_color() for axes in figure.axes]
    assert len(set(colors[:5])) == len(set(colors[5:])) == 1
    assert colors[0] != colors[5]
    few = films.sheet(stills[:3], "Figure 8", Metric.of("final_height"), "at least 1.5 m")
    assert few.get_suptitle() == "Figure 8 (1 of 3 at least 1.5 m)"
    assert [axes.get_title()[:5] for axes in few.axes[:3]] == ["3.250", "1.000", "0.500"]


@pytest.mark.integration
def test_films_of_create_are_those_of_the_level(tmp_path: Path) -> None:
    path = untrained(tmp_path / "run", "create-push", "gt32")
    with Run.load(path, num_workers=1) as run:
        (episode,) = run.play()
        split = run.split
    film_run(path, tmp_path / "out", options=FilmOptions(1, 24), num_workers=1)
    with (tmp_path / "out.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["outcome"], row["film"]) == ("failure", "out/failure/episode-000.gif")
    assert row["action_ids"].split() == [str(i) for i in episode.action_ids]
    assert len(episode.actions) == float(row["episode_length"])
    assert set(episode.action_ids) <= {*split.test.tolist(), *split.always_available.tolist()}
    # Played by hand in an environment of the level.
    env = CreateHost("Push").env
    assert episode.seed is not None
    seed = int(episode.seed.generate_state(1, np.uint64)[0])
    actions = [
        {"index": int(action.id), "position": np.asarray(action.position)}
        for action in episode.actions
    ]
    frames = list(episode_frames(env, seed, actions, RenderOptions(size=24)))
    assert env.episode.summary.num_placed == float(row["num_placed"]) > 0
    shown = Image.open(tmp_path / "out" / "failure" / "episode-000.gif")
    assert shown.n_frames > 0.5 * len(frames)  # The format joins frames that are the same.
    for word, frame in (("start", frames[0]), ("end", frames[-1])):
        still = Image.open(tmp_path / "out" / "failure" / f"episode-000-{word}.png")
        np.testing.assert_array_equal(np.asarray(still), frame)


@pytest.mark.unit
def test_a_tower_is_a_success_from_the_mean_of_random_play() -> None:
    tower, grid = (load_task(name).shown.filming for name in ("shape_stacking", "grid_world"))
    assert tower is not None
    assert grid is not None
    assert tower.is_success(1.3)
    assert not tower.is_success(1.29)
    assert grid.is_success(1.0)
    assert not grid.is_success(0.0)


@pytest.mark.integration
def test_films_of_towers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = untrained(tmp_path / "run", "shape_stacking", "gt21")
    played: list[Any] = []
    simulated: list[int] = []
    play, seen = Run.play, towers.seen

    def load(task: Task, *given: Any) -> Rollout:
        """Towers that settle briefly, and no more of them than are asked for."""
        rollout = rollout_of(task, *given)
        assert isinstance(rollout, DeviceRollout)
        return replace(rollout, env=ShapeStacking(MujocoC(settle_steps=24)), width=2)

    def kept(*given: Any, **options: Any) -> Any:
        played.extend(play(*given, **options))
        return played

    def counted(*given: Any) -> Any:
        simulated.append(len(given))
        return seen(*given)

    monkeypatch.setattr(trainer_module, "rollout_of", load)
    monkeypatch.setattr(Run, "play", kept)
    monkeypatch.setattr(towers, "seen", counted)
    out = tmp_path / "figure_8"
    files = film_run(path, out, "Towers", FilmOptions(2, 40, with_pages=True))
    assert len(simulated) == 2  # Not once more for the page.
    assert [file.name for file in files[:2]] == ["figure_8.png", "figure_8.csv"]
    with files[1].open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    heights = [float(row[HEIGHT]) for row in rows]
    for row, episode in zip(rows, played, strict=True):
        last = episode.states[-1].bodies
        top = max(z for i, z in zip(last.shape_ids, last.qpos[:, 2], strict=True) if i >= 0)
        assert float(row[HEIGHT]) == pytest.approx(top + 0.5, abs=1e-6)
        assert row["outcome"] == ("success" if float(row[HEIGHT]) >= 1.3 else "failure")
        assert row["action_ids"] == " ".join(str(int(a.id)) for a in episode.actions)
        film = tmp_path / row["film"]
        for word, state in (("start", episode.states[0]), ("end", episode.states[-1])):
            still = np.asarray(Image.open(film.with_name(f"{film.stem}-{word}.png")))
            expected = towers.draw_bodies(state.bodies, task_camera(1), 40)
            np.testing.assert_array_equal(still, expected)
        num_placed = int(np.sum(last.shape_ids[2:] >= 0))
        assert int(float(row["num_placed"])) == num_placed
        assert Image.open(film).n_frames >= 1 + num_placed
        page = film.with_suffix(".html").read_text(encoding="utf-8")
        short = ShapeStacking(MujocoC(settle_steps=24))
        assert page == towers.page(seen(short, episode.states, episode.actions))
    assert max(len(episode.actions) for episode in played) > 1
    assert len(set(heights)) == 2


@pytest.mark.unit
def test_the_first_success_is_chosen_and_said() -> None:
    how = "episode 2, first successful of episodes 0..3 (2 of 4 were)"
    assert choose([False, False, True, True]) == (2, how)
    assert choose([False, False]) == (0, "episode 0: none of episodes 0..1 was successful")


@pytest.mark.integration
def test_animation_of_a_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = untrained(tmp_path / "run", "grid_world", "gt12")
    gif, still = animate_run(path, tmp_path / "out" / "episode.gif", episode=7)
    assert (gif.name, still.name) == ("episode.gif", "episode.png")
    with Run.load(path) as run:
        (episode,) = run.play(first=7)
        test_ids, names = run.split.test, run.task.make_universe().action_names
    # One frame per move, the start, and the whole path.
    assert Image.open(gif).n_frames == 2 + int(episode.states[-1].num_moves)
    assert Image.open(gif).info["duration"] == 220
    assert Image.open(still).size == Image.open(gif).size
    output = capsys.readouterr().out
    assert "episode 7, as asked for; sets of 50 test actions, 0 of them seen in training" in output
    assert f"with {', '.join(names[i] for i in episode.action_ids)}, return" in output
    assert set(episode.action_ids) <= set(episode.available_ids.tolist()) <= set(test_ids.tolist())
    assert len(episode.states) == len(episode.actions) + 1 == len(episode.rewards) + 1


@pytest.mark.unit
def test_what_cannot_be_filmed_is_said_before_it_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Run, "play", None)
    shop = untrained(tmp_path / "shop", "recommender", "product")
    with pytest.raises(UsageError, match="Episodes of task recommender cannot be filmed"):
        film_run(shop, tmp_path / "out")
    with pytest.raises(UsageError, match="Episodes of task recommender cannot be filmed"):
        animate_run(shop, tmp_path / "out" / "a.gif")
    grid = untrained(tmp_path / "grid", "grid_world", "gt12")
    with pytest.raises(UsageError, match="grid_world has no interactive pages"):
        film_run(grid, tmp_path / "out", options=FilmOptions(1, with_pages=True))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UsageError, match=r"pip install 'jaxnew\[video\]'"):
        film_run(grid, tmp_path / "out", options=FilmOptions(1, suffix=".mp4"))
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="Nothing can be written in /proc/nowhere"):
        film_run(grid, Path("/proc/nowhere"), options=FilmOptions(1))
