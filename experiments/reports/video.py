"""Frames to a file that plays: GIF with Pillow, MP4 with the `video` extra."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from envs_mjx.grid_world.drawing import animate_episode

SUFFIXES = (".gif", ".mp4")
_BLOCK = 2  # Pixels: what the usual pixel format of MP4 needs sides to be multiples of.


def write_video(frames: Iterable[np.ndarray], path: str | Path, frame_ms: int = 60) -> Path:
    """Writes frames as an endless GIF or as MP4; the last frame stays a while.

    Args:
      frames: uint8[height, width, 3] each, all of one size, at least one.
      path: its suffix, .gif or .mp4, says what it becomes; its folder is made.
      frame_ms: milliseconds per frame.

    Returns:
      The path.

    Raises:
      ValueError: no frame, another suffix, or frames that do not fit together.
      ImportError: MP4 without imageio and its ffmpeg.
    """
    path, frames = Path(path), list(frames)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path} must end in one of {', '.join(SUFFIXES)}.")
    if len({frame.shape for frame in frames}) != 1:
        raise ValueError(
            f"A video needs frames of one size; got {len(frames)} frames of sizes "
            f"{sorted({frame.shape for frame in frames})}."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        animate_episode(frames, path, frame_ms)
    else:
        _write_mp4(frames, path, frame_ms)
    return path


def _write_mp4(frames: list[np.ndarray], path: Path, frame_ms: int) -> None:
    try:
        imageio = importlib.import_module("imageio.v2")
        importlib.import_module("imageio_ffmpeg")  # Found by imageio itself.
    except ImportError as err:
        raise ImportError(
            f"MP4 needs more packages ({err}); pip install 'jaxnew[video]', or write a .gif."
        ) from err
    height, width = (side // _BLOCK * _BLOCK for side in frames[0].shape[:2])
    with imageio.get_writer(path, fps=1000.0 / frame_ms, macro_block_size=_BLOCK) as writer:
        for frame in frames:
            writer.append_data(frame[:height, :width])
