"""Figure 8: films of zero-shot episodes, and figures whose runs are trained on the host."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl import flags
from PIL import Image

from envs_host.create.films import episode_frames
from envs_host.create.hosting import CreateHost
from envs_host.create.illustration import RenderOptions
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import UsageError, load_task
from experiments.pipeline.training import EVALUATION_SEED, TrainConfig, Trainer, save_inputs
from experiments.reports import films, jobs, paper_figures
from experiments.reports.figure_list import FIGURES, PaperFigure
from experiments.reports.films import Still, film_run
from experiments.reports.host_episodes import HostEpisode, check_film, play_host_episodes
from experiments.reports.plots import Metric
from experiments.reports.production import Cell, Source, find
from experiments.reports.runs import read_runs
from experiments.reports.searches import GRIDS, chosen, search_parts
from jaxnew.representation.table import engineered_table
from jaxnew.storage import config as config_lib
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.metrics import MetricsLog
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task import Film
from tests.experiments.commands import ROOT, read_json
from tests.experiments.handwritten import plain_config, write_run

PLACE = "tests.toy_task:TASK"
TOY = Cell("ours", "gt4")


def untrained(path: Path, place: str, representation: str, seed: int = 1) -> tuple[Path, Trainer]:
    """A run of a policy with random parameters, at smoke budget, and its parts."""
    domain = Domain.of(load_task(place), None)
    table = engineered_table(domain.universe, representation)
    budget = domain.task.stage_two["smoke"]
    config = TrainConfig.of(domain, "ours", representation, table, budget, seed)
    trainer = Trainer.of(config, domain.task, domain.split, table, 1)
    shapes = trainer.machinery.example(trainer.table, trainer.training_pool)
    rng = np.random.default_rng(seed)

    def fill(leaf: Any) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        is_number = jnp.issubdtype(leaf.dtype, jnp.floating)
        drawn = rng.normal(0.0, 0.1, leaf.shape) if is_number else np.ones(leaf.shape)
        return jnp.asarray(drawn, leaf.dtype)

    metadata = {"best_metric": 0.0, "best_step": 0, "elapsed_s": 0.0}
    with RunDirectory.open_or_create(path, config_lib.to_dict(config)) as run:
        save_inputs(run, domain.split, table)
        Checkpointer(run.checkpoints).save("best", 0, jax.tree.map(fill, shapes), metadata)
        with MetricsLog(path) as log:
            log.write(config.num_updates, {"validation/is_success": 0.25})
    return path, trainer


def last_frame(path: Path) -> np.ndarray:
    with Image.open(path) as film:
        film.seek(film.n_frames - 1)
        return np.asarray(film.convert("RGB"))


# ---- Films ----


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Trainer]]:
    path, trainer = untrained(tmp_path_factory.mktemp("toy") / "run", PLACE, "gt4")
    with closing(trainer):
        yield path, trainer


@pytest.mark.integration
def test_films_are_sorted_by_the_outcome_that_they_show(toy: Any, tmp_path: Path) -> None:
    path, trainer = toy
    old = tmp_path / "figure_8" / "success" / "episode-999.gif"
    old.parent.mkdir(parents=True)
    old.touch()
    files = film_run(path, tmp_path / "figure_8", 40, size=16, title="Toy", num_workers=1)
    assert [file.name for file in files[:2]] == ["figure_8.png", "figure_8.csv"]
    assert not old.exists()
    state, _ = films.load_state(RunDirectory.load(path), trainer, "best")
    key = jax.random.key(EVALUATION_SEED)
    expected = trainer.evaluator.run(
        state.params, None, trainer.table, trainer.pools["test"], key, 40
    )
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
def test_episodes_inside_jit_are_drawn_from_their_states(tmp_path: Path) -> None:
    path, trainer = untrained(tmp_path / "run", "grid_world", "gt12")
    film_run(path, tmp_path / "out", 12, size=90, title="Grid")
    state, _ = films.load_state(RunDirectory.load(path), trainer, "best")
    arguments = state.params, state.rollout.observation_statistics, trainer.table
    key = jax.random.key(EVALUATION_SEED)
    expected = trainer.evaluator.run(*arguments, trainer.pools["test"], key, 12)
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
        # A frame for every move, and the start; the format joins frames that are the same.
        assert 0.5 * moves < film.n_frames <= 1 + moves
        end = np.asarray(
            Image.open((tmp_path / row["film"]).with_name(Path(row["film"]).stem + "-end.png"))
        )
        assert end.shape[1:] == (90, 3)


@pytest.mark.unit
def test_a_film_that_ends_otherwise_is_no_film_of_the_episode() -> None:
    played = HostEpisode(
        3, np.random.SeedSequence(0), np.zeros(1), np.zeros((1, 2)), {"is_success": 1.0, "r": 0.5}
    )
    film = Film([], {"is_success": 1.0, "r": 0.5, "more": 7.0})
    check_film(played, film)
    lost = replace(played, metrics={"is_success": 0.0, "r": 0.5})
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
    figure = films.ranked_sheet(stills, Metric.of("final_height"), "at least 1.5 m", "Figure 8")
    title = "Figure 8, best and worst of 12 (7 of 12 at least 1.5 m)"
    assert figure.get_suptitle() == title
    shown = [(a.get_xlabel(), int(a.images[0].get_array()[0, 0, 0]) // 20) for a in figure.axes]
    best = [1, 8, 6, 11, 3]
    worst = [9, 2, 7, 0, 4]
    assert [number for _, number in shown] == best + worst
    assert shown[0][0] == "3.250 m (episode 1)"
    assert shown[9][0] == "0.250 m (episode 4)"
    colors = [axes.xaxis.label.get_color() for axes in figure.axes]
    assert len(set(colors[:5])) == len(set(colors[5:])) == 1
    assert colors[0] != colors[5]
    few = films.ranked_sheet(stills[:3], Metric.of("final_height"), "at least 1.5 m", "Figure 8")
    assert few.get_suptitle() == "Figure 8 (1 of 3 at least 1.5 m)"
    assert [axes.get_xlabel()[:5] for axes in few.axes[:3]] == ["3.250", "1.000", "0.500"]


@pytest.mark.integration
def test_films_of_create_are_those_of_the_level(tmp_path: Path) -> None:
    path, trainer = untrained(tmp_path / "run", "create-push", "gt32")
    with closing(trainer):
        state, _ = films.load_state(RunDirectory.load(path), trainer, "best")
        (episode,) = play_host_episodes(trainer, state, "test", 1)
    film_run(path, tmp_path / "out", 1, size=24, num_workers=1)
    with (tmp_path / "out.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["outcome"], row["film"]) == ("failure", "out/failure/episode-000.gif")
    assert row["action_ids"].split() == [str(i) for i in episode.ids]
    assert len(episode.ids) == float(row["episode_length"])
    split = Domain.of(load_task("create-push"), None).split
    assert set(episode.ids.tolist()) <= {*split.test.tolist(), *split.always_available.tolist()}
    # Played by hand in an environment of the level.
    env = CreateHost("Push").env
    seed = int(episode.seed.generate_state(1, np.uint64)[0])
    actions = [
        {"index": int(i), "position": p}
        for i, p in zip(episode.ids, episode.positions, strict=True)
    ]
    frames = list(episode_frames(env, seed, actions, RenderOptions(size=24)))
    assert env.episode.summary.num_placed == float(row["num_placed"]) > 0
    shown = Image.open(tmp_path / "out" / "failure" / "episode-000.gif")
    assert shown.n_frames > 0.5 * len(frames)  # The format joins frames that are the same.
    for word, frame in (("start", frames[0]), ("end", frames[-1])):
        still = Image.open(tmp_path / "out" / "failure" / f"episode-000-{word}.png")
        np.testing.assert_array_equal(np.asarray(still), frame)


@pytest.mark.unit
def test_which_run_is_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(paper_figures, "film_run", lambda *given: made.append(given) or [])
    config = {**plain_config(), "task": "create-push", "representation": "hvae"}
    path = write_run(tmp_path / "run", config)
    values = SimpleNamespace(run=[str(path)], out=None, films=3, film_size=64)
    values.film_format, values.film_pages = "mp4", True
    with flagged(task="create-push"):
        paper_figures.film_given(values)
        title = "Figure 8, CREATE Push: ours, hvae"
        assert made == [(path, path / "figures" / "figure_8", 3, 64, ".mp4", title, 0, True)]
        values.run *= 2
        with pytest.raises(UsageError, match="Figure 8 shows one run; 2 were given"):
            paper_figures.film_given(values)
    values.run = [str(path)]
    with flagged(task="create-seesaw"), pytest.raises(UsageError, match="of task create-seesaw"):
        paper_figures.film_given(values)
    shop = untrained(tmp_path / "shop", "recommender", "product")[0]
    with pytest.raises(UsageError, match="Episodes of task recommender cannot be filmed"):
        film_run(shop, tmp_path / "out", 1)
    with pytest.raises(UsageError, match="recommender has no interactive pages"):
        film_run(shop, tmp_path / "out", 1, with_pages=True)
    assert not (tmp_path / "out").exists()


@contextmanager
def flagged(**values: Any) -> Iterator[None]:
    """Flags of the commands with some values, and as they were afterwards."""
    if not flags.FLAGS.is_parsed():
        flags.FLAGS(["test"])
    saved = {name: getattr(flags.FLAGS, name) for name in values}
    try:
        for name, value in values.items():
            setattr(flags.FLAGS, name, value)
        yield
    finally:
        for name, value in saved.items():
            setattr(flags.FLAGS, name, value)


# ---- Runs that are made on the host ----


def source_of_toy(folder: Path) -> tuple[Any, ...]:
    domain = Domain.of(load_task(PLACE), None)
    return domain, folder, "smoke", "smoke", 0.0, (1,), (), {}


def run_and_kill(job: jobs.Job, folder: Path) -> None:
    """Starts a command, and ends it at its first checkpoint as a power cut would."""
    process = subprocess.Popen([sys.executable, "-m", *job._module, *job.command[1:]], cwd=ROOT)
    while process.poll() is None and not Checkpointer(folder / "checkpoints").steps("latest"):
        time.sleep(0.005)
    assert process.poll() is None
    process.kill()
    process.wait()
    raise UsageError("Stopped.")


@pytest.mark.integration
def test_bars_and_a_study_of_runs_that_are_made_on_the_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    cells = {"toy": (TOY,)}
    monkeypatch.setitem(FIGURES, "4", PaperFigure("bars", "toys", cells))
    monkeypatch.setitem(FIGURES, "9c", PaperFigure("study", "good", cells, study="goodness"))
    values = SimpleNamespace(
        figure=["4", "9c"],
        seeds=["1"],
        steps=0.0,
        finetune_steps=0.0,
        episodes=6,
        given=[],
        representation_budget=None,
        dry_run=True,
        out=None,
        pdf=False,
    )
    with flagged(task=PLACE, budget="smoke", runs=str(tmp_path), workers=1):
        assert paper_figures.make(values) == []
        planned = capfd.readouterr().out
        assert planned.count("python -m experiments.train") == 1  # Both figures need it.
        assert "30 episodes of evaluation" in planned  # 2 bars and 3 points.
        assert not any(tmp_path.iterdir())
        values.dry_run = False
        run = tmp_path / "toy" / "ours-gt4-default-smoke-4-1"
        with monkeypatch.context() as killed:
            killed.setattr(jobs.Job, "run", lambda job: run_and_kill(job, run))
            with pytest.raises(UsageError, match="Stopped"):
                paper_figures.make(values)
        assert Checkpointer(run / "checkpoints").steps("latest")[-1] < 4
        assert not find(Source(*source_of_toy(tmp_path)), TOY)
        files = paper_figures.make(values)
        assert "resuming" in capfd.readouterr().out
        before = {file: file.stat().st_mtime_ns for file in run.rglob("*.json*")}
        monkeypatch.setattr(jobs.Job, "run", lambda job: pytest.fail(job.text))
        assert paper_figures.make(values) == files
        assert before == {file: file.stat().st_mtime_ns for file in run.rglob("*.json*")}
        assert "All runs and evaluations are there" in capfd.readouterr().out
    assert [file.name for file in files] == [
        *("figure_4.png", "figure_4.md", "figure_4.csv"),
        *("figure_9c.png", "figure_9c.md", "figure_9c.csv"),
    ]
    found = {
        file.name.removesuffix("-best-sampled-m4.json"): read_json(file)["metrics"]["is_success"]
        for file in (run / "evaluation").iterdir()
    }
    assert set(found) == {"train", "test", "goodness-0", "goodness-0.5", "goodness-1"}
    with files[2].open() as file:
        bars = {row["actions"]: row for row in csv.DictReader(file)}
    for split in ("train", "test"):
        numbers = [float(bars[split][name]) for name in ("mean", "low", "high")]
        assert numbers == [found[split][name] for name in ("mean", "low", "high")]
    with files[5].open() as file:
        points = list(csv.DictReader(file))
    means = {float(p["share of good actions"]): float(p["mean"]) for p in points}
    assert means == {x: found[f"goodness-{x:g}"]["mean"] for x in (0.0, 0.5, 1.0)}
    assert found["goodness-0"]["mean"] == 0.0  # Bad actions are worth nothing.
    assert found["goodness-1"]["mean"] > 0.0
    assert "| 0 | 0.0 |" in files[4].read_text()


@pytest.mark.unit
def test_a_search_on_the_host_is_a_run_for_each_value_and_seed(tmp_path: Path) -> None:
    domain = Domain.of(load_task(PLACE), None)
    source = replace(Source(*source_of_toy(tmp_path)), seeds=(1, 2))
    parts = search_parts("entropy", source, TOY, (0.01, 0.1))
    folder = tmp_path / "toy" / "search-entropy-ours-gt4-smoke-4"
    names = [part.folder.relative_to(folder).name for part in parts]
    assert names == ["0.01-1", "0.01-2", "0.1-1", "0.1-2"]
    for part, value in zip(parts, ("0.01", "0.01", "0.1", "0.1"), strict=True):
        assert f"--set=hyperparameters.entropy_coefficient={value}" in part.job.command
        assert part.job.command[0] == "train"
        assert f"--workdir={part.folder}" in part.job.command
        assert part.job.title.startswith(f"entropy coefficient {value}: ours, gt4, seed")
        assert not part.is_finished
    # Minibatches of 32: 2 of them in a rollout of 4 environments are 16 steps, twice as many.
    sizes = search_parts("batch-size", source, TOY, (32,))
    assert [part.job.command[-2:] for part in sizes] == [
        ("--set=ppo.rollout.num_steps=16", "--set=num_updates=2")
    ] * 2
    runs = []
    for part, best in zip(parts, (0.2, 0.4, 0.1, 0.2), strict=True):
        value, seed = part.folder.name.split("-")
        config = config_lib.to_dict(
            TrainConfig.of(
                domain,
                "ours",
                "gt4",
                engineered_table(domain.universe, "gt4"),
                config_lib.set_paths(
                    domain.task.stage_two["smoke"],
                    [f"hyperparameters.entropy_coefficient={value}"],
                ),
                int(seed),
            )
        )
        write_run(part.folder, config, curve=(2 * best, best))
        assert part.is_finished
        runs += read_runs([part.folder])
    study = chosen("entropy", GRIDS["entropy"], runs)
    assert [(p.x, p.means.tolist()) for p in study.points] == [
        (0.01, [0.2, 0.4]),
        (0.1, [0.1, 0.2]),
    ]
    assert "mean over 2 seeds. Chosen by it: entropy coefficient 0.01." in study.note
    unfinished = write_run(tmp_path / "unfinished", config, curve=(0.1,))
    assert not replace(parts[0], folder=unfinished).is_finished
