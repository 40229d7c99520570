"""Pictures of Grid World, with Pillow only."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs_mjx.grid_world.environment import (
    FIRST_CELL,
    GRID_SIZE,
    LAST_CELL,
    GridWorldState,
    decode_layout,
    is_wall,
)
from envs_mjx.grid_world.skills import NUM_SKILLS, direction_of, moves_of, skill_name

Color = tuple[int, int, int]
Path2D = Sequence[tuple[int, int]]

PAPER: Color = (250, 250, 247)
INK: Color = (45, 52, 64)
FAINT_INK: Color = (122, 130, 143)
WALL_COLOR: Color = (74, 84, 99)
WALL_EDGE_COLOR: Color = (91, 102, 119)
FLOOR_COLOR: Color = (241, 241, 234)
FLOOR_EDGE_COLOR: Color = (224, 224, 214)
LAVA_COLOR: Color = (226, 74, 43)
LAVA_CREST_COLOR: Color = (255, 170, 64)
SUBGOAL_COLOR: Color = (246, 205, 97)
SUBGOAL_MARK_COLOR: Color = (168, 118, 18)
GOAL_COLOR: Color = (92, 184, 118)
AGENT_COLOR: Color = (38, 98, 196)
PATH_COLOR: Color = (38, 98, 196)

# Shapes are drawn this much larger and scaled down, because Pillow does not smooth edges.
_OVERSAMPLING = 3


def skill_path(before: GridWorldState, after: GridWorldState, skill_id: int) -> Path2D:
    """The cells that a skill really visited, from the states around it.

    Args:
      before: the state in which the skill began.
      after: the state that the raw step returned (not the next episode's).
      skill_id: 0..1023, or an invalid id, which stays where it is.

    Returns:
      `1 + after.num_moves - before.num_moves` cells (x, y); a cell comes twice in a row where a
      wall held the agent.
    """
    cells = [(int(before.agent_xy[0]), int(before.agent_xy[1]))]
    dxs, dys = direction_of(moves_of(np.asarray(skill_id)))
    for t in range(int(after.num_moves) - int(before.num_moves)):
        step = np.array([dxs[t], dys[t]]) * (0 <= skill_id < NUM_SKILLS)
        x, y = np.clip(cells[-1] + step, FIRST_CELL, LAST_CELL)
        cells.append((int(x), int(y)))
    return cells


def draw_state(
    state: GridWorldState,
    skill_path: Path2D | None = None,
    pixels: int = 360,
    caption: str | None = None,
    note: str | None = None,
) -> np.ndarray:
    """A picture of one state: lava river, opening (diamond), goal (flag) and agent (disc).

    Args:
      state: one (not batched) state.
      skill_path: cells (x, y) of the skill that led here, drawn as an arrow; see `skill_path`.
      pixels: side of the picture of the grid, at least 90; it is rounded down to a multiple of 9.
      caption, note: left and right text of a line below the grid; None for both leaves it out.

    Returns:
      uint8[height, width, 3] RGB; width and, without caption, height are `pixels // 9 * 9`.

    Raises:
      ValueError: `pixels` is not 90 to 4096.
    """
    if not 10 * GRID_SIZE <= pixels <= 4096:
        raise ValueError(f"pixels={pixels} must be 90 to 4,096.")
    size = pixels // GRID_SIZE * GRID_SIZE
    cell = size // GRID_SIZE * _OVERSAMPLING
    image = _draw_layout(int(state.layout), cell).copy()
    draw = ImageDraw.Draw(image, "RGBA")
    if skill_path is not None and len(skill_path) > 1:
        _draw_path(draw, skill_path, cell)
    x, y = int(state.agent_xy[0]), int(state.agent_xy[1])
    _draw_agent(draw, x, y, cell, is_dead=_is_lava(int(state.layout), x, y))
    image = image.resize((size, size), Image.Resampling.LANCZOS)
    if caption is not None or note is not None:
        image = _add_caption(image, caption or "", note or "")
    return np.asarray(image)


def draw_episode(
    states: Sequence[GridWorldState],
    skill_ids: Sequence[int],
    rewards: Sequence[float],
    pixels: int = 360,
) -> list[np.ndarray]:
    """The frames of one episode, one per move, with the skill's name and the return below.

    Args:
      states: T + 1 states: the start and what the raw step (`step_env`) returned after each skill.
      skill_ids: T ids.
      rewards: T rewards.
      pixels: side of the grid, see `draw_state`.

    Returns:
      Frames uint8[height, width, 3].

    Raises:
      ValueError: the three lengths do not belong together.
    """
    if not len(states) - 1 == len(skill_ids) == len(rewards):
        raise ValueError(
            f"{len(states)} states, {len(skill_ids)} skills and {len(rewards)} rewards; T skills "
            "need T rewards and T + 1 states."
        )
    total = 0.0
    frames = [draw_state(states[0], None, pixels, "start", _note(states[0], total))]
    for before, after, skill_id, reward in zip(
        states[:-1], states[1:], skill_ids, rewards, strict=True
    ):
        cells = skill_path(before, after, skill_id)
        name = skill_name(skill_id) if 0 <= skill_id < NUM_SKILLS else f"invalid {skill_id}"
        for move in range(1, len(cells)):
            is_last = move == len(cells) - 1
            total += float(reward) if is_last else 0.0
            shown = GridWorldState(
                layout=before.layout,
                agent_xy=jnp.array(cells[move]),
                num_moves=before.num_moves + move,
                has_reached_subgoal=after.has_reached_subgoal,
                episode_return=after.episode_return,
            )
            caption = f"{name}  {reward:+.3f}" if is_last and reward else name
            note = _note(shown, total)
            frames.append(draw_state(shown, cells[: move + 1], pixels, caption, note))
    return frames


def draw_way(
    states: Sequence[GridWorldState],
    skill_ids: Sequence[int],
    rewards: Sequence[float],
    pixels: int,
) -> np.ndarray:
    """The whole path of an episode over its last state; arguments as of `draw_episode`."""
    cells = [(int(x), int(y)) for x, y in [states[0].agent_xy]]
    for before, after, skill_id in zip(states[:-1], states[1:], skill_ids, strict=True):
        cells += list(skill_path(before, after, skill_id))[1:]
    caption = f"{len(skill_ids)} skills, {int(states[-1].num_moves)} moves"
    return draw_state(states[-1], cells, pixels, caption, f"return {sum(rewards):.3f}")


def _note(state: GridWorldState, total: float) -> str:
    return f"move {int(state.num_moves)}   return {total:.3f}"


def _is_lava(layout: int, x: int, y: int) -> bool:
    is_horizontal, position, opening = decode_layout(layout)
    across, along = (y, x) if is_horizontal else (x, y)
    return across == position and along != opening


@lru_cache(maxsize=64)
def _draw_layout(layout: int, cell: int) -> Image.Image:
    """Everything that does not move, `9 * cell` pixels wide. Do not write on it: it is cached."""
    image = Image.new("RGB", (GRID_SIZE * cell, GRID_SIZE * cell), WALL_COLOR)
    draw = ImageDraw.Draw(image, "RGBA")
    line = max(1, cell // 30)
    is_horizontal, position, opening = decode_layout(layout)
    for x, y in np.argwhere(~is_wall()).tolist():
        _fill_cell(draw, x, y, cell, FLOOR_COLOR, FLOOR_EDGE_COLOR, line)
    for along in range(FIRST_CELL, LAST_CELL + 1):
        x, y = (along, position) if is_horizontal else (position, along)
        if along != opening:
            _fill_cell(draw, x, y, cell, LAVA_COLOR, LAVA_COLOR, line)
            _draw_waves(draw, x, y, cell, bool(is_horizontal))
    x, y = (opening, position) if is_horizontal else (position, opening)
    _fill_cell(draw, x, y, cell, SUBGOAL_COLOR, SUBGOAL_COLOR, line)
    _draw_diamond(draw, x, y, cell)
    _fill_cell(draw, LAST_CELL, LAST_CELL, cell, GOAL_COLOR, GOAL_COLOR, line)
    _draw_flag(draw, LAST_CELL, LAST_CELL, cell)
    for x, y in np.argwhere(is_wall()).tolist():
        box = (x * cell, y * cell, (x + 1) * cell - 1, (y + 1) * cell - 1)
        draw.rectangle(box, outline=WALL_EDGE_COLOR, width=line)
    return image


def _fill_cell(
    draw: ImageDraw.ImageDraw, x: int, y: int, cell: int, fill: Color, edge: Color, line: int
) -> None:
    box = (x * cell, y * cell, (x + 1) * cell - 1, (y + 1) * cell - 1)
    draw.rectangle(box, fill=fill, outline=edge, width=line)


def _center(x: float, y: float, cell: int) -> tuple[float, float]:
    return (x + 0.5) * cell, (y + 0.5) * cell


def _draw_waves(draw: ImageDraw.ImageDraw, x: int, y: int, cell: int, is_horizontal: bool) -> None:
    """Three crests along the river, of one period per cell, so that they join between cells."""
    along = np.linspace(0.0, 1.0, 25)
    for height in (0.25, 0.5, 0.75):
        across = height + 0.06 * np.sin(2 * np.pi * along + 7.0 * height)
        dx, dy = (along, across) if is_horizontal else (across, along)
        points = [
            (float(a), float(b)) for a, b in zip((x + dx) * cell, (y + dy) * cell, strict=True)
        ]
        draw.line(points, fill=LAVA_CREST_COLOR, width=max(2, cell // 18), joint="curve")


def _draw_diamond(draw: ImageDraw.ImageDraw, x: int, y: int, cell: int) -> None:
    cx, cy = _center(x, y, cell)
    r = 0.26 * cell
    draw.polygon([(cx, cy - r), (cx + r, cy), (cx, cy + r), (cx - r, cy)], fill=SUBGOAL_MARK_COLOR)


def _draw_flag(draw: ImageDraw.ImageDraw, x: int, y: int, cell: int) -> None:
    cx, cy = _center(x, y, cell)
    pole = cx - 0.16 * cell
    width = max(2, cell // 14)
    draw.line([(pole, cy - 0.32 * cell), (pole, cy + 0.34 * cell)], fill=PAPER, width=width)
    tip = (cx + 0.28 * cell, cy - 0.15 * cell)
    draw.polygon([(pole, cy - 0.34 * cell), tip, (pole, cy + 0.04 * cell)], fill=PAPER)


def _draw_agent(draw: ImageDraw.ImageDraw, x: int, y: int, cell: int, is_dead: bool) -> None:
    """A disc; a dark one with a cross where the agent fell into the lava."""
    cx, cy = _center(x, y, cell)
    for radius, color in ((0.36 * cell, PAPER), (0.30 * cell, INK if is_dead else AGENT_COLOR)):
        draw.ellipse((cx - radius, cy - radius, cx + radius, cy + radius), fill=color)
    if is_dead:
        r, width = 0.13 * cell, max(2, cell // 14)
        draw.line([(cx - r, cy - r), (cx + r, cy + r)], fill=PAPER, width=width)
        draw.line([(cx - r, cy + r), (cx + r, cy - r)], fill=PAPER, width=width)


def _draw_path(draw: ImageDraw.ImageDraw, cells: Path2D, cell: int) -> None:
    """A line with a dot at its start and an arrow head in the middle of every move.

    Where a path goes back over its own track it keeps to the right, so that both ways are seen.
    Moves that a wall stopped leave no mark.
    """
    walked = [cells[0]] + [b for a, b in itertools.pairwise(cells) if a != b]
    corners = np.add(walked, 0.5) * cell
    directions = np.sign(np.diff(corners, axis=0))
    tracks = [frozenset(track) for track in itertools.pairwise(walked)]
    returns = len(set(tracks)) < len(tracks)
    lane, width, head = (0.15, 0.08, 0.13) if returns else (0.0, 0.11, 0.17)
    lane *= cell
    sides = lane * np.stack([-directions[:, 1], directions[:, 0]], axis=-1)

    points = []
    for t, side in enumerate(sides):
        # At a corner both lanes shift the point; where the path turns back there are two points.
        before = sides[t - 1] if t and (directions[t - 1] @ directions[t]) == 0 else 0.0
        after = (
            sides[t + 1] if t + 1 < len(sides) and directions[t] @ directions[t + 1] == 0 else 0.0
        )
        points += [corners[t] + side + before, corners[t + 1] + side + after]
    line = [(float(x), float(y)) for x, y in points]
    if not line:
        return
    draw.line(line, fill=PATH_COLOR, width=max(2, int(width * cell)), joint="curve")
    radius, (x, y) = 0.13 * cell, line[0]
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=PATH_COLOR)
    for t, (side, direction) in enumerate(zip(sides, directions, strict=True)):
        _draw_head(draw, (corners[t] + corners[t + 1]) / 2 + side, direction, head * cell)


def _draw_head(
    draw: ImageDraw.ImageDraw, middle: np.ndarray, direction: np.ndarray, size: float
) -> None:
    side = np.array([-direction[1], direction[0]])
    tail = middle - 0.6 * size * direction
    corners = [middle + size * direction, tail + size * side, tail - size * side]
    draw.polygon([(float(x), float(y)) for x, y in corners], fill=PATH_COLOR)


def _add_caption(image: Image.Image, caption: str, note: str) -> Image.Image:
    """The picture with a line of text below it."""
    width, height = image.size
    bar = max(14, width // 11)
    font = ImageFont.load_default(size=bar * 0.52)
    framed = Image.new("RGB", (width, height + bar), PAPER)
    framed.paste(image, (0, 0))
    draw = ImageDraw.Draw(framed)
    middle, margin = height + bar / 2, bar * 0.35
    draw.text((margin, middle), caption, fill=INK, font=font, anchor="lm")
    draw.text((width - margin, middle), note, fill=FAINT_INK, font=font, anchor="rm")
    return framed
