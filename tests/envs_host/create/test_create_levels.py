"""Level files: the built-in ones, custom ones, and what is said about wrong ones."""

from __future__ import annotations

import copy
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from envs_host.create.building import build_object
from envs_host.create.config import PhysicsConfig
from envs_host.create.environment import CreateEnv
from envs_host.create.layout import Layout, draw_layout
from envs_host.create.levels import (
    TASK_NAMES,
    LevelError,
    level_names,
    load_level,
    parse_level,
    register_folder,
    register_level,
)
from envs_host.create.levels.object_types import ALL_TYPES, BASIC_TYPES
from envs_host.create.world import World

SMALL = {
    "schema": 1,
    "name": "Small",
    "kind": "plain",
    "target": {"pos": [0.0, 0.5]},
    "goal": {"kind": "star", "pos": [0.0, -0.5]},
}
# Values for the parameters that have no default.
GIVEN = {
    "polygon": {"sides": 5, "circumradius": 4},
    "disc": {"radius": 3},
    "lever": {"length": 18},
    "limited_see_saw": {"length": 18, "max_angle_deg": 20},
    "see_saw": {"length": 18, "max_angle_deg": 20, "weight_side": "left", "weight_mass": 2},
    "cannon": {"angle_deg": 90, "impulse": 100},
    "fan": {"angle_deg": 0, "force": 60},
    "funnel": {"circumradius": 7},
    "bucket": {"circumradius": 7},
}


def read(**changes: object) -> object:
    return parse_level(json.dumps({**copy.deepcopy(SMALL), **changes}), "small.json")


@pytest.mark.golden
def test_built_in_levels_have_their_figures() -> None:
    assert set(TASK_NAMES) | {"GoalTest"} <= set(level_names())
    markers = {name for name in TASK_NAMES if load_level(name).has_marker}
    assert markers == {"Push", "Navigate", "Ladder", "Cannon", "Obstacle"}
    assert {n for n in TASK_NAMES if load_level(n).frame_walls} == {"Obstacle", "Seesaw", "Collide"}
    limits = {name: load_level(name).step_limit for name in TASK_NAMES}
    others = {name: limit for name, limit in limits.items() if limit != 30}
    assert others == {"Obstacle": 50, "Belt": 50, "Basket": 40}
    radii = {name: load_level(name).target.radius for name in TASK_NAMES}
    assert {n: r for n, r in radii.items() if r != 4} == {"Belt": 3, "Buckets": 3, "Basket": 3.5}
    must_hit = {name for name in TASK_NAMES if load_level(name).marker_must_hit_target}
    assert must_hit == {"Cannon", "Obstacle"}


@pytest.mark.unit
def test_defaults_fill_what_a_small_level_leaves_out() -> None:
    level = read()
    assert (level.step_limit, level.frame_walls, level.objects, level.noise) == (30, False, (), ())
    assert (level.target.radius, level.target.mass, level.goal.size) == (4.0, 10.0, 4.0)


@pytest.mark.unit
@pytest.mark.parametrize("type_name", ALL_TYPES)
def test_every_object_type_can_be_placed_and_drawn(type_name: str) -> None:
    record = {"key": "it", "type": type_name, "pos": [0.1, 0.2], **GIVEN.get(type_name, {})}
    kind = "marker" if type_name == "marker_ball" else "plain"
    spec = read(objects=[record], kind=kind).objects[0]
    assert spec.type in BASIC_TYPES
    thing = build_object(spec, (46.2, 50.4))
    assert tuple(thing.body.position) == (46.2, 50.4)
    assert len(list(thing.sprites())) >= 1


