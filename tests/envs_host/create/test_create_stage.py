"""The world against numbers measured on the release: drop tests and single figures.

The release ran on another version of the engine. Numbers printed to four decimals are met to their
rounding; a weighted see-saw amplifies rounding, so it gets more room.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pymunk
import pytest
import yaml

from envs_host.create import things
from envs_host.create.building import build_tool
from envs_host.create.config import PhysicsConfig
from envs_host.create.sprites import Kind, Sprite, Tone
from envs_host.create.stage import Stage
from envs_host.create.things import Thing
from envs_host.create.tools import ToolClass, all_tools
from envs_host.create.world import drop_test, probe_ball

GOLDEN = yaml.safe_load((Path(__file__).parent / "golden.yaml").read_text())
ROUNDING = 0.6e-4
SEESAW_TOLERANCE = 0.05


def run(stage: Stage, body: pymunk.Body, num_substeps: int) -> np.ndarray:
    """f64[n, 5] (x, y, vx, vy, angle) of a body after each substep; row k is substep k + 1."""
    states = []
    for _ in range(num_substeps):
        stage.run(1)
        states.append([*body.position, *body.velocity, body.angle])
    return np.array(states)


def drop(
    thing: Thing | None, start: tuple[float, float], num_substeps: int, **physics: object
) -> np.ndarray:
    """The probe ball's states, released at rest at `start`."""
    stage, ball = Stage(PhysicsConfig(**physics)), probe_ball(start)
    if thing is not None:
        stage.add(thing)
    stage.add(ball)
    return run(stage, ball.body, num_substeps)


def floor(elasticity: float, y: float = 30.0) -> Thing:
    return things.bar((42.0, y), 0.0, 60.0, 2.0, elasticity, 1.0, Tone.TOOL)


@pytest.mark.golden
@pytest.mark.parametrize("case", GOLDEN["drop_tests"], ids=lambda case: case["tool_id"])
def test_drop_tests_of_the_release(case: dict) -> None:
    states, first_contact = drop_test(case["tool_id"], (43.5, 62.0), 200)
    assert first_contact == case["first_contact"]
    tolerance = SEESAW_TOLERANCE if case["tool_id"] == 1652 else ROUNDING
    np.testing.assert_allclose(states[39::40], case["states"], atol=tolerance)


@pytest.mark.unit
def test_drop_test_without_contact_and_with_a_wrong_id() -> None:
    states, first_contact = drop_test(2365, (43.5, 62.0), 40)
    assert (states.shape, first_contact) == ((40, 4), None)
    with pytest.raises(ValueError, match="2366 is not in"):
        drop_test(2366, (43.5, 62.0), 40)


@pytest.mark.golden
def test_free_fall() -> None:
    states = drop(None, (42.0, 60.0), 40)
    # Position first: g dt^2 n (n - 1) / 2 = 2 / 900 * 40 * 39 / 2.
    assert states[-1, 1] == pytest.approx(60.0 - 2.0 / 900.0 * 780.0)
    assert states[-1, 1] == pytest.approx(58.2667, abs=ROUNDING)
    assert states[-1, 3] == pytest.approx(-2.6667, abs=ROUNDING)


@pytest.mark.golden
@pytest.mark.parametrize(("elasticity", "rebound"), [(0.8, 6.187), (1.0, 7.733), (1.2, 9.280)])
def test_trampolines_give_their_elasticity(elasticity: float, rebound: float) -> None:
    states = drop(things.trampoline((42.0, 30.0), 0.0, 22.0, elasticity), (42.0, 50.0), 120)
    bounce = int(np.argmax(states[:, 3] > 0.0))
    assert bounce == 116  # After 116 substeps it falls at 116 * 2 / 30, in the next it rises.
    assert states[bounce - 1, 3] == pytest.approx(-7.733, abs=6e-4)
    assert states[bounce, 3] == pytest.approx(rebound, abs=6e-4)


@pytest.mark.golden
def test_bounces_keep_or_gain_height() -> None:
    heights = drop(things.trampoline((42.0, 30.0), 0.0, 22.0, 1.0), (42.0, 50.0), 1000)[:, 1]
    peaks = [h for a, h, b in zip(heights, heights[1:], heights[2:], strict=False) if a < h >= b]
    assert len(peaks) >= 3
    assert peaks == pytest.approx([50.0] * len(peaks), abs=0.01)
    heights = drop(things.trampoline((42.0, 30.0), 0.0, 22.0, 1.2), (42.0, 50.0), 700)[:, 1]
    peaks = [h for a, h, b in zip(heights, heights[1:], heights[2:], strict=False) if a < h >= b]
    assert peaks[:2] == pytest.approx([56.6, 66.2], abs=0.06)


