"""Episodes against those recorded from the release, and the rules of docs/create.md."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from envs_host.create import things
from envs_host.create.config import CreateConfig, PhysicsConfig, RewardConfig
from envs_host.create.episode import End, Episode, Outcome
from envs_host.create.geometry import scaled_distance
from envs_host.create.layout import Layout
from envs_host.create.levels import TASK_NAMES, load_level, parse_level
from envs_host.create.sprites import Kind, Tone
from envs_host.create.tools import all_tools, no_op_id
from envs_host.create.world import Placement

GOLDEN = yaml.safe_load((Path(__file__).parent / "golden.yaml").read_text())
TOOLS = all_tools()
NO_OP = TOOLS[no_op_id()]
ENDS = {"marker_oob": End.MARKER_OUT, "target_oob": End.TARGET_OUT, "still": End.STILL}
# Positions are printed to three decimals.
ROUNDING = 0.6e-3
EPISODES = [(name, n) for name, of in GOLDEN["recorded_episodes"].items() for n in range(len(of))]


def start(level: str | dict, **settings: object) -> Episode:
    """An episode without noise."""
    loaded = load_level(level) if isinstance(level, str) else parse_level(json.dumps(level))
    return Episode(Layout(loaded), CreateConfig(**settings))


def idle(episode: Episode) -> list[Outcome]:
    """No-ops until the episode ends."""
    outcomes = [episode.step(NO_OP, (0.0, 0.0))]
    while not outcomes[-1].ends:
        outcomes.append(episode.step(NO_OP, (0.0, 0.0)))
    return outcomes


def rewards(outcomes: list[Outcome]) -> list[float]:
    return [outcome.reward for outcome in outcomes]


def custom(**changes: object) -> dict:
    """A plain level whose target rests on a floor, above its star."""
    return {
        "schema": 1,
        "name": "Custom",
        "kind": "plain",
        "target": {"pos": [0.0, 0.0]},
        "goal": {"kind": "star", "pos": [0.0, -0.9]},
        "objects": [{"key": "floor", "type": "bar", "pos": [0.0, -0.12], "thickness": 1}],
        **changes,
    }


@pytest.mark.golden
@pytest.mark.parametrize("name", GOLDEN["noop_rollouts"])
def test_rollouts_of_no_ops(name: str) -> None:
    golden, episode = GOLDEN["noop_rollouts"][name], start(name)
    for action in range(golden["actions"]):
        outcome = episode.step(NO_OP, (0.0, 0.0))
        now = episode.world.positions
        assert now.target == pytest.approx(golden["target"][action], abs=ROUNDING)
        if "marker" in golden:
            assert now.marker == pytest.approx(golden["marker"][action], abs=ROUNDING)
        if "goal_ball" in golden:
            assert now.goal == pytest.approx(golden["goal_ball"][action], abs=ROUNDING)
        assert bool(outcome.ends) == (action == golden["actions"] - 1)
    assert outcome.ends == (ENDS[golden["end"]],)
    assert (outcome.terminated, outcome.truncated) == (True, False)
    assert episode.summary.reward == pytest.approx(golden["total_reward"])
    assert episode.summary.num_no_op == golden["actions"]


@pytest.mark.golden
def test_push_with_one_cannon() -> None:
    golden, episode = GOLDEN["push_script"], start("Push")
    first = golden["first_action"]
    outcomes = [episode.step(TOOLS[first["tool_id"]], tuple(first["pos"]))]
    for target, marker in zip(golden["target"], golden["marker"], strict=True):
        assert episode.world.positions.target == pytest.approx(target, abs=ROUNDING)
        assert episode.world.positions.marker == pytest.approx(marker, abs=ROUNDING)
        if not outcomes[-1].ends:
            outcomes.append(episode.step(NO_OP, (0.0, 0.0)))
    assert rewards(outcomes) == pytest.approx(golden["rewards"])
    assert episode.summary.reward == pytest.approx(11.02)
    assert (episode.summary.goal_hit, episode.summary.target_hit) == (1, 1)
    assert episode.summary.num_placed == 1


@pytest.mark.golden
def test_the_goal_is_credited_once() -> None:
    outcomes = idle(start("GoalTest"))
    assert rewards(outcomes) == pytest.approx(GOLDEN["goal_test"]["rewards"])
    assert outcomes[2].reward == pytest.approx(10.01)


@pytest.mark.golden
def test_funnel_with_no_ops_hits_the_goal_at_the_origin() -> None:
    assert rewards(idle(start("Funnel"))) == pytest.approx(GOLDEN["funnel_noop_rewards"])


@pytest.mark.golden
@pytest.mark.parametrize(("name", "number"), EPISODES)
def test_recorded_episodes(name: str, number: int) -> None:
    golden, episode = GOLDEN["recorded_episodes"][name][number], start(name)
    outcomes = []
    for tool_id, x, y in golden["actions"]:
        assert not outcomes or not outcomes[-1].ends
        outcomes.append(episode.step(TOOLS[tool_id], (x, y)))
    assert rewards(outcomes) == pytest.approx(golden["rewards"], abs=1e-6)
    placed = [int(outcome.placement == Placement.PLACED) for outcome in outcomes]
    assert placed == golden["placed"]
    assert outcomes[-1].ends
    assert episode.world.positions.target == pytest.approx(golden["final_target"], abs=ROUNDING)


@pytest.mark.golden
@pytest.mark.parametrize(("name", "actions"), [("Navigate", 12), ("Belt", 15), ("Obstacle", 43)])
def test_these_end_by_stillness(name: str, actions: int) -> None:
    outcomes = idle(start(name))
    assert (len(outcomes), outcomes[-1].ends) == (actions, (End.STILL,))


@pytest.mark.golden
def test_push_ends_when_the_marker_is_gone() -> None:
    episode = start("Push")
    outcomes = idle(episode)
    assert (len(outcomes), episode.summary.reward) == (7, pytest.approx(0.07))
    assert outcomes[-1].ends == (End.MARKER_OUT,)
    assert episode.world.positions.target[1] == pytest.approx(35.5, abs=0.01)


@pytest.mark.golden
def test_blocked_placements_earn_nothing_and_place_nothing() -> None:
    episode, ramp = start("Push"), TOOLS[72]
    first = episode.step(ramp, (-0.3, 0.5))
    assert (first.placement, first.reward) == (Placement.PLACED, pytest.approx(0.01))
    for position in ((-0.3, 0.68), (0.1, -0.25), (0.1, -0.14)):  # A tool, a bar, the target.
        outcome = episode.step(ramp, position)
        assert (outcome.placement, outcome.reward) == (Placement.BLOCKED, pytest.approx(0.0))
    assert len(episode.world.tools) == 1
    assert (episode.summary.num_placed, episode.summary.num_blocked) == (1, 3)
    assert episode.step(ramp, (3.0, -5.0)).placement == Placement.PLACED
    assert tuple(episode.world.tools[1].body.position) == (84.0, 0.0)


@pytest.mark.golden
def test_only_placed_tools_keep_their_distance() -> None:
    ramp = TOOLS[0]  # Length 6, horizontal: short enough to lie beside another.
    for distance, expected in ((0.299, Placement.BLOCKED), (0.3001, Placement.PLACED)):
        episode = start("Moving")
        episode.step(ramp, (0.0, 0.0))
        assert episode.step(ramp, (0.0, -distance)).placement == expected
    # The no-op and blocked tools keep no distance.
    episode = start("Moving")
    episode.step(NO_OP, (0.0, 0.0))
    assert episode.step(ramp, (0.0, 0.0)).placement == Placement.PLACED
    # 0.2 from the target: no overlap with a short bar below it.
    assert episode.world.check_placement(ramp, (0.6, 0.3)) == Placement.PLACED


@pytest.mark.unit
@pytest.mark.parametrize(
    ("level", "position"),
    [
        ("Push", (-0.7, -0.64)),  # The star, a sensor.
        ("Basket", (-0.75, 0.65)),  # The basket, a sensor.
        ("Collide", (-0.6, 0.7)),  # The goal ball.
        ("Belt", (-0.1, -0.5)),  # A subgoal's disc.
        ("Belt", (0.55, 0.25)),  # A belt.
        ("Collide", (1.0, 0.0)),  # A frame wall.
        ("Seesaw", (-0.3, 0.5)),  # The heavy ball.
        ("Seesaw", (-0.3, -0.1)),  # The plank of the see-saw.
        ("Obstacle", (0.25, 0.93)),  # A box.
    ],
)
def test_everything_in_the_world_blocks(level: str, position: tuple[float, float]) -> None:
    episode = start(level)
    assert episode.world.check_placement(TOOLS[360], position) == Placement.BLOCKED
    assert not episode.world.tools


@pytest.mark.unit
def test_of_a_seesaw_only_the_plank_is_tested() -> None:
    """A weight of a see-saw has no shape, so a tool may be placed upon it."""
    episode = start("Moving")
    seesaw = next(
        t for t in TOOLS if t.weight_mass == 14 and t.size == 20 and t.max_angle_deg == 50
    )
    episode.step(seesaw, (0.0, 0.0))
    weight = next(s for s in episode.world.tools[0].sprites() if s.kind == Kind.DISC)
    probe = things.disc((weight.x, weight.y - 0.8), 0.5, 0.1, 0.0, Tone.TOOL)
    assert episode.world.stage.is_free(probe)


@pytest.mark.unit
def test_a_position_outside_is_invalid_before_clipping() -> None:
    world = start("Push").world
    assert world.check_placement(TOOLS[72], (1.01, 0.0)) == Placement.INVALID
    assert world.place(TOOLS[72], (0.0, -1.01)) == Placement.INVALID
    assert not world.tools


@pytest.mark.golden
def test_a_caught_ball_keeps_the_episode_running() -> None:
    episode = start("Buckets")
    outcomes = [episode.step(TOOLS[2248], (0.75, 0.3))]  # Bucket, 0 degrees, radius 9.
    while not outcomes[-1].ends:
        outcomes.append(episode.step(NO_OP, (0.0, 0.0)))
    assert episode.world.positions.target == pytest.approx((73.5, 54.6))
    assert (len(outcomes), outcomes[-1].ends) == (31, (End.STEP_LIMIT,))
    assert (outcomes[-1].terminated, outcomes[-1].truncated) == (False, True)
    assert episode.summary.reward == pytest.approx(0.31)


@pytest.mark.golden
@pytest.mark.parametrize(("name", "actions"), [("Obstacle", 51), ("Belt", 51), ("Basket", 41)])
def test_levels_have_their_own_limits(name: str, actions: int) -> None:
    assert start(name).step_limit + 1 == actions
    assert start(name, step_limit=5).step_limit == 5


@pytest.mark.unit
def test_an_episode_has_one_action_more_than_its_limit() -> None:
    outcomes = idle(start("Navigate", step_limit=3))
    assert (len(outcomes), outcomes[-1].ends) == (4, (End.STEP_LIMIT,))


@pytest.mark.unit
def test_the_second_quiet_action_ends_even_if_not_consecutive() -> None:
    episode = start(custom())
    is_quiet, outcome = [], episode.step(NO_OP, (0.0, 0.0))
    while not outcome.ends:
        is_quiet.append(episode.world.is_still(0.05))
        if is_quiet.count(True) == 1 and is_quiet[-1]:
            episode.world.target.body.velocity = 0.0, 2.0  # Still in flight after one action.
        outcome = episode.step(NO_OP, (0.0, 0.0))
    is_quiet.append(episode.world.is_still(0.05))
    assert outcome.ends == (End.STILL,)
    assert is_quiet.count(True) == 2
    assert is_quiet[-1]
    assert not is_quiet[-2]


@pytest.mark.unit
def test_a_turning_plank_counts_as_still() -> None:
    lever = {"key": "plank", "type": "lever", "pos": [0.6, 0.6], "length": 18}
    level = custom(objects=[*custom()["objects"], lever])
    episode = start(level)
    plank = episode.world.objects[1].body
    plank.angular_velocity = 1.0
    outcomes = idle(episode)
    assert outcomes[-1].ends == (End.STILL,)
    assert abs(plank.angular_velocity) > 0.9


@pytest.mark.unit
def test_reaching_the_goal_ends_the_episode_only_on_request() -> None:
    assert idle(start("GoalTest"))[2].ends == ()
    outcomes = idle(start("GoalTest", end_on_goal=True))
    assert (len(outcomes), outcomes[-1].ends) == (3, (End.GOAL,))
    assert outcomes[-1].terminated


@pytest.mark.golden
def test_goal_and_subgoals_are_worth_less_with_every_tool() -> None:
    """Belt: the subgoal at (-0.15, 0.28) reached with three tools placed is worth 2 - 0.3."""
    episode = start("Belt")
    for position in ((-0.9, 0.9), (-0.5, 0.9), (-0.9, 0.5)):
        episode.step(TOOLS[0], position)
    episode.world.target.body.position = (-0.15 + 1) * 42, (0.28 + 1) * 42
    episode.world.target.body.velocity = 0.0, 1.3  # It is still within the disc's reach at the end.
    outcome = episode.step(NO_OP, (0.0, 0.0))
    assert outcome.reward == pytest.approx(0.01 + 1.7)
    assert episode.summary.subgoal_reward == pytest.approx(1.7)
    assert len(episode.world.target_subgoals) == 2
    assert sum(s.kind == Kind.SUBGOAL for s in episode.world.sprites()) == 2
    episode.world.target.body.position = 75.0, 70.0  # Out of the way: the disc blocks no more.
    assert episode.step(NO_OP, (0.0, 0.0)).reward == pytest.approx(0.01)
    assert episode.world.check_placement(TOOLS[360], (-0.15, 0.28)) == Placement.PLACED


@pytest.mark.unit
def test_flying_through_a_subgoal_does_not_count() -> None:
    episode = start(custom(subgoals={"for_target": [[0.0, 0.5]]}, objects=[]))
    episode.world.target.body.position = 42.0, 80.0
    episode.world.target.body.velocity = 0.0, -20.0
    outcome = episode.step(NO_OP, (0.0, 0.0))  # From y = 80 to about 51.6, past the disc at 63.
    assert episode.world.positions.target[1] < 63.0 - 7.0
    assert outcome.reward == pytest.approx(0.01)


@pytest.mark.unit
def test_only_who_must_touch_a_subgoal_reaches_it() -> None:
    episode = start("Obstacle")
    target = episode.world.target.body
    target.position = (0.7 + 1) * 42, (-0.1 + 1) * 42
    target.velocity = 0.0, 1.3
    episode.step(NO_OP, (0.0, 0.0))
    assert len(episode.world.marker_subgoals) == 1
    episode = start("Obstacle")
    marker = episode.world.marker.body
    marker.position = (0.7 + 1) * 42, (-0.1 + 1) * 42
    marker.velocity = 0.0, 1.3
    outcome = episode.step(NO_OP, (0.0, 0.0))
    assert outcome.reward == pytest.approx(2.01)
    assert len(episode.world.marker_subgoals) == 0


@pytest.mark.unit
def test_subgoals_are_never_worth_less_than_nothing() -> None:
    rewards_ = RewardConfig(per_tool_discount=3.0)
    episode = start("Belt", rewards=rewards_)
    episode.step(TOOLS[0], (-0.9, 0.9))
    episode.world.target.body.position = (-0.15 + 1) * 42, (0.28 + 1) * 42
    episode.world.target.body.velocity = 0.0, 1.3
    assert episode.step(NO_OP, (0.0, 0.0)).reward == pytest.approx(0.01)
    assert len(episode.world.target_subgoals) == 2


@pytest.mark.unit
def test_the_goal_counts_at_the_earliest_after_the_target_hit() -> None:
    """A touch before the target was hit is credited one action after the hit."""
    level = custom(
        kind="marker",
        goal={"kind": "star", "pos": [0.0, 0.1]},
        objects=[*custom()["objects"], {"key": "m", "type": "marker_ball", "pos": [0.8, 0.9]}],
    )
    episode = start(level)
    first = episode.step(NO_OP, (0.0, 0.0))  # The target touches the star from the start.
    assert episode.world.has_touched_goal
    assert first.reward == pytest.approx(0.01)
    episode.world.target.body.velocity = 4.0, 0.0
    second = episode.step(NO_OP, (0.0, 0.0))
    assert second.reward == pytest.approx(1.01)
    third = episode.step(NO_OP, (0.0, 0.0))
    assert third.reward == pytest.approx(10.01)


@pytest.mark.unit
@pytest.mark.parametrize(("distance", "is_hit"), [(3.5, False), (3.63, True)])
def test_a_target_is_hit_beyond_356_units(distance: float, is_hit: bool) -> None:
    # 0.03 * sqrt(8) * 42 = 3.564.
    episode = start("Push")
    x, y = episode.world.positions.target
    episode.world.target.body.position = x + distance, y
    outcome = episode.step(NO_OP, (0.0, 0.0))  # It falls by 0.62, which adds 0.05 to the distance.
    assert outcome.reward == pytest.approx(1.01 if is_hit else 0.01)


@pytest.mark.unit
@pytest.mark.parametrize(("level", "reward"), [("Cannon", 1.0), ("Obstacle", 2.0)])
def test_some_targets_must_be_hit_by_the_marker(level: str, reward: float) -> None:
    episode = start(level)
    x, y = episode.world.positions.target
    episode.world.target.body.position = x + 4.5, y
    assert episode.step(NO_OP, (0.0, 0.0)).reward == pytest.approx(0.01)
    assert not episode.world.has_marker_hit_target
    x, y = episode.world.positions.target
    episode.world.marker.body.position = x + 7.9, y
    assert episode.step(NO_OP, (0.0, 0.0)).reward == pytest.approx(reward + 0.01)
    assert episode.world.has_marker_hit_target


@pytest.mark.unit
def test_directional_hits_go_to_the_goals_side() -> None:
    for sign, is_hit in ((-1.0, True), (1.0, False)):  # Push's goal is on the left.
        episode = start("Push", directional_target_hit=True)
        x, y = episode.world.positions.target
        episode.world.target.body.position = x + sign * 5.0, y
        episode.step(NO_OP, (0.0, 0.0))
        assert episode.summary.target_hit == is_hit


@pytest.mark.unit
def test_a_lost_marker_ends_nothing_after_the_target_was_hit() -> None:
    episode = start("Push", rewards=RewardConfig(marker_lost=-0.5))
    x, y = episode.world.positions.target
    episode.world.target.body.position = x - 4.0, y
    outcomes = idle(episode)
    assert outcomes[0].reward == pytest.approx(1.01)
    assert outcomes[-1].ends != (End.MARKER_OUT,)
    assert len(outcomes) > 7
    lost = idle(start("Push", rewards=RewardConfig(marker_lost=-0.5)))
    assert lost[-1].reward == pytest.approx(0.01 - 0.5)


@pytest.mark.unit
def test_without_subgoal_rewards_obstacle_pays_nothing_on_the_way() -> None:
    golden = GOLDEN["recorded_episodes"]["Obstacle"][0]
    episode = start("Obstacle", rewards=RewardConfig(with_subgoals=False))
    outcomes = [episode.step(TOOLS[i], (x, y)) for i, x, y in golden["actions"]]
    assert max(golden["rewards"]) == pytest.approx(1.7)
    assert max(rewards(outcomes)) == pytest.approx(0.01)
    episode = start("Push", rewards=RewardConfig(with_subgoals=False))
    first = GOLDEN["push_script"]["first_action"]
    outcomes = [episode.step(TOOLS[first["tool_id"]], tuple(first["pos"])), *idle(episode)]
    assert outcomes[4].reward == pytest.approx(0.01)  # The hit, which still arms the goal.
    assert outcomes[8].reward == pytest.approx(9.91)


@pytest.mark.oracle
def test_dense_rewards_are_decreases_of_distance() -> None:
    episode = start("Moving", rewards=RewardConfig(dense_scale=0.1))

    def distance() -> float:
        now = episode.world.positions
        return math.dist(now.target, now.goal) / 42.0 / math.sqrt(8.0)

    before = distance()
    outcome = episode.step(NO_OP, (0.0, 0.0))
    assert outcome.reward == pytest.approx(0.01 + 0.1 * (before - distance()))
    assert episode.summary.dense_reward == pytest.approx(outcome.reward - 0.01)
    credited = start("GoalTest", rewards=RewardConfig(dense_scale=0.1))
    outcomes = idle(credited)
    assert outcomes[2].reward > 10.01
    assert rewards(outcomes[3:]) == pytest.approx([0.01] * len(outcomes[3:]))


@pytest.mark.oracle
def test_dense_rewards_of_marker_levels() -> None:
    episode = start("Push", rewards=RewardConfig(dense_scale=0.5))

    def distance() -> float:
        now = episode.world.positions
        return math.dist(now.target, now.marker) / 42.0 / math.sqrt(8.0)

    before = distance()
    outcome = episode.step(NO_OP, (0.0, 0.0))  # Not armed: target and goal do not count.
    assert outcome.reward == pytest.approx(0.01 + 0.5 * (before - distance()))


@pytest.mark.unit
@pytest.mark.parametrize(
    ("setting", "level", "expected"),
    [("level", "Collide", 3), ("off", "Collide", 0), ("on", "Push", 3), ("level", "Push", 0)],
)
def test_frame_walls(setting: str, level: str, expected: int) -> None:
    world = start(level, frame_walls=setting).world
    assert len(world.frame) == expected
    assert [s.tone for s in world.sprites()].count(Tone.FRAME) == expected


@pytest.mark.unit
def test_things_enter_the_engine_in_another_order_than_they_are_drawn() -> None:
    """With target and goal first, Obstacle's pile of boxes is not the release's."""
    for name in ("Obstacle", "Belt", "Basket"):
        world = start(name).world
        subgoals = (*world.marker_subgoals, *world.target_subgoals)
        order = (*world.objects, world.target, world.goal, *subgoals, *world.frame)
        assert list(world.stage.space.shapes) == [thing.shape for thing in order]


@pytest.mark.unit
def test_drawing_order() -> None:
    episode = start("Obstacle")
    assert episode.step(TOOLS[360], (0.8, 0.5)).placement == Placement.PLACED
    sprites = list(episode.world.sprites())
    tones = [sprite.tone for sprite in sprites]
    assert tones[:4] == [Tone.TARGET, Tone.GOAL, Tone.TOOL, Tone.MARKER]
    assert tones[-4:] == [Tone.SUBGOAL, Tone.FRAME, Tone.FRAME, Tone.FRAME]
    assert [sprite.x for sprite in sprites[-3:]] == [84.0, 0.0, 42.0]


@pytest.mark.unit
def test_subgoals_of_the_marker_come_before_the_targets() -> None:
    marker = {"key": "m", "type": "marker_ball", "pos": [0.8, 0.9]}
    subgoals = {"for_target": [[-0.5, 0.5]], "for_marker": [[0.5, 0.5]]}
    level = custom(kind="marker", objects=[marker], subgoals=subgoals)
    assert [sprite.x for sprite in start(level).world.sprites()][-2:] == [63.0, 21.0]


@pytest.mark.oracle
def test_distances_are_clipped_and_scaled() -> None:
    assert scaled_distance((0.0, 0.0), (84.0, 84.0)) == pytest.approx(1.0)
    assert scaled_distance((42.0, 42.0), (42.0, 84.0)) == pytest.approx(1.0 / math.sqrt(8.0))
    assert scaled_distance((42.0, 42.0), (42.0, 99.0)) == pytest.approx(1.0 / math.sqrt(8.0))


@pytest.mark.unit
@pytest.mark.parametrize("name", TASK_NAMES)
def test_looks_of_the_levels(name: str) -> None:
    sprites = list(start(name).world.sprites())
    kinds = {"Basket": (Kind.BASKETBALL, Kind.BASKET_GOAL), "Collide": (Kind.DISC, Kind.DISC),
             "Moving": (Kind.DISC, Kind.DISC)}  # fmt: skip
    assert (sprites[0].kind, sprites[1].kind) == kinds.get(name, (Kind.DISC, Kind.STAR))
    tones = {"Basket": (Tone.PICTURE, Tone.PICTURE)}.get(name, (Tone.TARGET, Tone.GOAL))
    assert (sprites[0].tone, sprites[1].tone) == tones
    if name == "Push":
        target, star = sprites[0], sprites[1]
        assert (target.x, target.y, target.size) == pytest.approx((46.2, 36.12, 4.0))
        assert (star.x, star.y, star.size, star.width) == pytest.approx((12.6, 15.12, 4.0, 2.0))


@pytest.mark.unit
def test_gravity_and_substeps_can_be_set() -> None:
    episode = start("Moving", physics=PhysicsConfig(gravity=0.0))
    before = episode.world.positions
    episode.step(NO_OP, (0.0, 0.0))
    assert episode.world.positions == before
    episode = start("Moving", physics=PhysicsConfig(substeps=10))
    y = episode.world.positions.target[1]
    episode.step(NO_OP, (0.0, 0.0))
    assert episode.world.positions.target[1] == pytest.approx(y - 2.0 / 900.0 * 45.0)


@pytest.mark.unit
def test_films_see_ten_frames_per_action() -> None:
    episode, heights = start("Moving"), []
    episode.simulate(NO_OP, (0.0, 0.0), watch=lambda w: heights.append(w.positions.target[1]))
    assert len(heights) == 10
    assert heights == sorted(heights, reverse=True)
    plain = start("Moving")
    plain.simulate(NO_OP, (0.0, 0.0))
    assert heights[-1] == plain.world.positions.target[1]


@pytest.mark.property
@pytest.mark.parametrize("name", TASK_NAMES)
def test_random_play_keeps_the_books(name: str) -> None:
    """Rewards add up, outcomes are counted, every episode ends within its limit."""
    rng = np.random.default_rng(5)
    episode = start(name)
    outcomes = []
    while not outcomes or not outcomes[-1].ends:
        tool = TOOLS[rng.integers(len(TOOLS))]
        x, y = rng.uniform(-1.0, 1.0, 2)
        outcomes.append(episode.step(tool, (float(x), float(y))))
    summary = episode.summary
    assert summary.length == len(outcomes) <= episode.step_limit + 1
    assert summary.reward == pytest.approx(sum(rewards(outcomes)))
    counted = (summary.num_placed, summary.num_blocked, summary.num_no_op, summary.num_invalid)
    kinds = (Placement.PLACED, Placement.BLOCKED, Placement.NO_OP, Placement.INVALID)
    placements = [outcome.placement for outcome in outcomes]
    assert counted == tuple(placements.count(kind) for kind in kinds)
    assert len(episode.world.tools) == summary.num_placed
