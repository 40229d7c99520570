"""The PPO objective (docs/method.md, "PPO")."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxnew.policy import PolicyMethod, distribution_and_value
from jaxnew.sampling import Actions, AvailableSet


@struct.dataclass
class Hyperparameters:
    """Numbers that a sweep may vary: all traced, so that one program serves every value.

    Attributes:
      learning_rate: of Adam at the start; it falls linearly to a tenth over `lr_steps`.
      entropy_coefficient: weight of the mean entropy at the start.
      final_entropy: share of that weight that is left at the end; it falls linearly over
        `lr_steps`.
      clip: of the probability ratio, and of the value's change.
      discount: gamma.
      gae_lambda: lambda of the advantage estimator.
      value_coefficient: weight of the value loss.
      failure_coefficient: weight of the loss of a policy that foretells failures.
      representation_noise: deviation of the Gaussian noise on representations during training, in
        that of the actions that are trained with, see `Actions.perturbed`.
    """

    learning_rate: float = 1e-3
    entropy_coefficient: float = 0.05
    final_entropy: float = 1.0
    clip: float = 0.1
    discount: float = 0.99
    gae_lambda: float = 0.95
    value_coefficient: float = 0.5
    failure_coefficient: float = 1.0
    representation_noise: float = 0.0

    def check(self) -> None:
        """Raises ValueError unless every number, none of them traced, is in its range."""
        ranges = {
            "learning_rate": (0.0, 1.0),
            "entropy_coefficient": (0.0, math.inf),
            "final_entropy": (0.0, 1.0),
            "clip": (0.0, math.inf),
            "discount": (0.0, 1.0),
            "gae_lambda": (0.0, 1.0),
            "value_coefficient": (0.0, math.inf),
            "failure_coefficient": (0.0, math.inf),
            "representation_noise": (0.0, math.inf),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                bounds = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
                raise ValueError(f"{name}={value} must be {bounds}.")


@struct.dataclass
class Minibatch:
    """Transitions to learn from; every field is `[B, ...]`.

    Attributes:
      observation: f32[B, ...] normalised, or uint8[B, H, W, C] images.
      available: sets [B, m], or None where one fixed set is in force in all of them.
      sample: what the policy drew, a pytree.
      log_prob: f32[B] its log-probability then.
      value: f32[B] value then.
      advantage: f32[B] normalised over the whole rollout.
      value_target: f32[B].
      is_failure: bool[B] whether the episode ended badly, see `jaxnew.ppo.advantages.failures`.
    """

    observation: jax.Array
    available: AvailableSet | None
    sample: Any
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    value_target: jax.Array
    is_failure: jax.Array


def normalize_advantages(advantages: jax.Array) -> jax.Array:
    """Subtracts the mean and divides by the standard deviation + 1e-5, over all of them.

    The deviation is the sample one (n - 1), as in the original's PyTorch code.
    """
    return (advantages - jnp.mean(advantages)) / (jnp.std(advantages, ddof=1) + 1e-5)


def loss(
    params: Any,
    projected: jax.Array,
    minibatch: Minibatch,
    available: AvailableSet,
    method: PolicyMethod,
    hyperparameters: Hyperparameters,
    actions: Actions,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate, clipped value loss and entropy bonus, means over the minibatch, and the
    loss of a policy that foretells failures.

    Args:
      params: of the policy.
      projected: `method.project` of `actions.offered`, f32[R, p]; handed in, so that it is computed
        once per gradient step.
      minibatch: B transitions.
      available: their sets [B, m], or the fixed one [n].
      method: the policy.
      hyperparameters: traced weights.
      actions: what the sets are of.

    Returns:
      The total loss f32[] and its parts, for the log.
    """
    rows = actions.rows(projected, available)
    distribution, value = distribution_and_value(
        method, params, minibatch.observation, rows, available.mask
    )
    log_ratio = distribution.log_prob(minibatch.sample) - minibatch.log_prob
    ratio = jnp.exp(log_ratio)
    clip = hyperparameters.clip
    policy_loss = -jnp.mean(
        jnp.minimum(
            ratio * minibatch.advantage,
            jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * minibatch.advantage,
        )
    )
    clipped_value = minibatch.value + jnp.clip(value - minibatch.value, -clip, clip)
    value_loss = 0.5 * jnp.mean(
        jnp.maximum(
            (value - minibatch.value_target) ** 2, (clipped_value - minibatch.value_target) ** 2
        )
    )
    entropy = jnp.mean(distribution.entropy(minibatch.sample))
    total = (
        policy_loss
        + hyperparameters.value_coefficient * value_loss
        - hyperparameters.entropy_coefficient * entropy
    )
    foretold = {}
    failure_loss = getattr(method, "failure_loss", None)
    if failure_loss is not None:
        taken = method.decode(minibatch.sample, available, actions.table).id
        failed = jnp.mean(
            failure_loss(params, distribution, actions.table[taken], minibatch.is_failure)
        )
        total += hyperparameters.failure_coefficient * failed
        foretold = {"loss/failure": failed}
    return total, {
        **foretold,
        "loss/total": total,
        "loss/policy": policy_loss,
        "loss/value": value_loss,
        "policy/entropy": entropy,
        "policy/approximate_kl": jnp.mean(ratio - 1.0 - log_ratio),
        "policy/clipped": jnp.mean((jnp.abs(ratio - 1.0) > clip).astype(jnp.float32)),
    }