@pytest.mark.golden
def test_rebounds_of_a_ramp_die_out() -> None:
    states = drop(floor(0.5), (42.0, 50.0), 600)
    speeds = states[:, 3]
    rebounds = [b for a, b in itertools.pairwise(speeds) if a < 0.0 < b]
    assert rebounds[:4] == pytest.approx([3.867, 1.933, 0.933, 0.467], abs=6e-4)
    assert states[-1, 1] == pytest.approx(35.0, abs=0.12)  # Within the engine's slop of 0.1.
    assert states[-1, 3] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.golden
def test_belts_overwrite_the_velocity() -> None:
    states = drop(things.belt((42.0, 42.0), 12.0, (3.0, 0.0)), (42.0, 50.0), 300)
    carried = np.isclose(states[:, 2], 3.0) & np.isclose(states[:, 3], -2.0 / 30.0)
    assert carried.sum() > 50
    assert states[np.flatnonzero(carried)[-1], 0] - 42.0 == pytest.approx(7.5, abs=0.11)
    after = states[np.flatnonzero(carried)[-1] + 1 :]
    assert np.all(np.diff(after[:, 3]) < 0.0)  # It falls again.
    assert np.allclose(after[:, 2], 3.0)
    back = drop(things.belt((42.0, 42.0), 12.0, (-6.0, 0.0)), (42.0, 50.0), 150)
    assert back[-1, 2] == pytest.approx(-6.0)


@pytest.mark.golden
def test_cannons() -> None:
    up = drop(things.cannon((42.0, 30.0), math.pi / 2.0, 100.0), (42.0, 50.0), 374)
    for substep in (95, 373):
        assert up[substep - 1, :2] == pytest.approx((42.0, 33.65), abs=1e-6)
        assert up[substep - 1, 3] == pytest.approx(9.933, abs=6e-4)
        assert up[substep - 2, 3] < 0.0
    right = drop(things.cannon((42.0, 30.0), 0.0, 100.0), (42.0, 50.0), 95)
    assert right[93, 0] == pytest.approx(42.0)
    assert right[94, :4] == pytest.approx((47.0, 30.0, 10.0, -0.067), abs=6e-4)


@pytest.mark.golden
def test_a_heavy_box_is_shot_at_a_third_of_the_speed() -> None:
    stage = Stage(PhysicsConfig())
    box = things.dynamic_box((42.0, 50.0), 5.0, 30.0, 0.1, 1.0)
    stage.add(things.cannon((42.0, 30.0), 0.0, 120.0))
    stage.add(box)
    states = run(stage, box.body, 120)
    assert states[:, 2].max() == pytest.approx(4.0)


@pytest.mark.golden
@pytest.mark.parametrize("aim", [0.0, 1.0, math.pi])
def test_the_cannon_region_ignores_the_aim(aim: float) -> None:
    corners = things.cannon((42.0, 30.0), aim, 100.0).shape.get_vertices()
    expected = [(-5.783, 2.210), (-0.343, -6.181), (5.783, -2.210), (0.343, 6.181)]
    for corner in expected:
        assert min(math.dist(corner, found) for found in corners) < 1e-3


@pytest.mark.golden
@pytest.mark.parametrize(
    ("angle_deg", "expected"), [(0, (6.0, -2.0)), (90, (0.0, 4.0)), (45, (4.243, 2.243))]
)
def test_fans_accelerate_what_touches_them(angle_deg: float, expected: tuple) -> None:
    stage, ball = Stage(PhysicsConfig()), probe_ball((42.0, 42.0))
    stage.add(things.fan((42.0, 42.0), math.radians(angle_deg), 60.0))
    stage.add(ball)
    states = run(stage, ball.body, 10)
    acceleration = np.diff(states[:, 2:4], axis=0) * 30.0
    assert acceleration == pytest.approx(np.tile(expected, (9, 1)), abs=6e-4)
    far = drop(things.fan((42.0, 42.0), 0.0, 60.0), (42.0, 80.0), 5)
    assert far[:, 2] == pytest.approx(0.0)


@pytest.mark.golden
@pytest.mark.parametrize(("frame", "expected"), [("body", (0.0, 4.0)), ("world", (6.0, -2.0))])
def test_the_frame_of_the_force_can_be_chosen(frame: str, expected: tuple) -> None:
    stage, ball = Stage(PhysicsConfig(fan_frame=frame)), probe_ball((42.0, 42.0))
    ball.body.angle = math.pi / 2.0
    stage.add(things.fan((42.0, 42.0), 0.0, 60.0))
    stage.add(ball)
    states = run(stage, ball.body, 10)
    acceleration = np.diff(states[:, 2:4], axis=0) * 30.0
    assert acceleration == pytest.approx(np.tile(expected, (9, 1)), abs=1e-6)
    assert ball.body.angle == pytest.approx(math.pi / 2.0)  # The force acts at the centre.