@pytest.mark.golden
@pytest.mark.parametrize(
    ("type_name", "expected"),
    [
        ("long_floor", {"length": 24, "angle_deg": 0, "elasticity": 0.5}),
        ("medium_floor", {"length": 16}),
        ("short_floor", {"length": 8}),
        ("very_short_floor", {"length": 4}),
        ("floor", {"length": 16, "angle_deg": 0, "thickness": 2, "friction": 1}),
        ("wall", {"length": 16, "angle_deg": 90}),
        ("elastic_wall", {"length": 16, "angle_deg": 90, "elasticity": 0.8}),
        ("ramp_30", {"length": 16, "angle_deg": 30, "elasticity": 0.5}),
        ("ramp_60_reversed", {"angle_deg": -60, "elasticity": 0.5}),
        ("bump_45", {"length": 16, "angle_deg": 45, "elasticity": 0.8}),
        ("trampoline", {"length": 16, "elasticity": 1.2, "angle_deg": 0}),
        ("trampoline_45", {"elasticity": 1.2, "angle_deg": 45}),
        ("trampoline_45_reversed", {"angle_deg": -45}),
        ("trampoline_vertical", {"angle_deg": 90}),
        ("box", {"size": 5, "mass": 10}),
        ("belt", {"velocity": (5, 0), "length": 20}),
        ("right_belt", {"velocity": (-4, 0), "length": 20}),
        ("ladder", {"length": 20, "angle_deg": 95}),
        ("fast_ladder", {"length": 15, "angle_deg": 95}),
    ],
)
def test_defaults_of_the_object_types(type_name: str, expected: dict) -> None:
    spec = read(objects=[{"key": "it", "type": type_name, "pos": [0, 0]}]).objects[0]
    assert {name: spec.parameters[name] for name in expected} == expected


@pytest.mark.golden
def test_ladders_carry_up_and_left_or_down_and_right() -> None:
    def velocity(type_name: str) -> tuple[float, float]:
        spec = read(objects=[{"key": "it", "type": type_name, "pos": [0, 0]}]).objects[0]
        return spec.pair("velocity")

    # (4 v cos 95 deg, v sin 95 deg) with v = 4.
    assert velocity("ladder") == pytest.approx((-1.394492, 3.984779), abs=1e-6)
    assert velocity("fast_ladder") == velocity("ladder")
    assert velocity("down_ladder") == pytest.approx((1.394492, -3.984779), abs=1e-6)


OBJECT = {"key": "it", "type": "bar", "pos": [0, 0]}


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, r"small.json: schema is 2; it must be one of \(1,\)"),
        ({"kind": "odd"}, r"kind is 'odd'; it must be one of \('marker', 'plain'\)"),
        ({"name": "a b"}, "name is 'a b'; it must be letters and digits"),
        ({"step_limit": 0}, "step_limit is 0; it must be a whole number from 1 to 10000"),
        ({"step_limit": True}, "step_limit is True"),
        ({"frame_walls": 1}, "frame_walls is 1; it must be true or false"),
        ({"target": {}}, "target.pos is missing"),
        ({"target": {"pos": [0]}}, r"target.pos is \[0\]; it must be two numbers"),
        ({"target": {"pos": [0, "up"]}}, r"target.pos\[1\] is 'up'; it must be a number"),
        ({"target": {"pos": [0, 0], "radius": 0}}, "target.radius is 0; .* number from 1 to 168"),
        ({"target": {"pos": [0, 0], "size": 3}}, "target.size is not a field; allowed here"),
        ({"goal": {"kind": "hole", "pos": [0, 0]}}, "goal.kind is 'hole'"),
        ({"goal": {"kind": "star", "pos": [0, 0], "mass": 1}}, "goal.mass is not a field"),
        ({"speed": 3}, "speed is not a field; allowed here"),
        ({"reward_overrides": {"alive": 1}}, "reward_overrides.alive is not a field"),
        ({"objects": {}}, "objects is {}; it must be a list"),
        ({"objects": [3]}, r"objects\[0\] is 3; it must be an object"),
        ({"objects": [{**OBJECT, "type": "puncher"}]}, r"objects\[0\].type is 'puncher'"),
        ({"objects": [{**OBJECT, "length": -1}]}, r"objects\[0\].length is -1; .* from 1 to 168"),
        ({"objects": [{**OBJECT, "length": "2 * 8"}]}, r"objects\[0\].length is '2 \* 8'"),
        ({"objects": [{**OBJECT, "tone": "pink"}]}, r"objects\[0\].tone is 'pink'; .* one of"),
        ({"objects": [{**OBJECT, "velocity": [1, 0]}]}, r"objects\[0\].velocity is not a field"),
        ({"objects": [{**OBJECT, "type": "cannon"}]}, r"objects\[0\].angle_deg is missing"),
        ({"objects": [OBJECT, OBJECT]}, r"objects\[1\].key is 'it'; it must be a key that is used"),
        ({"objects": [{**OBJECT, "key": "goal"}]}, r"objects\[0\].key is 'goal'"),
        (
            {"objects": [{**OBJECT, "type": "polygon", "sides": 4.5, "circumradius": 3}]},
            "sides is 4.5; it must be a whole number",
        ),
        ({"kind": "marker"}, r"objects is \[\]; it must be 1 marker_ball in a marker level"),
        ({"marker_must_hit_target": True}, "kind is 'plain'; it must be marker"),
        ({"subgoals": {"for_marker": [[0, 0]]}}, "kind is 'plain'; it must be marker"),
        ({"subgoals": {"for_goal": []}}, "subgoals.for_goal is not a field"),
        ({"noise": [{"members": ["goal"], "dx": [1, 0], "dy": [0, 0]}]}, r"noise\[0\].dx"),
        ({"noise": [{"members": [], "dx": [0, 0], "dy": [0, 0]}]}, r"noise\[0\].members"),
        ({"noise": [{"members": ["floor"], "dx": [0, 0], "dy": [0, 0]}]}, "'floor'; .*among"),
        ({"noise": [{"members": ["goal"], "choice": []}]}, r"noise\[0\].choice"),
        ({"noise": [{"members": ["goal", "goal"], "choice": [[0, 0]]}]}, "one group only"),
    ],
)
def test_errors_name_file_field_and_what_is_allowed(changes: dict, message: str) -> None:
    with pytest.raises(LevelError, match=message) as caught:
        read(**changes)
    assert str(caught.value).startswith("small.json: ")


