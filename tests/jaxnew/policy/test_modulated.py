"""What a modulated utility policy has that others have not; its forward pass: test_utility.py."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import UtilityMethod, method_of_evaluations
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.modulated import ModulatedMethod
from tests.jaxnew.policy import numpy_policy

NUM_FEATURES, D, M, BATCH = 9, 5, 12, 7
NETWORK = NetworkConfig(state_width=24, critic_width=16, utility_width=40)
METHOD = ModulatedMethod(NETWORK)
RNG = np.random.default_rng(0)
OBS = RNG.normal(size=(BATCH, NUM_FEATURES)).astype(np.float32)
REPRESENTATIONS = RNG.normal(size=(BATCH, M, D)).astype(np.float32)
MASK = np.ones((BATCH, M), bool)


@pytest.fixture(scope="module")
def params() -> Any:
    fresh = METHOD.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    return numpy_policy.randomized(fresh, seed=1)


@pytest.mark.property
@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_a_modulated_utility_reads_representations_in_their_own_unit(scale: float) -> None:
    """Moved and stretched as a whole, they are the same to it; their dimensions keep their ratios.

    Roundings of 7 scale by 1e-7 are 1e-6 of the unit."""
    rng = np.random.default_rng(8)
    known = rng.normal(size=(50, D)) * np.linspace(0.2, 2.0, D)
    known -= known.mean(axis=0)
    unit = np.sqrt((known**2).mean())
    plain = ModulatedMethod(NETWORK)
    fresh = plain.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    drawn = numpy_policy.randomized(fresh, seed=1)
    given = (scale * (known + 7.0)).astype(np.float32)
    method = ModulatedMethod(NETWORK, given)
    for name in ("project", "embed"):
        found = getattr(method, name)(drawn, given[:9])
        expected = getattr(plain, name)(drawn, (known[:9] / unit).astype(np.float32))
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
    # One action has no deviation.
    assert np.isfinite(ModulatedMethod(NETWORK, given[:1]).project(drawn, given[:1])).all()


@pytest.mark.unit
def test_evaluations_are_of_the_cautious_policy_and_learning_is_not(params: Any) -> None:
    """An action that one head alone is afraid of is avoided in evaluations only."""
    weights = dict(params["failure"]["weights"])
    weights["kernel"] = 0.0 * weights["kernel"]
    weights["bias"] = np.where(np.arange(4 * 33) == 2 * 33 + 3, 4.0, 0.0).astype(np.float32)
    params = {**params, "failure": {**params["failure"], "weights": weights}}
    _, odds = numpy_policy.modulated(params, OBS, REPRESENTATIONS)
    assert (odds[..., [0, 1, 3]] == 0).all()
    logits = {}
    for method in (METHOD, method_of_evaluations(METHOD)):
        projected = method.project(params, REPRESENTATIONS)
        found = method.distribution(params, OBS, projected, MASK)
        logits[method] = np.asarray(jax.nn.log_softmax(found.logits))
    learning, evaluated = logits.values()
    expected = np.asarray(
        jax.nn.log_softmax(learning - 8.0 * np.logaddexp(0.0, odds[..., 2].clip(0.0)))
    )
    assert odds[..., 2].max() > 1.0
    np.testing.assert_allclose(evaluated, expected, rtol=1e-4, atol=1e-4)
    # A method that has no other way to act acts as it learns.
    ours = UtilityMethod(NETWORK)
    assert method_of_evaluations(ours) is ours


@pytest.mark.oracle
def test_every_head_learns_from_what_came_of_an_action(params: Any) -> None:
    """The sum over heads of the cross entropy, and its gradient; what is gained by an action does
    not reach them."""
    is_failure = np.arange(BATCH) % 3 == 0
    taken = REPRESENTATIONS[:, 4]

    def policy(params: Any) -> Any:
        projected = METHOD.project(params, REPRESENTATIONS)
        return METHOD.distribution(params, OBS, projected, MASK)

    def total(params: Any) -> jax.Array:
        return jnp.sum(METHOD.failure_loss(params, policy(params), taken, is_failure))

    _, odds = numpy_policy.modulated(params, OBS, REPRESENTATIONS)
    odds = odds[:, 4]
    assert odds.std(axis=-1).min() > 0.01, "heads that differ"
    expected = np.logaddexp(0.0, np.where(is_failure[:, None], -odds, odds)).sum(axis=-1)
    found = METHOD.failure_loss(params, policy(params), taken, is_failure)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    gradient = jax.grad(total)(params)
    slope = (1.0 / (1.0 + np.exp(-odds)) - is_failure[:, None]).sum(axis=0)
    bias = np.asarray(gradient["failure"]["weights"]["bias"]).reshape(4, 33)[:, -1]
    np.testing.assert_allclose(bias, slope, rtol=1e-4, atol=1e-5)
    # The state feature and the embedding are shared, and learn from it too.
    for module, name in (("encoder", "Dense_0"), ("utility", "embed")):
        assert np.abs(gradient[module][name]["kernel"]).max() > 1e-4
    of_choice = jax.grad(lambda p: jnp.sum(policy(p).log_prob(jnp.full(BATCH, 4))))(params)
    assert all((np.asarray(x) == 0).all() for x in jax.tree.leaves(of_choice["failure"]))


@pytest.mark.unit
def test_heads_start_apart() -> None:
    fresh = METHOD.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    for name, width in (("of_action", 32), ("of_state", 32), ("weights", 33)):
        kernel = np.asarray(fresh["failure"][name]["kernel"])
        heads = kernel.reshape(len(kernel), 4, width)
        assert all(not np.allclose(heads[:, 0], heads[:, i]) for i in (1, 2, 3)), name
