"""What budgets spend, written as differences to one another."""

from __future__ import annotations

from dataclasses import replace

import pytest

from jaxnew.storage.config import ConfigError
from jaxnew.task.budgets import LoopConfig, scaled_cost
from tests.toy_device import TASK

pytestmark = pytest.mark.unit

ONE, TWO = TASK.stage_one["smoke"], TASK.stage_two["smoke"]


def test_a_budget_differs_in_what_is_said() -> None:
    varied = TWO.vary(num_updates=9, ppo__rollout__num_envs=2, sets__size=3, cost="more")
    rollout = replace(TWO.ppo.rollout, num_envs=2)
    assert varied == replace(
        TWO,
        num_updates=9,
        ppo=replace(TWO.ppo, rollout=rollout),
        sets=replace(TWO.sets, size=3),
        cost="more",
    )
    assert TWO.vary() == TWO
    assert ONE.vary(model__num_steps=7).model == replace(ONE.model, num_steps=7)
    # What is legal only together is set together.
    assert TWO.vary(ppo__num_minibatches=3, ppo__rollout__num_steps=9).ppo.minibatch_size == 12
    for budget, changes, says in (
        (TWO, {"num_update": 3}, r"Did you mean num_updates\?"),
        (TWO, {"ppo__num_minibatches": 3}, "32 is not divisible by num_minibatches=3"),
        (TWO, {"num_updates": 1.5}, "num_updates must be int"),
        (TWO, {"sets": 3}, "sets is a group of fields"),
        (ONE, {"model__kind": "autoencoder"}, "kind='autoencoder' is unknown"),
    ):
        with pytest.raises(ConfigError, match=says):
            budget.vary(**changes)


@pytest.mark.parametrize("counts_epochs", [False, True])
def test_steps_of_an_encoder_of_more_actions(counts_epochs: bool) -> None:
    """As many steps, or as many passes: 24 actions in batches of 3 are 8 steps a pass, 12 are 4."""
    budget = replace(ONE, counts_epochs=counts_epochs)
    assert budget.config("hvae", 12, 12) == budget.model
    assert budget.config("hvae", 24, 12).num_steps == (8 if counts_epochs else 4)
    assert budget.config("vae", 24, 12).num_steps == (8 if counts_epochs else 4)
    assert budget.config("vae", 12, 12) == replace(budget.model, kind="vae")
    own = replace(budget, vae_steps=6)
    assert own.config("vae", 24, 12).num_steps == (12 if counts_epochs else 6)
    assert own.config("hvae", 12, 12) == budget.model


def test_what_is_foretold_follows_the_settings() -> None:
    assert scaled_cost("1 hour", steps=1.0, recordings=1.0) == "1 hour"
    told = scaled_cost("1 hour", steps=0.25, batches=1.0, recordings=2.0)
    assert told == "1 hour for the preset; this has 0.25 of its steps and 2 of its recordings"


@pytest.mark.parametrize("name", sorted(vars(LoopConfig())))
def test_rhythms_are_counts(name: str) -> None:
    low = 0 if name == "evaluation_set_size" else 1
    assert getattr(LoopConfig(**{name: low}), name) == low
    with pytest.raises(ValueError, match=f"{name}={low - 1} must be at least {low}"):
        LoopConfig(**{name: low - 1})