def numbers(level: object, path: str = "") -> dict[str, float]:
    """Every number of a parsed file by its place."""
    if isinstance(level, dict | list):
        items = level.items() if isinstance(level, dict) else enumerate(level)
        return {k: v for key, item in items for k, v in numbers(item, f"{path}/{key}").items()}
    return {path: level} if isinstance(level, int | float) and not isinstance(level, bool) else {}


# Every field that can hold a number: each type of objects, each kind of goal, both of noise.
EVERYTHING = [
    {
        "kind": "marker",
        "step_limit": 30,
        "target": {"pos": [0, 0.5], "radius": 4, "mass": 10, "elasticity": 1, "friction": 1},
        "goal": goal,
        "reward_overrides": {"goal": 1, "subgoal": 1, "target_hit": 1},
        "subgoals": {"for_target": [[0, 0]], "for_marker": [[0, 0]]},
        "noise": [
            {"members": ["goal"], "dx": [0, 0], "dy": [0, 0]},
            {"members": ["target"], "choice": [[0, 0]]},
        ],
        "objects": [
            {
                **{name: p.default for name, p in BASIC_TYPES[type_name].items()},
                **GIVEN.get(type_name, {}),
                "key": f"o{i}",
                "type": type_name,
                "pos": [0, 0],
            }
            for i, type_name in enumerate(BASIC_TYPES)
        ],
    }
    for goal in (
        {"kind": "ball", "pos": [0, 0], "radius": 4, "mass": 1, "elasticity": 1, "friction": 1},
        {"kind": "star", "pos": [0, 0], "circumradius": 4},
        {"kind": "basket", "pos": [0, 0], "sensor_square": 4},
    )
]


@pytest.mark.unit
@pytest.mark.parametrize(
    "value", [math.nan, math.inf, 1e300, -1e300, 10**400], ids=["NaN", "inf", "big", "low", "whole"]
)
def test_no_number_is_too_large_for_its_field(value: float) -> None:
    for level in EVERYTHING:
        found = numbers(level)
        assert len(found) > 80
        read(**level)
        for path in found:
            *parents, last = path.strip("/").split("/")
            changed = at = copy.deepcopy(level)
            for part in parents:
                at = at[int(part) if isinstance(at, list) else part]
            at[int(last) if isinstance(at, list) else last] = value
            with pytest.raises(LevelError, match=(*parents, last)[0]) as caught:
                read(**changed)
            assert re.search(r"must be .*(from|\[low, high\])", str(caught.value)), path


