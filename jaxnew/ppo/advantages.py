"""Generalised advantage estimation, and what counts as a failure."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp


def gae(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    discount: jax.Array | float,
    lam: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Generalised advantage estimates, bootstrapping through time limits.

    Args:
      rewards: f32[T, N] reward after each step.
      values: f32[T, N] value of the observation before each step.
      next_values: f32[T, N] value of the observation the step really produced,
        i.e. of `final_observation` where an episode ended.
      terminated: bool[T, N] ends after which nothing is gained. Give `done` here to treat time
        limits as ends, as the paper's runs did.
      done: bool[T, N] any end; the recursion stops there.
      discount: gamma.
      lam: lambda of the estimator.

    Returns:
      advantages f32[T, N] and value targets f32[T, N] (advantages + values).
    """
    chex.assert_equal_shape([rewards, values, next_values, terminated, done])
    deltas = temporal_differences(rewards, values, next_values, terminated, discount)

    def step(
        advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        delta, is_done = inputs
        advantage = delta + discount * lam * jnp.where(is_done, 0.0, advantage)
        return advantage, advantage

    _, advantages = jax.lax.scan(step, jnp.zeros_like(deltas[0]), (deltas, done), reverse=True)
    return advantages, advantages + values


def temporal_differences(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    discount: jax.Array | float,
) -> jax.Array:
    """f32[T, N] by how much each step was better than its observation's value; see `gae`."""
    goes_on = jnp.asarray(~terminated, jnp.float32)
    return rewards + discount * next_values * goes_on - values


def failures(terminated: jax.Array, deltas: jax.Array) -> jax.Array:
    """bool[T, N] steps that ended their episode for less than their observation's value."""
    return terminated & (deltas < 0)
