"""What both VAEs share: recordings are read by an encoder and written by a decoder.

`docs/method.md`, "HVAE" and "Encoders in minutes".
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.decoders import DecoderStart, TrajectoryDecoder
from jaxnew.representation.encoders import (
    Scales,
    Standardization,
    TrajectoryEncoder,
    likelihood_log_variance,
)
from jaxnew.representation.images import ImageRecordingDecoder, ImageRecordingEncoder
from jaxnew.representation.modality import Modality


class Read(NamedTuple):
    """What an encoder makes of recordings f32[B, S, T, D].

    Attributes:
      hidden: f32[E, B, S].
      start: f32[B, S, D'] what the decoder starts from: the first steps, or their frames' codes.
      scales: the units of the D numbers.
    """

    hidden: jax.Array
    start: jax.Array
    scales: Scales


class Autoencoder(nn.Module):
    """Encoder and decoder of recordings: trajectories, videos or still images.

    Attributes:
      config: widths, and what differs from the paper.
      modality: what was recorded.
    """

    config: RepresentationConfig
    modality: Modality

    def setup(self) -> None:
        config, modality = self.config, self.modality
        width, shape, is_still = config.hidden_width, modality.image_shape, modality.is_still
        pytorch_init = config.kind == "vae"
        encoder: Any
        decoder: Any
        if shape is None:
            encoder = TrajectoryEncoder(config.encoder_width, config.reads_changes)
            fed_back = modality.num_categories if config.standardizes else 0
            decoder = TrajectoryDecoder(width, pytorch_init, config.predicts_changes, fed_back)
        else:
            reads_changes = config.reads_changes and not is_still
            encoder = ImageRecordingEncoder(config.encoder_width, shape, reads_changes)
            decoder = ImageRecordingDecoder(
                width, shape, is_still, config.predicts_changes, pytorch_init
            )
        self.encoder, self.decoder = encoder, decoder
        self.decoder_start = DecoderStart(width, pytorch_init)
        self.scales = Standardization(
            config.standardizes and not modality.num_categories,
            None if shape is None else shape[-1],
        )
        gaussian_dim = 0 if config.has_optimal_variance else modality.gaussian_dim
        self.likelihood_log_variance = likelihood_log_variance(self, gaussian_dim)

    def read(self, features: jax.Array, training: bool) -> Read:
        """Encodes recordings f32[B, S, T, D]."""
        scales = self.scales(features, training)
        if self.modality.image_shape is None:
            return Read(self.encoder(features, scales), features[:, :, 0], scales)
        hidden, start = self.encoder(features, training)
        return Read(hidden, start, scales)

    def mean_changes(self, features: jax.Array) -> jax.Array:
        """f32[B, (T - 1) D] of recordings f32[B, S, T, D]: the mean over S of each later step's
        change from the first, in units of the change from step to step.
        """
        changes = jnp.mean(features[:, :, 1:] - features[:, :, :1], axis=1)
        return (changes / self.scales(features, False).change).reshape(len(features), -1)

    def write(self, g: jax.Array, read: Read, features: jax.Array, training: bool) -> Any:
        """Means (or logits) of the scored steps, f32[B, S, T-1, D], of a still f32[B, S, 1, D].

        Args:
          g: f32[H, B, S] from `DecoderStart`.
          read: what was made of the recordings.
          features: the recordings; of videos the first frames are read.
          training: see `ChannelBatchNorm`.
        """
        if self.modality.image_shape is None:
            return self.decoder(g, read.start, features.shape[2], read.scales)
        return self.decoder(g, read.start, features, read.scales, training)
