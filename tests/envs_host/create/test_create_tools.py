"""Tools, their universe and their splits against docs/create.md, "Tools" and "Splits"."""

from __future__ import annotations

import math

import numpy as np
import pytest

from envs_host.create.tools import (
    CLASS_ORDER,
    Tool,
    ToolClass,
    all_tools,
    analysis_ids,
    analysis_split,
    analysis_train_ids,
    angle_differences,
    angle_test_ids,
    embedding_test_ids,
    full_ids,
    mix_ids,
    no_op_id,
    published_split,
    squared_train_distances,
    tool_universe,
)

# Class, first id and count at 15 degrees, count at 3 degrees.
TABLE = [
    ("ramp", 0, 180, 900),
    ("trampoline", 180, 180, 900),
    ("ball", 360, 20, 20),
    ("bouncy ball", 380, 20, 20),
    ("box", 400, 20, 20),
    ("bouncy box", 420, 20, 20),
    ("triangle", 440, 168, 840),
    ("bouncy triangle", 608, 168, 840),
    ("square", 776, 105, 609),
    ("bouncy square", 881, 105, 609),
    ("pentagon", 986, 105, 504),
    ("bouncy pentagon", 1091, 105, 504),
    ("hexagon", 1196, 84, 420),
    ("bouncy hexagon", 1280, 84, 420),
    ("lever", 1364, 55, 55),
    ("limited see-saw", 1419, 90, 435),
    ("weighted see-saw", 1509, 160, 760),
    ("cannon", 1669, 168, 840),
    ("fan", 1837, 168, 840),
    ("belt", 2005, 120, 120),
    ("funnel", 2125, 120, 600),
    ("bucket", 2245, 120, 600),
    ("no-op", 2365, 1, 1),
]

# Group -> training angles, by which the default split can be told.
TRAIN_ANGLES = {
    "ramp": {45, 60, 75, 90, 105, 165},
    "trampoline": {45, 60, 75, 90, 105, 165},
    "triangle": {30, 45, 60, 105},
    "bouncy triangle": {30, 45, 60, 105},
    "square": {15, 30, 75},
    "bouncy square": {15, 30, 75},
    "pentagon": {15, 45, 60},
    "bouncy pentagon": {15, 45, 60},
    "hexagon": {15, 45},
    "bouncy hexagon": {15, 45},
    "limited see-saw": {50, 65, 80},
    "weighted see-saw": {5, 50},
    "cannon": {0, 15, 45, 60, 105, 120, 165, 240, 255, 300, 315, 330},
    "fan": {60, 90, 135, 195, 210, 225, 240, 255, 270, 285, 300, 330},
    "funnel": {15, 30, 45, 60, 75, 105, 135, 195, 255, 270, 285, 300},
    "bucket": {15, 45, 75, 90, 105, 150, 180, 195, 210, 240, 255, 345},
}


@pytest.mark.golden
@pytest.mark.parametrize(("name", "first", "count", "fine_count"), TABLE)
def test_classes_have_the_ids_and_counts_of_the_table(
    name: str, first: int, count: int, fine_count: int
) -> None:
    ids = [tool.id for tool in all_tools() if tool.tool_class == name]
    assert ids == list(range(first, first + count))
    assert sum(tool.tool_class == name for tool in all_tools(3)) == fine_count


@pytest.mark.golden
def test_totals() -> None:
    assert len(all_tools()) == 2366
    assert len(all_tools(3)) == 10877
    assert [tool.id for tool in all_tools()] == list(range(2366))
    assert no_op_id() == 2365


@pytest.mark.golden
@pytest.mark.parametrize(
    ("tool_id", "expected"),
    [
        (72, {"tool_class": "ramp", "elasticity": 0.3, "angle_deg": 30, "size": 14}),
        (169, {"tool_class": "ramp", "elasticity": 0.5, "angle_deg": 135, "size": 22}),
        (369, {"tool_class": "ball", "elasticity": 0.3, "size": 5}),
        (418, {"tool_class": "box", "elasticity": 0.5, "size": 11}),
        (954, {"tool_class": "bouncy square", "elasticity": 1.0, "angle_deg": 60, "size": 6}),
        (1407, {"tool_class": "lever", "size": 24, "friction": 1.1}),
        (
            1477,
            {"tool_class": "limited see-saw", "size": 18, "max_angle_deg": 20, "friction": 1.05},
        ),
        (1590, {"size": 16, "max_angle_deg": 35, "weight_side": "right", "weight_mass": 6}),
        (1652, {"size": 20, "max_angle_deg": 20, "weight_side": "left", "weight_mass": 14}),
        (1755, {"tool_class": "cannon", "angle_deg": 180, "force": 80}),
        (1852, {"tool_class": "fan", "angle_deg": 30, "force": 45}),
        (2043, {"tool_class": "belt", "size": 12, "velocity": 3}),
        (2123, {"tool_class": "belt", "size": 24, "velocity": -5}),
        (2127, {"tool_class": "funnel", "angle_deg": 0, "size": 7}),
        (2247, {"tool_class": "bucket", "angle_deg": 0, "size": 7}),
    ],
)
def test_examples_of_the_spec(tool_id: int, expected: dict) -> None:
    tool = all_tools()[tool_id]
    assert {name: getattr(tool, name) for name in expected} == pytest.approx(expected)


