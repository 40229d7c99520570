"""Pictures and films for people: mirrored, with colours, traces, text and tint."""

from __future__ import annotations

import math

import numpy as np
import pytest

from envs_host.create import CreateConfig, CreateEnv
from envs_host.create.building import build_tool
from envs_host.create.colors import COLOR_OF_TONE
from envs_host.create.drawing import draw
from envs_host.create.films import episode_frames
from envs_host.create.illustration import RenderOptions, Trace, illustrate
from envs_host.create.levels.registry import BUILT_IN_NAMES
from envs_host.create.pen import Pen
from envs_host.create.sprites import Kind, Sprite, Tone
from envs_host.create.tools import ToolClass, all_tools

BLIND = CreateConfig(observation="none", action_ids="universe")
NO_OP = {"index": 2365, "position": (0.0, 0.0)}
# Scores in Push without noise with its ninth action.
SCRIPT = [{"index": 1755, "position": (0.6, -0.05)}, *[NO_OP] * 11]
SMALL = RenderOptions(size=64)


def disc(tone: Tone, x: float, y: float, radius: float = 4.0) -> Sprite:
    return Sprite(Kind.DISC, x, y, 0.0, radius, tone)


def env(level: str = "Push", **options: object) -> CreateEnv:
    return CreateEnv(
        level, True, BLIND, render_mode="rgb_array", render_options=RenderOptions(64, **options)
    )


@pytest.mark.unit
def test_colours_are_nominal_and_the_picture_is_mirrored() -> None:
    picture = illustrate([disc(Tone.TARGET, 10.5, 73.5, 5.0)], 168)
    assert picture.shape == (168, 168, 3)
    assert picture.dtype == np.uint8
    # World (10.5, 73.5) is 10.5 units below the top and from the right, 2 pixels per unit; beside
    # the cross in the middle.
    assert tuple(picture[21 - 4, 147 - 4]) == COLOR_OF_TONE[Tone.TARGET] == (0xF4, 0x5B, 0x69)
    inked = np.argwhere((picture != 255).any(axis=-1))
    assert inked.mean(axis=0) == pytest.approx([20.5, 146.5], abs=0.1)
    # Smooth: some pixels are partly covered; the area is that of the disc (4 pixels per unit).
    darkness = 1.0 - picture.min(axis=-1) / 255.0
    assert len(inked) == pytest.approx(4 * math.pi * 25, rel=0.08)
    assert 0.0 < darkness[darkness > 0].min() < 0.3


@pytest.mark.unit
def test_angles_turn_counter_clockwise_in_the_world() -> None:
    bar = Sprite(Kind.BAR, 42.0, 42.0, math.radians(45), 40.0, Tone.SCENERY, width=2.0)
    inked = np.argwhere((illustrate([bar], 168) != 255).any(axis=-1))
    # Up to the right in the world is up to the left in the picture.
    assert np.corrcoef(inked.T)[0, 1] > 0.95
    pen = Pen(84, (255, 255, 255))
    pen.move((42.0, 42.0), math.pi / 2)
    pen.disc(3.0, (0, 0, 0), centre=(10.0, 0.0))
    dark = np.argwhere(np.asarray(pen.finished())[..., 0] < 128)
    assert dark.mean(axis=0) == pytest.approx([31.5, 41.5], abs=0.2)


@pytest.mark.unit
def test_later_sprites_cover_earlier_ones() -> None:
    sprites = [disc(Tone.TARGET, 42.0, 42.0), disc(Tone.TOOL, 42.0, 42.0)]
    assert tuple(illustrate(sprites, 84)[41, 41]) == COLOR_OF_TONE[Tone.TOOL]


@pytest.mark.contract
def test_people_see_every_kind_of_tool() -> None:
    for tool_class in ToolClass:
        if tool_class == ToolClass.NO_OP:
            continue
        tool = next(tool for tool in all_tools() if tool.tool_class == tool_class)
        thing = build_tool(tool, (42.0, 42.0))
        picture = draw(list(thing.sprites()), "people", 168)
        inked = np.argwhere((picture != 255).any(axis=-1))
        assert len(inked) > 30, tool_class
        # It stands where the tool is: all of it within its length or 12 units.
        reach = 2 * max(12.0, tool.size or 0.0)
        assert abs(inked - 83.5).max() < reach, tool_class


@pytest.mark.contract
@pytest.mark.parametrize("level", BUILT_IN_NAMES)
def test_every_level_can_be_rendered(level: str) -> None:
    shown = env(level)
    shown.reset(seed=0)
    picture = shown.render()
    assert picture.shape == (64, 64, 3)
    assert np.array_equal(shown.render(), picture)
    assert (picture != 255).any(axis=-1).mean() > 0.01


@pytest.mark.unit
def test_size_of_a_picture() -> None:
    shown = CreateEnv("Push", True, BLIND, render_mode="rgb_array")
    shown.reset(seed=0)
    assert shown.render().shape == (1024, 1024, 3)
    assert draw([], "people").shape == (1024, 1024, 3)
    assert CreateEnv("Push", True, BLIND).render() is None
    with pytest.raises(ValueError, match="must be 16 to 4096 pixels"):
        illustrate([], 15)


