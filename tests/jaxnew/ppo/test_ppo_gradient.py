"""Gradient steps against a plain re-implementation (docs/method.md, "PPO")."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.finiteness import cause_of
from jaxnew.policy import make_method
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.ppo.objective import Minibatch
from jaxnew.rollout.contract import RolloutBatch, RolloutConfig
from jaxnew.sampling import AvailableSet
from tests.jaxnew.policy import numpy_policy
from tests.jaxnew.ppo import naive
from tests.jaxnew.ppo.learners import (
    ACTIONS,
    BOOTSTRAPPED,
    CONFIG,
    NO_STEP,
    TABLE,
    WIDTH,
    A,
    D,
    M,
    N,
    T,
    learner_of,
)


@functools.cache
def learn_of(config: PPOConfig) -> Any:
    return jax.jit(learner_of(config).learn)


@pytest.fixture(scope="module")
def params() -> Any:
    shapes = make_method("ours").init(jax.random.key(0), jnp.zeros(4), D)
    return numpy_policy.randomized(shapes, seed=1, scale=0.1)


def batch_of(params: Any, seed: int, value_scale: float) -> dict[str, np.ndarray]:
    """A rollout [T, N] of numbers as they may occur: the data are near the policy, not on it."""
    rng = np.random.default_rng(seed)
    observation = rng.normal(size=(T, N, 4)).astype(np.float32)
    ids = np.array([rng.permutation(A)[:WIDTH] for _ in range(T * N)], np.int32)
    ids = ids.reshape(T, N, WIDTH)
    mask = np.broadcast_to(np.arange(WIDTH) < M, ids.shape)
    sample = rng.integers(0, M, (T, N)).astype(np.int32)
    log_probs = numpy_policy.log_softmax(
        numpy_policy.utilities(params, observation, TABLE[ids]), mask
    )
    log_prob = np.take_along_axis(log_probs, sample[..., None], axis=-1)[..., 0]
    value = numpy_policy.value(params, observation)
    terminated = rng.random((T, N)) < 0.15
    data = {
        "log_prob": log_prob + rng.normal(0, 0.1, (T, N)),
        "value": value + rng.normal(0, 0.1, (T, N)),
        "next_value": value_scale * rng.normal(size=(T, N)),
        "reward": value_scale * rng.normal(size=(T, N)),
    }
    return {
        **{name: x.astype(np.float32) for name, x in data.items()},
        "observation": observation,
        "ids": ids,
        "mask": mask,
        "sample": sample,
        "terminated": terminated,
        "done": terminated | (rng.random((T, N)) < 0.15),
    }


def as_batch(data: dict[str, np.ndarray]) -> RolloutBatch:
    data = dict(data)
    return RolloutBatch(available=AvailableSet(data.pop("ids"), data.pop("mask")), **data)


def metrics_of(learner: Learner, learn: Any, params: Any, data: dict[str, np.ndarray]) -> Any:
    """What `learn`, that of `learner`, says of a first update."""
    fresh = learner.optimizer.init(params)
    batch, hp = as_batch(data), Hyperparameters()
    *_, metrics = learn(jax.random.key(0), params, fresh, batch, hp, ACTIONS, NO_STEP)
    return metrics


@pytest.mark.oracle
@pytest.mark.parametrize("config", [CONFIG, BOOTSTRAPPED], ids=["ends", "bootstrapped"])
@pytest.mark.parametrize("value_scale", [0.05, 3.0])
def test_learning_from_two_batches_is_what_the_formulas_say(
    params: Any, config: PPOConfig, value_scale: float
) -> None:
    """GAE, normalisation, minibatches, both losses, clipping, Adam and its schedule, in one.

    Adam moves a parameter by up to `learning_rate`, 1e-3, per step; its eps of 1e-5 keeps float32
    roundings of the gradient (1e-8) to 1e-3 of that. Eight steps: below 1e-5.
    """
    hp = Hyperparameters(
        learning_rate=2e-3,
        entropy_coefficient=0.3,
        final_entropy=0.25,
        clip=0.15,
        discount=0.9,
        gae_lambda=0.8,
        value_coefficient=0.7,
    )
    learner, learn = learner_of(config), learn_of(config)
    state = params, learner.optimizer.init(params)
    expected = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    zeros = jax.tree.map(np.zeros_like, expected)
    adam = naive.Adam(zeros, zeros)
    norms: list[float] = []
    for update in (3, 40):  # On the slope and after it: J = 10.
        data = batch_of(params, seed=update, value_scale=value_scale)
        key = jax.random.key(update)
        *state, metrics = learn(key, *state, as_batch(data), hp, ACTIONS, jnp.int32(update))

        learning_rate = 2e-3 * (1 - 0.9 * min(1.0, update / 10))
        now = hp.replace(entropy_coefficient=0.3 * (1 - 0.75 * min(1.0, update / 10)))
        np.testing.assert_allclose(metrics["learning_rate"], learning_rate, rtol=1e-6)
        has_no_future = data["done"] if config is CONFIG else data["terminated"]
        advantages = naive.advantages_of(data, has_no_future, hp)
        normalized = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-5)
        flat = {
            name: x.reshape(-1, *x.shape[2:])
            for name, x in {
                **data,
                "advantage": normalized,
                "value_target": advantages + data["value"],
            }.items()
        }
        history: list[dict[str, float]] = []
        for indices in np.asarray(learner._minibatch_indices(key)):
            minibatch = {name: x[indices] for name, x in flat.items()}
            parts, grads = naive.gradient(expected, TABLE, minibatch, now)
            expected, norm = adam.step(expected, grads, learning_rate)
            norms.append(norm)
            history.append({**parts, "gradient_norm": norm})
        assert len(history) == 4
        for name in history[0]:
            mean = np.mean([step[name] for step in history])
            np.testing.assert_allclose(metrics[name], mean, rtol=1e-4, atol=1e-5, err_msg=name)
        residual = flat["value_target"] - flat["value"]
        explained = 1 - residual.var() / flat["value_target"].var()
        np.testing.assert_allclose(metrics["value/explained_variance"], explained, atol=1e-4)
        assert {float(metrics[f"nonfinite/{x}"]) for x in ("loss", "gradient", "advantage")} == {0}

    for got, want in zip(jax.tree.leaves(state[0]), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-5)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), expected, params)
    assert max(jax.tree.leaves(moved)) > 2e-3  # Far more than the tolerance.
    # Both sides of the bound on the norm were tested.
    assert (max(norms) > 0.5) if value_scale == 3.0 else (min(norms) < 0.5), norms


@pytest.mark.property
@pytest.mark.parametrize("microbatch_size", [0, 1, 4, 16])
def test_gradient_of_projected_microbatches_is_that_of_the_naive_loss(
    params: Any, microbatch_size: int
) -> None:
    """The table projected once and microbatches added up, against the loss that looks rows up and
    projects them for the whole minibatch. Means of 16 terms: float32 roundings only."""
    learner = learner_of(replace(CONFIG, microbatch_size=microbatch_size))
    data = batch_of(params, seed=2, value_scale=1.0)
    flat = {name: x.reshape(-1, *x.shape[2:])[:16] for name, x in data.items()}
    extra = np.random.default_rng(3).normal(size=(2, 16)).astype(np.float32)
    minibatch = {
        **{
            name: flat[name]
            for name in ("observation", "ids", "mask", "sample", "log_prob", "value")
        },
        "advantage": extra[0],
        "value_target": extra[1],
        "is_failure": extra[0] < 0,
    }
    hp = Hyperparameters()
    under_test = dict(minibatch)
    available = AvailableSet(under_test.pop("ids"), under_test.pop("mask"))
    grads, parts = jax.jit(learner._gradient)(
        params, Minibatch(available=available, **under_test), hp, ACTIONS, available
    )
    expected_parts, expected = naive.gradient(params, TABLE, minibatch, hp)
    for name, value in expected_parts.items():
        np.testing.assert_allclose(parts[name], value, rtol=2e-5, atol=2e-5, err_msg=name)
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(grads), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * largest)
    # The projection itself is among what was compared.
    assert np.abs(expected["utility"]["embed"]["kernel"]).max() > 1e-3 * largest


@pytest.mark.oracle
@pytest.mark.parametrize("config", [CONFIG, BOOTSTRAPPED], ids=["ends", "bootstrapped"])
def test_failures_of_a_rollout_are_foretold_from_it(config: PPOConfig) -> None:
    """Before the first step: cross entropy with whether each step ended its episode for less than
    its value, by the rule of the config for time limits."""
    config = replace(config, num_epochs=1, num_minibatches=1)
    learner = learner_of(config, "modulated")
    shapes = learner.method.init(jax.random.key(0), jnp.zeros(4), D)
    params = numpy_policy.randomized(shapes, seed=1)
    data = batch_of(make_method("ours").init(jax.random.key(0), jnp.zeros(4), D), 4, 1.0)
    metrics = metrics_of(learner, jax.jit(learner.learn), params, data)
    ends = data["done"] if config.time_limits_are_ends else data["terminated"]
    is_failure = ends & (data["reward"] < data["value"])
    assert 0 < is_failure.sum() < ends.sum()
    _, odds = numpy_policy.modulated(params, data["observation"], TABLE[data["ids"]])
    odds = np.take_along_axis(odds, data["sample"][..., None, None], axis=-2)[..., 0, :]
    expected = 4 * np.mean(np.logaddexp(0.0, np.where(is_failure[..., None], -odds, odds)))
    np.testing.assert_allclose(metrics["loss/failure"], expected, rtol=1e-4)


@pytest.mark.property
def test_every_epoch_is_a_fresh_permutation_of_all_transitions() -> None:
    learner = learner_of(replace(CONFIG, num_epochs=3))
    indices = np.asarray(learner._minibatch_indices(jax.random.key(0)))
    assert indices.shape == (6, 16)
    epochs = indices.reshape(3, 32)
    assert (np.sort(epochs, axis=1) == np.arange(32)).all()
    assert len({tuple(epoch) for epoch in epochs.tolist()} | {tuple(range(32))}) == 4
    other = np.asarray(learner._minibatch_indices(jax.random.key(1)))
    assert not np.array_equal(indices, other)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("num_steps", "lr_steps", "update", "expected"),
    [
        # Confirmed in a released CREATE checkpoint, J = 8138.
        (384, 100_000_000, 4849, 4.637e-4),
        # "lr at the end of training": CREATE, Grid World, Recommender, Shape Stacking.
        (384, 100_000_000, 4882, 4.6e-4),
        (512, 40_000_000, 2441, 1.0e-4),
        (256, 40_000_000, 4882, 1.0e-4),
        (128, 100_000_000, 732, 9.7e-4),
        # It stays there.
        (512, 40_000_000, 10_000, 1.0e-4),
        (512, 40_000_000, 0, 1.0e-3),
    ],
)
def test_learning_rate_schedule(
    num_steps: int, lr_steps: int, update: int, expected: float
) -> None:
    rollout = RolloutConfig(num_envs=32, num_steps=num_steps)
    config = PPOConfig(rollout=rollout, lr_steps=lr_steps)
    assert config.lr_updates == lr_steps // num_steps // 32
    if num_steps == 384:
        assert config.lr_updates == 8138
    learner = learner_of(config)
    got = 1e-3 * float(learner._falling_to(0.1, jnp.int32(update)))
    # To the digits given.
    np.testing.assert_allclose(got, expected, rtol=1.5e-2 if expected in (4.6e-4,) else 6e-3)
    if update == 4849:
        np.testing.assert_allclose(got, 4.637e-4, rtol=2e-4)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ("observation", "observation"),
        ("reward", "reward"),
        ("log_prob", "policy"),
        ("next_value", "next_value"),
        ("params", "loss"),
    ],
)
def test_nonfinite_numbers_are_counted(params: Any, broken: str, cause: str) -> None:
    """And the first of them is named."""
    data = batch_of(params, seed=5, value_scale=1.0)
    if broken != "params":
        data[broken][T - 1, 2] = np.nan
    else:
        params = jax.tree.map(np.copy, params)
        params["encoder"]["Dense_0"]["kernel"][0, 0] = np.nan
    learner = learner_of(CONFIG)
    metrics = metrics_of(learner, learn_of(CONFIG), params, data)
    assert metrics["nonfinite/loss"] >= 1
    assert metrics["nonfinite/gradient"] >= 1
    assert cause_of(metrics) == cause
    if broken == "reward":
        # One that spreads to what came before it in its episode, and no further.
        assert 1 <= metrics["nonfinite/advantage"] <= T
    elif broken != "next_value":
        assert metrics["nonfinite/advantage"] == 0


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_minibatches": 3}, r"32 is not divisible by num_minibatches=3"),
        ({"microbatch_size": 5}, r"16 transitions is not divisible by microbatch_size=5.*0"),
        ({"rollout": RolloutConfig(1, 1)}, "one advantage has no deviation"),
        ({"lr_steps": 31}, r"lr_steps=31 is less than one update of 32 steps"),
        ({"time_limits_are_ends": False}, r"opposite of time_limits_are_ends, got False"),
        ({"num_minibatches": 0}, "num_minibatches"),
        ({"num_minibatches": -2}, "num_minibatches"),
        ({"num_epochs": 0}, "num_epochs"),
        ({"microbatch_size": -4}, "microbatch_size"),
        ({"max_grad_norm": 0.0}, "max_grad_norm"),
    ],
)
def test_bad_configs_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes)
