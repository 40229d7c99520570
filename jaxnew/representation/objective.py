"""Terms of the evidence lower bound. Pure functions.

`docs/method.md`, "Objective of stage 1".
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct

# Bound of the log-variance that fits the errors: a deviation of a 400th.
OPTIMAL_LOG_VARIANCE_MIN = -12.0


@struct.dataclass
class ElboTerms:
    """What the loss is made of; each summed over the batch and divided by its B*S recordings.

    Attributes:
      reconstruction: f32[] log-likelihood of the scored steps.
      kl_action: f32[] divergence of the action posteriors from N(0, I), each action counted once
        (so 1/S per recording, or 1/n, see `elbo_terms`); zero for the flat VAE.
      kl_observation: f32[] divergence of the recordings' posteriors from their prior.
    """

    reconstruction: jax.Array
    kl_action: jax.Array
    kl_observation: jax.Array


@struct.dataclass
class VAEOutput:
    """Distributions of one forward pass, for either VAE.

    Attributes:
      action_mean, action_log_variance: f32[B, dc] posterior q(c | O); None for the flat VAE.
      observation_mean: f32[B, S, dz] and observation_log_variance: f32[dz], posterior of z.
      prior_mean: f32[B, 1, dz] and prior_log_variance: f32[dz], prior of z; zeros (N(0, I)) for
        the flat VAE.
      prediction: f32[B, S, T-1, D] means or logits of the steps 1..T-1; f32[B, S, 1, D] of a still
        image.
      likelihood_log_variance: f32[D] that is learned; None for a categorical likelihood, and where
        the variance is that of the batch's errors.
    """

    action_mean: jax.Array | None
    action_log_variance: jax.Array | None
    observation_mean: jax.Array
    observation_log_variance: jax.Array
    prior_mean: jax.Array
    prior_log_variance: jax.Array
    prediction: jax.Array
    likelihood_log_variance: jax.Array | None


def gaussian_log_likelihood(
    target: jax.Array, mean: jax.Array, log_variance: jax.Array
) -> jax.Array:
    """Log-density of diagonal Gaussians, log(2 pi) included, summed over the last axis.

    Args:
      target: f32[..., D].
      mean: f32[..., D].
      log_variance: f32[D] or f32[..., D], not clamped.
    Returns:
      f32[...].
    """
    squared_error = jnp.square(target - mean) * jnp.exp(-log_variance)
    return -0.5 * jnp.sum(squared_error + log_variance + math.log(2.0 * math.pi), axis=-1)


def optimal_log_variance(target: jax.Array, mean: jax.Array, is_shared: bool) -> jax.Array:
    """The log-variance under which a batch is likeliest given its means: its mean squared error.

    The optimal sigma-VAE (Rybkin, Daniilidis, Levine, "Simple and Effective VAE Training with
    Calibrated Decoders", ICML 2021). No gradient flows through it: it would be zero.
    At least -12.

    Args:
      target: f32[..., D].
      mean: f32[..., D].
      is_shared: one for all D numbers, as for pixels; False: one for each.
    Returns:
      f32[D].
    """
    squared_error = jnp.square(target - mean).reshape(-1, target.shape[-1])
    variance = jnp.mean(squared_error, axis=0)
    if is_shared:
        variance = jnp.full_like(variance, jnp.mean(variance))
    variance = jnp.maximum(variance, math.exp(OPTIMAL_LOG_VARIANCE_MIN))
    return jax.lax.stop_gradient(jnp.log(variance))


def categorical_log_likelihood(
    target: jax.Array, logits: jax.Array, num_categories: int
) -> jax.Array:
    """Log-probability of one-hot coordinates, summed over coordinates.

    Args:
      target: f32[..., D] one-hot blocks of `num_categories`, one block per coordinate.
      logits: f32[..., D] in the same layout.
      num_categories: size K of a block; D is a multiple of it.
    Returns:
      f32[...].
    """
    blocks = (*logits.shape[:-1], logits.shape[-1] // num_categories, num_categories)
    log_probabilities = jax.nn.log_softmax(logits.reshape(blocks))
    return jnp.sum(target.reshape(blocks) * log_probabilities, axis=(-2, -1))


def gaussian_kl(
    mean: jax.Array,
    log_variance: jax.Array,
    prior_mean: jax.Array | float = 0.0,
    prior_log_variance: jax.Array | float = 0.0,
) -> jax.Array:
    """KL(N(mean, e^log_variance) || N(prior)) of diagonal Gaussians, summed over the last axis.

    Args:
      mean: f32[..., d].
      log_variance: f32[d] or f32[..., d], not clamped.
      prior_mean: broadcasts against `mean`; zero by default.
      prior_log_variance: broadcasts against `mean`; zero by default.
    Returns:
      f32[...].
    """
    log_ratio = log_variance - prior_log_variance
    squared = jnp.square(mean - prior_mean) * jnp.exp(-prior_log_variance)
    return 0.5 * jnp.sum(jnp.exp(log_ratio) - log_ratio + squared - 1.0, axis=-1)


@struct.dataclass
class LatentNoise:
    """Standard normal draws behind the sampled latents of one pass.

    Attributes:
      action: f32[B, dc]; not read by the flat VAE.
      observation: f32[B, S, dz].
    """

    action: jax.Array
    observation: jax.Array


def draw_noise(
    key: jax.Array, batch_shape: tuple[int, int], action_latent: int, observation_latent: int
) -> LatentNoise:
    """Noise for `batch_shape` = (B, S) recordings; consumes `key`."""
    key_action, key_observation = jax.random.split(key)
    return LatentNoise(
        action=jax.random.normal(key_action, (batch_shape[0], action_latent), jnp.float32),
        observation=jax.random.normal(
            key_observation, (*batch_shape, observation_latent), jnp.float32
        ),
    )


def sample_gaussian(mean: jax.Array, log_variance: jax.Array, noise: jax.Array) -> jax.Array:
    """`mean + exp(log_variance / 2) * noise`; all f32, shapes broadcast to that of `mean`."""
    return mean + jnp.exp(0.5 * log_variance) * noise


def reconstruction_weight(epoch: jax.Array) -> jax.Array:
    """`w = 1 + 0.5^epoch`, f32[], of an int32[] epoch counted from 0."""
    return 1.0 + jnp.exp2(-jnp.asarray(epoch, jnp.float32))


def weighted_loss(terms: ElboTerms, weight: jax.Array | float) -> jax.Array:
    """`-(w * reconstruction - KL / w)`, f32[]; w = 1 gives the negative ELBO."""
    return (terms.kl_action + terms.kl_observation) / weight - weight * terms.reconstruction


def elbo_terms(
    output: VAEOutput,
    features: jax.Array,
    num_categories: int,
    *,
    kl_recordings: int | None = None,
    has_shared_variance: bool = False,
) -> ElboTerms:
    """The terms of the bound for one batch.

    Args:
      output: of the model's forward pass on `features`.
      features: f32[B, S, T, D]; step 0 is given to the decoder and not scored, unless T = 1, which
        is a still image.
      num_categories: categories per coordinate; 0 for a Gaussian likelihood.
      kl_recordings: n, the action's divergence counts 1/n per recording; None: 1/S.
      has_shared_variance: see `optimal_log_variance`.
    """
    target = features[:, :, 1:] if features.shape[2] > 1 else features
    log_variance = output.likelihood_log_variance
    if num_categories:
        log_likelihood = categorical_log_likelihood(target, output.prediction, num_categories)
    else:
        if log_variance is None:
            log_variance = optimal_log_variance(target, output.prediction, has_shared_variance)
        log_likelihood = gaussian_log_likelihood(target, output.prediction, log_variance)
    kl_observation = gaussian_kl(
        output.observation_mean,
        output.observation_log_variance,
        output.prior_mean,
        output.prior_log_variance,
    )
    kl_action = jnp.zeros((), jnp.float32)
    if output.action_mean is not None and output.action_log_variance is not None:
        kl_action = jnp.sum(gaussian_kl(output.action_mean, output.action_log_variance))
    num_actions, per_action = features.shape[:2]
    num_recordings = num_actions * per_action
    return ElboTerms(
        reconstruction=jnp.sum(log_likelihood) / num_recordings,
        kl_action=kl_action / (num_actions * (kl_recordings or per_action)),
        kl_observation=jnp.sum(kl_observation) / num_recordings,
    )