@pytest.mark.property
@pytest.mark.parametrize("end", ["low", "high"])
def test_what_is_allowed_can_be_simulated_and_drawn(end: str) -> None:
    """Every object with every number at an end of its range, in the way of ball and marker."""
    objects = []
    for i, (type_name, parameters) in enumerate(BASIC_TYPES.items()):
        values = {
            name: getattr(p, end) if p.kind == "number" else [getattr(p, end)] * 2
            for name, p in parameters.items()
            if p.kind != "choice"
        }
        side = {"weight_side": "left"} if type_name == "see_saw" else {}
        pos = [0.5 * (i % 4) - 0.7, 0.5 * (i // 4) - 0.7]
        objects.append({"key": f"o{i}", "type": type_name, "pos": pos, **side, **values})
    env = CreateEnv(read(kind="marker", objects=objects))
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(3):
            observation, reward, terminated, *_ = env.step({"index": 0, "position": [0, 0]})
            assert math.isfinite(reward)
            assert observation.min() < 255
            if terminated:
                break


@pytest.mark.unit
def test_lists_have_an_end() -> None:
    with pytest.raises(LevelError, match=r"for_target has 1,001 entries; .* 1,000 at most"):
        read(subgoals={"for_target": [[0, 0]] * 1001})


@pytest.mark.unit
def test_what_is_no_json_or_no_level_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LevelError, match="the text is not JSON"):
        parse_level("{")
    with pytest.raises(LevelError, match="Did you mean 'Funnel'"):
        load_level("Funel")
    with pytest.raises(LevelError, match="is no file"):
        load_level(tmp_path / "absent.json")
    (tmp_path / "latin.json").write_bytes(b'{"name": "\xfc"}')
    with pytest.raises(LevelError, match=r"latin\.json is no UTF-8 text .*; save it as UTF-8"):
        load_level(tmp_path / "latin.json")
    with pytest.raises(LevelError, match="the text is not JSON: maximum recursion depth"):
        parse_level("[" * 100_000)


@pytest.mark.unit
def test_folders_and_texts_can_be_registered(tmp_path: Path) -> None:
    names = ("AlphaOfTest", "BetaOfTest")
    for name in names:
        (tmp_path / f"{name}.json").write_text(json.dumps({**SMALL, "name": name}))
    assert register_folder(tmp_path) == names
    assert set(names) <= set(level_names())
    assert load_level("BetaOfTest").name == "BetaOfTest"
    assert load_level(tmp_path / "AlphaOfTest.json") == load_level("AlphaOfTest")
    assert register_folder(tmp_path) == names  # The same levels again are no clash.
    with pytest.raises(LevelError, match="must not be one of those taken"):
        register_level(json.dumps({**SMALL, "name": "AlphaOfTest", "step_limit": 7}))
    with pytest.raises(LevelError, match="must not be one of those taken"):
        register_level(json.dumps({**SMALL, "name": "Push"}))
    with pytest.raises(LevelError, match="holds no level file"):
        register_folder(tmp_path / "nothing")


@pytest.mark.unit
def test_a_folder_with_a_wrong_file_registers_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({**SMALL, "name": "GoodOfTest"}))
    (tmp_path / "b.json").write_text(json.dumps({**SMALL, "name": "Bad Name"}))
    with pytest.raises(LevelError, match=r"b.json: name"):
        register_folder(tmp_path)
    assert "GoodOfTest" not in level_names()
    (tmp_path / "b.json").write_text(json.dumps({**SMALL, "name": "GoodOfTest"}))
    with pytest.raises(LevelError, match="another file has"):
        register_folder(tmp_path)
    assert "GoodOfTest" not in level_names()
    (tmp_path / "b.json").write_text(json.dumps({**SMALL, "name": "Push"}))
    with pytest.raises(LevelError, match="must not be one of those taken"):
        register_folder(tmp_path)
    assert "GoodOfTest" not in level_names()


