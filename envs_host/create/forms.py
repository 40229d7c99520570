"""From sprites to places in a frame, quickly: forms are computed once and then moved about.

A form is what a sprite looks like around an anchor, which is a pixel. Anchors are whole pixels, so
all sprites of one kind, size and angle share one form (bars and polygons share one with those that
have the same fractions of a pixel).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from envs_host.create import raster
from envs_host.create.colors import GRAY_OF_INK, INK_OF_TONE, Ink
from envs_host.create.geometry import WORLD_SIZE
from envs_host.create.glyphs import glyph, is_picture
from envs_host.create.raster import Pixel
from envs_host.create.sprites import Kind, Sprite, Tone

# Boxes and basketballs are drawn in 72 positions, so that their forms are few.
_TURNING = frozenset({Kind.BASKETBALL, Kind.BOX})
_NUM_TURNS = 72
_FULL_TURN = 2.0 * math.pi

# Pixels; so that corners that are whole numbers but for rounding are not one pixel too far.
_NOISE = 1e-6
_GRAYS = GRAY_OF_INK.tolist()


class Form(NamedTuple):
    """Pixels around an anchor.

    Attributes:
      pixels: int[n, 2] rows and columns, not mirrored.
      offsets: int[n] the same in the flat frame, mirrored.
      bounds: smallest and largest row, smallest and largest column.
      inks, grays: u8[n] of a picture; None for what has one tone.
    """

    pixels: np.ndarray
    offsets: np.ndarray
    bounds: tuple[int, int, int, int]
    inks: np.ndarray | None
    grays: np.ndarray | None


class Print(NamedTuple):
    """What a sprite writes into a frame: int[n] places, and one value or u8[n] for all of them."""

    places: np.ndarray
    grays: np.ndarray | int
    inks: np.ndarray | int


def print_of(sprite: Sprite, size: int) -> Print:
    """Where a sprite is in the flat mirrored frame of `size` x `size` pixels, and its values."""
    form, row, column = _LOCATE[sprite.kind](sprite, size)
    base = (row + 1) * size - 1 - column
    top, bottom, left, right = form.bounds
    is_inside = row + top >= 0 and row + bottom < size
    if is_inside and column + left >= 0 and column + right < size:
        places, seen = form.offsets + base, None
    else:
        pixels = form.pixels + np.array([row, column])
        seen = np.all((pixels >= 0) & (pixels < size), axis=1)
        places = form.offsets[seen] + base
    if form.inks is None or form.grays is None:
        ink = INK_OF_TONE[sprite.tone]
        return Print(places, _GRAYS[ink], int(ink))
    if seen is None:
        return Print(places, form.grays, form.inks)
    return Print(places, form.grays[seen], form.inks[seen])


# What stands still is asked for again in every frame of an episode.
fixed_print_of = lru_cache(maxsize=2048)(print_of)


def _form(pixels: np.ndarray, size: int, inks: np.ndarray | None = None) -> Form:
    # What is too small for a pixel of the picture has none.
    corners = pixels if len(pixels) else np.zeros((1, 2), int)
    (top, left), (bottom, right) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    offsets = pixels[:, 0] * size - pixels[:, 1]
    grays = None if inks is None else GRAY_OF_INK[inks]
    return Form(pixels, offsets, (top, bottom, left, right), inks, grays)


def _centre(sprite: Sprite, size: int) -> Pixel:
    """Row and column of a position: int(84 - y) and int(x) at size 84."""
    scale = size / WORLD_SIZE
    return int(size - sprite.y * scale), int(sprite.x * scale)


def _pixel(sprite: Sprite, size: int, distance: float, angle: float) -> Pixel:
    """The pixel at a distance from a sprite's centre."""
    scale = size / WORLD_SIZE
    x = sprite.x + distance * math.cos(angle)
    y = sprite.y + distance * math.sin(angle)
    return math.floor(size - y * scale + _NOISE), math.floor(x * scale + _NOISE)


def _locate_disc(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    return _disc_form(int(sprite.size * size / WORLD_SIZE), size), *_centre(sprite, size)


@lru_cache(maxsize=256)
def _disc_form(radius: int, size: int) -> Form:
    return _form(raster.disc(radius), size)


def _locate_line(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    """A bar or a plank, from end to end."""
    half = sprite.size / 2.0
    row, column = _pixel(sprite, size, -half, sprite.angle)
    end_row, end_column = _pixel(sprite, size, half, sprite.angle)
    width = max(1, int(math.floor(sprite.width) * size / WORLD_SIZE))
    return _line_form(end_row - row, end_column - column, width, size), row, column


@lru_cache(maxsize=8192)
def _line_form(rows: int, columns: int, width: int, size: int) -> Form:
    return _form(raster.line((0, 0), (rows, columns), width), size)


def _locate_polygon(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    step = _FULL_TURN / sprite.sides
    corners = [
        _pixel(sprite, size, sprite.size, sprite.angle + k * step) for k in range(sprite.sides)
    ]
    row, column = corners[0]
    relative = tuple((r - row, c - column) for r, c in corners)
    return _polygon_form(relative, size), row, column


@lru_cache(maxsize=8192)
def _polygon_form(corners: tuple[Pixel, ...], size: int) -> Form:
    return _form(raster.convex_polygon(corners), size)


def _locate_pivot(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    """A triangle below its tip, which is the position."""
    scale = size / WORLD_SIZE
    half, height = int(sprite.size * scale / 2.0), max(1, int(sprite.width * scale))
    form = _polygon_form(((0, 0), (height, -half), (height, half)), size)
    return form, *_centre(sprite, size)


def _locate_star(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    return _star_form(sprite.size, size), *_centre(sprite, size)


@lru_cache(maxsize=64)
def _star_form(radius: float, size: int) -> Form:
    return _form(raster.star(radius * size / WORLD_SIZE), size)


def _locate_picture(sprite: Sprite, size: int) -> tuple[Form, int, int]:
    angle = sprite.angle
    if sprite.kind in _TURNING:
        turn = round(angle / _FULL_TURN * _NUM_TURNS) % _NUM_TURNS
        angle = turn * _FULL_TURN / _NUM_TURNS
    form = _picture_form(sprite.kind, angle, sprite.size, sprite.width, size)
    return form, *_centre(sprite, size)


@lru_cache(maxsize=16384)
def _picture_form(kind: Kind, angle: float, length: float, width: float, size: int) -> Form:
    sprite = Sprite(kind, 0.0, 0.0, angle, length, Tone.PICTURE, width)
    pixels, inks = glyph(sprite, size / WORLD_SIZE)
    return _form(pixels, size, inks)


_LOCATE: dict[Kind, Callable[[Sprite, int], tuple[Form, int, int]]] = {
    Kind.DISC: _locate_disc,
    Kind.SUBGOAL: _locate_disc,
    Kind.BAR: _locate_line,
    Kind.PLANK: _locate_line,
    Kind.POLYGON: _locate_polygon,
    Kind.PIVOT: _locate_pivot,
    Kind.STAR: _locate_star,
    **{kind: _locate_picture for kind in Kind if is_picture(kind)},
}

WHITE_GRAY = _GRAYS[Ink.WHITE]
