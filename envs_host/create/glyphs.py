"""Small pictures of what is more than one tone, as observations show it.

They are our own; ink and mean gray are those that the release's pictures had after scaling.
A glyph stands around a corner of pixels. Pixels are (row, column), see `raster`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from envs_host.create.colors import Ink
from envs_host.create.raster import line
from envs_host.create.sprites import Kind, Sprite

_CANNON_BOX = (11.566, 12.362)  # Of the region, the same for all aims.
_BARREL = (12.2, 8.6)
_LONG_LADDER = 17.5
_BELT_PATTERN = (Ink.BELT_DARK, Ink.BELT_LIGHT, Ink.BELT_LIGHT, Ink.WHITE)

_BASKET = (
    "gggggggggg",
    "g........g",
    "gG..GG..Gg",
    ".g......g.",
    ".g..GG..g.",
    ".g......g.",
    "..gG..Gg..",
    "..g....g..",
    "...gGGg...",
    "...G......",
)
_BASKETBALL_ROWS = (3, 5, 7, 7, 7, 5, 2)


class Glyph(NamedTuple):
    """int[n, 2] pixels and the u8[n] ink of each."""

    pixels: np.ndarray
    inks: np.ndarray


def glyph(sprite: Sprite, scale: float) -> Glyph:
    """The pixels of a picture, around (0, 0) whatever the sprite's position.

    Args:
      sprite: one of tone picture.
      scale: pixels per unit.
    """
    return _GLYPHS[sprite.kind](sprite, scale)


def is_picture(kind: Kind) -> bool:
    """Whether `glyph` knows the kind."""
    return kind in _GLYPHS


def _sample(reach: float, scale: float, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels around (0, 0) and where their centres are in a frame turned by `angle`, in units."""
    half = math.ceil(reach * scale)
    pixels = np.argwhere(np.ones((2 * half, 2 * half), bool)) - half
    x = (pixels[:, 1] + 0.5) / scale
    y = -(pixels[:, 0] + 0.5) / scale
    cos, sin = math.cos(angle), math.sin(angle)
    return pixels, cos * x + sin * y, cos * y - sin * x


def _inked(pixels: np.ndarray, inks: np.ndarray) -> Glyph:
    has_ink = inks != Ink.WHITE
    return Glyph(pixels[has_ink], inks[has_ink].astype(np.uint8))


def _trampoline(sprite: Sprite, scale: float) -> Glyph:
    """A mat above a row of legs. Slanted ones are thicker, as if stretched to the bounding box."""
    angle = (sprite.angle + math.pi / 2.0) % math.pi - math.pi / 2.0
    if angle < -math.pi / 2.0 + 1e-6:
        angle = math.pi / 2.0
    length = sprite.size + 1.0
    thickness = max(2.0 / scale, sprite.width + 2.0 * abs(math.sin(2.0 * angle)))
    pixels, along, up = _sample(length, scale, angle)
    is_mat = up > 0.0
    is_leg = np.mod(along * scale + 0.5 * length * scale, 4.0) < 2.0
    inks = np.where(is_mat, Ink.MAT_BLUE, np.where(is_leg, Ink.LEG_BLUE, Ink.WHITE))
    is_inside = (abs(along) <= length / 2.0) & (abs(up) <= thickness / 2.0)
    return _inked(pixels, np.where(is_inside, inks, Ink.WHITE))


def _cannon(sprite: Sprite, scale: float) -> Glyph:
    """A barrel with rings, turned by the aim and squeezed into a box that is always the same."""
    cos, sin = math.cos(sprite.angle), math.sin(sprite.angle)
    length, width = _BARREL
    pixels, x, y = _sample(max(_CANNON_BOX), scale, 0.0)
    x = x * max(1.0, (length * abs(cos) + width * abs(sin)) / _CANNON_BOX[0])
    y = y * max(1.0, (length * abs(sin) + width * abs(cos)) / _CANNON_BOX[1])
    along = (cos * x + sin * y) / (length / 2.0)
    across = abs(cos * y - sin * x) / (width / 2.0)
    is_barrel = (abs(along) <= 1.0) & (across <= 0.95 - 0.1 * along)
    is_ring = (abs(along - 0.86) < 0.15) | (abs(along + 0.25) < 0.14)
    inks = np.where(is_ring, Ink.CANNON_YELLOW, Ink.CANNON_RED)
    return _inked(pixels, np.where(is_barrel, inks, Ink.WHITE))


def _fan(sprite: Sprite, scale: float) -> Glyph:
    """An oval ring with blades and a hub."""
    pixels, along, across = _sample(sprite.width, scale, sprite.angle)
    distance = np.hypot(along / (sprite.size / 2.0), across / (sprite.width / 2.0))
    is_ring = (distance <= 1.0) & (distance > 0.68)
    is_blade = (distance <= 0.68) & (abs(along) < 0.55 / min(scale, 1.0)) & (abs(across) > 0.8)
    is_hub = np.hypot(along, across) < 0.75 / min(scale, 1.0)
    inks = np.select(
        [is_hub, is_ring, is_blade], [Ink.HUB_BLUE, Ink.FAN_BLUE, Ink.BLADE_BLUE], Ink.WHITE
    )
    return _inked(pixels, inks)


