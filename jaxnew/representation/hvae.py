"""The hierarchical VAE: a set of recordings -> one latent per action (paper section 4.1).

`docs/method.md`, "HVAE", has the layers, and their blocks `Lin`, `Res` and `BN1`. Both networks
`q(z | o, c)` and `p(z | c)` of the release hold one more dense layer, for a second stochastic layer
that is never used; it is left out here.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.autoencoder import Autoencoder
from jaxnew.representation.encoders import Dense, LatentHead, ResBlock, ScalarBatchNorm
from jaxnew.representation.objective import LatentNoise, VAEOutput, sample_gaussian


class ActionInference(nn.Module):
    """`q(c | O)`: encoded recordings of an action -> a Gaussian.

    Attributes:
      width: Ho.
      latent: dc.
    """

    width: int
    latent: int

    @nn.compact
    def __call__(self, h: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[E, B, S] -> (mean f32[dc, B], log-variance f32[dc, B]); blind to the order of S."""
        e = ResBlock(2)(nn.relu(Dense(self.width)(h)))
        # The release has Lin, then the mean over S. The two commute; this order is cheaper.
        e = Dense(self.width)(jnp.mean(e, axis=-1))
        e = Dense(2 * self.latent)(ResBlock(3)(e))
        mean, log_variance = jnp.split(ScalarBatchNorm()(e, training), 2)
        return mean, log_variance


class ObservationInference(nn.Module):
    """`q(z | o, c)`: an encoded recording and its action -> a Gaussian.

    Attributes:
      width: H.
      latent: dz.
    """

    width: int
    latent: int

    @nn.compact
    def __call__(self, h: jax.Array, c: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """(f32[E, B, S], f32[dc, B]) -> (mean f32[dz, B, S], log-variance f32[dz])."""
        from_recording = Dense(self.width, name="from_recording")(h)
        from_action = Dense(self.width, name="from_action")(c)
        e = nn.relu(from_recording + from_action[:, :, None])
        return LatentHead(self.latent)(e, training)


class LatentPrior(nn.Module):
    """`p(z | c)`.

    Attributes:
      width: H.
      latent: dz.
    """

    width: int
    latent: int

    @nn.compact
    def __call__(self, c: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[dc, B] -> (mean f32[dz, B, 1], log-variance f32[dz])."""
        e = nn.relu(Dense(self.width)(c))[:, :, None]
        return LatentHead(self.latent)(e, training)


class HVAE(Autoencoder):
    """The hierarchical VAE."""

    def setup(self) -> None:
        super().setup()
        width, latent = self.config.hidden_width, self.config.observation_latent
        self.action_inference = ActionInference(
            self.config.inference_width, self.config.action_latent
        )
        self.observation_inference = ObservationInference(width, latent)
        self.latent_prior = LatentPrior(width, latent)

    def __call__(self, features: jax.Array, noise: LatentNoise, training: bool) -> VAEOutput:
        """One pass through inference, prior and decoder.

        Args:
          features: f32[B, S, T, D] recordings of B actions.
          noise: of the two sampled latents.
          training: True normalises with batch statistics and updates the running averages.
        """
        read = self.read(features, training)
        action_mean, action_log_variance = self.action_inference(read.hidden, training)
        c = sample_gaussian(action_mean, action_log_variance, noise.action.T)
        z_mean, z_log_variance = self.observation_inference(read.hidden, c, training)
        z_noise = jnp.moveaxis(noise.observation, -1, 0)
        z = sample_gaussian(z_mean, z_log_variance[:, None, None], z_noise)
        prior_mean, prior_log_variance = self.latent_prior(c, training)
        g = self.decoder_start(z, c)
        prediction = self.write(g, read, features, training)
        return VAEOutput(
            action_mean=action_mean.T,
            action_log_variance=action_log_variance.T,
            observation_mean=jnp.moveaxis(z_mean, 0, -1),
            observation_log_variance=z_log_variance,
            prior_mean=jnp.moveaxis(prior_mean, 0, -1),
            prior_log_variance=prior_log_variance,
            prediction=prediction,
            likelihood_log_variance=self.likelihood_log_variance,
        )

    def posterior(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`q(c | O)` with running averages: f32[B, S, T, D] -> (mean, log-variance) f32[B, dc]."""
        mean, log_variance = self.action_inference(self.read(features, False).hidden, False)
        return mean.T, log_variance.T
