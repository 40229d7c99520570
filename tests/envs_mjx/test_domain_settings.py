"""What a run may set of each domain: ranges, and that it arrives."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

import jax
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld, GridWorldParams, GridWorldSettings
from envs_mjx.recommender import Recommender, RecommenderParams, RecommenderSettings
from envs_mjx.shape_stacking import ShapeStacking, StackingParams, StackingSettings
from tests.envs_mjx.grid_world.test_grid_world_contract import CHANGES

pytestmark = pytest.mark.unit

DOMAINS = (
    (GridWorld, GridWorldSettings, GridWorldParams),
    (Recommender, RecommenderSettings, RecommenderParams),
    (ShapeStacking, StackingSettings, StackingParams),
)
# Another legal value of each field that is a parameter; the contract of each domain shows that
# each parameter matters.
VALUES = {**CHANGES, "max_recommendations": 20, "max_actions": 4}


def differing(one: Any, other: Any) -> set[str]:
    """Names of the fields that are not equal."""
    return {
        field.name
        for field in dataclasses.fields(one)
        if not np.array_equal(getattr(one, field.name), getattr(other, field.name))
    }


@pytest.mark.parametrize(("domain", "settings", "params"), DOMAINS)
def test_an_environment_is_made_from_the_fields(domain, settings, params) -> None:
    """With the same defaults, so that nothing set is the published task."""
    taken = {name: p.default for name, p in inspect.signature(domain).parameters.items()}
    assert dataclasses.asdict(settings()).items() <= taken.items()
    assert set(taken) - set(dataclasses.asdict(settings())) <= {"position_dim", "shapes", "extra"}
    for field in dataclasses.fields(params):
        if field.default is not dataclasses.MISSING:
            assert field.default == getattr(settings(), field.name)


@pytest.mark.parametrize(("domain", "settings", "params"), DOMAINS)
def test_parameters_arrive(domain, settings, params) -> None:
    names = {field.name for field in dataclasses.fields(settings)} & set(VALUES)
    assert names == {field.name for field in dataclasses.fields(params)} - {
        "product_vectors",
        "product_constants",
    }
    published = domain().default_params
    for name in names:
        env = domain(**dataclasses.asdict(settings(**{name: VALUES[name]})))
        assert differing(env.default_params, published) == {name}
        assert getattr(env.default_params, name) == VALUES[name]
        structures = map(jax.tree.structure, (env.default_params, published))
        assert len(set(structures)) == 1


def test_limits_that_are_set_end_episodes() -> None:
    for env, steps in (
        (GridWorld(max_moves=20), 4),
        (Recommender(max_recommendations=20), 20),
        (ShapeStacking(max_actions=4), 4),
    ):
        assert env.max_episode_steps(env.default_params) == steps


@pytest.mark.parametrize(
    ("settings", "given", "says"),
    [
        (GridWorldSettings, {"max_moves": 0}, "max_moves=0 must be 1 to 10,000"),
        (GridWorldSettings, {"fixed_layout": 42}, "fixed_layout=42 must be 0 to 41, or -1"),
        (GridWorldSettings, {"fixed_layout": -2}, "fixed_layout=-2 must be 0 to 41, or -1"),
        (GridWorldSettings, {"subgoal_reward": np.nan}, "subgoal_reward=nan must be a million at"),
        (GridWorldSettings, {"goal_reward": np.inf}, "goal_reward=inf must be a million at"),
        (GridWorldSettings, {"time_penalty": -np.inf}, "time_penalty=-inf must be a million at"),
        (
            RecommenderSettings,
            {"max_recommendations": 0},
            "max_recommendations=0 must be 1 to 10,000",
        ),
        (GridWorldSettings, {"max_moves": 10**12}, "max_moves=1000000000000 must be 1 to 10,000"),
        (RecommenderSettings, {"max_recommendations": 10**9}, "=1000000000 must be 1 to 10,000"),
        (StackingSettings, {"max_actions": 0}, "max_actions=0 must be 1 to 10"),
        (StackingSettings, {"max_actions": 11}, "max_actions=11 must be 1 to 10"),
        (StackingSettings, {"physics": "warp"}, r"physics='warp' must be one of \('auto', 'mjx'"),
        (StackingSettings, {"reward_variant": "both"}, r"reward_variant='both' must be one of"),
    ],
)
def test_ranges(settings: type, given: dict[str, Any], says: str) -> None:
    domain = next(domain for domain, owner, _ in DOMAINS if owner is settings)
    with pytest.raises(ValueError, match=says):
        settings(**given)
    if "physics" not in given:  # An environment takes engines too, and `make_engine` refuses.
        with pytest.raises(ValueError, match=says):
            domain(**given)
