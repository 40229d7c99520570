"""Colours of CREATE's pictures (docs/create.md, "Observation").

The release drew on an 8-bit surface: red and green have 8 levels, blue has 4. Agents saw those
colours, so observations use them; pictures for people use the colours that were meant. The gray of
a pixel is 0.299 R + 0.587 G + 0.114 B, rounded.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from envs_host.create.sprites import Tone

Color = tuple[int, int, int]


class Ink(IntEnum):
    """Numbers of the colours that observations consist of; 0 is the ground."""

    WHITE = 0
    RED = 1
    BLUE = 2
    GREEN = 3
    PALE_GREEN = 4
    ORANGE = 5
    DARK_BLUE = 6
    STEEL_BLUE = 7
    LIGHT_STEEL_BLUE = 8
    BLACK = 9
    MAT_BLUE = 10
    LEG_BLUE = 11
    CANNON_RED = 12
    CANNON_YELLOW = 13
    FAN_BLUE = 14
    BLADE_BLUE = 15
    HUB_BLUE = 16
    BELT_DARK = 17
    BELT_LIGHT = 18
    FUNNEL_GRAY = 19
    HANDLE_BROWN = 20
    LADDER_BROWN = 21
    LADDER_LIGHT = 22
    LADDER_YELLOW = 23
    NET_GREEN = 24
    BASKETBALL = 25
    BASKETBALL_LINE = 26
    WOOD_DARK = 27
    WOOD_LIGHT = 28


_SEEN: dict[Ink, Color] = {
    Ink.WHITE: (255, 255, 255),
    Ink.RED: (255, 73, 85),
    Ink.BLUE: (109, 182, 255),
    Ink.GREEN: (109, 255, 85),
    Ink.PALE_GREEN: (219, 255, 170),
    Ink.ORANGE: (255, 146, 85),
    Ink.DARK_BLUE: (0, 109, 170),
    Ink.STEEL_BLUE: (73, 146, 170),
    Ink.LIGHT_STEEL_BLUE: (182, 182, 255),
    Ink.BLACK: (0, 0, 0),
    Ink.MAT_BLUE: (73, 146, 170),
    Ink.LEG_BLUE: (0, 36, 170),
    Ink.CANNON_RED: (182, 36, 0),
    Ink.CANNON_YELLOW: (255, 182, 0),
    Ink.FAN_BLUE: (73, 109, 170),
    Ink.BLADE_BLUE: (73, 146, 170),
    Ink.HUB_BLUE: (36, 73, 170),
    Ink.BELT_DARK: (36, 36, 0),
    Ink.BELT_LIGHT: (146, 146, 85),
    Ink.FUNNEL_GRAY: (146, 146, 170),
    Ink.HANDLE_BROWN: (73, 36, 0),
    Ink.LADDER_BROWN: (109, 36, 85),
    Ink.LADDER_LIGHT: (219, 182, 85),
    Ink.LADDER_YELLOW: (219, 219, 85),
    Ink.NET_GREEN: (109, 219, 85),
    Ink.BASKETBALL: (255, 146, 0),
    Ink.BASKETBALL_LINE: (109, 36, 0),
    Ink.WOOD_DARK: (146, 109, 85),
    Ink.WOOD_LIGHT: (219, 182, 85),
}

# u8[n, 3], u8[n]: what an observation shows for each ink.
RGB_OF_INK = np.array([_SEEN[ink] for ink in Ink], np.uint8)
GRAY_OF_INK = np.rint(RGB_OF_INK @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)

INK_OF_TONE: dict[Tone, Ink] = {
    Tone.TARGET: Ink.RED,
    Tone.MARKER: Ink.BLUE,
    Tone.GOAL: Ink.GREEN,
    Tone.SUBGOAL: Ink.PALE_GREEN,
    Tone.TOOL: Ink.ORANGE,
    Tone.BOUNCY_TOOL: Ink.DARK_BLUE,
    Tone.PLANK: Ink.ORANGE,
    Tone.SCENERY: Ink.STEEL_BLUE,
    Tone.FRAME: Ink.LIGHT_STEEL_BLUE,
    Tone.BLACK: Ink.BLACK,
}

# The nominal colours, for people.
COLOR_OF_TONE: dict[Tone, Color] = {
    Tone.TARGET: (0xF4, 0x5B, 0x69),
    Tone.MARKER: (0x79, 0xAD, 0xDC),
    Tone.GOAL: (0x7C, 0xFD, 0x2E),
    Tone.SUBGOAL: (0xD3, 0xFE, 0xB9),
    Tone.TOOL: (0xFA, 0x85, 0x35),
    Tone.BOUNCY_TOOL: (0x08, 0x67, 0x88),
    Tone.PLANK: (0xFA, 0x91, 0x49),
    Tone.SCENERY: (70, 130, 180),
    Tone.FRAME: (176, 196, 222),
    Tone.BLACK: (0, 0, 0),
}
