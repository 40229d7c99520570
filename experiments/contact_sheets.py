"""Two pictures that show CREATE at a glance: its twelve levels, and examples of its tools.

    python -m experiments.contact_sheets --out=results/create

Above, what people see; below, in gray, the pixels that the agent gets. All pictures are mirrored
left-right, as in the release.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs_host.create.building import build_tool
from envs_host.create.config import CreateConfig
from envs_host.create.drawing import OBSERVATION_SIZE, draw
from envs_host.create.episode import Episode
from envs_host.create.geometry import WORLD_SIZE
from envs_host.create.layout import Layout
from envs_host.create.levels import TASK_NAMES, load_level
from envs_host.create.sprites import Sprite
from envs_host.create.tools import Tool, ToolClass, all_tools
from experiments.flags import Arguments
from jaxnew.task.places import check_output

ARGUMENTS = Arguments(__doc__)
ARGUMENTS.define("string", "out", "results/create", "Folder of the two pictures.")

NUM_EXAMPLES = 3

_INK, _FAINT, _PAPER, _FRAME = (45, 52, 64), (122, 130, 143), (255, 255, 255), (214, 218, 224)
_GAP, _TITLE = 14, 30
_LEVEL_SIZE, _LEVEL_COLUMNS = 300, 4
_TOOL_SIZE, _TOOL_COLUMNS = 420, 4
_LARGEST_SHOWN = 26.0  # Units: what fits into a third of the world's width.
_NUM_COLORS = 200


def main() -> None:
    out = check_output(ARGUMENTS.out)
    for name, sheet in (("levels", levels_sheet()), ("tools", tools_sheet())):
        path = out / f"{name}.png"
        # A palette makes the files a third as large; nobody sees it.
        sheet.quantize(_NUM_COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
        print(path)


def levels_sheet() -> Image.Image:
    """The start of every level without noise; in a corner, the agent's first frame."""
    cells = []
    for name in TASK_NAMES:
        level = load_level(name)
        sprites = list(Episode(_shown(Layout(level)), CreateConfig()).world.sprites())
        people = draw(sprites, "people", _LEVEL_SIZE)
        agent = np.repeat(draw(sprites, "gray")[..., None], 3, axis=-1)
        marker = "marker" if level.has_marker else "no marker"
        note = f"{marker}, {level.step_limit + 1} actions"
        cells.append((name, note, np.concatenate([people, _beside(agent, _LEVEL_SIZE)], axis=1)))
    return _sheet(cells, _LEVEL_COLUMNS // 2 + 1)


def _shown(layout: Layout) -> Layout:
    """The layout with the first of the choices where a level has some (Funnel's goal)."""
    choices = [group for group in layout.level.noise if group.choice]
    offsets = {member: group.choice[0] for group in choices for member in group.members}
    return Layout(layout.level, offsets)


def _beside(agent: np.ndarray, height: int) -> np.ndarray:
    """The agent's frame with a border, as large as whole pixels allow, on paper of that height."""
    side = OBSERVATION_SIZE * 2
    panel = np.full((height, side + 2 * _GAP, 3), 255, np.uint8)
    panel[:, 0] = _FRAME
    top = height - side - _GAP
    panel[top - 1 : top + side + 1, _GAP - 1 : _GAP + side + 1] = _FRAME
    panel[top : top + side, _GAP : _GAP + side] = agent.repeat(2, axis=0).repeat(2, axis=1)
    return panel


def tools_sheet() -> Image.Image:
    """Three tools of every class but the no-op, and below them what the agent sees."""
    cells = []
    for tool_class in ToolClass:
        if tool_class == ToolClass.NO_OP:
            continue
        tools = [tool for tool in all_tools() if tool.tool_class == tool_class]
        sprites = _row_of_tools(_examples(tools))
        people = _strip(draw(sprites, "people", _TOOL_SIZE))
        gray = _strip(draw(sprites, "gray")).repeat(_TOOL_SIZE // OBSERVATION_SIZE, axis=0)
        agent = np.repeat(gray.repeat(_TOOL_SIZE // OBSERVATION_SIZE, axis=1)[..., None], 3, -1)
        cells.append((tool_class.value, f"{len(tools)} tools", np.concatenate([people, agent])))
    return _sheet(cells, _TOOL_COLUMNS)


def _examples(tools: Sequence[Tool]) -> list[Tool]:
    """Tools of different sizes and angles, none too long for its place."""
    small = [tool for tool in tools if (tool.size or 0.0) <= _LARGEST_SHOWN]
    chosen: list[Tool] = []
    for place in np.random.default_rng(len(tools)).permutation(len(small)):
        tool = small[place]
        angles = {other.angle_deg for other in chosen} - {None}
        is_new = tool.angle_deg not in angles and tool.size not in {o.size for o in chosen}
        if (is_new or tool.size is None) and len(chosen) < NUM_EXAMPLES:
            chosen.append(tool)
    return chosen


def _row_of_tools(tools: Sequence[Tool]) -> list[Sprite]:
    """Sprites of tools side by side, the first one on the left of the mirrored picture."""
    step = WORLD_SIZE / len(tools)
    positions = [(WORLD_SIZE - (k + 0.5) * step, WORLD_SIZE / 2.0) for k in range(len(tools))]
    return [
        sprite
        for tool, position in zip(tools, positions, strict=True)
        for sprite in build_tool(tool, position).sprites()
    ]


def _strip(picture: np.ndarray) -> np.ndarray:
    """The middle third of a picture's height."""
    third = len(picture) // NUM_EXAMPLES
    return picture[third : 2 * third]


def _sheet(cells: Sequence[tuple[str, str, np.ndarray]], columns: int) -> Image.Image:
    """Pictures with a title and a note above each, row by row."""
    height, width = cells[0][2].shape[:2]
    rows = -(-len(cells) // columns)
    size = columns * (width + _GAP) + _GAP, rows * (height + _TITLE + _GAP) + _GAP
    sheet = Image.new("RGB", size, _PAPER)
    pen = ImageDraw.Draw(sheet)
    title_font, note_font = (ImageFont.load_default(size=_TITLE * share) for share in (0.62, 0.5))
    for place, (title, note, picture) in enumerate(cells):
        x = _GAP + place % columns * (width + _GAP)
        y = _GAP + place // columns * (height + _TITLE + _GAP)
        pen.text((x, y + _TITLE / 2), title, fill=_INK, font=title_font, anchor="lm")
        pen.text((x + width, y + _TITLE / 2), note, fill=_FAINT, font=note_font, anchor="rm")
        sheet.paste(Image.fromarray(picture), (x, y + _TITLE))
        box = (x - 1, y + _TITLE - 1, x + width, y + _TITLE + height)
        pen.rectangle(box, outline=_FRAME)
    return sheet


if __name__ == "__main__":
    ARGUMENTS.start(main)