@pytest.mark.unit
def test_no_square_is_a_box_and_seesaws_stop_at_their_limits() -> None:
    tools = all_tools()
    squares = {tool.angle_deg for tool in tools if tool.tool_class == ToolClass.SQUARE}
    assert squares == {0, 15, 30, 60, 75}
    weighted = {t.max_angle_deg for t in tools if t.tool_class == ToolClass.WEIGHTED_SEESAW}
    limited = {t.max_angle_deg for t in tools if t.tool_class == ToolClass.LIMITED_SEESAW}
    assert (weighted, limited) == ({5, 20, 35, 50}, {5, 20, 35, 50, 65, 80})


@pytest.mark.unit
@pytest.mark.parametrize("spacing", [0, 91, 2.5, True, -15])
def test_a_wrong_spacing_is_refused(spacing: float) -> None:
    with pytest.raises(ValueError, match="angle_spacing"):
        all_tools(spacing)


@pytest.mark.unit
def test_universe_lists_every_tool_once() -> None:
    universe = tool_universe()
    assert universe.num_actions == 2366
    assert universe.class_names == tuple(row[0] for row in TABLE)
    assert len(set(universe.action_hashes)) == 2366
    assert len(set(universe.action_names)) == 2366
    assert universe.action_names[1590] == "weighted see-saw s=16 f=1 max=35 w=6 right"
    assert tool_universe(3).num_actions == 10877
    assert universe.hash != tool_universe(3).hash


@pytest.mark.oracle
def test_hand_made_vectors_are_one_hot_and_standardised() -> None:
    vectors = tool_universe().engineered["gt32"]
    assert vectors.shape == (2366, 32)
    assert vectors.dtype == np.float32
    np.testing.assert_array_equal(vectors[:, :23].argmax(axis=1), tool_universe().class_labels)
    np.testing.assert_array_equal(vectors[:, :23].sum(axis=1), 1.0)
    # The numbers are rounded to float32; the means of them are taken in float64.
    numbers = vectors[:, 23:].astype(np.float64)
    np.testing.assert_allclose(numbers.mean(axis=0), 0.0, atol=1e-6)
    np.testing.assert_allclose(numbers.std(axis=0), 1.0, atol=1e-6)

    def column(value_of: object) -> np.ndarray:
        values = np.array([value_of(tool) or 0.0 for tool in all_tools()])
        return (values - values.mean()) / np.sqrt(((values - values.mean()) ** 2).mean())

    by_hand = [
        column(lambda tool: tool.elasticity),
        column(lambda tool: math.radians(tool.angle_deg or 0.0)),
        column(lambda tool: tool.size),
        column(lambda tool: tool.friction),
        column(lambda tool: math.radians(tool.max_angle_deg or 0.0)),
        column(lambda tool: tool.weight_mass),
        column(lambda tool: float(tool.weight_side == "right")),
        column(lambda tool: tool.force),
        column(lambda tool: tool.velocity),
    ]
    np.testing.assert_allclose(vectors[:, 23:], np.stack(by_hand, axis=1), atol=1e-5)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "counts", "union"),
    [("default", (1097, 507, 506), 2110), ("full", (938, 400, 399), 1737)],
)
def test_published_splits(name: str, counts: tuple[int, ...], union: int) -> None:
    split = published_split(name)
    split.check(tool_universe())
    assert (len(split.train), len(split.validation), len(split.test)) == counts
    assert len(split.ids("all")) == union
    assert split.always_available.tolist() == [2365]


@pytest.mark.oracle
def test_the_default_split_follows_its_angles() -> None:
    expected = [
        tool.id
        for tool in all_tools()
        if tool.primary_parameter in TRAIN_ANGLES.get(tool.tool_class.value, set())
    ]
    assert published_split("default").train.tolist() == expected
    grouped = [tool.id for tool in all_tools() if tool.tool_class.value in TRAIN_ANGLES]
    assert published_split("default").ids("all").tolist() == grouped


@pytest.mark.oracle
def test_the_full_split_follows_its_classes() -> None:
    train = {"ramp", "trampoline", "ball", "bouncy ball", "limited see-saw", "weighted see-saw",
             "cannon", "bucket"}  # fmt: skip
    new = {"triangle", "bouncy triangle", "lever", "fan", "belt", "funnel"}
    split = published_split("full")
    classes = {part: {all_tools()[i].tool_class.value for i in split.ids(part)}
               for part in ("train", "validation", "test")}  # fmt: skip
    assert classes == {"train": train, "validation": new, "test": new}
    of_these = [tool.id for tool in all_tools() if tool.tool_class.value in train | new]
    assert full_ids().tolist() == of_these


