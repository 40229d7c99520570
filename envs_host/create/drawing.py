"""Pictures of a world, for agents and for people (docs/create.md, "Observation").

Every picture is mirrored left-right, as all pictures of the release are: the top left corner shows
the world's (+1, +1).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from envs_host.create.colors import RGB_OF_INK, Ink
from envs_host.create.config import MAX_PIXELS
from envs_host.create.forms import WHITE_GRAY, fixed_print_of, print_of
from envs_host.create.sprites import Kind, Sprite

MODES = ("gray", "rgb", "people")
OBSERVATION_SIZE = 84
PEOPLE_SIZE = 1024

# Kinds that may look different in the next frame; prints of the others are remembered.
_MOVING = frozenset({Kind.DISC, Kind.PLANK, Kind.BASKETBALL, Kind.BOX})


def draw(
    sprites: Iterable[Sprite], mode: str = "gray", size: int | None = None, **extras: Any
) -> np.ndarray:
    """A picture of sprites on white, later ones over earlier ones.

    Args:
      sprites: see `sprites`; what lies outside the world is cut off.
      mode: "gray" and "rgb" are observations, one pixel per unit at size 84, not smoothed. Their
        rgb has the release's 8-bit colours, their gray is rounded. "people" is smooth and has the
        nominal colours.
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
    if not 1 <= size <= MAX_PIXELS:
        raise ValueError(f"size={size} must be 1 to {MAX_PIXELS} pixels.")
    if mode == "gray":
        return _draw_grays(sprites, size)
    return np.take(RGB_OF_INK, _draw_inks(sprites, size), axis=0)


def _draw_grays(sprites: Iterable[Sprite], size: int) -> np.ndarray:
    """u8[size, size] of grays."""
    frame = np.empty(size * size, np.uint8)
    frame.fill(WHITE_GRAY)
    for sprite in sprites:
        make = print_of if sprite.kind in _MOVING else fixed_print_of
        places, grays, _ = make(sprite, size)
        frame[places] = grays
    return frame.reshape(size, size)


def _draw_inks(sprites: Iterable[Sprite], size: int) -> np.ndarray:
    """u8[size, size] of the numbers of inks."""
    frame = np.full(size * size, Ink.WHITE, np.uint8)
    for sprite in sprites:
        make = print_of if sprite.kind in _MOVING else fixed_print_of
        places, _, inks = make(sprite, size)
        frame[places] = inks
    return frame.reshape(size, size)