@pytest.mark.golden
def test_buckets_hold_what_comes_from_above() -> None:
    states = drop(things.bucket((42.0, 30.0), 0.0, 7.0), (42.0, 50.0), 160)
    assert states[99, 1] > 34.0
    np.testing.assert_array_equal(states[100:, :2], [[42.0, 30.0]] * 60)
    assert np.diff(states[100:, 3]) == pytest.approx(-2.0 / 30.0)
    upside_down = drop(things.bucket((42.0, 30.0), math.pi, 7.0), (42.0, 50.0), 700)
    assert upside_down[-1, 1] - 30.0 == pytest.approx(8.95, abs=0.1)  # The engine's slop.


@pytest.mark.unit
def test_the_later_release_zeroes_the_velocity() -> None:
    bucket = things.bucket((42.0, 30.0), 0.0, 7.0)
    states = drop(bucket, (42.0, 50.0), 160, bucket_zeroes_velocity=True)
    np.testing.assert_array_equal(states[100:, :2], [[42.0, 30.0]] * 60)
    assert states[101:, 3] == pytest.approx(-2.0 / 30.0)


@pytest.mark.golden
def test_the_side_of_a_bucket_is_a_wall() -> None:
    stage, ball = Stage(PhysicsConfig(gravity=0.0)), probe_ball((70.0, 30.0))
    stage.add(things.bucket((42.0, 30.0), 0.0, 7.0))
    stage.add(ball)
    ball.body.velocity = -20.0, 0.0
    states = run(stage, ball.body, 60)
    assert states[-1, 2] == pytest.approx(10.0)


@pytest.mark.golden
def test_funnels_let_through_to_the_tip() -> None:
    states = drop(things.funnel((42.0, 30.0), 0.0, 7.0), (42.0, 50.0), 140)
    assert states[105, 1] > 34.0
    assert states[106, :2] == pytest.approx((42.0, 23.0))
    # The velocity was zeroed before gravity acted once.
    assert states[106, 3] == pytest.approx(-2.0 / 30.0, abs=1e-6)
    assert states[111, 1] == pytest.approx(20.75, abs=0.006)
    assert states[139, 1] < 19.0


@pytest.mark.golden
def test_a_free_plank_turns_slowly_about_its_pivot() -> None:
    stage, plank = Stage(PhysicsConfig()), things.lever((42.0, 42.0), 18.0, 1.0)
    ball = probe_ball((47.0, 62.0))
    stage.add(plank)
    stage.add(ball)
    states = run(stage, plank.body, 340)
    assert states[[139, 239, 339], 4] == pytest.approx((-0.027, -0.230, -0.537), abs=6e-4)
    assert np.abs(states[:, :2] - 42.0).max() < 0.01


@pytest.mark.golden
def test_limited_seesaws_overshoot_a_little() -> None:
    stage = Stage(PhysicsConfig())
    plank = things.limited_seesaw((42.0, 42.0), 18.0, math.radians(20.0), 1.0)
    stage.add(plank)
    stage.add(probe_ball((50.0, 57.0)))
    angles = np.degrees(run(stage, plank.body, 600)[:, 4])
    assert np.abs(angles).max() == pytest.approx(24.4, abs=0.06)


@pytest.mark.golden
def test_the_overshoot_stays_below_8_degrees() -> None:
    seesaws = [t for t in all_tools() if t.tool_class == ToolClass.LIMITED_SEESAW]
    for tool in seesaws[::7]:
        stage, plank = Stage(PhysicsConfig()), build_tool(tool, (42.0, 42.0))
        stage.add(plank)
        stage.add(probe_ball((42.0 + 0.4 * tool.size, 66.0)))
        angles = np.degrees(run(stage, plank.body, 300)[:, 4])
        assert np.abs(angles).max() < tool.max_angle_deg + 8.0


@pytest.mark.golden
@pytest.mark.parametrize(("side", "sign"), [("right", 1.0), ("left", -1.0)])
def test_weighted_seesaws_rest_with_the_weight_down(side: str, sign: float) -> None:
    stage = Stage(PhysicsConfig())
    plank = things.weighted_seesaw((42.0, 42.0), 16.0, math.radians(35.0), side, 6.0)
    stage.add(plank)
    states = run(stage, plank.body, 300)
    assert np.degrees(np.abs(states[:, 4])).max() < 0.6
    weight = next(s for s in plank.sprites() if s.kind == Kind.DISC)
    assert (weight.x - 42.0) * sign > 4.0
    assert weight.y < 42.0 - 2.0


