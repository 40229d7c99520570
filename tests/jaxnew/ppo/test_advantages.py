"""Generalised advantage estimation against its definition as a sum (docs/method.md, "PPO")."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from jaxnew.ppo.advantages import failures, gae, temporal_differences

T, N = 9, 3
compiled = jax.jit(gae)


def expected_gae(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    has_no_future: np.ndarray,
    done: np.ndarray,
    discount: float,
    lam: float,
) -> np.ndarray:
    """A_t = sum_k (gamma lambda)^k delta_{t+k} up to the end of the episode or of the rollout."""
    advantages = np.zeros((T, N))
    for n in range(N):
        for t in range(T):
            for k in range(T - t):
                i = t + k
                future = 0.0 if has_no_future[i, n] else discount * next_values[i, n]
                delta = rewards[i, n] + future - values[i, n]
                advantages[t, n] += (discount * lam) ** k * delta
                if done[i, n]:
                    break
    return advantages


NUMBERS = npst.arrays(np.float32, (T, N), elements=st.floats(-10, 10, width=32))
FLAGS = npst.arrays(bool, (T, N))


@pytest.mark.property
@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    rewards=NUMBERS,
    values=NUMBERS,
    next_values=NUMBERS,
    terminated=FLAGS,
    truncated=FLAGS,
    discount=st.sampled_from([0.0, 0.9, 0.99, 1.0]),
    lam=st.sampled_from([0.0, 0.5, 0.95, 1.0]),
    time_limits_are_ends=st.booleans(),
)
def test_advantages_are_the_sum_of_the_definition(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    discount: float,
    lam: float,
    time_limits_are_ends: bool,
) -> None:
    done = terminated | truncated
    has_no_future = done if time_limits_are_ends else terminated
    advantages, targets = compiled(rewards, values, next_values, has_no_future, done, discount, lam)
    expected = expected_gae(rewards, values, next_values, has_no_future, done, discount, lam)
    # Sums of nine numbers up to 30: float32 roundings of 2e-5.
    np.testing.assert_allclose(advantages, expected, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(targets, expected + values, rtol=1e-5, atol=1e-4)


@pytest.mark.unit
def test_worked_numbers() -> None:
    """One environment, gamma 0.5, lambda 0.5; the second step truncates, the last goes on.

    delta_3 = 1 + 0.5 * 8 - 2 = 3                 A_3 = 3
    delta_2 = 4 + 0.5 * 6 - 1 = 6                 A_2 = 6      (the sum stops at the end)
    delta_1 = 2 + 0.5 * 1 - 3 = -0.5              A_1 = -0.5 + 0.25 * 6 = 1
    With the time limit as an end: delta_2 = 4 - 1 = 3 = A_2, A_1 = -0.5 + 0.75 = 0.25.
    """
    rewards, values, next_values = (
        jnp.array(x)[:, None] for x in ([2.0, 4.0, 1.0], [3.0, 1.0, 2.0], [1.0, 6.0, 8.0])
    )
    done = jnp.array([False, True, False])[:, None]
    terminated = jnp.zeros_like(done)
    advantages, targets = gae(rewards, values, next_values, terminated, done, 0.5, 0.5)
    assert advantages[:, 0].tolist() == [1.0, 6.0, 3.0]
    assert targets[:, 0].tolist() == [4.0, 7.0, 5.0]
    advantages, _ = gae(rewards, values, next_values, done, done, 0.5, 0.5)
    assert advantages[:, 0].tolist() == [0.25, 3.0, 3.0]


@pytest.mark.unit
def test_a_failure_ends_an_episode_for_less_than_expected() -> None:
    """Differences of two environments: -0.5, 6, 3 and -9, 0, -4. Only the last two steps of the
    first one and the first and the last of the second end an episode."""
    rewards, values, next_values = (
        jnp.array(x).T
        for x in (
            [[2.0, 4.0, 1.0], [0.0, 1.0, 0.0]],
            [[3.0, 1.0, -2.0], [9.0, 3.0, 4.0]],
            [[1.0, 6.0, 8.0], [5.0, 4.0, 0.0]],
        )
    )
    terminated = jnp.array([[False, True, True], [True, False, True]]).T
    deltas = temporal_differences(rewards, values, next_values, terminated, 0.5)
    assert deltas.T.tolist() == [[-0.5, 3.0, 3.0], [-9.0, 0.0, -4.0]]
    assert failures(terminated, deltas).T.tolist() == [[False] * 3, [True, False, True]]


@pytest.mark.unit
def test_unequal_shapes_are_refused() -> None:
    ones = jnp.ones((3, 2))
    flags = jnp.zeros((3, 2), bool)
    with pytest.raises(AssertionError, match="shape"):
        gae(ones, ones, ones[:2], flags, flags, 0.9, 0.9)
