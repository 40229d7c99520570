"""Pictures of a world for people: smooth, with real colours, traces and a line of text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs_host.create.colors import COLOR_OF_TONE, Color
from envs_host.create.config import MAX_PIXELS
from envs_host.create.geometry import Point
from envs_host.create.pen import Pen, blend, darker
from envs_host.create.portraits import portray
from envs_host.create.sprites import Sprite, Tone

GROUND: Color = (255, 255, 255)
GROUND_AFTER_SUCCESS: Color = (200, 255, 255)
INK: Color = (45, 52, 64)

_SMALLEST = 16
_TEXT_SHARE = 0.034
_TRACE_WIDTH = 0.45


@dataclass(frozen=True)
class RenderOptions:
    """How an episode is shown to people.

    Attributes:
      size: pixels of the side.
      with_text: whether action number and return are written into the picture.
      with_traces: whether the ways of target and marker are drawn.
      with_tint: whether the ground changes its colour after success.
    """

    size: int = 1024
    with_text: bool = True
    with_traces: bool = True
    with_tint: bool = True


class Trace(NamedTuple):
    """Where something has been: positions in units, in order; the tone of what left it."""

    points: Sequence[Point]
    tone: Tone


def illustrate(
    sprites: Iterable[Sprite],
    size: int,
    caption: str = "",
    note: str = "",
    traces: Sequence[Trace] = (),
    is_success: bool = False,
) -> np.ndarray:
    """A smooth picture, mirrored like all others.

    Args:
      sprites: see `sprites`; later ones cover earlier ones.
      size: pixels of the side, at least 16.
      caption, note: text in the top left and top right corner.
      traces: drawn below the sprites.
      is_success: whether the ground has the tint of success.

    Returns:
      u8[size, size, 3] RGB.

    Raises:
      ValueError: `size` is too small.
    """
    if not _SMALLEST <= size <= MAX_PIXELS:
        raise ValueError(f"size={size} must be {_SMALLEST} to {MAX_PIXELS} pixels.")
    ground = GROUND_AFTER_SUCCESS if is_success else GROUND
    pen = Pen(size, ground)
    for trace in traces:
        _draw_trace(pen, trace, ground)
    for sprite in sprites:
        portray(pen, sprite)
    image = pen.finished()
    if caption or note:
        _write(image, caption, note)
    return np.asarray(image)


def _draw_trace(pen: Pen, trace: Trace, ground: Color) -> None:
    """A line that begins with a dot."""
    if not trace.points:
        return
    color = blend(darker(COLOR_OF_TONE[trace.tone], 0.1), ground, 0.35)
    pen.move((0.0, 0.0))
    pen.disc(0.9, color, centre=trace.points[0])
    if len(trace.points) > 1:
        pen.line(trace.points, color, _TRACE_WIDTH)


def _write(image: Image.Image, caption: str, note: str) -> None:
    width, _ = image.size
    height = max(8.0, _TEXT_SHARE * width)
    font = ImageFont.load_default(size=height)
    draw = ImageDraw.Draw(image)
    margin = 0.6 * height
    halo = max(1, round(0.12 * height))
    for x, text, anchor in ((margin, caption, "lt"), (width - margin, note, "rt")):
        draw.text(
            (x, margin),
            text,
            fill=INK,
            font=font,
            anchor=anchor,
            stroke_width=halo,
            stroke_fill=GROUND,
        )