@pytest.mark.unit
def test_the_weight_stays_where_it_is_on_the_plank() -> None:
    stage = Stage(PhysicsConfig())
    plank = things.weighted_seesaw((42.0, 42.0), 16.0, math.radians(35.0), "right", 2.0)
    weight = next(part for part in plank.others if getattr(part, "mass", 0.0) == 2.0)
    start = plank.body.world_to_local(weight.position)
    stage.add(plank)
    stage.add(probe_ball((36.0, 55.0)))  # Onto the raised end.
    angles = run(stage, plank.body, 200)[:, 4]
    assert angles.max() > 0.2
    assert weight.angle == pytest.approx(plank.body.angle, abs=0.01)
    assert math.dist(plank.body.world_to_local(weight.position), start) < 0.1


@pytest.mark.golden
def test_planks_damp_balls() -> None:
    stage = Stage(PhysicsConfig(gravity=0.0))
    ball = probe_ball((42.0, 45.9))  # Overlaps the plank, so it touches from the first substep.
    stage.add(things.lever((42.0, 42.0), 30.0, 1.1))
    stage.add(ball)
    ball.body.velocity = 3.0, 0.0
    ball.body.angular_velocity = 1.0
    states = run(stage, ball.body, 3)
    assert states[:, 2] == pytest.approx([3.0 * 0.9**n for n in (1, 2, 3)])
    assert ball.body.angular_velocity == pytest.approx(0.9**3)


@pytest.mark.unit
def test_planks_do_not_damp_boxes() -> None:
    stage = Stage(PhysicsConfig(gravity=0.0))
    box = things.dynamic_box((42.0, 44.45), 5.0, 30.0, 0.1, 1.0)
    stage.add(things.lever((42.0, 42.0), 30.0, 1.1))
    stage.add(box)
    box.body.velocity = 3.0, 0.0
    assert run(stage, box.body, 3)[:, 2] == pytest.approx(3.0)


@pytest.mark.unit
@pytest.mark.parametrize(
    "region",
    [
        things.cannon((42.0, 42.0), 0.0, 100.0),
        things.fan((42.0, 42.0), 0.0, 100.0),
        things.belt((42.0, 42.0), 20.0, (5.0, 0.0)),
        things.bucket((42.0, 42.0), 0.0, 7.0),
    ],
    ids=["cannon", "fan", "belt", "bucket"],
)
def test_planks_are_no_moving_objects(region: Thing) -> None:
    stage, plank = Stage(PhysicsConfig()), things.lever((42.0, 42.5), 6.0, 1.0)
    stage.add(region)
    stage.add(plank)
    states = run(stage, plank.body, 20)
    assert np.abs(states[:, 0] - 42.0).max() < 0.5
    assert not stage.ledger.caught


@pytest.mark.unit
def test_a_caught_ball_goes_to_the_next_bucket_that_it_touches() -> None:
    """The mark is the object's, is never cleared, and knows no bucket."""
    stage, ball = Stage(PhysicsConfig()), probe_ball((42.0, 40.0))
    stage.add(things.bucket((42.0, 30.0), 0.0, 7.0))
    stage.add(things.bucket((70.0, 30.0), 0.0, 7.0))
    stage.add(ball)
    stage.run(80)
    assert tuple(ball.body.position) == (42.0, 30.0)
    ball.body.position = 70.0, 22.0  # Below the other one, from where nothing is caught.
    stage.run(1)
    assert tuple(ball.body.position) == (70.0, 30.0)


@pytest.mark.unit
def test_surfaces_of_solid_tools() -> None:
    surfaces = {}
    for tool in all_tools():
        if tool.elasticity is not None:
            shape = build_tool(tool, (42.0, 42.0)).shape
            surfaces.setdefault(tool.tool_class, set()).add(shape.friction)
            assert shape.elasticity == tool.elasticity
            assert not shape.sensor
    no_friction = {tool_class for tool_class, found in surfaces.items() if found == {0.0}}
    assert no_friction == {ToolClass.BALL, ToolClass.BOUNCY_BALL}
    assert all(found in ({0.0}, {1.0}) for found in surfaces.values())