@pytest.mark.golden
def test_analysis_counts() -> None:
    assert len(analysis_ids()) == 7555
    assert len(analysis_train_ids()) == 761
    split = analysis_split()
    split.check(tool_universe(3))
    assert (len(split.train), len(split.validation), len(split.test)) == (761, 771, 6023)
    assert split.ids("all").tolist() == analysis_ids().tolist()
    assert split.always_available.tolist() == [10876]


@pytest.mark.golden
@pytest.mark.parametrize(
    ("theta", "count"), [(15, 444), (12, 1529), (9, 3027), (6, 4525), (3, 6023)]
)
def test_angle_test_sets_have_the_exact_counts(theta: float, count: int) -> None:
    assert len(angle_test_ids(theta)) == count


def _brute_force_circular(tool: Tool, trained: list[Tool]) -> float:
    """Degrees to the nearest trained tool of the class, turning the shape by its symmetry."""
    sides = {"triangle": 3, "bouncy triangle": 3, "ramp": 2, "trampoline": 2}
    turns = sides.get(tool.tool_class.value, 1)
    steps = [0.0] if tool.max_angle_deg is not None else [360.0 * k / turns for k in range(-3, 4)]
    return min(
        abs(tool.primary_parameter - other.primary_parameter + step)
        for other in trained
        if other.tool_class == tool.tool_class
        for step in steps
    )


@pytest.mark.oracle
def test_circular_angle_differences_against_brute_force() -> None:
    tools = all_tools(3)
    trained = [tools[i] for i in analysis_train_ids()]
    rng = np.random.default_rng(0)
    places = rng.choice(len(analysis_ids()), 60, replace=False)
    expected = [_brute_force_circular(tools[analysis_ids()[place]], trained) for place in places]
    np.testing.assert_allclose(angle_differences(per_class=True)[places], expected, atol=1e-9)
    # 345 degrees is 15 from 0 on the circle and far from 330 only by the plain rule, too; but 357
    # is 3 degrees from 0 on the circle and 27 from 330 by the plain rule.
    fan = next(t.id for t in tools if t.tool_class == ToolClass.FAN and t.angle_deg == 357)
    assert fan in angle_test_ids(15)
    assert fan not in angle_test_ids(6, per_class=True)


@pytest.mark.unit
def test_angle_must_be_positive() -> None:
    with pytest.raises(ValueError, match="above 0"):
        angle_test_ids(0.0)


@pytest.mark.oracle
def test_embedding_test_sets_use_squared_distances() -> None:
    table = np.random.default_rng(1).normal(size=(10877, 2)).astype(np.float32)
    distances = squared_train_distances(table)
    place = 4321
    row = table[analysis_ids()[place]].astype(float)
    by_hand = min(sum((row - table[i]) ** 2) for i in analysis_train_ids())
    assert distances[place] == pytest.approx(by_hand, rel=1e-6)
    far = embedding_test_ids(table, 0.5)
    assert 0 < len(far) < 7555
    assert set(far) == set(analysis_ids()[distances > 0.5])
    assert not set(far) & set(analysis_train_ids())
    with pytest.raises(ValueError, match="10877"):
        embedding_test_ids(table[:-1], 0.5)


@pytest.mark.unit
def test_mixes_hold_the_share_of_new_tools() -> None:
    # Tools that are not trained with are far from all others, so every one of them is new.
    table = np.zeros((10877, 1), np.float32)
    new = np.setdiff1d(analysis_ids(), analysis_train_ids())
    table[new] = 10.0
    for ratio in (0.0, 0.2, 0.4, 0.6, 0.8):
        ids = mix_ids(table, ratio, seed=3)
        assert len(ids) == int(ratio * len(new)) + int((1.0 - ratio) * 761)
        assert np.isin(ids, new).sum() == int(ratio * len(new))
        assert len(np.unique(ids)) == len(ids)
        is_new = np.isin(ids, new)
        # Neither part is the beginning of the ascending list.
        assert ratio == 0.0 or ids[is_new].tolist() != new[: is_new.sum()].tolist()
        assert ids[~is_new].tolist() != analysis_train_ids()[: (~is_new).sum()].tolist()
    assert mix_ids(table, 0.4, seed=3).tolist() == mix_ids(table, 0.4, seed=3).tolist()
    assert mix_ids(table, 0.4, seed=3).tolist() != mix_ids(table, 0.4, seed=4).tolist()
    with pytest.raises(ValueError, match="not in"):
        mix_ids(table, 1.5, seed=0)


@pytest.mark.unit
def test_unknown_splits_are_refused() -> None:
    with pytest.raises(ValueError, match="gran_2"):
        published_split("gran_2")


@pytest.mark.unit
def test_labels_count_the_classes() -> None:
    assert [tool_class.label for tool_class in CLASS_ORDER] == list(range(23))
