"""What the agent sees, against docs/create.md, "Observation": pixels, tones, order, glyphs."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from envs_host.create import CreateConfig, CreateEnv, colors, forms, raster
from envs_host.create.building import build_tool
from envs_host.create.drawing import draw
from envs_host.create.sprites import Kind, Sprite, Tone
from envs_host.create.tools import Tool, ToolClass, all_tools

UNIVERSE = CreateConfig(action_ids="universe")
NO_OP = {"index": 2365, "position": (0.0, 0.0)}
CENTRE = (42.0, 42.0)

# Of the release's 8-bit colours.
GRAY_SEEN = {
    Tone.TARGET: 128.8,
    Tone.MARKER: 168.5,
    Tone.GOAL: 192.0,
    Tone.SUBGOAL: 234.5,
    Tone.TOOL: 171.6,
    Tone.BOUNCY_TOOL: 83.4,
    Tone.PLANK: 171.6,
    Tone.SCENERY: 126.9,
    Tone.FRAME: 190.3,
    Tone.BLACK: 0.0,
}


def disc(tone: Tone, x: float, y: float, radius: float = 4.0) -> Sprite:
    return Sprite(Kind.DISC, x, y, 0.0, radius, tone)


def bar(x: float, y: float, angle: float, length: float, width: float) -> Sprite:
    return Sprite(Kind.BAR, x, y, angle, length, Tone.SCENERY, width=width)


def picture(kind: Kind, size: float, angle: float = 0.0, at: tuple = CENTRE) -> Sprite:
    return Sprite(kind, *at, angle, size, Tone.PICTURE, width=2.0)


def ink(frame: np.ndarray) -> np.ndarray:
    return frame[frame != 255].astype(float)


def rows(frame: np.ndarray) -> list[int]:
    """Widths of the inked rows."""
    widths = (frame != 255).sum(axis=1)
    return widths[widths > 0].tolist()


def extent(frame: np.ndarray) -> tuple[int, int, int, int]:
    """First and last inked row, first and last inked column."""
    found = np.argwhere(frame != 255)
    (top, left), (bottom, right) = found.min(axis=0), found.max(axis=0)
    return int(top), int(bottom), int(left), int(right)


def of_class(name: str) -> list[Tool]:
    return [tool for tool in all_tools() if tool.tool_class == name]


def frame_of(tool: Tool, position: tuple[float, float] = CENTRE, size: int = 84) -> np.ndarray:
    return draw(list(build_tool(tool, position).sprites()), size=size)


@pytest.mark.golden
def test_first_frame_of_push_has_the_histogram_of_the_release() -> None:
    """The release's histogram of the first frame, with each gray rounded."""
    frame, _ = CreateEnv("Push", deterministic=True).reset(seed=0)
    assert frame.shape == (84, 84)
    assert frame.dtype == np.uint8
    values, counts = np.unique(frame, return_counts=True)
    histogram = dict(zip(values.tolist(), counts.tolist(), strict=True))
    assert histogram == {255: 6899, 168: 44, 129: 44, 192: 35, 127: 34}
    assert extent(np.where(frame == 129, 0, 255)) == (43, 50, 34, 41)
    assert extent(np.where(frame == 192, 0, 255))[2:] == (83 - 12 - 4, 83 - 12 + 4)
    # Platforms at y = 31.5 and 10.5; their ends at x = 38.2, 54.2 and 4.6, 20.6.
    assert np.argwhere(frame == 127)[:, 0].tolist() == [52] * 17 + [73] * 17
    assert np.argwhere(frame == 127)[:, 1].tolist() == [*range(29, 46), *range(63, 80)]


@pytest.mark.golden
@pytest.mark.parametrize(
    ("radius", "widths"), [(3, [2, 4, 6, 6, 4, 2]), (4, [2, 6, 6, 8, 8, 6, 6, 2])]
)
def test_rows_of_small_discs(radius: int, widths: list[int]) -> None:
    assert rows(draw([disc(Tone.TARGET, 42.9, 42.1, radius)])) == widths
    # int(x) and int(84 - y) are the first pixels right of and below the middle; then mirrored.
    assert extent(draw([disc(Tone.TARGET, 42.9, 42.1, radius)])) == (
        41 - radius,
        40 + radius,
        83 - 41 - radius,
        83 - 42 + radius,
    )