def _belt(sprite: Sprite, scale: float) -> Glyph:
    """One row of dashes, their dark ends where the belt runs to."""
    half = max(1, int(sprite.size * scale / 2.0))
    columns = np.arange(-half, half + 1)
    pattern = np.array(_BELT_PATTERN if math.cos(sprite.angle) < 0.0 else _BELT_PATTERN[::-1])
    pixels = np.stack([np.zeros_like(columns), columns], axis=1)
    return _inked(pixels, pattern[(columns + half) % len(pattern)])


def _funnel(sprite: Sprite, scale: float) -> Glyph:
    """The two sides that meet in the tip; the third one is open."""
    left, tip, right = (
        (
            -int(sprite.size * scale * math.sin(sprite.angle + math.radians(degrees))),
            int(sprite.size * scale * math.cos(sprite.angle + math.radians(degrees))),
        )
        for degrees in (150.0, 270.0, 30.0)
    )
    pixels = np.unique(np.concatenate([line(left, tip), line(tip, right)]), axis=0)
    return _inked(pixels, np.full(len(pixels), Ink.FUNNEL_GRAY))


def _bucket(sprite: Sprite, scale: float) -> Glyph:
    """A filled square, dark where it is open."""
    half = sprite.size / math.sqrt(2.0)
    pixels, along, up = _sample(sprite.size, scale, sprite.angle)
    is_inside = (abs(along) <= half) & (abs(up) <= half)
    inks = np.where(up > 0.38 * half, Ink.HANDLE_BROWN, Ink.ORANGE)
    return _inked(pixels, np.where(is_inside, inks, Ink.WHITE))


def _ladder(sprite: Sprite, scale: float) -> Glyph:
    """Two rails one pixel wide with rungs between them.

    In the release's picture of length 20 dark edges survived the scaling, in that of 15 none did.
    """
    pixels, along, across = _sample(sprite.size, scale, sprite.angle)
    along, across = along * scale, abs(across) * scale
    is_rail = (across > 0.5) & (across <= 1.5)
    is_rung = (across <= 0.5) & (np.mod(along + 2.0, 4.0) < 1.0)
    is_inside = (abs(along) <= sprite.size * scale / 2.0) & (is_rail | is_rung)
    is_edge = np.isin(np.mod(pixels[:, 0], 7), (0, 3))
    dark = Ink.LADDER_BROWN if sprite.size > _LONG_LADDER else Ink.LADDER_YELLOW
    inks = np.where(is_edge, dark, Ink.LADDER_LIGHT)
    return _inked(pixels, np.where(is_inside, inks, Ink.WHITE))


def _basket(sprite: Sprite, scale: float) -> Glyph:
    """A rim and a net, from a bitmap."""
    inks = {"g": Ink.GREEN, "G": Ink.NET_GREEN, ".": Ink.WHITE}
    art = np.array([[inks[mark] for mark in row] for row in _BASKET])
    side = max(1, int(sprite.size * scale))
    source = np.arange(side) * len(_BASKET) // side
    pixels = np.argwhere(np.ones((side, side), bool)) - side // 2
    return _inked(pixels, art[np.ix_(source, source)].ravel())


def _basketball(sprite: Sprite, scale: float) -> Glyph:
    """A disc 7 pixels wide with seams that turn with it."""
    half = len(_BASKETBALL_ROWS) // 2
    radius = max(1, int(sprite.size * scale))
    pixels = np.argwhere(np.ones((2 * radius + 1, 2 * radius + 1), bool)) - radius
    rows = np.clip(np.rint(pixels[:, 0] * half / radius).astype(int), -half, half) + half
    width = np.array(_BASKETBALL_ROWS)[rows] * radius / half
    is_inside = (pixels[:, 1] >= -width / 2.0) & (pixels[:, 1] < width / 2.0)
    cos, sin = math.cos(sprite.angle), math.sin(sprite.angle)
    along = cos * pixels[:, 1] - sin * pixels[:, 0]
    across = cos * pixels[:, 0] + sin * pixels[:, 1]
    is_seam = (abs(across) <= 0.5) | ((abs(along) <= 0.5) & (across > 1.5))
    inks = np.where(is_seam, Ink.BASKETBALL_LINE, Ink.BASKETBALL)
    return _inked(pixels, np.where(is_inside, inks, Ink.WHITE))


def _box(sprite: Sprite, scale: float) -> Glyph:
    """A wooden box, 4 x 4 pixels for a side of 5 as in the release, turned with the body."""
    half = 0.43 * sprite.size
    pixels, along, up = _sample(sprite.size, scale, sprite.angle)
    edge = np.maximum(abs(along), abs(up))
    inks = np.where(edge > half / 2.0, Ink.WOOD_DARK, Ink.WOOD_LIGHT)
    return _inked(pixels, np.where(edge <= half + 1e-9, inks, Ink.WHITE))


_GLYPHS: dict[Kind, Callable[[Sprite, float], Glyph]] = {
    Kind.TRAMPOLINE: _trampoline,
    Kind.CANNON: _cannon,
    Kind.FAN: _fan,
    Kind.BELT: _belt,
    Kind.FUNNEL: _funnel,
    Kind.BUCKET: _bucket,
    Kind.LADDER: _ladder,
    Kind.BASKET_GOAL: _basket,
    Kind.BASKETBALL: _basketball,
    Kind.BOX: _box,
}
