"""The PPO loss and its parts against float64 from the formulas (docs/method.md, "PPO")."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from jaxnew.policy import UtilityMethod
from jaxnew.policy.modulated import ModulatedMethod
from jaxnew.ppo import Hyperparameters
from jaxnew.ppo.objective import Minibatch, loss, normalize_advantages
from jaxnew.sampling import Actions, AvailableSet
from tests.jaxnew.policy import numpy_policy
from tests.jaxnew.ppo import naive

B, A, M, D, NUM_FEATURES = 40, 9, 5, 3, 4
METHOD, MODULATED = UtilityMethod(), ModulatedMethod()

# float32 against float64 on means of 40 order-one numbers.
TOLERANCE = {"rtol": 2e-5, "atol": 2e-5}


@pytest.fixture(scope="module")
def params() -> Any:
    shapes = METHOD.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    return numpy_policy.randomized(shapes, seed=1)


TABLE = np.random.default_rng(2).normal(size=(A, D)).astype(np.float32)
ACTIONS = Actions.of(TABLE, np.arange(A), 4, padded_size=M)


def transitions(params: Any, seed: int, log_ratio: np.ndarray, change: np.ndarray) -> dict:
    """Transitions [B] on which the new policy is `exp(log_ratio)` as likely to do what was done,
    and the new value is higher by `change`."""
    rng = np.random.default_rng(seed)
    observation = rng.normal(size=(B, NUM_FEATURES)).astype(np.float32)
    ids = np.array([rng.permutation(A)[:M] for _ in range(B)], np.int32)
    mask = np.broadcast_to(np.arange(M) < 4, (B, M))
    sample = rng.integers(0, 4, B).astype(np.int32)
    log_probs = numpy_policy.log_softmax(
        numpy_policy.utilities(params, observation, TABLE[ids]), mask
    )
    new_value = numpy_policy.value(params, observation)
    return {
        "observation": observation,
        "ids": ids,
        "mask": mask,
        "sample": sample,
        "log_prob": (log_probs[np.arange(B), sample] - log_ratio).astype(np.float32),
        "value": (new_value - change).astype(np.float32),
        "advantage": rng.normal(size=B).astype(np.float32),
        "value_target": (new_value + rng.normal(0, 0.3, B)).astype(np.float32),
        "is_failure": rng.random(B) < 0.3,
    }


@functools.partial(jax.jit, static_argnames="method")
def compiled(
    params: Any, data: dict[str, jax.Array], hp: Hyperparameters, method: UtilityMethod = METHOD
) -> Any:
    """((total, parts), gradient) of the loss under test."""
    data = dict(data)
    available = AvailableSet(data.pop("ids"), data.pop("mask"))
    minibatch = Minibatch(available=available, **data)

    def total(params: Any) -> Any:
        projected = method.project(params, ACTIONS.offered(available))
        return loss(params, projected, minibatch, available, method, hp, ACTIONS)

    return jax.value_and_grad(total, has_aux=True)(params)


def assert_gradients_close(got: Any, expected: Any) -> None:
    """To the largest entry of the whole gradient: roundings of the sums of B = 40 terms."""
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))
    assert largest > 0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5 * largest)


@pytest.mark.oracle
@pytest.mark.parametrize("clip", [0.1, 0.3])
@pytest.mark.parametrize("spread", [0.0, 0.05, 0.5, 10.0])
def test_loss_parts_and_gradient(params: Any, spread: float, clip: float) -> None:
    """Ratios and values inside, around and far outside of the clip ranges; e^20 at the extreme."""
    hp = Hyperparameters(entropy_coefficient=0.07, clip=clip, value_coefficient=0.6)
    rng = np.random.default_rng(3)
    data = transitions(
        params, 4, rng.uniform(-2, 2, B) * spread, rng.uniform(-2, 2, B) * min(spread, 1.0)
    )
    (total, parts), grads = compiled(params, data, hp)
    expected, expected_grads = naive.gradient(params, TABLE, data, hp)
    assert set(parts) == set(expected)
    # The old log-probabilities are float32: a ratio of e^20 is known to 2e-6 of itself.
    for name, value in expected.items():
        np.testing.assert_allclose(parts[name], value, **TOLERANCE, err_msg=name)
    assert float(total) == float(parts["loss/total"])
    assert_gradients_close(grads, expected_grads)
    if spread == 0.5:
        assert 0.2 < parts["policy/clipped"] < 1.0


@pytest.mark.oracle
def test_foretold_failures_are_learned_from_the_actions_that_were_taken(params: Any) -> None:
    """Cross entropy of what came of them, in nats, with its weight beside the objective."""
    shapes = MODULATED.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    foretelling = numpy_policy.randomized(shapes, seed=7)
    data = transitions(params, 8, np.zeros(B), np.zeros(B))
    hp = Hyperparameters(failure_coefficient=0.7)
    (total, parts), grads = compiled(foretelling, data, hp, MODULATED)
    _, odds = numpy_policy.modulated(foretelling, data["observation"], TABLE[data["ids"]])
    odds = odds[np.arange(B), data["sample"]]
    assert odds.std() > 0.2
    failed = data["is_failure"][:, None]
    expected = 4 * np.mean(np.logaddexp(0.0, np.where(failed, -odds, odds)))
    np.testing.assert_allclose(parts["loss/failure"], expected, **TOLERANCE)
    rest = parts["loss/policy"] + hp.value_coefficient * parts["loss/value"]
    rest -= hp.entropy_coefficient * parts["policy/entropy"]
    np.testing.assert_allclose(total, rest + 0.7 * expected, **TOLERANCE)
    slope = 0.7 * 4 * np.mean(1.0 / (1.0 + np.exp(-odds)) - failed)  # Of the odds' biases.
    biases = np.asarray(grads["failure"]["weights"]["bias"]).reshape(4, -1)[:, -1]
    np.testing.assert_allclose(np.sum(biases), slope, **TOLERANCE)


def one_transition(
    params: Any, ratio: float, advantage: float, old_value: float = 0.0, target: float = 0.0
) -> dict[str, np.ndarray]:
    """B copies of a transition; `old_value` and `target` relative to the new value."""
    data = transitions(params, 5, np.full(B, np.log(ratio)), np.full(B, -old_value))
    new_value = data["value"] - old_value
    data["advantage"] = np.full(B, advantage, np.float32)
    data["value_target"] = (new_value + target).astype(np.float32)
    return data


@pytest.mark.unit
@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.05, 2.0, -2.1),  # Inside.
        (1.5, 2.0, -2.2),  # Gains are capped at 1.1 A,
        (0.5, 2.0, -1.0),  # losses are not.
        (1.5, -2.0, 3.0),
        (0.5, -2.0, 1.8),  # 0.9 A.
        (1e4, 1.0, -1.1),
        (1e4, -1.0, 1e4),
        (1e-4, -1.0, 0.9),
    ],
)
def test_policy_loss_worked(params: Any, ratio: float, advantage: float, expected: float) -> None:
    data = one_transition(params, ratio, advantage)
    (_, parts), grads = compiled(params, data, Hyperparameters(entropy_coefficient=0.0))
    np.testing.assert_allclose(parts["loss/policy"], expected, rtol=3e-5)
    # Where the cap binds, nothing pulls any further: zero gradient in the actor.
    is_capped = expected in (-2.2, 1.8, -1.1, 0.9)
    actor_grad = np.abs(np.asarray(grads["utility"]["score"]["kernel"])).max()
    assert (actor_grad == 0) == is_capped


@pytest.mark.unit
@pytest.mark.parametrize(
    ("old_value", "target", "expected"),
    [
        # V is new; the clipped value is V_old +- 0.1. 0.5 * max((V - R)^2, (V_clipped - R)^2).
        (0.05, 1.0, 0.5),  # Change below 0.1: no clip, 0.5 * 1^2.
        (-0.5, 1.0, 0.5 * 1.4**2),  # V_clipped = V - 0.4, further from R: counts, no gradient.
        (0.5, 1.0, 0.5 * 1.0**2),  # V_clipped = V + 0.4, nearer to R: the larger error, 1.
        (0.5, -1.0, 0.5 * 1.4**2),
        (0.0, 0.0, 0.0),
    ],
)
def test_value_loss_worked(params: Any, old_value: float, target: float, expected: float) -> None:
    data = one_transition(params, 1.0, 0.0, old_value, target)
    hp = Hyperparameters(entropy_coefficient=0.0)
    (total, parts), grads = compiled(params, data, hp)
    np.testing.assert_allclose(parts["loss/value"], expected, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(total, 0.5 * expected, rtol=1e-5, atol=1e-7)
    critic_grad = np.abs(np.asarray(grads["critic"]["value"]["bias"])).max()
    if expected > 0:
        assert (critic_grad == 0) == (expected > 0.9)


@pytest.mark.property
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    values=npst.arrays(np.float32, (7, 4), elements=st.floats(-1000, 1000, width=32)),
)
def test_advantages_are_normalised_over_all_of_them(values: np.ndarray) -> None:
    doubles = values.astype(np.float64)
    expected = (doubles - doubles.mean()) / (doubles.std(ddof=1) + 1e-5)
    got = np.asarray(normalize_advantages(jnp.asarray(values)))
    # Roundings of the mean, 6e-8 of the largest value, over the deviation.
    atol = 1e-5 + 1e-6 * np.abs(doubles).max() / (doubles.std(ddof=1) + 1e-5)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=atol)


@pytest.mark.unit
def test_normalisation_worked() -> None:
    # Mean 2, squares (1 + 0 + 1), sample deviation sqrt(2 / 2) = 1; the population's is 0.816.
    got = normalize_advantages(jnp.array([[1.0], [2.0], [3.0]]))
    np.testing.assert_allclose(got[:, 0], np.array([-1, 0, 1]) / (1 + 1e-5), rtol=1e-6)
    # Equal advantages teach nothing, and divide by 1e-5 and not by zero.
    assert (np.asarray(normalize_advantages(jnp.full((4, 4), 3.0))) == 0).all()
