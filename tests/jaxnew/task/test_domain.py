"""Tasks with their splits, and where they are found."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace
from pathlib import Path

import pytest

from jaxnew.task.domain import ENTRY_POINTS, Domain, load_task, published
from jaxnew.task.places import UsageError
from tests import toy_device, toy_task, video_task

pytestmark = pytest.mark.unit

LADDER, TOY = toy_device.TASK, toy_task.TASK


def test_the_projects_tasks_are_found_by_name() -> None:
    """Those of the entry points, each of which names itself."""
    names = {point.name for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    assert names == {"create", "grid_world", "recommender", "shape_stacking"}
    for name in ("grid_world", "recommender", "shape_stacking", "create-push"):
        task = load_task(name)
        assert (task.name, task.place, task.reference) == (name, None, name)
    assert load_task("shape_stacking-2d-place").name == "shape_stacking-2d-place"


def test_a_task_of_ones_own_is_found_by_place() -> None:
    place = "tests.toy_task:TASK"
    task = load_task(place)
    assert (task.name, task.place, task.reference) == ("toy", place, place)
    assert replace(task, place=None) == TOY


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("grid", r"Unknown task 'grid'\. Tasks: create, grid_world, recommender, shape_stacking"),
        ("create-nowhere", "Unknown task 'create-nowhere': there are create, create-"),
        ("grid_world-hard", "Unknown task 'grid_world-hard': there are grid_world"),
        ("tests.toy_task:split", r"is <function split.*, not a jaxnew\.Task"),
        ("tests.toy_task:TASKK", r"did you mean tests\.toy_task:TASK\?"),
    ],
)
def test_tasks_that_are_not_there(name: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        load_task(name)


def test_a_domain_is_a_task_with_a_split() -> None:
    domain = Domain.of(LADDER, split_seed=3)
    assert (domain.split_name, domain.split_seed, domain.split.seed) == ("default", 3, 3)
    assert domain.split.hash != Domain.of(LADDER).split.hash
    assert domain.split_label == "default-split3"
    assert Domain.of(LADDER).split_label == "default"
    assert (
        domain.folder(Path("runs"))
        == domain.actions_folder(Path("runs"))
        == Path("runs/toy-ladder")
    )
    shared = Domain.of(replace(LADDER, actions_name="ladders"))
    assert shared.actions_folder(Path("runs")) == Path("runs/ladders")
    assert domain.play is toy_device.PLAY
    assert domain.stage_one(domain.play, "smoke") is LADDER.stage_one["smoke"]
    with pytest.raises(UsageError, match=r"toy-ladder has no split 'full'; .* \['default'\]"):
        Domain.of(LADDER, "full")
    with pytest.raises(UsageError, match="Stage one has no budget 'paper'; choose one of smoke"):
        domain.stage_one(domain.play, "paper")
    with pytest.raises(UsageError, match="toy has no play environment"):
        _ = Domain.of(TOY).play


def test_a_play_may_have_budgets_of_its_own() -> None:
    domain = Domain.of(video_task.TASK)
    states, video = video_task.TASK.plays
    assert domain.stage_one(states, "smoke").model.num_steps == 2
    assert domain.stage_one(video, "smoke").model.num_steps == 4


def test_a_published_split_has_one_seed() -> None:
    split = Domain.of(LADDER).split
    task = replace(LADDER, splits={"default": published(lambda: split)})
    assert Domain.of(task).split is split
    with pytest.raises(UsageError, match="published one and cannot be drawn from split_seed=2"):
        Domain.of(task, split_seed=2)
