"""A policy on disk: loaded from its directory alone, evaluated and played."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.actions import ActionIdentity, SplitMismatch, content_hash, mixture_ids
from jaxnew.evaluation import measure, summarize
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.results import Evaluation, Question, on_record
from jaxnew.run import Run, locate
from jaxnew.storage.checkpoint import CheckpointError
from jaxnew.storage.config import ConfigError
from jaxnew.storage.run_directory import RunDirectory, RunDirectoryError
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.training import train
from tests import toy_device, toy_task

pytestmark = pytest.mark.integration

LADDER = toy_device.TASK
UNIVERSE = Domain.of(LADDER).universe
TABLE = engineered_table(UNIVERSE, "gt3")
MINE = np.array([1, 2, 3, 4])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The best checkpoint, as it was loaded."""
    path = tmp_path_factory.mktemp("runs") / "mine"
    train(LADDER, TABLE, budget="smoke", workdir=path)
    return Run.load(path)


def results(run: Run) -> dict[str, Any]:
    """What is in the run's directory, by file without the hash behind its words."""
    found = RunDirectory.load(run.path).evaluations()
    return {re.sub(r"-[0-9a-f]{8}$", "", name): content for name, content in found.items()}


def test_a_run_is_loaded_from_its_directory_or_a_checkpoint(run: Run) -> None:
    assert (run.checkpoint, run.was_interrupted) == ("best", False)
    assert run.step in (2, 4)
    assert (run.task.name, run.config.method) == ("toy-ladder", "ours")
    assert run.trainer.table.hash == TABLE.hash
    latest = Run.load(str(run.path), "latest")
    assert (latest.checkpoint, latest.step) == ("latest", 4)
    assert Run.load(run.path / "checkpoints" / "latest").step == 4
    assert Run.load(run.path, task=replace(LADDER, name="other")).task.name == "other"


