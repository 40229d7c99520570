"""The hierarchical VAE: a set of recordings -> one latent per action (paper section 4.1).

`docs/method.md`, "HVAE", has the layers, and their blocks `Lin`, `Res` and `BN1`. Both networks
`q(z | o, c)` and `p(z | c)` of the release hold one more dense layer, for a second stochastic layer
that is never used; it is left out here.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.decoders import DecoderStart
from jaxnew.representation.encoders import (
    Dense,
    LatentHead,
    ResBlock,
    ScalarBatchNorm,
    Standardization,
    likelihood_log_variance,
)
from jaxnew.representation.images import (
    decoded,
    encoded,
    recording_decoder,
    recording_encoder,
)
from jaxnew.representation.objective import LatentNoise, VAEOutput, sample_gaussian


class ActionInference(nn.Module):
    """`q(c | O)`: encoded recordings of an action -> a Gaussian.

    Attributes:
      width: Ho.
      latent: dc.
      normalizes_log_variance: see `RepresentationConfig`.
    """

    width: int
    latent: int
    normalizes_log_variance: bool = True

    @nn.compact
    def __call__(self, h: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[E, B, S] -> (mean f32[dc, B], log-variance f32[dc, B]); blind to the order of S."""
        e = ResBlock(2)(nn.relu(Dense(self.width)(h)))
        # The release has Lin, then the mean over S. The two commute; this order is cheaper.
        e = Dense(self.width)(jnp.mean(e, axis=-1))
        e = Dense(2 * self.latent)(ResBlock(3)(e))
        normalize = ScalarBatchNorm()
        if not self.normalizes_log_variance:
            mean, log_variance = jnp.split(e, 2)
            return normalize(mean, training), log_variance
        mean, log_variance = jnp.split(normalize(e, training), 2)
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


class HVAE(nn.Module):
    """The hierarchical VAE for trajectories, videos and still images.

    Attributes:
      encoder_width: E.
      inference_width: Ho.
      hidden_width: H.
      action_latent: dc.
      observation_latent: dz.
      gaussian_dim: D for a Gaussian likelihood, whose log-variance is a free vector of that length;
        0 for one without: a categorical one, or where it is that of the batch's errors.
      image_shape: (side, side, channels) where a step of a recording is an image, else None.
      is_still: whether a recording is one image.
      normalizes_log_variance, standardizes, predicts_changes, reads_changes: see
        `RepresentationConfig`. Of videos, changes are those of the frames' codes.
    """

    encoder_width: int
    inference_width: int
    hidden_width: int
    action_latent: int
    observation_latent: int
    gaussian_dim: int
    image_shape: tuple[int, int, int] | None = None
    is_still: bool = False
    normalizes_log_variance: bool = True
    standardizes: bool = False
    predicts_changes: bool = False
    reads_changes: bool = False

    def setup(self) -> None:
        reads_changes = self.reads_changes and not self.is_still
        self.encoder = recording_encoder(self.encoder_width, self.image_shape, reads_changes)
        num_channels = None if self.image_shape is None else self.image_shape[-1]
        self.scales = Standardization(self.standardizes, num_channels)
        self.action_inference = ActionInference(
            self.inference_width, self.action_latent, self.normalizes_log_variance
        )
        self.observation_inference = ObservationInference(
            self.hidden_width, self.observation_latent
        )
        self.latent_prior = LatentPrior(self.hidden_width, self.observation_latent)
        self.decoder_start = DecoderStart(self.hidden_width)
        self.decoder = recording_decoder(
            self.hidden_width, self.image_shape, self.is_still, self.predicts_changes
        )
        self.likelihood_log_variance = likelihood_log_variance(self, self.gaussian_dim)

    def __call__(self, features: jax.Array, noise: LatentNoise, training: bool) -> VAEOutput:
        """One pass through inference, prior and decoder.

        Args:
          features: f32[B, S, T, D] recordings of B actions.
          noise: of the two sampled latents.
          training: True normalises with batch statistics and updates the running averages.
        """
        scales = self.scales(features, training)
        h, start = encoded(self.encoder, features, scales, training)
        action_mean, action_log_variance = self.action_inference(h, training)
        c = sample_gaussian(action_mean, action_log_variance, noise.action.T)
        z_mean, z_log_variance = self.observation_inference(h, c, training)
        z_noise = jnp.moveaxis(noise.observation, -1, 0)
        z = sample_gaussian(z_mean, z_log_variance[:, None, None], z_noise)
        prior_mean, prior_log_variance = self.latent_prior(c, training)
        g = self.decoder_start(z, c)
        prediction = decoded(self.decoder, g, start, features, scales, training)
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
        h, _ = encoded(self.encoder, features, self.scales(features, False), False)
        mean, log_variance = self.action_inference(h, False)
        return mean.T, log_variance.T