@pytest.mark.unit
@pytest.mark.parametrize("size", [1, 5, 13])
def test_what_is_too_small_for_a_pixel_is_left_out(size: int) -> None:
    for level in ("Push", "Funnel", "Ladder", "Seesaw"):
        env = CreateEnv(level, config=CreateConfig(render_size=size))
        assert env.reset(seed=0)[0].shape == (size, size)
        for index in (5, 20, 33):
            env.step({"index": index, "position": [index / 20 - 1, 0.5]})


@pytest.mark.golden
def test_sizes_of_discs_and_star() -> None:
    sizes = {radius: len(raster.disc(radius)) for radius in (1, 3, 4, 9)}
    assert sizes == {1: 4, 3: 24, 4: 44, 9: 232}
    star = draw([Sprite(Kind.STAR, *CENTRE, 0.0, 4.0, Tone.GOAL, width=2.0, sides=5)])
    assert len(ink(star)) == 35
    assert extent(star) == (38, 46, 37, 45)
    assert rows(star)[0] == 1  # A vertex on top.


@pytest.mark.golden
def test_bars_and_planks() -> None:
    assert rows(draw([bar(46.2, 31.5, 0.0, 16.0, 1.0)])) == [17]
    upright = draw([bar(46.2, 31.5, math.pi / 2, 16.0, 1.0)])
    assert rows(upright) == [1] * 17
    # Width floor(2.5) = 2: the line and the row below it, or the column right of it, mirrored.
    assert rows(draw([bar(42.0, 42.0, 0.0, 16.0, 2.5)])) == [17, 17]
    assert extent(draw([bar(42.0, 42.0, 0.0, 16.0, 2.0)]))[:2] == (42, 43)
    assert extent(draw([bar(42.0, 42.0, math.pi / 2, 16.0, 2.0)]))[2:] == (83 - 43, 83 - 42)
    plank = frame_of(of_class(ToolClass.LEVER)[0])
    # Length 6: a line of 7, below it a triangle that ends in a base of 5.
    assert rows(plank) == [7, 3, 5]
    assert np.unique(ink(plank)).tolist() == [172]


@pytest.mark.golden
def test_left_and_top_frame_wall_show_two_pixels_and_the_right_one_none() -> None:
    frame, _ = CreateEnv("Collide", True).reset(seed=0)
    walls = frame == 190
    assert walls[:2].all()
    assert walls[:, -2:].all()  # The world's left is the picture's right.
    assert walls.sum() == 2 * 84 + 2 * 82


