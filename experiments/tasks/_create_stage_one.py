"""CREATE's recordings as network inputs, and the HVAEs for them (docs/method.md, "HVAE").

A recording is f32[7, 6] states (tool x, y; ball x, y; ball velocity, all in the affine map of
positions), or uint8[7, 48, 48, 1] frames, which are drawn from f64[7, 4, 3] poses. N_train // B
gradient steps are an epoch: with 1,098 train tools 8 of states, 34 of videos.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from envs_host.create.poses import FRAMES_SHAPE, POSES_SHAPE, draw_poses
from envs_host.create.recorder import PoolRecorder
from jaxnew.observations import RecordingFormat
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import image_modality, vector_modality
from jaxnew.task.budgets import StageOneBudget
from jaxnew.task.task import Drawing, Play

STATE = vector_modality("state", 6)
VIDEO = image_modality("video", (48, 48, 1))

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
VIDEO_HVAE = replace(
    STATE_HVAE,
    encoder_width=128,
    hidden_width=128,
    actions_per_batch=32,
    recordings_per_action=45,
    num_steps=170_000,
)


_VIDEO_STAGE_ONE = {
    "smoke": StageOneBudget(
        num_recordings=2,
        model=VIDEO_HVAE.in_minutes(num_steps=2, actions_per_batch=2, recordings_per_action=2),
        checkpoint_every=1,
        cost="a minute and a half on one core, half of it for compiling",
    ),
    "laptop": StageOneBudget(
        num_recordings=24,
        model=VIDEO_HVAE.in_minutes(num_steps=2000, actions_per_batch=16, recordings_per_action=4),
        checkpoint_every=100,
        cost="about 45 minutes and 3.5 GB of memory on one core, from the rate of 3 steps",
    ),
    # 50 s a step on one core, from the rate of `laptop`.
    "paper": StageOneBudget(
        num_recordings=1024,
        model=VIDEO_HVAE,
        checkpoint_every=500,
        cost="nobody measured how long it takes",
        chunk_steps=4,
        counts_epochs=True,
    ),
}


def video_play(spacing_deg: int) -> Play:
    """Videos of the tools `spacing_deg` degrees apart, of the simulations of their states."""
    kind = f"{spacing_deg} degrees"
    return Play(
        format=RecordingFormat(f"CREATE play, poses, {kind}", POSES_SHAPE, "float64"),
        record_block=PoolRecorder(modality="poses", angle_spacing=spacing_deg),
        block_actions=64,
        modalities={"video": VIDEO},
        drawing=Drawing(
            format=RecordingFormat(f"CREATE play, video, {kind}", FRAMES_SHAPE, "uint8"),
            draw=partial(draw_poses, angle_spacing=spacing_deg),
            folder="frames",
        ),
        folder="poses",
        stage_one=_VIDEO_STAGE_ONE,
    )
