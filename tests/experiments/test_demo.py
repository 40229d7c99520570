"""What the demo compares its policy with."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.demo import uniform
from jaxnew.policy import make_method
from jaxnew.rollout.contract import Policy
from tests.jaxnew.policy.numpy_policy import randomized

M, D, NUM_FEATURES = 7, 3, 5


@pytest.mark.unit
@pytest.mark.parametrize("name", ["ours", "modulated"])
def test_random_play_is_uniform(name: str) -> None:
    method = make_method(name)
    fresh = method.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    policy = Policy(randomized(fresh, seed=1))
    rng = np.random.default_rng(2)
    obs = rng.normal(size=(4, NUM_FEATURES)).astype(np.float32)
    vectors = rng.normal(size=(4, M, D)).astype(np.float32)

    def log_probs(policy: Policy) -> np.ndarray:
        rows = method.project(policy.params, vectors)
        found = method.distribution(policy.params, obs, rows, np.ones((4, M), bool))
        return np.stack([found.log_prob(jnp.full(4, choice)) for choice in range(M)])

    assert log_probs(policy).std() > 0.1
    np.testing.assert_allclose(log_probs(uniform(policy)), -np.log(M), rtol=1e-6)
