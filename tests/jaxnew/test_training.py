"""What fine-tuning begins with (docs/method.md, "Fine-tuning")."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxnew.ppo import TrainState
from jaxnew.run import Run
from jaxnew.training import _warm_start

pytestmark = pytest.mark.unit

HEADS = ("alpha", "beta", "stop")


def state_of(value: float, policy: str, num_actions: int, statistics: str) -> TrainState:
    """A policy whose parameters all are `value`."""
    params: dict[str, Any] = {
        "policy": {policy: {"kernel": np.full((2, num_actions), value)}},
        "critic": {"value": np.full(2, value)},
        "auxiliary": {"heads": {name: {"kernel": np.full(2, value)} for name in HEADS}},
    }
    rollout: Any = SimpleNamespace(observation_statistics=statistics)
    nothing: Any = None
    return TrainState(params, nothing, rollout, nothing, nothing)


def started(policy: str) -> tuple[TrainState, TrainState, TrainState]:
    """What a policy begins with, and the trained and the fresh state that it is made of."""
    source, fresh = state_of(1.0, policy, 5, "trained"), state_of(0.0, policy, 3, "fresh")

    def restarted(state: TrainState, actions: str, statistics: str) -> TrainState:
        rollout: Any = SimpleNamespace(actions=actions, observation_statistics=statistics)
        return dataclasses.replace(state, rollout=rollout)

    trainer: Any = SimpleNamespace(
        learner=SimpleNamespace(restarted=restarted), training="test actions"
    )
    return _warm_start(fresh, run_of(source), trainer), source, fresh


def run_of(state: TrainState) -> Run:
    """A run that ended so."""
    run: Any = SimpleNamespace(policy=state.policy)
    return run


def test_a_utility_policy_keeps_everything() -> None:
    state, source, _ = started("mean")
    assert state.params == source.params
    assert state.rollout == SimpleNamespace(
        actions="test actions", observation_statistics="trained"
    )


def test_a_discrete_policy_gets_new_categorical_heads() -> None:
    state, source, fresh = started("logits")
    assert state.params["policy"] == fresh.params["policy"]
    assert state.params["critic"] == source.params["critic"]
    heads = state.params["auxiliary"]["heads"]
    assert heads["stop"] is fresh.params["auxiliary"]["heads"]["stop"]
    for name in ("alpha", "beta"):
        assert heads[name] == source.params["auxiliary"]["heads"][name]
    assert source.params["auxiliary"]["heads"]["stop"]["kernel"][0] == 1.0, "it is left alone"


def test_a_discrete_policy_may_have_no_stop_bit() -> None:
    source, fresh = state_of(1.0, "logits", 5, ""), state_of(0.0, "logits", 3, "")
    for state in (source, fresh):
        del state.params["auxiliary"]
    trainer: Any = SimpleNamespace(
        learner=SimpleNamespace(restarted=lambda state, *_: state), training=None
    )
    params = _warm_start(fresh, run_of(source), trainer).params
    assert params == {"policy": fresh.params["policy"], "critic": source.params["critic"]}
