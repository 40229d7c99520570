"""The network that a config and a modality ask for."""

from __future__ import annotations

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.hvae import HVAE
from jaxnew.representation.modality import Modality
from jaxnew.representation.vae import FlatVAE


def build_model(config: RepresentationConfig, modality: Modality) -> HVAE | FlatVAE:
    """An HVAE or a flat VAE for the modality's features."""
    if config.kind == "hvae":
        return HVAE(
            encoder_width=config.encoder_width,
            inference_width=config.inference_width,
            hidden_width=config.hidden_width,
            action_latent=config.action_latent,
            observation_latent=config.observation_latent,
            gaussian_dim=modality.gaussian_dim,
            image_shape=modality.image_shape,
            is_still=modality.is_still,
        )
    return FlatVAE(
        encoder_width=config.encoder_width,
        hidden_width=config.hidden_width,
        observation_latent=config.observation_latent,
        gaussian_dim=modality.gaussian_dim,
        image_shape=modality.image_shape,
        is_still=modality.is_still,
    )
