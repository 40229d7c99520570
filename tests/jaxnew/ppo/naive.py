"""PPO and its networks, written again as plainly as it can be; an oracle for the learner.

Forward pass and loss follow the paper's formulas one transition set at a time (the utility function
on concatenated features, the table looked up inside the loss) and are differentiated by JAX in
float64; all else is NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.ppo import Hyperparameters


def _dense(layer: dict[str, Any], x: jax.Array) -> jax.Array:
    return x @ layer["kernel"] + layer["bias"]


def _encode(layers: dict[str, Any], obs: jax.Array) -> jax.Array:
    return jnp.tanh(_dense(layers["Dense_1"], jnp.tanh(_dense(layers["Dense_0"], obs))))


def _utilities(params: Any, obs: jax.Array, representations: jax.Array) -> jax.Array:
    features = _encode(params["encoder"], obs)
    embedded = _dense(params["utility"]["embed"], representations)
    features = jnp.broadcast_to(features[:, None], embedded.shape)
    hidden = _dense(params["utility"], jnp.concatenate([features, embedded], axis=-1))
    return _dense(params["utility"]["score"], jnp.maximum(hidden, 0))[..., 0]


def loss(
    params: Any, table: jax.Array, data: dict[str, jax.Array], hp: dict[str, float]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Total loss of transitions [B, ...] and its parts."""
    utilities = _utilities(params, data["observation"], table[data["ids"]])
    # Softmax over the real entries only; -inf - (-inf) is kept out of the sums by `where`.
    log_normalizer = jax.scipy.special.logsumexp(utilities, axis=1, where=data["mask"])
    log_probs = utilities - log_normalizer[:, None]
    chosen = log_probs[jnp.arange(len(utilities)), data["sample"]]
    entropy = -jnp.sum(jnp.where(data["mask"], jnp.exp(log_probs) * log_probs, 0), axis=1).mean()

    ratio = jnp.exp(chosen - data["log_prob"])
    clip, advantage = hp["clip"], data["advantage"]
    limited = jnp.minimum(jnp.maximum(ratio, 1 - clip), 1 + clip)
    policy_loss = -jnp.minimum(ratio * advantage, limited * advantage).mean()

    critic = params["critic"]
    value = _dense(critic["value"], _encode(critic["VectorEncoder_0"], data["observation"]))[:, 0]
    change = jnp.minimum(jnp.maximum(value - data["value"], -clip), clip)
    target = data["value_target"]
    errors = (value - target) ** 2, (data["value"] + change - target) ** 2
    value_loss = 0.5 * jnp.maximum(*errors).mean()

    total = policy_loss + hp["value_coefficient"] * value_loss - hp["entropy_coefficient"] * entropy
    log_ratio = chosen - data["log_prob"]
    return total, {
        "loss/total": total,
        "loss/policy": policy_loss,
        "loss/value": value_loss,
        "policy/entropy": entropy,
        "policy/approximate_kl": (ratio - 1 - log_ratio).mean(),
        "policy/clipped": ((ratio > 1 + clip) | (ratio < 1 - clip)).mean(),
    }


_gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))


def gradient(
    params: Any, table: np.ndarray, data: dict[str, np.ndarray], hp: Hyperparameters
) -> tuple[dict[str, float], Any]:
    """The parts of the loss and its gradient, in float64."""
    as_double = lambda x: np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else x  # noqa: E731
    with jax.enable_x64(True):
        (_, parts), grads = _gradient(
            *jax.tree.map(as_double, (params, table, data, vars(hp))),
        )
        return jax.tree.map(np.asarray, (parts, grads))


def advantages_of(
    data: dict[str, np.ndarray], has_no_future: np.ndarray, hp: Hyperparameters
) -> np.ndarray:
    """GAE backwards over [T, N] in float64."""
    mask = 1.0 - has_no_future
    delta = data["reward"] + hp.discount * data["next_value"] * mask - data["value"]
    advantages, running = np.zeros(delta.shape), 0.0
    for t in reversed(range(len(delta))):
        running = delta[t] + hp.discount * hp.gae_lambda * (1.0 - data["done"][t]) * running
        advantages[t] = running
    return advantages


@dataclass
class Adam:
    """Adam with betas (0.9, 0.999) and eps 1e-5, after clipping the global norm to 0.5."""

    first: Any
    second: Any
    count: int = 0

    def step(self, params: Any, grads: Any, learning_rate: float) -> tuple[Any, float]:
        """New parameters and the norm before clipping."""
        norm = np.sqrt(sum((g**2).sum() for g in jax.tree.leaves(grads)))
        grads = jax.tree.map(lambda g: g * min(1.0, 0.5 / norm), grads)
        self.count += 1
        self.first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, self.first, grads)
        self.second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, self.second, grads)
        first_scale, second_scale = 1 - 0.9**self.count, 1 - 0.999**self.count
        new = jax.tree.map(
            lambda p, m, v: (
                p - learning_rate * (m / first_scale) / (np.sqrt(v / second_scale) + 1e-5)
            ),
            params,
            self.first,
            self.second,
        )
        return new, float(norm)