@pytest.mark.unit
@pytest.mark.parametrize(("thickness", "radius"), [(1.0, 0.0), (2.0, 1.0), (2.5, 1.0), (4.0, 2.0)])
def test_bars_have_half_their_thickness_rounded_down(thickness: float, radius: float) -> None:
    assert things.bar((0, 0), 0.0, 8.0, thickness, 0.5, 1.0, Tone.TOOL).shape.radius == radius


@pytest.mark.golden
def test_masses_and_moments() -> None:
    ball = probe_ball((42.0, 42.0))
    assert (ball.body.mass, ball.body.moment) == (10.0, 80.0)
    heavy = things.ball((0.0, 0.0), 4.0, 30.0, Tone.BLACK)
    assert heavy.body.moment == 240.0
    box = things.dynamic_box((0.0, 0.0), 5.0, 30.0, 0.1, 1.0)
    assert box.body.moment == pytest.approx(30.0 * (25.0 + 25.0) / 12.0)
    plank = things.lever((0.0, 0.0), 18.0, 1.0)
    assert (plank.body.mass, plank.body.moment) == (10.0, 10000.0)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("tool_class", "kind", "tone"),
    [
        ("ramp", Kind.BAR, Tone.TOOL),
        ("trampoline", Kind.TRAMPOLINE, Tone.PICTURE),
        ("ball", Kind.DISC, Tone.TOOL),
        ("bouncy ball", Kind.DISC, Tone.BOUNCY_TOOL),
        ("box", Kind.POLYGON, Tone.TOOL),
        ("bouncy box", Kind.POLYGON, Tone.BOUNCY_TOOL),
        ("triangle", Kind.POLYGON, Tone.TOOL),
        ("bouncy hexagon", Kind.POLYGON, Tone.BOUNCY_TOOL),
        ("lever", Kind.PLANK, Tone.PLANK),
        ("limited see-saw", Kind.PLANK, Tone.PLANK),
        ("weighted see-saw", Kind.PLANK, Tone.PLANK),
        ("cannon", Kind.CANNON, Tone.PICTURE),
        ("fan", Kind.FAN, Tone.PICTURE),
        ("belt", Kind.BELT, Tone.PICTURE),
        ("funnel", Kind.FUNNEL, Tone.PICTURE),
        ("bucket", Kind.BUCKET, Tone.PICTURE),
    ],
)
def test_how_tools_look(tool_class: str, kind: Kind, tone: Tone) -> None:
    tool = next(tool for tool in all_tools() if tool.tool_class == tool_class)
    sprites = list(build_tool(tool, (30.0, 40.0)).sprites())
    assert (sprites[0].kind, sprites[0].tone) == (kind, tone)
    assert (sprites[0].x, sprites[0].y) == (30.0, 40.0)
    if kind == Kind.PLANK:
        expected = Sprite(Kind.PIVOT, 30.0, 40.0, 0.0, 5.0, Tone.PLANK, width=2.0, sides=3)
        assert sprites[1] == expected
    assert len(sprites) == {"lever": 2, "limited see-saw": 2, "weighted see-saw": 3}.get(
        tool_class, 1
    )


@pytest.mark.unit
def test_belts_look_where_they_run() -> None:
    for velocity, angle in ((3.0, 0.0), (-3.0, math.pi)):
        sprite = next(things.belt((42.0, 42.0), 12.0, (velocity, 0.0)).sprites())
        assert (sprite.angle, sprite.size) == (angle, 12.0)


@pytest.mark.unit
def test_sprites_lie_where_the_shapes_are() -> None:
    """The corners of a polygon sprite are the vertices of its shape, boxes included."""
    for tool in all_tools():
        if tool.tool_class.value in ("box", "bouncy triangle", "square", "pentagon", "hexagon"):
            thing = build_tool(tool, (42.0, 42.0))
            sprite = next(thing.sprites())
            corners = [
                (sprite.size * math.cos(a), sprite.size * math.sin(a))
                for k in range(sprite.sides)
                for a in [sprite.angle + 2.0 * math.pi * k / sprite.sides]
            ]
            found = thing.shape.get_vertices()
            assert all(min(math.dist(c, v) for v in found) < 1e-9 for c in corners)


@pytest.mark.unit
def test_moving_sprites_follow_their_bodies() -> None:
    stage, plank = Stage(PhysicsConfig()), things.lever((42.0, 42.0), 18.0, 1.0)
    ball = probe_ball((47.0, 50.0))
    stage.add(plank)
    stage.add(ball)
    stage.run(150)
    drawn = next(ball.sprites())
    assert (drawn.x, drawn.y) == tuple(ball.body.position) != (47.0, 50.0)
    assert next(plank.sprites()).angle == plank.body.angle != 0.0
