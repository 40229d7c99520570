"""The toy of `tests/toy_host.py`, whose actions are 24 tools of CREATE on video.

`--task=tests.video_task:TASK`. Videos have two frames, so that programs compile quickly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envs_host.create.play import record_block
from envs_host.create.poses import FRAMES_SHAPE, POSES_SHAPE, draw_poses, record_poses
from envs_host.create.tools import no_op_id
from jaxnew.observations import RecordingFormat
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import image_modality, vector_modality
from jaxnew.task.budgets import StageOneBudget
from jaxnew.task.task import Drawing, Play
from tests import toy_host, toy_task

FIRST, NUM_FRAMES = 3, 2
TOOL_OF = 98 * np.arange(toy_host.NUM_ACTIONS, dtype=np.int32)
TOOL_OF[toy_task.NO_OP] = no_op_id()


def record_states(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    return record_block(seed, TOOL_OF[ids], num_recordings)


def record(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    poses = record_poses(seed, TOOL_OF[ids], num_recordings)
    return poses[:, :, FIRST : FIRST + NUM_FRAMES]


def draw(ids: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return draw_poses(TOOL_OF[ids], poses)


_HVAE = RepresentationConfig(
    encoder_width=16,
    inference_width=16,
    hidden_width=16,
    action_latent=4,
    observation_latent=4,
    actions_per_batch=3,
    recordings_per_action=2,
    num_steps=4,
)
_SMOKE = StageOneBudget(
    num_recordings=3,
    model=_HVAE,
    checkpoint_every=1,
    cost="seconds",
)
STATES = Play(
    format=RecordingFormat("Toy play, states", (7, 6), "float32"),
    record_block=record_states,
    block_actions=8,
    modalities={"state": vector_modality("state", 6)},
)
VIDEO = Play(
    format=RecordingFormat("Toy play, poses", (NUM_FRAMES, *POSES_SHAPE[1:]), "float64"),
    record_block=record,
    block_actions=8,
    modalities={"video": image_modality("video", (48, 48, 1))},
    drawing=Drawing(
        format=RecordingFormat("Toy play, video", (NUM_FRAMES, *FRAMES_SHAPE[1:]), "uint8"),
        draw=draw,
        folder="frames",
    ),
    folder="poses",
    stage_one={"smoke": _SMOKE},
)
TASK = replace(
    toy_task.TASK,
    name="toy-video",
    plays=(STATES, VIDEO),
    stage_one={"smoke": _SMOKE.vary(model__num_steps=2)},
)
