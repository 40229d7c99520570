"""A pen that draws in world units, mirrored and smoothed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from PIL import Image, ImageDraw

from envs_host.create.colors import Color
from envs_host.create.geometry import WORLD_SIZE, Point

# Pictures are drawn larger and scaled down, because Pillow does not smooth edges.
_OVERSAMPLING = 3
_OVERSAMPLING_LARGE = 2
_LARGE = 700


def blend(color: Color, other: Color, share: float) -> Color:
    """`color` with a share of `other`, 0 to 1."""
    red, green, blue = (
        round((1.0 - share) * a + share * b) for a, b in zip(color, other, strict=True)
    )
    return red, green, blue


def darker(color: Color, share: float = 0.3) -> Color:
    return blend(color, (0, 0, 0), share)


def lighter(color: Color, share: float = 0.4) -> Color:
    return blend(color, (255, 255, 255), share)


class Pen:
    """Draws on one picture. Positions are units in a frame that `move` sets; widths are units."""

    def __init__(self, size: int, ground: Color) -> None:
        """A picture of `size` pixels a side, all ground."""
        self._size = size
        large = size * (_OVERSAMPLING_LARGE if size >= _LARGE else _OVERSAMPLING)
        self._pixels_per_unit = large / WORLD_SIZE
        self._image = Image.new("RGB", (large, large), ground)
        self._draw = ImageDraw.Draw(self._image)
        self.move((0.0, 0.0))

    def move(self, origin: Point, angle: float = 0.0, flip: bool = False) -> None:
        """Puts the frame's origin at a position of the world and turns it.

        Args:
          origin: in units.
          angle: radians, counter-clockwise in the world.
          flip: whether the frame's second axis points down instead of up.
        """
        self._origin = origin
        self._cos, self._sin = math.cos(angle), math.sin(angle)
        self._up = -1.0 if flip else 1.0

    def polygon(
        self,
        points: Sequence[Point],
        fill: Color,
        outline: Color | None = None,
        width: float = 0.35,
    ) -> None:
        """A filled polygon, with a line around it."""
        pixels = [self._pixel(point) for point in points]
        self._draw.polygon(pixels, fill=fill)
        if outline is not None:
            self.line([*points, points[0]], outline, width)

    def line(self, points: Sequence[Point], color: Color, width: float) -> None:
        """Straight pieces with round ends and corners."""
        pixels = [self._pixel(point) for point in points]
        broad = max(1, round(width * self._pixels_per_unit))
        self._draw.line(pixels, fill=color, width=broad)
        if broad > 2:
            for pixel in pixels:
                self._draw.ellipse(_box(pixel, broad / 2.0), fill=color)

    def disc(
        self,
        radius: float,
        fill: Color,
        outline: Color | None = None,
        width: float = 0.35,
        centre: Point = (0.0, 0.0),
    ) -> None:
        """A disc around a point of the frame, the outline inside it."""
        reach = radius * self._pixels_per_unit
        broad = 0 if outline is None else max(1, round(width * self._pixels_per_unit))
        box = _box(self._pixel(centre), reach)
        self._draw.ellipse(box, fill=fill, outline=outline, width=broad)

    def ellipse(self, radii: Point, centre: Point = (0.0, 0.0), turn: float = 0.0) -> list[Point]:
        """Points around an ellipse, for `polygon` and `line`."""
        cos, sin = math.cos(turn), math.sin(turn)
        points = []
        for angle in np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False).tolist():
            x, y = radii[0] * math.cos(angle), radii[1] * math.sin(angle)
            points.append((centre[0] + cos * x - sin * y, centre[1] + sin * x + cos * y))
        return points

    def arc(self, radii: Point, centre: Point, start: float, end: float) -> list[Point]:
        """Points along an ellipse from one angle to another, for `line`."""
        angles: Iterable[float] = np.linspace(start, end, 24).tolist()
        return [
            (centre[0] + radii[0] * math.cos(a), centre[1] + radii[1] * math.sin(a)) for a in angles
        ]

    def finished(self) -> Image.Image:
        """The picture in its final size."""
        return self._image.resize((self._size, self._size), Image.Resampling.BOX)

    def _pixel(self, point: Point) -> Point:
        """Where a point of the frame is in the picture, which is mirrored."""
        along, across = point[0], self._up * point[1]
        x = self._origin[0] + self._cos * along - self._sin * across
        y = self._origin[1] + self._sin * along + self._cos * across
        scale = self._pixels_per_unit
        # Pillow counts from the middle of the first pixel.
        return (WORLD_SIZE - x) * scale - 0.5, (WORLD_SIZE - y) * scale - 0.5


def _box(centre: Point, reach: float) -> tuple[int, int, int, int]:
    """First and last pixels of a disc, as Pillow wants them; it would cut fractions off."""
    x, y = centre[0] + 0.5, centre[1] + 0.5
    left, top = round(x - reach), round(y - reach)
    return left, top, max(left, round(x + reach) - 1), max(top, round(y + reach) - 1)