def pixels_of_line(sprite: Sprite, size: int) -> np.ndarray:
    """bool[size, size] of a bar: its ends' pixels, the nearest pixels between them, and copies of
    these at -((w - 1) // 2)..w // 2 across: below a flat line, right of one that is not."""
    scale, width = size / 84, max(1, int(int(sprite.width) * size / 84))
    half = sprite.size / 2 * np.array([-math.sin(sprite.angle), math.cos(sprite.angle)])
    centre = np.array([84 - sprite.y, sprite.x])
    start, end = (np.floor((centre + side * half) * scale + 1e-6) for side in (-1, 1))
    steps = max(1, int(abs(end - start).max()))
    along = np.arange(steps + 1)[:, None] / steps
    line = np.floor(start + along * (end - start) + 0.5 + 1e-9).astype(int)
    is_flat = abs(end - start)[1] > abs(end - start)[0]
    shifts = np.arange(-((width - 1) // 2), width // 2 + 1)[:, None]
    across = shifts * (np.array([[1, 0]]) if is_flat else np.array([[0, 1]]))
    found = (line[None] + across[:, None]).reshape(-1, 2)
    found = found[((found >= 0) & (found < size)).all(axis=1)]
    covered = np.zeros((size, size), bool)
    covered[found[:, 0], size - 1 - found[:, 1]] = True
    return covered


@pytest.mark.oracle
@pytest.mark.parametrize("size", [84, 48, 168, 252])
def test_lines_against_plain_numpy(size: int) -> None:
    """Frame walls, bars and ramps, of widths 1 to 6 pixels, of all angles, over the edges too."""
    rng = np.random.default_rng(0)
    sprites = [s for name in ("Collide", "Cannon", "Belt") for s in bars_of(name)]
    for tool in of_class(ToolClass.RAMP):
        sprites += build_tool(tool, tuple(rng.uniform(0, 84, 2))).sprites()
    for angle in np.radians(range(0, 360, 5)):
        sprites.append(bar(*rng.uniform(0, 84, 2), angle, rng.uniform(5, 60), 2.0))
    for sprite in sprites:
        expected = pixels_of_line(sprite, size)
        assert np.array_equal(draw([sprite], size=size) != 255, expected), sprite
        assert np.array_equal((draw([sprite], "rgb", size) != 255).any(axis=2), expected), sprite


def bars_of(name: str) -> list[Sprite]:
    env = CreateEnv(name, True)
    env.reset(seed=0)
    return [sprite for sprite in env.world.sprites() if sprite.kind is Kind.BAR]


@pytest.mark.golden
@pytest.mark.parametrize(("angle", "further"), [(44.0, (1, 0)), (45.0, (0, -1)), (46.0, (0, -1))])
def test_of_a_diagonal_the_further_pixel_is_on_the_right(
    angle: float, further: tuple[int, int]
) -> None:
    """As of steep lines; mirrored it is on the left."""
    thin, wide = (draw([bar(*CENTRE, math.radians(-angle), 40.0, w)]) != 255 for w in (1.0, 2.0))
    assert np.array_equal(wide, thin | np.roll(thin, further, axis=(0, 1)))


@pytest.mark.golden
def test_tones_are_those_of_the_table() -> None:
    assert set(GRAY_SEEN) == set(Tone) - {Tone.PICTURE}
    for tone, gray in GRAY_SEEN.items():
        seen = colors.RGB_OF_INK[colors.INK_OF_TONE[tone]] @ np.array([0.299, 0.587, 0.114])
        assert seen == pytest.approx(gray, abs=0.06), tone
        assert ink(draw([disc(tone, *CENTRE)]))[0] == pytest.approx(seen, abs=0.5)


@pytest.mark.unit
def test_rgb_has_8_bit_colours_and_the_same_grays() -> None:
    env = CreateEnv("Basket", True, CreateConfig(observation="rgb"))
    frame, _ = env.reset(seed=0)
    assert frame.shape == env.observation_space.shape == (84, 84, 3)
    levels = [0, 36, 73, 109, 146, 182, 219, 255]
    assert np.isin(colors.RGB_OF_INK[:, :2], levels).all()
    assert np.isin(colors.RGB_OF_INK[:, 2], [0, 85, 170, 255]).all()
    gray = draw(env.world.sprites())
    difference = abs(frame @ np.array([0.299, 0.587, 0.114]) - gray)
    assert difference.max() <= 0.5
    assert len(np.unique(gray)) > 4


@pytest.mark.unit
def test_pictures_are_mirrored() -> None:
    sprites = [disc(Tone.TARGET, 10.0, 70.0), bar(20.0, 20.0, math.radians(45), 20.0, 1.0)]
    frame = draw(sprites)
    assert extent(np.where(frame == 129, 0, 255)) == (10, 17, 83 - 13, 83 - 6)
    line = np.argwhere(frame == 127)
    assert (line[:, 1] > 42).all()
    # It rises to +x, so in the picture it falls to the right.
    assert np.all(np.diff(line[np.argsort(line[:, 0])], axis=0) == 1)


@pytest.mark.unit
def test_later_sprites_cover_earlier_ones() -> None:
    below, above = disc(Tone.TARGET, *CENTRE), disc(Tone.BLACK, *CENTRE, 3.0)
    assert (draw([below, above]) == 0).sum() == 24
    assert (draw([above, below]) == 0).sum() == 0


@pytest.mark.unit
def test_order_of_a_world() -> None:
    """Target, goal, tools, objects, subgoals, frame walls: each covers what comes before."""
    env = CreateEnv("Seesaw", True, UNIVERSE)
    env.reset(seed=0)
    placed = env.step({"index": 360, "position": (0.6, 0.4)})[4]["placement"]
    assert placed == "placed"
    kinds = [(sprite.kind.value, sprite.tone.value) for sprite in env.world.sprites()]
    assert kinds == [
        ("disc", "target"),
        ("star", "goal"),
        ("disc", "tool"),
        ("disc", "black"),
        ("plank", "plank"),
        ("pivot", "plank"),
        ("disc", "plank"),
        ("bar", "scenery"),
        ("bar", "scenery"),
        ("subgoal", "subgoal"),
        *[("bar", "frame")] * 3,
    ]


# Of the release's pictures: share of the shape's area (with the room that it leaves), mean gray
# of the ink with its spread. Means over all tools of a class, each of them within the spread.
PICTURES = {
    ToolClass.TRAMPOLINE: ((0.7, 1.8), 96.0, 35.0),
    ToolClass.CANNON: ((1.0, 1.2), 104.0, 47.0),
    ToolClass.FAN: ((0.5, 0.6), 107.0, 15.0),
    ToolClass.BELT: ((0.33, 0.39), 90.0, 50.0),
    ToolClass.FUNNEL: ((0.35, 0.45), 149.0, 1.0),
    ToolClass.BUCKET: ((0.95, 1.05), 132.0, 57.0),
}


@pytest.mark.golden
@pytest.mark.parametrize("tool_class", PICTURES)
def test_pictures_of_tools_have_the_ink_and_gray_of_the_release(tool_class: ToolClass) -> None:
    (low, high), gray, spread = PICTURES[tool_class]
    shares, everything = [], []
    for tool in of_class(tool_class):
        inked = ink(frame_of(tool))
        shares.append(len(inked) / build_tool(tool, CENTRE).shape.area)
        everything.append(inked)
        assert inked.mean() == pytest.approx(gray, abs=spread)
    values = np.concatenate(everything)
    assert low <= np.mean(shares) <= high
    assert values.mean() == pytest.approx(gray, abs=max(1.0, 0.4 * spread))
    assert values.std() == pytest.approx(spread, abs=max(1.0, 0.2 * spread))
    if tool_class == ToolClass.TRAMPOLINE:  # Its shares are a range of tools, not a mean.
        assert low <= min(shares) <= max(shares) <= high
    if tool_class == ToolClass.CANNON:
        assert np.mean([len(inked) for inked in everything]) == pytest.approx(82, abs=4)
    if tool_class == ToolClass.FAN:
        assert 13 <= min(map(len, everything)) <= max(map(len, everything)) <= 47
    if tool_class == ToolClass.BELT:
        assert all(50 <= inked.mean() <= 130 for inked in everything)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("sprite", "pixels", "gray", "spread"),
    [
        (picture(Kind.LADDER, 20.0, math.radians(95)), 45, 148, 54),
        (picture(Kind.LADDER, 15.0, math.radians(95)), 33, 183, 13),
        (picture(Kind.BASKET_GOAL, 10.0), 37, 184, 8),
        (picture(Kind.BASKETBALL, 3.5), 36, 136, 48),
        (picture(Kind.BOX, 5.0), 16, 134, 26),
    ],
    ids=lambda value: value.kind.value if isinstance(value, Sprite) else str(value),
)
def test_pictures_of_level_objects(sprite: Sprite, pixels: int, gray: int, spread: int) -> None:
    inked = ink(draw([sprite]))
    assert len(inked) == pytest.approx(pixels, abs=1)
    assert inked.mean() == pytest.approx(gray, abs=6)
    assert inked.std() == pytest.approx(spread, abs=4)


@pytest.mark.unit
def test_slanted_trampolines_are_thick() -> None:
    widest = {0: 2, 45: 3, 90: 2, 135: 3}
    for angle, thickness in widest.items():
        tool = next(
            tool
            for tool in of_class(ToolClass.TRAMPOLINE)
            if tool.angle_deg == angle and tool.size == 22
        )
        frame = frame_of(tool)
        along = max(extent(frame)[1] - extent(frame)[0], extent(frame)[3] - extent(frame)[2]) + 1
        assert (len(ink(frame)) / along > 2.0) == (thickness == 3)
    # Legs are below, whichever way it is slanted: the lowest inked pixel of a column is dark.
    for angle in (30, 150):
        tool = next(tool for tool in of_class(ToolClass.TRAMPOLINE) if tool.angle_deg == angle)
        frame = frame_of(tool)
        top = [column[column != 255][0] for column in frame.T if (column != 255).any()]
        assert set(top[1:-1]) == {127}


@pytest.mark.unit
def test_pictures_turn_with_their_tool() -> None:
    bucket = {tool.angle_deg: tool for tool in of_class(ToolClass.BUCKET) if tool.size == 7.0}
    upright, left = frame_of(bucket[0.0]), frame_of(bucket[90.0])
    dark = upright == upright[upright != 255].min()
    assert np.argwhere(dark)[:, 0].max() < 42  # Open above.
    # Turned counter-clockwise it opens to -x, which the mirrored picture shows on the right.
    assert np.array_equal(left, np.rot90(upright, -1))
    belts = {tool.velocity: tool for tool in of_class(ToolClass.BELT) if tool.size == 12.0}
    assert np.array_equal(frame_of(belts[1.0]), frame_of(belts[6.0]))
    assert not np.array_equal(frame_of(belts[1.0]), frame_of(belts[-1.0]))


@pytest.mark.unit
def test_boxes_turn_with_their_body() -> None:
    straight, turned = (draw([picture(Kind.BOX, 5.0, angle)]) for angle in (0.0, math.pi / 4))
    assert rows(straight) == [4, 4, 4, 4]
    assert rows(turned)[0] < max(rows(turned))
    assert len(rows(turned)) == 6
    quarter = draw([picture(Kind.BOX, 5.0, 2.5 * math.pi)])
    assert np.array_equal(quarter, straight)
    env = CreateEnv("Obstacle", True, UNIVERSE)
    env.reset(seed=0)
    boxes = [thing for thing in env.world.objects if thing.looks[0][1].kind is Kind.BOX]
    boxes[0].body.angle = math.pi / 4
    before, after = draw(boxes[1].sprites()), draw(boxes[0].sprites())
    assert rows(before) == [4, 4, 4, 4]
    assert rows(after) != rows(before)


@pytest.mark.unit
def test_what_rolls_has_few_forms() -> None:
    """Each is computed once, though no two frames have the same angle."""
    forms._picture_form.cache_clear()
    frames = {draw([picture(Kind.BASKETBALL, 3.5, 0.01 * k)]).tobytes() for k in range(1000)}
    assert 8 < len(frames) <= forms._picture_form.cache_info().currsize <= 72


def every_kind() -> Iterator[Sprite]:
    yield from (disc(Tone.TARGET, *CENTRE), disc(Tone.TOOL, *CENTRE, 9.0))
    yield bar(*CENTRE, 0.4, 17.0, 2.0)
    yield Sprite(Kind.STAR, *CENTRE, 0.0, 4.0, Tone.GOAL, width=2.0, sides=5)
    yield Sprite(Kind.POLYGON, *CENTRE, 0.3, 7.0, Tone.BOUNCY_TOOL, sides=5)
    yield Sprite(Kind.PLANK, *CENTRE, 0.7, 18.0, Tone.PLANK)
    yield Sprite(Kind.PIVOT, *CENTRE, 0.0, 5.0, Tone.PLANK, width=2.0, sides=3)
    yield Sprite(Kind.SUBGOAL, *CENTRE, 0.0, 3.0, Tone.SUBGOAL)
    yield Sprite(Kind.CANNON, *CENTRE, 0.5, 7.3, Tone.PICTURE, width=10.0)
    yield Sprite(Kind.FAN, *CENTRE, 0.5, 6.7, Tone.PICTURE, width=10.0)
    for kind, size in (
        (Kind.TRAMPOLINE, 14.0),
        (Kind.BELT, 12.0),
        (Kind.FUNNEL, 7.0),
        (Kind.BUCKET, 7.0),
        (Kind.LADDER, 20.0),
        (Kind.BASKET_GOAL, 10.0),
        (Kind.BASKETBALL, 3.5),
        (Kind.BOX, 5.0),
    ):
        yield picture(kind, size, 0.9)


@pytest.mark.property
@pytest.mark.parametrize("sprite", list(every_kind()), ids=lambda sprite: sprite.kind.value)
def test_what_is_partly_outside_is_cut_off(sprite: Sprite) -> None:
    """Near an edge it looks as it does in the middle, without what is beyond the edge."""
    middle = np.pad(draw([sprite]), 42, constant_values=255)
    assert len(ink(middle)) > 0
    for dx, dy in ((-40, 0), (40, 0), (0, -41), (0, 41), (-40, 40), (41, -41), (30, 5)):
        moved = Sprite(
            sprite.kind,
            sprite.x + dx,
            sprite.y + dy,
            sprite.angle,
            sprite.size,
            sprite.tone,
            sprite.width,
            sprite.sides,
        )
        # dx to the right in the world is dx to the left in the picture.
        expected = middle[42 + dy : 126 + dy, 42 + dx : 126 + dx]
        assert np.array_equal(draw([moved]), expected), (dx, dy)


@pytest.mark.unit
def test_nothing_is_seen_of_what_is_far_outside() -> None:
    for x, y in ((-200.0, 42.0), (42.0, 500.0), (1e4, -1e4)):
        moving = [disc(Tone.TARGET, x, y), Sprite(Kind.PLANK, x, y, 0.3, 20.0, Tone.PLANK)]
        assert len(ink(draw([*moving, picture(Kind.BOX, 5.0, at=(x, y))]))) == 0


@pytest.mark.unit
def test_a_reached_subgoal_disappears() -> None:
    env = CreateEnv("Buckets", True, UNIVERSE)
    frame, _ = env.reset(seed=0)
    assert (frame == 235).sum() == 24
    target, place = env.world.target.body, (-0.2 + 1) * 42
    target.position = place, (-0.1 + 1) * 42 + 4.0
    seen, reward, *_ = env.step(NO_OP)
    # The picture of the action still has it: it is drawn before it is judged.
    assert reward > 1.9
    assert (seen == 235).sum() > 0
    assert (env.step(NO_OP)[0] == 235).sum() == 0


@pytest.mark.contract
@pytest.mark.parametrize("size", [48, 84])
def test_every_tool_is_visible(size: int) -> None:
    for tool in all_tools():
        if tool.tool_class != ToolClass.NO_OP:
            frame = frame_of(tool, CENTRE, size)
            assert frame.shape == (size, size)
            assert len(ink(frame)) >= 2, tool


@pytest.mark.unit
def test_smaller_pictures() -> None:
    # Length 16 * 48 / 84 = 9.1, from column 19.4 to 28.6; width 2 * 48 / 84 = 1.1.
    assert rows(draw([bar(42.0, 42.0, 0.0, 16.0, 2.0)], size=48)) == [10]
    # Radius int(4 * 48 / 84) = 2.
    assert rows(draw([disc(Tone.MARKER, *CENTRE)], size=48)) == [2, 4, 4, 2]
    assert extent(draw([disc(Tone.MARKER, 0.0, 84.0, 7.0)], size=48)) == (0, 3, 44, 47)
    config = CreateConfig(render_size=48)
    assert CreateEnv("Push", True, config).reset(seed=0)[0].shape == (48, 48)


@pytest.mark.contract
def test_same_sprites_same_bits() -> None:
    env = CreateEnv("Obstacle", False, UNIVERSE)
    env.reset(seed=3)
    for index in (1480, 1700, 2000, 200, 700):
        env.step({"index": index, "position": env.np_random.uniform(-1, 1, 2)})
    sprites = tuple(env.world.sprites())
    first = draw(sprites)
    for cached in (forms.fixed_print_of, forms._picture_form, forms._line_form):
        assert cached.cache_info().currsize > 0
        cached.cache_clear()
    assert np.array_equal(draw(sprites), first)
    first[:] = 0  # Belongs to the caller.
    assert draw(sprites).max() == 255


@pytest.mark.unit
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "grey"}, "one of"),
        ({"size": 0}, "size=0 must be 1 to 4096 pixels"),
        ({"size": 10**6}, "size=1000000 must be 1 to 4096 pixels"),
        ({"mode": "people", "size": 8}, "must be 16 to 4096 pixels"),
        ({"caption": "x"}, "for mode='people'"),
    ],
)
def test_bad_input(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw([], **arguments)