@pytest.mark.unit
def test_tint_after_success() -> None:
    for with_tint, ground in ((True, [200, 255, 255]), (False, [255, 255, 255])):
        shown = env(with_text=False, with_tint=with_tint)
        shown.reset(seed=0)
        grounds = []
        for action in SCRIPT[:9]:
            assert shown.render()[32, 60].tolist() == [255, 255, 255]
            goal_hit = shown.step(action)[4]["goal_hit"]
            grounds.append((goal_hit, shown.render()[32, 60].tolist()))
        assert grounds[-2:] == [(0, [255, 255, 255]), (1, ground)]


@pytest.mark.unit
def test_traces_show_where_target_and_marker_were() -> None:
    shown = env(with_text=False)
    shown.reset(seed=0)
    start = shown.render()
    # The marker's start, (0.6, 0.75), mirrored: a point that it leaves.
    row, column = round(0.125 * 64), round(0.2 * 64)
    for action in SCRIPT[:5]:
        shown.step(action)
    with_traces = shown.render()
    assert (start[row, column] != 255).any()
    assert (with_traces[row, column] != 255).any()
    shown._render_options = RenderOptions(64, with_text=False, with_traces=False)
    assert (shown.render()[row, column] == 255).all()
    shown._render_options = RenderOptions(64, with_text=False)
    shown.reset(seed=0)
    assert np.array_equal(shown.render(), start)


@pytest.mark.unit
def test_traces_are_below_the_sprites() -> None:
    trace = Trace([(20.0, 42.0), (64.0, 42.0)], Tone.TARGET)
    picture = illustrate([disc(Tone.TOOL, 42.0, 42.0)], 84, traces=[trace])
    assert tuple(picture[41, 41]) == COLOR_OF_TONE[Tone.TOOL]
    assert (picture[41:43, 25] != 255).any()
    assert (picture[41:43, 10] == 255).all()
    assert (illustrate([], 84, traces=[Trace([], Tone.MARKER)]) == 255).all()


@pytest.mark.unit
def test_text_in_the_top_corners() -> None:
    picture = illustrate([], 400, caption="action 3", note="return 1.04")
    inked = np.argwhere((picture < 128).all(axis=-1))
    assert inked[:, 0].max() < 40
    assert {bool(column < 200) for column in inked[:, 1]} == {True, False}
    assert not ((inked[:, 1] > 160) & (inked[:, 1] < 240)).any()
    shown = CreateEnv(
        "Push", True, BLIND, render_mode="rgb_array", render_options=RenderOptions(256)
    )
    shown.reset(seed=0)
    before = shown.render()
    shown.step(NO_OP)
    after = shown.render()
    # "action 0" becomes "action 1", "return 0.00" becomes "return 0.01"; the marker is below.
    for columns in (slice(0, 128), slice(128, 256)):
        assert (before[:18, columns] != after[:18, columns]).any()


@pytest.mark.contract
def test_rendering_changes_nothing_in_the_world() -> None:
    silent, shown = CreateEnv("Seesaw", True, BLIND), env("Seesaw")
    for each in (silent, shown):
        each.reset(seed=5)
    for index, x in ((1700, -0.2), (250, 0.5), (1900, 0.8), (2365, 0.0)):
        action = {"index": index, "position": (x, 0.3)}
        outcomes = [each.step(action)[1:4] for each in (silent, shown)]
        shown.render()
        assert outcomes[0] == outcomes[1]
        assert silent.world.positions == shown.world.positions


@pytest.mark.integration
def test_film_of_an_episode() -> None:
    played = env()
    frames = list(episode_frames(played, 0, SCRIPT, SMALL))
    assert len(frames) == 1 + 10 * len(SCRIPT) + 1
    assert {frame.shape for frame in frames} == {(64, 64, 3)}
    assert played.episode.summary.reward == pytest.approx(11.02)
    assert played.watch is None
    # Smooth: the marker falls a little from frame to frame. Its lowest row:
    rows = [np.argwhere((frame[:28, 12] != 255).any(axis=-1)).max() for frame in frames[:15]]
    assert rows == sorted(rows)
    assert len(set(rows)) > 2
    tinted = [tuple(frame[50, 32]) == (200, 255, 255) for frame in frames]
    assert tinted == [False] * 91 + [True] * 31
    again = list(episode_frames(played, 0, SCRIPT, SMALL))
    assert all(np.array_equal(a, b) for a, b in zip(frames, again, strict=True))
    with pytest.raises(RuntimeError, match="over"):
        list(episode_frames(played, 0, [*SCRIPT, NO_OP], SMALL))
    assert played.watch is None


@pytest.mark.unit
def test_a_film_begins_where_its_seed_says() -> None:
    noisy = CreateEnv("Push", False, BLIND)
    first, again, other = (next(iter(episode_frames(noisy, seed, [], SMALL))) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.unit
def test_a_film_is_large_enough_to_look_at() -> None:
    first = next(iter(episode_frames(env(), 0, SCRIPT)))
    assert first.shape == (512, 512, 3)
