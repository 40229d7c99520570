"""Which pixels a form covers, at one pixel per unit or any other scale (spec create 7.3).

Pixels are (row, column) with row 0 on top and columns along +x: not mirrored yet. Functions return
int arrays [n, 2]; pixels may lie outside the picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Pixel = tuple[int, int]

# A disc covers the pixels whose centres are nearer to its centre, a corner of pixels, than its
# radius less this. It gives the figures of spec create 7.3: rows 2 4 6 6 4 2 for radius 3,
# 2 6 6 8 8 6 6 2 for 4, and 232 pixels for 9. The smallest disc has 2 x 2 pixels.
_DISC_SHRINKAGE = 0.4
_SMALLEST_DISC = 0.75

_STAR = (
    "....#....",
    "....#....",
    "...###...",
    "#########",
    "..#####..",
    "..#####..",
    "..#####..",
    ".##...##.",
    ".#.....#.",
)


def disc(radius: int) -> np.ndarray:
    """Pixels of a disc around (0, 0): rows and columns -radius..radius - 1."""
    reach = max(radius - _DISC_SHRINKAGE, _SMALLEST_DISC)
    centres = np.arange(-max(radius, 1), max(radius, 1)) + 0.5
    return np.argwhere(np.hypot(centres[:, None], centres) < reach) - max(radius, 1)


def line(start: Pixel, end: Pixel, width: int = 1) -> np.ndarray:
    """Pixels of a line, both ends included.

    A wider line is repeated alternately above and below, if it is flat, or left and right. Width 2
    has the further pixels above or left, so that a bar on the edge of the world (its pixel is the
    one just outside) still shows one row or column.
    """
    rows, columns = end[0] - start[0], end[1] - start[1]
    num_steps = max(abs(rows), abs(columns), 1)
    share = np.arange(num_steps + 1) / num_steps
    row = start[0] + np.floor(share * rows + 0.5).astype(int)
    column = start[1] + np.floor(share * columns + 0.5).astype(int)
    is_flat = abs(columns) >= abs(rows)
    pixels = []
    for shift in range(-(width // 2), width - width // 2):
        down, right = (shift, 0) if is_flat else (0, shift)
        pixels.append(np.stack([row + down, column + right], axis=1))
    return np.concatenate(pixels)


def convex_polygon(corners: Sequence[Pixel]) -> np.ndarray:
    """Pixels of a filled convex polygon with corners on pixels, which belong to it.

    Each row is filled from its leftmost to its rightmost crossing with the edges, both rounded.
    """
    start = np.array(corners)
    rise, run = (np.roll(start, -1, axis=0) - start).T
    rows = np.arange(start[:, 0].min(), start[:, 0].max() + 1)
    columns = np.arange(start[:, 1].min(), start[:, 1].max() + 1)
    # Rows of flat edges are crossed by their neighbours, in the same corners.
    share = (rows[:, None] - start[:, 0]) / np.where(rise == 0, np.inf, rise)
    is_crossed = (share >= 0.0) & (share <= 1.0) & (rise != 0)
    crossing = np.floor(start[:, 1] + share * run + 0.5)
    left = np.where(is_crossed, crossing, np.inf).min(axis=1)
    right = np.where(is_crossed, crossing, -np.inf).max(axis=1)
    if len(rows) == 1:
        left, right = columns[:1], columns[-1:]
    is_filled = (columns >= left[:, None]) & (columns <= right[:, None])
    return np.argwhere(is_filled) + np.array([rows[0], columns[0]])


def star(radius: float) -> np.ndarray:
    """Pixels of the goal's star around (0, 0), 9 x 9 and 35 of them for radius 4."""
    art = np.array([[mark == "#" for mark in row] for row in _STAR])
    side = max(1, round(radius / 4.0 * len(_STAR)))
    source = np.arange(side) * len(_STAR) // side
    return np.argwhere(art[np.ix_(source, source)]) - side // 2
