"""Pictures of a world: what the agent sees, and what people look at (spec create 7, 10).

Every picture is mirrored left-right, as all pictures of the release are (A9): the top left corner
shows the world's (+1, +1).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from envs_host.create import raster
from envs_host.create.colors import GRAY_OF_INK, INK_OF_TONE, RGB_OF_INK, Ink
from envs_host.create.geometry import WORLD_SIZE
from envs_host.create.glyphs import Glyph, glyph, is_picture
from envs_host.create.sprites import Kind, Sprite, Tone

MODES = ("gray", "rgb", "people")
OBSERVATION_SIZE = 84
PEOPLE_SIZE = 1024

# Boxes and basketballs are drawn in 72 positions, so that each is computed once.
_TURNING = frozenset({Kind.BASKETBALL, Kind.BOX})
_NUM_TURNS = 72
# Pixels; so that corners that are whole numbers but for rounding are not one pixel too far.
_NOISE = 1e-6
_GRAYS = GRAY_OF_INK.tolist()
_INKS = list(range(len(_GRAYS)))


class _Print(NamedTuple):
    """What a sprite writes into a frame: int[n] places in the flat frame, and u8[n] twice."""

    places: np.ndarray
    grays: np.ndarray
    inks: np.ndarray


def draw(
    sprites: Iterable[Sprite], mode: str = "gray", size: int | None = None, **extras: Any
) -> np.ndarray:
    """A picture of sprites on white, later ones over earlier ones.

    Args:
      sprites: see `sprites`; what lies outside the world is cut off.
      mode: "gray" and "rgb" are observations, one pixel per unit at size 84, not smoothed. Their
        gray is the one of spec create 7.2 ("gray seen"), rounded; rgb has the 8-bit colours that
        gave those grays. "people" is smooth and has the nominal colours.
      size: pixels of the side; default 84, for people 1024.
      extras: for people only, see `illustration.illustrate`.

    Returns:
      u8[size, size], or u8[size, size, 3] for rgb and people.

    Raises:
      ValueError: the mode or the size cannot be.
    """
    if mode not in MODES:
        raise ValueError(f"mode={mode!r} must be one of {MODES}.")
    if mode == "people":
        from envs_host.create.illustration import illustrate  # Needs Pillow; workers do not.

        return illustrate(sprites, PEOPLE_SIZE if size is None else size, **extras)
    if extras:
        raise ValueError(f"{sorted(extras)} are for mode='people', not for {mode!r}.")
    size = OBSERVATION_SIZE if size is None else size
    if size < 1:
        raise ValueError(f"size={size} must be at least 1 pixel.")
    if mode == "gray":
        return _paint(sprites, size, _GRAYS, column=1)
    return np.take(RGB_OF_INK, _paint(sprites, size, _INKS, column=2), axis=0)


def _paint(
    sprites: Iterable[Sprite], size: int, value_of: Sequence[int], column: int
) -> np.ndarray:
    """u8[size, size] of grays (`column` 1 of a print) or of numbers of inks (2)."""
    frame = np.full(size * size, value_of[Ink.WHITE], np.uint8)
    for sprite in sprites:
        kind = sprite.kind
        if kind is Kind.DISC:
            frame[_disc_places(sprite, size)] = value_of[INK_OF_TONE[sprite.tone]]
        elif kind is Kind.PLANK:
            frame[_plank_places(sprite, size)] = value_of[INK_OF_TONE[sprite.tone]]
        else:
            form = _turning_print(sprite, size) if kind in _TURNING else _print(sprite, size)
            frame[form.places] = form[column]
    return frame.reshape(size, size)


def _centre(sprite: Sprite, size: int) -> raster.Pixel:
    """Row and column of a position: (int(84 - y), int(x)) at size 84 (7.3)."""
    scale = size / WORLD_SIZE
    return int(size - sprite.y * scale), int(sprite.x * scale)


def _disc_places(sprite: Sprite, size: int) -> np.ndarray:
    """Where a disc is; quick for one that is wholly in the picture."""
    row, column = _centre(sprite, size)
    radius = int(sprite.size * size / WORLD_SIZE)
    reach = max(radius, 1)
    if reach <= row <= size - reach and reach <= column <= size - reach:
        return _disc_offsets(radius, size) + ((row + 1) * size - 1 - column)
    return _places(_disc(radius) + np.array([row, column]), size)


@lru_cache(maxsize=256)
def _disc_offsets(radius: int, size: int) -> np.ndarray:
    pixels = _disc(radius)
    return pixels[:, 0] * size - pixels[:, 1]


@lru_cache(maxsize=256)
def _disc(radius: int) -> np.ndarray:
    return raster.disc(radius)


def _plank_places(sprite: Sprite, size: int) -> np.ndarray:
    """Where a plank is; quick for one that is wholly in the picture."""
    start, end = _ends(sprite, size)
    rise, run = end[0] - start[0], end[1] - start[1]
    if min(*start, *end) >= 0 and max(*start, *end) < size:
        return _line_offsets(rise, run, size) + ((start[0] + 1) * size - 1 - start[1])
    return _places(raster.line(start, end), size)


@lru_cache(maxsize=4096)
def _line_offsets(rise: int, run: int, size: int) -> np.ndarray:
    pixels = raster.line((0, 0), (rise, run))
    return pixels[:, 0] * size - pixels[:, 1]


def _places(pixels: np.ndarray, size: int) -> np.ndarray:
    """Places of the pixels that are in the picture, mirrored."""
    rows, columns = pixels[_is_inside(pixels, size)].T
    return (rows + 1) * size - 1 - columns


def _is_inside(pixels: np.ndarray, size: int) -> np.ndarray:
    return np.all((pixels >= 0) & (pixels < size), axis=1)


def _turning_print(sprite: Sprite, size: int) -> _Print:
    """The print of a picture that turns: its forms are remembered, not its places."""
    turn = round(sprite.angle / (2.0 * math.pi) * _NUM_TURNS) % _NUM_TURNS
    form = _turned(sprite.kind, sprite.size, turn, size / WORLD_SIZE)
    return _cut(Glyph(form.pixels + _centre(sprite, size), form.inks), size)


@lru_cache(maxsize=1024)
def _turned(kind: Kind, size: float, turn: int, scale: float) -> Glyph:
    angle = 2.0 * math.pi * turn / _NUM_TURNS
    return glyph(Sprite(kind, 0.0, 0.0, angle, size, Tone.PICTURE), scale)


@lru_cache(maxsize=4096)
def _print(sprite: Sprite, size: int) -> _Print:
    """The print of what stands still: all frames of an episode ask for the same ones."""
    if is_picture(sprite.kind):
        form = glyph(sprite, size / WORLD_SIZE)
        return _cut(Glyph(form.pixels + _centre(sprite, size), form.inks), size)
    pixels = _solid(sprite, size)
    ink = INK_OF_TONE[sprite.tone]
    return _cut(Glyph(pixels, np.full(len(pixels), ink, np.uint8)), size)


def _cut(form: Glyph, size: int) -> _Print:
    is_inside = _is_inside(form.pixels, size)
    inks = form.inks[is_inside]
    return _Print(_places(form.pixels, size), GRAY_OF_INK[inks], inks)


def _solid(sprite: Sprite, size: int) -> np.ndarray:
    """Pixels of what has one tone and stands still."""
    scale = size / WORLD_SIZE
    centre = np.array(_centre(sprite, size))
    if sprite.kind is Kind.BAR:
        width = max(1, int(math.floor(sprite.width) * scale))
        return raster.line(*_ends(sprite, size), width)
    if sprite.kind is Kind.PIVOT:
        half, height = int(sprite.size * scale / 2.0), max(1, int(sprite.width * scale))
        row, column = _centre(sprite, size)
        foot = row + height
        return raster.polygon([(row, column), (foot, column - half), (foot, column + half)])
    if sprite.kind is Kind.STAR:
        return raster.star(sprite.size * scale) + centre
    if sprite.kind is Kind.SUBGOAL:
        return _disc(int(sprite.size * scale)) + centre
    assert sprite.kind is Kind.POLYGON, sprite.kind
    angles = [sprite.angle + 2.0 * math.pi * k / sprite.sides for k in range(sprite.sides)]
    return raster.polygon([_pixel(sprite, size, sprite.size, angle) for angle in angles])


def _ends(sprite: Sprite, size: int) -> tuple[raster.Pixel, raster.Pixel]:
    """Pixels of the two ends of a bar or a plank."""
    half = sprite.size / 2.0
    return (
        _pixel(sprite, size, -half, sprite.angle),
        _pixel(sprite, size, half, sprite.angle),
    )


def _pixel(sprite: Sprite, size: int, distance: float, angle: float) -> raster.Pixel:
    """The pixel at a distance from a sprite's centre."""
    scale = size / WORLD_SIZE
    x = sprite.x + distance * math.cos(angle)
    y = sprite.y + distance * math.sin(angle)
    return math.floor(size - y * scale + _NOISE), math.floor(x * scale + _NOISE)
