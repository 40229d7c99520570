"""Which pixels a form covers, at one pixel per unit or any other scale.

Pixels are (row, column) with row 0 on top and columns along +x: not mirrored yet. Functions return
int arrays [n, 2]; pixels may lie outside the picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Pixel = tuple[int, int]

# A disc covers the pixels whose centres are nearer to its centre, a corner of pixels, than its
# radius less this. It gives the figures of the release: rows 2 4 6 6 4 2 for radius 3, 2 6 6 8 8 6
# 6 2 for 4, and 232 pixels for 9. The smallest disc has 2 x 2 pixels.
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

    A wider line is repeated alternately below and above, if it is flat, or right and left, if it is
    steep or a diagonal. So of an even width the further pixels are below or right.
    """
    rows, columns = end[0] - start[0], end[1] - start[1]
    num_steps = max(abs(rows), abs(columns), 1)
    # Halves are rounded up.
    pixels = [
        (start[0] + (2 * step * rows + num_steps) // (2 * num_steps),
         start[1] + (2 * step * columns + num_steps) // (2 * num_steps))
        for step in range(num_steps + 1)
    ]  # fmt: skip
    is_flat = abs(columns) > abs(rows)
    shifts = range(-((width - 1) // 2), width // 2 + 1)
    if is_flat:
        return np.array([(row + shift, column) for shift in shifts for row, column in pixels])
    return np.array([(row, column + shift) for shift in shifts for row, column in pixels])


def convex_polygon(corners: Sequence[Pixel]) -> np.ndarray:
    """Pixels of a filled convex polygon with corners on pixels, which belong to it.

    Each row is filled from its leftmost to its rightmost crossing with the edges, both rounded.
    """
    sides: dict[int, tuple[int, int]] = {}  # By row; plain Python is quicker for so few pixels.
    for (row, column), (end_row, end_column) in zip(
        corners, [*corners[1:], corners[0]], strict=True
    ):
        rise, run = end_row - row, end_column - column
        step = 1 if rise >= 0 else -1
        for down in range(0, rise + step, step):
            crossing = column + ((2 * down * run + rise) // (2 * rise) if rise else 0)
            left, right = sides.get(row + down, (crossing, crossing))
            sides[row + down] = min(left, crossing), max(right, crossing)
    return np.array(
        [
            (row, column)
            for row, (left, right) in sorted(sides.items())
            for column in range(left, right + 1)
        ]
    )


def star(radius: float) -> np.ndarray:
    """Pixels of the goal's star around (0, 0), 9 x 9 and 35 of them for radius 4."""
    art = np.array([[mark == "#" for mark in row] for row in _STAR])
    side = max(1, round(radius / 4.0 * len(_STAR)))
    source = np.arange(side) * len(_STAR) // side
    return np.argwhere(art[np.ix_(source, source)]) - side // 2