def test_exactly_the_checkpoint_that_is_named(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A step is that step, an absent one is none, and a folder of a run is not the run."""
    folder = run.path / "checkpoints" / "latest"
    second = folder / "000000000002"
    assert locate(folder) == (run.path, "latest", None)
    assert locate(second) == (run.path, "latest", 2)
    found = Run.load(second)
    assert (found.checkpoint, found.step) == ("latest", 2)
    monkeypatch.chdir(second)
    assert locate(".") == (run.path, "latest", 2)
    (tmp_path / "link").symlink_to(second)
    assert locate(tmp_path / "link") == (run.path, "latest", 2)
    with pytest.raises(UsageError, match=r"is a latest checkpoint, not a best one"):
        Run.load(second, "best")
    inside = ("typo", "evaluation", "checkpoints", "config.json", "checkpoints/last")
    absent = ("checkpoints/latest/000000000077", "checkpoints/latest/000000000002/state")
    for name in (*inside, *absent):
        with pytest.raises(
            UsageError, match=r"is no checkpoint of .*: checkpoints/best/0000"
        ) as err:
            Run.load(run.path / name)
        assert "checkpoints/latest/000000000002, checkpoints/latest/000000000004" in str(err.value)


def test_what_is_no_run_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is neither a run directory nor a checkpoint in one"):
        Run.load(tmp_path)
    with pytest.raises(ConfigError, match=r"only pool\.FIELD=value can be set"):
        Run.load(run.path, set={"num_updates": 3})
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    assert Run.load(copy).step == run.step, "it needs nothing but its directory"
    shutil.rmtree(copy / "checkpoints" / "best")
    with pytest.raises(CheckpointError, match="no best checkpoint"):
        Run.load(copy)
    other = replace(TABLE, universe_hash="0" * 16)
    other.save(copy / "table.npz")
    with pytest.raises(SplitMismatch, match="universe"):
        Run.load(copy, "latest")
    (copy / "table.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="damaged"):
        Run.load(copy, "latest")
    RunDirectory.open_or_create(tmp_path / "other", {"members": []}).close()
    with pytest.raises(ConfigError, match="no run of a policy"):
        Run.load(tmp_path / "other")
    (copy / "provenance.json").unlink()
    with pytest.raises(RunDirectoryError, match=r"has no provenance\.json"):
        Run.load(copy)


def test_numbers_are_those_of_the_rollout_and_are_kept(run: Run) -> None:
    found = run.evaluate(["train", "test"], episodes=12)
    assert list(found.rows) == ["train", "test"]
    for name, row in found.to_dict().items():
        played = measure(run.trainer.rollout, run.policy, run.trainer.actions(name), 12)
        assert row["metrics"] == summarize(played)
        seconds = row.pop("seconds")
        assert seconds >= 0
        expected = {
            "num_episodes": 12,
            "num_actions": {"train": 12, "test": 6}[name],
            "set_size": 4,
            "policy": "sampled",
            "evaluation_seed": 2020,
        }
        assert {key: row[key] for key in row if key != "metrics"} == expected
        kept = results(run)[f"{name}-best-sampled-m4"]
        assert kept.pop("seconds") == seconds
        assert kept == {"checkpoint": "best", "step": run.step, "actions": name, **row}


def test_whoever_asks_otherwise_gets_a_file_of_its_own(run: Run) -> None:
    run.evaluate(episodes=4)
    before = set(results(run))
    asked: tuple[dict[str, Any], ...] = (
        {"greedy": True},
        {"set_size": 3},
        {"grows_from": 1, "growth": 2},
        {"parts": "validation"},
        {"ids": {"mine": MINE}},
        {"unseen_ratio": 0.5},
    )
    for arguments in asked:
        run.evaluate(episodes=4, **arguments)
    assert set(results(run)) - before == {
        "test-best-greedy-m4",
        "test-best-sampled-m3",
        "test-best-sampled-m4-from1-by2",
        "validation-best-sampled-m4",
        f"mine-{content_hash(MINE)[:8]}-best-sampled-m4",
        "unseen-0.5-best-sampled-m4",
    }
    grown = results(run)["test-best-sampled-m4-from1-by2"]
    assert (grown["first_size"], grown["growth"]) == (1, 2)
    mixed = results(run)["unseen-0.5-best-sampled-m4"]
    assert mixed["num_actions"] == len(mixture_ids(run.split.train, run.split.test, 0.5))
    here = results(run)
    run.evaluate("all", episodes=4, record=False)
    assert results(run) == here
    Run.load(run.path, "latest").evaluate(episodes=4)
    assert set(results(run)) - set(here) == {"test-latest-sampled-m4"}


def test_different_questions_have_different_files(run: Run, tmp_path: Path) -> None:
    """Also where they differ in a seed, a number of episodes, an update or other ids alone."""
    earlier = Run.load(run.path / "checkpoints" / "latest" / "000000000002")
    latest = Run.load(run.path, "latest")
    asked: tuple[tuple[Run, dict[str, Any]], ...] = (
        (latest, {}),
        (latest, {"seed": 1}),
        (latest, {"episodes": 5}),
        (earlier, {}),
        (latest, {"ids": {"my ids, ä/ö": MINE}}),
        (latest, {"ids": {"my ids, ä/ö": MINE + 1}}),
        (latest, {"ids": {"x" * 300: MINE}}),
    )
    for number, (of_run, arguments) in enumerate(asked, 1):
        of_run.evaluate(**{"episodes": 4, **arguments}, record=tmp_path / "kept")
        assert len(list((tmp_path / "kept").iterdir())) == number
    latest.evaluate(episodes=4, record=str(tmp_path / "kept"))
    assert len(list((tmp_path / "kept").iterdir())) == len(asked), "the same question again"
    (file,) = (tmp_path / "kept").glob("test-latest-sampled-m4-seed1-*.json")
    assert json.loads(file.read_text())["run"] == str(run.path)


def test_what_is_on_record_is_of_the_checkpoint_as_it_is_now(run: Run, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy, ignore=shutil.ignore_patterns("*.json"))
    for name in ("config.json", "provenance.json", "split.json"):
        shutil.copy(run.path / name, copy)
    again, question = Run.load(copy), Question("test", 4)
    again.evaluate(episodes=4)
    again.evaluate(episodes=6)
    again.evaluate(episodes=5)
    (best,) = on_record(copy)
    assert question.is_answered_by(best, 6), "the answer with most episodes"
    again.acting_as(again.policy, "other").evaluate(episodes=4)
    replace(again, step=again.step - 1).evaluate(episodes=9)
    assert [e["checkpoint"] for e in on_record(copy)] == ["best", "other"]
    # Another validation has made another checkpoint the best.
    steps = copy / "checkpoints" / "best"
    (steps / f"{again.step:012d}").rename(steps / f"{again.step + 1:012d}")
    assert [e["checkpoint"] for e in on_record(copy)] == ["other"]
    # Until 0.2.0 there was one file for all episodes and seeds.
    old = {**best, "step": again.step + 1}
    (copy / "evaluation" / "test-best-sampled-m4.json").write_text(json.dumps(old))
    assert [question.is_answered_by(e) for e in on_record(copy)] == [False, True]


def test_where_nothing_can_be_recorded_nothing_is_played(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    before = results(run)
    with monkeypatch.context() as patch:
        patch.setattr(type(run), "_row", None)
        with pytest.raises(UsageError, match=r"Nothing can be written in .*file.*record elsewhere"):
            run.evaluate(episodes=4, record=tmp_path / "file" / "folder")
    assert results(run) == before

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device", "x.json")

    monkeypatch.setattr("jaxnew.run.write_json_atomically", full)
    found = run.evaluate(["train", "test"], episodes=4, record=tmp_path)
    assert list(found.rows) == ["train", "test"]
    assert "test is not on record: [Errno 28] No space left on device" in str(found)


def test_new_actions_are_drawn_and_represented_by_their_table(run: Run) -> None:
    ids = np.array([3, 8, 20, 21], np.int32)
    vectors = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    identity = ActionIdentity.of(UNIVERSE, ids)
    table = RepresentationTable(
        vectors, ids, source="new", encoder_hash=TABLE.hash, identity=identity
    )
    found = run.evaluate(table=table, episodes=6)
    digest = content_hash(table.hash, UNIVERSE.name)[:8]
    assert list(found.rows) == [f"table-{digest}"]
    assert f"table-{digest}-best-sampled-m4" in results(run)
    named = run.evaluate(table=table, table_name="new", episodes=6, greedy=True)
    assert list(named.rows) == ["table-new"]
    assert f"table-new-{digest}-best-greedy-m4" in results(run)
    whole = np.array(run.trainer.training.table)
    whole[ids] = vectors
    actions = run.trainer.actions("new", ids, vectors=jnp.asarray(whole))
    assert named.rows["table-new"]["metrics"] == summarize(
        measure(run.trainer.rollout, run.policy, actions, 6, is_greedy=True)
    )
    # One that is hardly trained is almost uniform, but what it likes most is another action.
    own = run.evaluate(ids={"old": ids}, episodes=6, greedy=True).rows["old"]["metrics"]
    assert own != named.rows["table-new"]["metrics"]
    outside = RepresentationTable(vectors, np.array([3, 8, 20, 24], np.int32))
    with pytest.raises(SplitMismatch, match=r"has ids up to 24; Ladder-v0 has 0\.\.23"):
        run.evaluate(table=outside, allow=["other-encoder", "unknown-actions"])


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"parts": "test", "unseen_ratio": 0.4}, UsageError, "Give one of parts of the split, ids"),
        ({"ids": {"a": np.arange(5)}, "table": TABLE}, UsageError, "Give one of parts"),
        ({"parts": "tests"}, ValueError, "tests"),
        ({"set_size": 7}, ValueError, "Sets of 7 .* from the test actions"),
        ({"grows_from": 5}, ValueError, r"first_size=5 must be in 0\.\.4"),
        ({"episodes": 0}, ValueError, "num_episodes=0 must be at least 1"),
        ({"seed": 2**32}, ConfigError, "seed of the evaluation=4294967296 must be an integer"),
        ({"seed": True}, ConfigError, "seed of the evaluation=True must be an integer"),
        ({"unseen_ratio": 1.5}, ValueError, "1.5"),
        ({"ids": {}}, UsageError, "ids are lists by name"),
        ({"ids": [1, 2, 3]}, UsageError, "ids are lists by name"),
        ({"ids": {"test": np.arange(5)}}, UsageError, "names of parts of the split"),
        ({"ids": {"mine": np.arange(5.0)}}, ValueError, "the mine actions: must be .* float64"),
    ],
)
def test_what_cannot_be_evaluated(
    run: Run, arguments: dict[str, Any], error: type[Exception], says: str
) -> None:
    before = results(run)
    with pytest.raises(error, match=says):
        run.evaluate(**{"episodes": 4, **arguments})
    assert results(run) == before


def test_episodes_are_those_that_are_evaluated(run: Run) -> None:
    (third,) = run.play("test", first=3)
    more = run.play("test", first=0, count=5)
    assert third.action_ids == more[3].action_ids
    assert len(third.states) == len(third.actions) + 1
    numbers = measure(run.trainer.rollout, run.policy, run.trainer.actions("test"), 5)
    for episode in more:
        for name, values in numbers.items():
            assert episode.metrics[name] == pytest.approx(values[episode.number], rel=1e-5)
    assert run.play("test", count=1, seed=1)[0].action_ids != more[0].action_ids
    assert set(more[0].available_ids.tolist()) <= set(run.split.test.tolist())


def test_another_policy_is_recorded_under_its_name(run: Run) -> None:
    other = run.acting_as(Run.load(run.path, "latest").policy, "mean of two")
    assert (other.checkpoint, other.path) == ("mean of two", run.path)
    assert isinstance(other.evaluate(episodes=4, record=False), Evaluation)
    path = run.acting_as(run.policy, "a b").record("test", {"policy": "sampled", "set_size": 4})
    assert path.parent == run.path / "evaluation"
    assert re.fullmatch("test-a-b-sampled-m4-[0-9a-f]{8}.json", path.name)
    path.unlink()


def test_a_run_on_the_host_ends_its_processes(tmp_path: Path) -> None:
    train(toy_task.TASK, "gt4", budget="smoke", workdir=tmp_path, set={"num_updates": 1})
    with Run.load(tmp_path, task=toy_task.TASK, num_workers=1) as run:
        found = run.evaluate(["train", "test"], episodes=3)
        (episode,) = run.play("test", first=1)
        test = run.evaluate("test", episodes=2, record=False).rows["test"]
        assert test["num_actions"] == 6
        assert episode.seed is not None
        pool: Any = run.trainer.rollout.environments.pool  # type: ignore[attr-defined]
    assert pool.is_closed
    assert list(found.rows) == ["train", "test"]
