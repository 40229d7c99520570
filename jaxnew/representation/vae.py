"""The flat VAE baseline: every recording on its own, no action latent.

`docs/method.md`, "Flat VAE".
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.decoders import DecoderStart
from jaxnew.representation.encoders import (
    Dense,
    LatentHead,
    Standardization,
    likelihood_log_variance,
)
from jaxnew.representation.hvae import HVAE
from jaxnew.representation.images import (
    decoded,
    encoded,
    recording_decoder,
    recording_encoder,
)
from jaxnew.representation.modality import Modality
from jaxnew.representation.objective import LatentNoise, VAEOutput, sample_gaussian


class FlatInference(nn.Module):
    """`q(z | o)` of the flat VAE.

    Attributes:
      width: H.
      latent: dz.
    """

    width: int
    latent: int

    @nn.compact
    def __call__(self, h: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[E, B, S] -> (mean f32[dz, B, S], log-variance f32[dz])."""
        e = nn.relu(Dense(self.width, pytorch_init=True)(h))
        return LatentHead(self.latent, pytorch_init=True)(e, training)


class FlatVAE(nn.Module):
    """The flat VAE: encoder, `q(z | o)`, decoder, prior N(0, I).

    For trajectories, videos and still images. Dense layers keep PyTorch's default initialisation.

    Attributes:
      encoder_width: E.
      hidden_width: H.
      observation_latent: dz.
      gaussian_dim, image_shape, is_still, standardizes, predicts_changes, reads_changes: see
        `HVAE`.
    """

    encoder_width: int
    hidden_width: int
    observation_latent: int
    gaussian_dim: int
    image_shape: tuple[int, int, int] | None = None
    is_still: bool = False
    standardizes: bool = False
    predicts_changes: bool = False
    reads_changes: bool = False

    def setup(self) -> None:
        reads_changes = self.reads_changes and not self.is_still
        self.encoder = recording_encoder(self.encoder_width, self.image_shape, reads_changes)
        num_channels = None if self.image_shape is None else self.image_shape[-1]
        self.scales = Standardization(self.standardizes, num_channels)
        self.inference = FlatInference(self.hidden_width, self.observation_latent)
        self.decoder_start = DecoderStart(self.hidden_width, pytorch_init=True)
        self.decoder = recording_decoder(
            self.hidden_width,
            self.image_shape,
            self.is_still,
            self.predicts_changes,
            pytorch_init=True,
        )
        self.likelihood_log_variance = likelihood_log_variance(self, self.gaussian_dim)

    def __call__(self, features: jax.Array, noise: LatentNoise, training: bool) -> VAEOutput:
        """One pass through inference and decoder.

        Args:
          features: f32[B, S, T, D]; which axis a recording lies on does not matter here.
          noise: of the sampled latents.
          training: True normalises with batch statistics and updates the running averages.
        """
        scales = self.scales(features, training)
        h, start = encoded(self.encoder, features, scales, training)
        mean, log_variance = self.inference(h, training)
        z_noise = jnp.moveaxis(noise.observation, -1, 0)
        z = sample_gaussian(mean, log_variance[:, None, None], z_noise)
        g = self.decoder_start(z, None)
        prediction = decoded(self.decoder, g, start, features, scales, training)
        return VAEOutput(
            action_mean=None,
            action_log_variance=None,
            observation_mean=jnp.moveaxis(mean, 0, -1),
            observation_log_variance=log_variance,
            prior_mean=jnp.zeros((features.shape[0], 1, self.observation_latent), jnp.float32),
            prior_log_variance=jnp.zeros_like(log_variance),
            prediction=prediction,
            likelihood_log_variance=self.likelihood_log_variance,
        )

    def posterior(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        """An action's representation, with running averages.

        Args:
          features: f32[B, S, T, D].
        Returns:
          f32[B, dz] mean over S of the recordings' posterior means, and their shared
          log-variance, f32[B, dz].
        """
        h, _ = encoded(self.encoder, features, self.scales(features, False), False)
        mean, log_variance = self.inference(h, False)
        mean = jnp.mean(mean, axis=-1).T
        return mean, jnp.broadcast_to(log_variance, mean.shape)


def build_model(config: RepresentationConfig, modality: Modality) -> HVAE | FlatVAE:
    """The network for a modality's features: what `config.kind` names, with the config's widths."""
    shared: dict[str, Any] = {
        "encoder_width": config.encoder_width,
        "hidden_width": config.hidden_width,
        "observation_latent": config.observation_latent,
        "gaussian_dim": 0 if config.has_optimal_variance else modality.gaussian_dim,
        "image_shape": modality.image_shape,
        "is_still": modality.is_still,
        "standardizes": config.standardizes,
        "predicts_changes": config.predicts_changes,
        "reads_changes": config.reads_changes,
    }
    if config.kind == "vae":
        return FlatVAE(**shared)
    return HVAE(
        inference_width=config.inference_width,
        action_latent=config.action_latent,
        normalizes_log_variance=config.normalizes_log_variance,
        **shared,
    )
