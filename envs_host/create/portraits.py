"""How each kind of thing looks to people; the drawings are our own."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

from envs_host.create.colors import COLOR_OF_TONE, Color
from envs_host.create.geometry import Point
from envs_host.create.pen import Pen, darker, lighter
from envs_host.create.sprites import Kind, Sprite, Tone

WHITE: Color = (255, 255, 255)
MAT: Color = (38, 70, 140)
METAL: Color = (120, 130, 145)
CANNON_RED: Color = (205, 52, 48)
CANNON_YELLOW: Color = (250, 202, 60)
IRON: Color = (58, 62, 72)
FAN_BLUE: Color = (40, 120, 190)
AIR: Color = (150, 205, 240)
RUBBER: Color = (56, 58, 66)
FUNNEL: Color = (140, 148, 160)
BUCKET: Color = (240, 140, 50)
BUCKET_DARK: Color = (96, 52, 20)
WOOD: Color = (208, 160, 100)
LEATHER: Color = (236, 130, 45)
NET: Color = (70, 190, 60)

# Round dynamic things show how they turn; static discs and weights do not.
_ROLLING = frozenset({Tone.TARGET, Tone.MARKER, Tone.GOAL, Tone.BLACK})


def portray(pen: Pen, sprite: Sprite) -> None:
    """Draws one sprite."""
    pen.move((sprite.x, sprite.y), sprite.angle)
    _PORTRAITS[sprite.kind](pen, sprite)


def _disc(pen: Pen, sprite: Sprite) -> None:
    color, radius = COLOR_OF_TONE[sprite.tone], sprite.size
    pen.disc(radius, color, darker(color), min(0.4, 0.3 * radius))
    if sprite.tone not in _ROLLING:
        return
    mark = lighter(color, 0.55) if sprite.tone != Tone.BLACK else (110, 110, 115)
    pen.line([(-0.55 * radius, 0.0), (0.55 * radius, 0.0)], mark, 0.09 * radius)
    pen.line([(0.0, -0.55 * radius), (0.0, 0.55 * radius)], mark, 0.09 * radius)


def _star(pen: Pen, sprite: Sprite) -> None:
    color = COLOR_OF_TONE[sprite.tone]
    corners = []
    for k in range(2 * sprite.sides):
        radius = sprite.width if k % 2 else sprite.size
        corners.append(_polar(radius, math.pi / 2.0 + k * math.pi / sprite.sides))
    pen.polygon(corners, color, darker(color, 0.35), 0.3)


def _bar(pen: Pen, sprite: Sprite) -> None:
    color, half = COLOR_OF_TONE[sprite.tone], sprite.size / 2.0
    thickness = max(1.0, math.floor(sprite.width))
    pen.line([(-half, 0.0), (half, 0.0)], darker(color, 0.25), thickness)
    pen.line([(-half, 0.0), (half, 0.0)], color, thickness - 0.4)


def _polygon(pen: Pen, sprite: Sprite) -> None:
    color = COLOR_OF_TONE[sprite.tone]
    corners = [_polar(sprite.size, 2.0 * math.pi * k / sprite.sides) for k in range(sprite.sides)]
    pen.polygon(corners, color, darker(color), 0.4)


def _plank(pen: Pen, sprite: Sprite) -> None:
    color, half = COLOR_OF_TONE[sprite.tone], sprite.size / 2.0
    pen.line([(-half, 0.0), (half, 0.0)], darker(color, 0.45), 1.1)
    pen.line([(-half, 0.0), (half, 0.0)], color, 0.6)


def _pivot(pen: Pen, sprite: Sprite) -> None:
    color, half = COLOR_OF_TONE[sprite.tone], sprite.size / 2.0
    corners = [(0.0, 0.0), (-half, -1.6 * sprite.width), (half, -1.6 * sprite.width)]
    pen.polygon(corners, darker(color, 0.15), darker(color, 0.5), 0.3)
    pen.disc(0.55, lighter(color), darker(color, 0.5), 0.25)


def _trampoline(pen: Pen, sprite: Sprite) -> None:
    """A mat on a frame; legs hang from it, with springs at its ends."""
    turn = (sprite.angle + math.pi / 2.0) % math.pi - math.pi / 2.0
    if turn < -math.pi / 2.0 + 1e-6:
        turn = math.pi / 2.0
    pen.move((sprite.x, sprite.y), turn)
    half = sprite.size / 2.0
    foot = 2.6
    for x in (-half + 0.6, half - 0.6):
        lean = math.copysign(0.5, x)
        pen.line([(x, 0.0), (x + lean, -foot)], METAL, 0.55)
        pen.line([(x + lean - 0.7, -foot), (x + lean + 0.7, -foot)], METAL, 0.55)
    if sprite.size > 12.0:
        pen.line([(0.0, 0.0), (0.0, -0.8 * foot)], METAL, 0.45)
    pen.line([(-half, 0.0), (half, 0.0)], METAL, 2.0)
    pen.line([(-half + 0.9, 0.35), (half - 0.9, 0.35)], MAT, 1.2)
    for x in (-half + 0.2, half - 0.2):
        pen.line([(x - 0.3, 0.3), (x + 0.3, 0.3)], CANNON_YELLOW, 0.7)


def _cannon(pen: Pen, sprite: Sprite) -> None:
    """A barrel that points to where it shoots, on a wheel."""
    outline = darker(CANNON_RED, 0.45)
    barrel = [(-4.2, -2.3), (-4.2, 2.3), (5.4, 1.75), (5.4, -1.75)]
    pen.disc(2.3, CANNON_RED, outline, 0.35, centre=(-4.2, 0.0))
    pen.disc(0.7, outline, centre=(-6.6, 0.0))
    pen.polygon(barrel, CANNON_RED, outline, 0.35)
    for x, half in ((-2.9, 2.25), (1.0, 2.05), (4.9, 2.1)):
        pen.line([(x, -half), (x, half)], darker(CANNON_YELLOW, 0.35), 1.15)
        pen.line([(x, -half), (x, half)], CANNON_YELLOW, 0.7)
    pen.polygon(pen.ellipse((0.55, 1.55), (5.6, 0.0)), IRON)
    pen.disc(2.5, WOOD, darker(WOOD, 0.5), 0.5, centre=(-1.6, 0.0))
    for k in range(3):
        spoke = _polar(2.0, k * math.pi / 3.0)
        ends = [(-1.6 - spoke[0], -spoke[1]), (-1.6 + spoke[0], spoke[1])]
        pen.line(ends, darker(WOOD, 0.5), 0.3)
    pen.disc(0.7, IRON, centre=(-1.6, 0.0))


def _fan(pen: Pen, sprite: Sprite) -> None:
    """A ring with blades, seen from the side, and the air that it moves."""
    radii = (0.5 * sprite.size - 1.2, sprite.width / 2.0)
    for y in (-2.8, 0.0, 2.8):
        reach = 6.6 if y == 0.0 else 5.6
        pen.line([(1.8, y), (reach, y)], AIR, 0.4)
        pen.line([(reach - 1.0, y + 0.8), (reach, y), (reach - 1.0, y - 0.8)], AIR, 0.4)
    back = -0.7
    pen.polygon(pen.ellipse(radii, (back, 0.0)), lighter(FAN_BLUE, 0.8), FAN_BLUE, 0.8)
    for k in range(3):
        turn = math.pi / 2.0 + k * 2.0 * math.pi / 3.0
        middle = (back + 0.45 * radii[0] * math.cos(turn), 0.45 * radii[1] * math.sin(turn))
        blade = pen.ellipse((2.0, 0.8), middle, turn)
        pen.polygon(blade, lighter(FAN_BLUE, 0.15), darker(FAN_BLUE), 0.2)
    pen.disc(0.8, darker(FAN_BLUE, 0.4), centre=(back, 0.0))


def _belt(pen: Pen, sprite: Sprite) -> None:
    """A band over rollers, with arrows in its direction."""
    half = sprite.size / 2.0
    pen.line([(-half, 0.0), (half, 0.0)], RUBBER, 2.0)
    pen.line([(-half, 0.0), (half, 0.0)], METAL, 1.3)
    num_arrows = max(2, int(sprite.size / 2.4))
    for k in range(num_arrows):
        x = -half + (k + 0.5) * sprite.size / num_arrows
        pen.line([(x - 0.35, 0.5), (x + 0.35, 0.0), (x - 0.35, -0.5)], CANNON_YELLOW, 0.35)
    for x in (-half, half):
        pen.disc(1.0, RUBBER, centre=(x, 0.0))
        pen.disc(0.4, METAL, centre=(x, 0.0))


def _funnel(pen: Pen, sprite: Sprite) -> None:
    """A cone, open at its wide side, with a spout at its tip."""
    left, tip, right = (_polar(sprite.size, math.radians(degrees)) for degrees in (150, 270, 30))
    pen.polygon([left, tip, right], lighter(FUNNEL, 0.65))
    inner = lighter(FUNNEL, 0.45)
    middle = ((left[0] + right[0]) / 2.0, left[1])
    pen.polygon(
        pen.ellipse((right[0], 0.12 * sprite.size), middle), inner, darker(FUNNEL, 0.2), 0.3
    )
    pen.line([left, tip, right], darker(FUNNEL, 0.25), 0.75)
    pen.line([tip, (0.0, tip[1] - 0.18 * sprite.size)], darker(FUNNEL, 0.25), 1.1)


def _bucket(pen: Pen, sprite: Sprite) -> None:
    """A pail with its handle over the open side."""
    half = sprite.size / math.sqrt(2.0)
    handle = pen.arc((0.8 * half, 0.75 * half), (0.0, half), 0.0, math.pi)
    pen.line(handle, BUCKET_DARK, 0.12 * half)
    body = [(-half, half), (half, half), (0.88 * half, -half), (-0.88 * half, -half)]
    pen.polygon(body, BUCKET, darker(BUCKET, 0.35), 0.35)
    shine = [(-0.62 * half, 0.55 * half), (-0.55 * half, -0.7 * half)]
    pen.line(shine, lighter(BUCKET, 0.5), 0.14 * half)
    opening = pen.ellipse((half, 0.24 * half), (0.0, 0.8 * half))
    pen.polygon(opening, BUCKET_DARK, darker(BUCKET, 0.35), 0.35)


def _ladder(pen: Pen, sprite: Sprite) -> None:
    half = sprite.size / 2.0
    num_rungs = max(2, round(sprite.size / 2.5))
    for k in range(num_rungs):
        x = -half + (k + 0.5) * sprite.size / num_rungs
        pen.line([(x, -1.5), (x, 1.5)], darker(WOOD, 0.15), 0.5)
    for y in (-1.5, 1.5):
        pen.line([(-half, y), (half, y)], darker(WOOD, 0.4), 0.75)
        pen.line([(-half, y), (half, y)], WOOD, 0.4)


def _basket(pen: Pen, sprite: Sprite) -> None:
    half = sprite.size / 2.0
    strands = (-1.0, -0.5, 0.0, 0.5, 1.0)
    for near, far in itertools.pairwise(strands):
        pen.line([(near * half, half), (0.6 * far * half, -half)], NET, 0.3)
        pen.line([(far * half, half), (0.6 * near * half, -half)], NET, 0.3)
    for side in (-1.0, 1.0):
        pen.line([(side * half, half), (0.6 * side * half, -half)], NET, 0.4)
    pen.line([(-half, half), (half, half)], darker(COLOR_OF_TONE[Tone.GOAL], 0.3), 1.1)


def _basketball(pen: Pen, sprite: Sprite) -> None:
    radius, seam = sprite.size, darker(LEATHER, 0.65)
    pen.disc(radius, LEATHER, seam, 0.35)
    pen.line([(-0.95 * radius, 0.0), (0.95 * radius, 0.0)], seam, 0.3)
    pen.line([(0.0, -0.95 * radius), (0.0, 0.95 * radius)], seam, 0.3)
    for side in (-1.0, 1.0):
        centre = (side * 1.25 * radius, 0.0)
        middle = math.pi if side > 0.0 else 0.0
        curve = pen.arc((0.78 * radius, 0.95 * radius), centre, middle - 0.72, middle + 0.72)
        pen.line(curve, seam, 0.3)


def _box(pen: Pen, sprite: Sprite) -> None:
    half, edge = sprite.size / 2.0, darker(WOOD, 0.4)
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    pen.polygon(corners, WOOD, edge, 0.4)
    inner = 0.62 * half
    pen.line([(-inner, -inner), (inner, inner)], edge, 0.5)
    pen.line([(-inner, inner), (inner, -inner)], edge, 0.5)
    frame = [(-inner, -inner), (inner, -inner), (inner, inner), (-inner, inner), (-inner, -inner)]
    pen.line(frame, edge, 0.3)


def _subgoal(pen: Pen, sprite: Sprite) -> None:
    color = COLOR_OF_TONE[sprite.tone]
    pen.disc(sprite.size, color, darker(color, 0.3), 0.3)
    pen.disc(0.45 * sprite.size, color, darker(color, 0.18), 0.3)


def _polar(radius: float, angle: float) -> Point:
    return radius * math.cos(angle), radius * math.sin(angle)


_PORTRAITS: dict[Kind, Callable[[Pen, Sprite], None]] = {
    Kind.DISC: _disc,
    Kind.STAR: _star,
    Kind.BAR: _bar,
    Kind.POLYGON: _polygon,
    Kind.PLANK: _plank,
    Kind.PIVOT: _pivot,
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
    Kind.SUBGOAL: _subgoal,
}
