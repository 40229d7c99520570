"""Frames to a file that plays: GIF with Pillow, MP4 with the `video` extra."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SUFFIXES = (".gif", ".mp4")
_LAST_MS = 1500
_BLOCK = 2  # Pixels: what the usual pixel format of MP4 needs sides to be multiples of.


def write_video(frames: Sequence[np.ndarray], path: Path, frame_ms: int = 60) -> Path:
    """Writes frames as an endless GIF, whose last frame stays a while, or as MP4.

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
    check_suffix(path.suffix)
    if len({frame.shape for frame in frames}) != 1:
        raise ValueError(
            f"A video needs frames of one size; got {len(frames)} frames of sizes "
            f"{sorted({frame.shape for frame in frames})}."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    (_write_gif if path.suffix == ".gif" else _write_mp4)(frames, path, frame_ms)
    return path


def check_suffix(suffix: str) -> None:
    """Raises unless videos with that suffix can be made here.

    Raises:
      ValueError: it is none of `SUFFIXES`.
      ImportError: MP4 without imageio and its ffmpeg.
    """
    if suffix not in SUFFIXES:
        raise ValueError(f"The name of a video ends in {' or '.join(SUFFIXES)}, not {suffix!r}.")
    if suffix == ".mp4":
        _imageio()


def _imageio() -> Any:
    """The package that writes MP4."""
    try:
        importlib.import_module("imageio_ffmpeg")  # Found by imageio itself.
        return importlib.import_module("imageio.v2")
    except ImportError as err:
        raise ImportError(
            f"MP4 needs more packages ({err}); pip install 'jaxnew[video]', or make GIFs."
        ) from err


def _write_gif(frames: Sequence[np.ndarray], path: Path, frame_ms: int) -> None:
    # One palette for all frames, so that colours do not flicker.
    palette = Image.fromarray(np.concatenate([frames[0], frames[-1]])).quantize(128)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    images[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=[frame_ms] * (len(images) - 1) + [_LAST_MS],
        loop=0,
    )


def _write_mp4(frames: Sequence[np.ndarray], path: Path, frame_ms: int) -> None:
    height, width = (side // _BLOCK * _BLOCK for side in frames[0].shape[:2])
    with _imageio().get_writer(path, fps=1000.0 / frame_ms, macro_block_size=_BLOCK) as writer:
        for frame in frames:
            writer.append_data(frame[:height, :width])
