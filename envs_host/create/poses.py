"""Video recordings kept as poses: where things were, from which their frames are drawn at any time.

A frame of 48 x 48 pixels is 2,304 bytes, the poses behind it 96. Drawing them gives the frames of
`play.record_images` to the bit, for poses are all that a frame depends on besides the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from envs_host.create.building import build_tool
from envs_host.create.drawing import draw
from envs_host.create.play import IMAGE_SIZE, NUM_STATES, PlayConfig, record_worlds
from envs_host.create.sprites import Sprite
from envs_host.create.tools import ToolClass, all_tools
from envs_host.create.tools.catalogue import DEFAULT_SPACING_DEG
from envs_host.create.world import probe_ball

MAX_SPRITES = 4  # A weighted see-saw's plank, pivot and weight, and the ball.
POSE_SIZE = 3
POSES_SHAPE = (NUM_STATES, MAX_SPRITES, POSE_SIZE)
FRAMES_SHAPE = (NUM_STATES, IMAGE_SIZE, IMAGE_SIZE, 1)


def record_poses(
    seed: int,
    ids: Sequence[int] | np.ndarray,
    num_recordings: int,
    config: PlayConfig | None = None,
) -> np.ndarray:
    """The trajectories of `play.record_block` with the same arguments, as poses of sprites.

    Returns:
      f64[n, S, 7, 4, 3]: x, y (units) and angle (radians) of the tool's sprites and then the
      ball's, in the order in which they are drawn; zeros where a tool has fewer sprites.

    Raises:
      ValueError: an id does not exist, or there is nothing to record.
    """
    of_tools = record_worlds(seed, ids, num_recordings, config)
    poses = np.zeros((len(ids), num_recordings, *POSES_SHAPE))
    for of_tool, recordings in zip(poses, of_tools, strict=True):
        for of_recording, recording in zip(of_tool, recordings, strict=True):
            for of_state, snapshot in zip(of_recording, recording.snapshots, strict=True):
                found = [(sprite.x, sprite.y, sprite.angle) for sprite in snapshot.sprites]
                of_state[: len(found)] = found
    return poses


def draw_poses(
    ids: np.ndarray, poses: np.ndarray, angle_spacing: int = DEFAULT_SPACING_DEG
) -> np.ndarray:
    """The frames of recordings: tool and ball on white, as `play.record_images` draws them.

    Args:
      ids: int[n] the tool of each recording.
      poses: f64[n, T, 4, 3], see `record_poses`.
      angle_spacing: degrees; which list of tools ids belong to.

    Returns:
      u8[n, T, 48, 48, 1] grays.

    Raises:
      ValueError: `poses` are not one recording for each id.
    """
    if poses.ndim != 4 or len(poses) != len(ids) or poses.shape[2:] != POSES_SHAPE[1:]:
        raise ValueError(
            f"poses must be [{len(ids)}, T, {MAX_SPRITES}, {POSE_SIZE}], one recording for each "
            f"id; got shape {poses.shape}."
        )
    frames = np.empty((*poses.shape[:2], *FRAMES_SHAPE[1:]), np.uint8)
    # Plain numbers, because sprites of NumPy's are slow to draw.
    for tool_id, of_recording, frames_of in zip(ids.tolist(), poses.tolist(), frames, strict=True):
        looks = _looks(tool_id, angle_spacing)
        for of_state, frame in zip(of_recording, frames_of, strict=True):
            sprites = [
                Sprite(kind, x, y, angle, size, tone, width, sides)
                for (kind, _, _, _, size, tone, width, sides), (x, y, angle) in zip(
                    looks, of_state, strict=False
                )
            ]
            frame[..., 0] = draw(sprites, "gray", IMAGE_SIZE)
    return frames


@lru_cache(maxsize=16384)
def _looks(tool_id: int, angle_spacing: int) -> tuple[Sprite, ...]:
    """The sprites of a tool and of the ball; of their poses nothing is meant."""
    tool = all_tools(angle_spacing)[tool_id]
    origin = (0.0, 0.0)
    things = [probe_ball(origin)]
    if tool.tool_class != ToolClass.NO_OP:
        things.insert(0, build_tool(tool, origin))
    return tuple(sprite for thing in things for sprite in thing.sprites())
