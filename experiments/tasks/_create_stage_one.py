"""CREATE's recordings as network inputs, and the HVAEs for them (spec method 3, columns CREATE).

A recording is stored as f32[7, 6] states (tool x, y; ball x, y; ball velocity, all in the affine
map of positions) or as uint8[7, 48, 48, 1] frames. N_train // B gradient steps are an epoch: with
1,098 train tools 8 of states, 34 of videos.
"""

from __future__ import annotations

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import image_modality, vector_modality

STATE = vector_modality("state", 6)
VIDEO = image_modality("video", (48, 48, 1))
MODALITIES = {"state": STATE, "video": VIDEO}

STATE_HVAE = RepresentationConfig(
    encoder_width=64,
    inference_width=128,
    hidden_width=64,
    action_latent=128,
    observation_latent=128,
    actions_per_batch=128,
    recordings_per_action=464,
    num_steps=80_000,
)
VIDEO_HVAE = RepresentationConfig(
    encoder_width=128,
    inference_width=128,
    hidden_width=128,
    action_latent=128,
    observation_latent=128,
    actions_per_batch=32,
    recordings_per_action=45,
    num_steps=170_000,
)
