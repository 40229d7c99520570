"""The flat VAE baseline: every recording on its own, no action latent.

`docs/method.md`, "Flat VAE".
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.autoencoder import Autoencoder
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.encoders import Dense, LatentHead
from jaxnew.representation.hvae import HVAE
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


class FlatVAE(Autoencoder):
    """The flat VAE: encoder, `q(z | o)`, decoder, prior N(0, I).

    Dense layers keep PyTorch's default initialisation.
    """

    def setup(self) -> None:
        super().setup()
        self.inference = FlatInference(self.config.hidden_width, self.config.observation_latent)

    def __call__(self, features: jax.Array, noise: LatentNoise, training: bool) -> VAEOutput:
        """One pass through inference and decoder.

        Args:
          features: f32[B, S, T, D]; which axis a recording lies on does not matter here.
          noise: of the sampled latents.
          training: True normalises with batch statistics and updates the running averages.
        """
        read = self.read(features, training)
        mean, log_variance = self.inference(read.hidden, training)
        z_noise = jnp.moveaxis(noise.observation, -1, 0)
        z = sample_gaussian(mean, log_variance[:, None, None], z_noise)
        g = self.decoder_start(z, None)
        prediction = self.write(g, read, features, training)
        return VAEOutput(
            action_mean=None,
            action_log_variance=None,
            observation_mean=jnp.moveaxis(mean, 0, -1),
            observation_log_variance=log_variance,
            prior_mean=jnp.zeros((len(features), 1, z.shape[0]), jnp.float32),
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
        mean, log_variance = self.inference(self.read(features, False).hidden, False)
        mean = jnp.mean(mean, axis=-1).T
        return mean, jnp.broadcast_to(log_variance, mean.shape)


def build_model(config: RepresentationConfig, modality: Modality) -> HVAE | FlatVAE:
    """The network for a modality's features that `config.kind` names."""
    return (FlatVAE if config.kind == "vae" else HVAE)(config, modality)