@pytest.mark.unit
def test_members_of_a_group_move_together_and_others_stay() -> None:
    level = load_level("Push")
    layout = draw_layout(level, np.random.default_rng(0))
    assert layout.offsets["target"] == layout.offsets["medium_floor_0"]
    assert layout.offsets["goal"] == layout.offsets["medium_floor_1"]
    assert len(set(layout.offsets.values())) == 3
    world = World(layout, PhysicsConfig(), frame_walls=False, min_tool_distance=0.3)
    dx, dy = layout.offsets["target"]
    assert world.positions.target == pytest.approx((46.2 + 42 * dx, 36.12 + 42 * dy))
    still = World(Layout(level), PhysicsConfig(), frame_walls=False, min_tool_distance=0.3)
    assert still.positions.target == pytest.approx((46.2, 36.12))


# Half-widths of the noise, (x, y), of each level's members that move.
NOISE = {
    "Push": {"marker": (0.2, 0.2), "target": (0.2, 0.2), "goal": (0.2, 0.2)},
    "Navigate": {"target": (0.1, 0.1), "goal": (0.2, 0.2)},
    "Ladder": {"target": (0.1, 0.1), "goal": (0.2, 0.2)},
    "Cannon": {"marker": (0.1, 0.1), "target": (0.05, 0.05), "goal": (0.05, 0.05)},
    "Obstacle": {"marker": (0.02, 0.02), "target": (0.02, 0.0)},
    "Seesaw": {"target": (0.1, 0.1), "ball": (0.05, 0.05)},
    "Belt": {"target": (0.1, 0.1), "goal": (0.1, 0.1)},
    "Collide": {"target": (0.1, 0.1), "goal": (0.1, 0.1)},
    "Basket": {"target": (0.1, 0.1), "goal": (0.1, 0.1)},
    "Buckets": {"target": (0.1, 0.1)},
    "Moving": {"target": (0.2, 0.2), "goal": (0.0, 0.5)},
}


@pytest.mark.golden
@pytest.mark.parametrize("name", NOISE)
def test_noise_fills_its_range(name: str) -> None:
    level, rng = load_level(name), np.random.default_rng(0)
    layouts = [draw_layout(level, rng) for _ in range(300)]
    platforms = {m for m in layouts[0].offsets if m.startswith(("floor", "medium", "short"))}
    assert set(layouts[0].offsets) - platforms == set(NOISE[name])
    for member, half_width in NOISE[name].items():
        offsets = np.array([layout.offsets[member] for layout in layouts])
        assert (np.abs(offsets) <= half_width).all()
        # 300 uniform draws reach 97 % of the range, both ways, but for 0.985 ** 300 = 1 %.
        assert (offsets.max(axis=0) >= 0.97 * np.array(half_width)).all()
        assert (offsets.min(axis=0) <= -0.97 * np.array(half_width)).all()


@pytest.mark.golden
def test_noise_of_funnel_takes_one_of_two_goals() -> None:
    level, rng = load_level("Funnel"), np.random.default_rng(0)
    layouts = [draw_layout(level, rng) for _ in range(200)]
    goals = [layout.offsets["goal"] for layout in layouts]
    assert set(goals) == {(-0.28, -0.8), (0.28, -0.8)}
    # Binomial(200, 1/2) is within 100 +- 4 * 7.07.
    assert 72 <= goals.count((0.28, -0.8)) <= 128
    targets = np.array([layout.offsets["target"] for layout in layouts])
    assert -0.2 <= targets.min() < -0.19
    assert 0.04 < targets.max() <= 0.05


@pytest.mark.unit
def test_angles_of_bars_are_degrees() -> None:
    thing = build_object(
        read(objects=[{**OBJECT, "angle_deg": 90, "length": 10}]).objects[0], (5, 5)
    )
    assert (thing.shape.a.y, thing.shape.b.y) == pytest.approx((-5, 5))
    assert next(thing.sprites()).angle == pytest.approx(math.pi / 2)
