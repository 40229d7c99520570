"""CREATE through Gymnasium: spaces, action sets, seeds, info, settings."""

from __future__ import annotations

import dataclasses
import sys
from types import ModuleType

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from envs_host.create import CreateConfig, CreateEnv, RewardConfig, register_environments
from envs_host.create.action_sets import draw_action_set
from envs_host.create.levels import load_level
from envs_host.create.tools import analysis_ids, full_ids, published_split
from envs_host.create.world import Placement

BLIND = CreateConfig(observation="none")


def make(level: str = "Push", deterministic: bool = True, **settings: object) -> CreateEnv:
    return CreateEnv(level, deterministic, config=dataclasses.replace(BLIND, **settings))


def act(index: int, x: float = 0.0, y: float = 0.0) -> dict:
    return {"index": index, "position": np.array([x, y], np.float32)}


def play(env: CreateEnv, seed: int, num_actions: int = 6) -> list:
    """Everything that random play of one seed brings."""
    _, info = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    found = [info["available_ids"].tolist(), env.world.positions]
    for _ in range(num_actions):
        index, (x, y) = int(rng.integers(50)), rng.uniform(-1, 1, 2)
        _, reward, terminated, truncated, info = env.step(act(index, x, y))
        found.append((reward, terminated, truncated, info["placement"], env.world.positions))
        if terminated or truncated:
            break
    return found


@pytest.mark.contract
@pytest.mark.parametrize("env_id", register_environments())
def test_every_registered_environment_passes_gymnasiums_checks(env_id: str) -> None:
    env = gymnasium.make(env_id, config=BLIND)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.deterministic == env_id.endswith("Det-v1")
    env.close()


@pytest.mark.unit
def test_ids_are_twelve_tasks_and_a_smoke_level_twice() -> None:
    ids = register_environments()
    assert len(ids) == len(set(ids)) == 26
    assert {"jaxnew/CreatePush-v1", "jaxnew/CreatePushDet-v1", "jaxnew/CreateGoalTest-v1"} <= {*ids}


@pytest.mark.unit
@pytest.mark.filterwarnings("ignore:.*out of date")
def test_earlier_versions_are_refused() -> None:
    with pytest.raises(gymnasium.error.DeprecatedEnv, match="use `jaxnew/CreatePush-v1` instead"):
        gymnasium.make("jaxnew/CreatePush-v0")


@pytest.mark.contract
def test_same_seed_same_episode_and_other_seed_another() -> None:
    env = make("Push", deterministic=False)
    assert play(env, 3) == play(make("Push", deterministic=False), 3)
    # Again in the same environment: nothing is left of the episode before.
    assert play(env, 3) == play(env, 3)
    assert play(env, 3)[0] != play(env, 4)[0]
    assert play(env, 3)[1] != play(env, 4)[1]


@pytest.mark.contract
def test_resets_without_a_seed_go_on_and_are_reproducible() -> None:
    def sets(seed: int) -> list:
        env = make("Push", deterministic=False)
        infos = [env.reset(seed=seed)[1], env.reset()[1], env.reset()[1]]
        return [info["available_ids"].tolist() for info in infos]

    first, second, third = sets(9)
    assert first != second != third
    assert sets(9) == [first, second, third]


@pytest.mark.unit
def test_deterministic_levels_keep_their_positions_but_not_their_sets() -> None:
    env = make("Push", deterministic=True)
    found = [env.reset(seed=seed)[1]["available_ids"].tolist() for seed in (0, 1)]
    assert env.world.positions.target == pytest.approx((46.2, 36.12))
    assert found[0] != found[1]


@pytest.mark.unit
def test_layouts_do_not_depend_on_the_size_of_the_set() -> None:
    def starts(size: int) -> list:
        env = make("Push", deterministic=False, action_set_size=size)
        env.reset(seed=1)
        first = env.world.positions
        env.reset()
        return [first, env.world.positions]

    assert starts(50) == starts(10)


@pytest.mark.unit
def test_a_task_id_freezes_the_layout() -> None:
    env = make("Push", deterministic=False, task_id=7)
    starts = []
    for seed in (0, 1, 2):
        env.reset(seed=seed)
        starts.append(env.world.positions)
    assert starts[0] == starts[1] == starts[2]
    other = make("Push", deterministic=False, task_id=8)
    other.reset(seed=0)
    assert other.world.positions != starts[0]


@pytest.mark.unit
@pytest.mark.parametrize("part", ["train", "validation", "test"])
def test_sets_hold_the_no_op_first_and_49_tools_of_their_part(part: str) -> None:
    env = make(split_part=part)
    pool = set(published_split("default").ids(part).tolist())
    for seed in range(5):
        ids = env.reset(seed=seed)[1]["available_ids"]
        assert (ids.shape, ids.dtype, ids[0]) == ((50,), np.int32, 2365)
        assert len(set(ids.tolist())) == 50
        assert set(ids[1:].tolist()) <= pool


@pytest.mark.property
def test_every_candidate_is_equally_likely() -> None:
    rng, candidates = np.random.default_rng(0), np.arange(10, 30)
    counts = np.zeros(40)
    for _ in range(4000):
        counts[draw_action_set(rng, candidates, 5, no_op=35)] += 1
    assert counts[35] == 4000
    # 4 of 20 candidates in 4000 sets: 800 each, deviation sqrt(4000 * 0.2 * 0.8) = 25.
    assert np.abs(counts[10:30] - 800).max() < 5 * 25.3


@pytest.mark.unit
def test_sets_are_constant_in_an_episode_and_cannot_be_changed_through_info() -> None:
    env = make()
    first = env.reset(seed=0)[1]["available_ids"]
    kept = first.copy()
    first[:] = 0
    _, _, _, _, info = env.step(act(0))
    np.testing.assert_array_equal(info["available_ids"], kept)


@pytest.mark.unit
def test_samplers_can_be_replaced_and_are_checked() -> None:
    def lowest(rng: np.random.Generator, candidates: np.ndarray, size: int) -> np.ndarray:
        return candidates[:size]

    config = dataclasses.replace(BLIND, action_set_size=4)
    env = CreateEnv("Push", config=config, candidates=[8, 5, 3, 9, 4], sampler=lowest)
    assert env.reset(seed=0)[1]["available_ids"].tolist() == [2365, 4, 5, 8]
    wrong = CreateEnv("Push", config=config, sampler=lambda rng, candidates, size: [15, 15, 16, 17])
    with pytest.raises(ValueError, match="4 distinct ids"):
        wrong.reset(seed=0)


@pytest.mark.unit
@pytest.mark.parametrize("candidates", [[3, 3], [2365, 1], [], [5000], [-1, 2], [1.5, 3]])
def test_wrong_candidates_are_refused(candidates: list[float]) -> None:
    with pytest.raises(
        ValueError,
        match=r"candidates: (must be a non-empty list of integers|action|the no-op 2365)",
    ):
        CreateEnv("Push", config=BLIND, candidates=candidates)


@pytest.mark.unit
def test_a_set_that_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="exceeds the 3 candidates"):
        CreateEnv("Push", config=BLIND, candidates=[1, 2, 3])


@pytest.mark.unit
def test_indices_mean_tools_of_the_set() -> None:
    env = make()
    ids = env.reset(seed=0)[1]["available_ids"]
    env.step(act(7, -0.3, 0.6))
    env.step(act(0, 0.9, 0.9))
    sprite = list(env.world.sprites())[2]
    assert env.episode.summary.num_placed == 1
    other = make(action_ids="universe")
    other.reset(seed=0)
    assert other.action_space["index"].n == 2366
    other.step(act(int(ids[7]), -0.3, 0.6))
    assert list(other.world.sprites())[2] == sprite


@pytest.mark.unit
def test_with_the_universe_every_id_is_an_action() -> None:
    env = make(action_ids="universe")
    ids = env.reset(seed=0)[1]["available_ids"]
    np.testing.assert_array_equal(ids, np.arange(2366))
    assert env.step(act(2365))[4]["placement"] == "no_op"
    assert env.step(act(360, -0.3, 0.6))[4]["placement"] == "placed"


@pytest.mark.unit
def test_the_analysis_uses_the_3_degree_list() -> None:
    env = make(split="analysis", split_part="test")
    ids = env.reset(seed=0)[1]["available_ids"]
    assert ids[0] == 10876
    assert set(ids[1:].tolist()) <= set(analysis_ids().tolist())
    assert set(make(split="full", split_part="all").reset(seed=0)[1]["available_ids"][1:]) <= set(
        full_ids().tolist()
    )


@pytest.mark.unit
def test_info_of_a_step_and_of_the_end() -> None:
    env = make("GoalTest", action_ids="universe")
    _, info = env.reset(seed=0)
    keys = {"available_ids", "goal_hit", "target_hit", "placement"}
    assert set(info) == keys
    hits, total, ended = [], 0.0, False
    while not ended:
        _, reward, terminated, truncated, info = env.step(act(2365))
        hits.append(info["goal_hit"])
        total += reward
        ended = terminated or truncated
        assert set(info) == (keys | {"ends", "summary"} if ended else keys)
    assert hits == [0, 0] + [1] * 10
    assert info["ends"] == ("still",)
    assert info["summary"] == {
        "length": 12,
        "goal_hit": 1,
        "target_hit": 0,
        "reward": pytest.approx(total),
        "subgoal_reward": 0.0,
        "dense_reward": 0.0,
        "num_placed": 0,
        "num_no_op": 12,
        "num_blocked": 0,
        "num_invalid": 0,
    }


@pytest.mark.contract
def test_the_limit_truncates_and_the_rest_terminates() -> None:
    env = make("Navigate", step_limit=2, action_ids="universe")
    env.reset(seed=0)
    ends = [env.step(act(2365))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(RuntimeError, match="over"):
        env.step(act(2365))


@pytest.mark.contract
def test_acting_before_reset_is_refused() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        make().step(act(0))


@pytest.mark.contract
@pytest.mark.parametrize(
    ("action", "message"),
    [
        (act(50), "index=50 is not in 0..49"),
        (act(-1), "index=-1"),
        ({"index": 0}, "must be"),
        ({"index": 0, "position": [0.0]}, "must be"),
        ({"index": 0, "position": [0.0, float("nan")]}, "finite"),
        (3, "must be"),
    ],
)
def test_wrong_actions_are_refused(action: object, message: str) -> None:
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.contract
def test_positions_are_clipped() -> None:
    env = make(action_ids="universe")
    env.reset(seed=0)
    assert env.step(act(72, 3.0, -5.0))[4]["placement"] == "placed"
    assert env.world.tool_positions == [(1.0, -1.0)]


@pytest.mark.unit
def test_would_be_valid_agrees_with_placing_and_changes_nothing() -> None:
    env, rng, verdicts = make("Obstacle", action_ids="universe"), np.random.default_rng(2), []
    env.reset(seed=0)
    for _ in range(25):
        tool, position = int(rng.integers(2365)), rng.uniform(-1, 1, 2)
        before = env.world.positions, len(env.world.tools)
        said = env.would_be_valid(tool, position)
        assert (env.world.positions, len(env.world.tools)) == before
        _, _, terminated, _, info = env.step({"index": tool, "position": position})
        assert said == (info["placement"] == "placed")
        verdicts.append(said)
        if terminated:
            break
    assert {True, False} == set(verdicts)
    assert not env.would_be_valid(2365, (0.0, 0.9))
    assert not env.would_be_valid(72, (1.5, 0.0))


@pytest.mark.contract
def test_settings_matter() -> None:
    env = make("Moving", min_tool_distance=0.8, action_ids="universe")
    env.reset(seed=0)
    env.step(act(0, 0.0, 0.0))
    assert env.step(act(0, 0.0, -0.7))[4]["placement"] == Placement.BLOCKED
    fast = make("Navigate", stop_speed=1e9, action_ids="universe")
    fast.reset(seed=0)
    assert fast.step(act(2365))[2] is False
    assert fast.step(act(2365))[2] is True
    eager = make("Push", move_threshold=0.0, action_ids="universe")
    eager.reset(seed=0)
    assert eager.step(act(2365))[1] == pytest.approx(1.01)
    alive = make("Push", rewards=RewardConfig(alive=0.5, no_op=0.25), action_ids="universe")
    alive.reset(seed=0)
    assert alive.step(act(2365))[1] == pytest.approx(0.75)


@pytest.mark.unit
def test_a_level_object_will_do() -> None:
    assert CreateEnv(load_level("Funnel"), config=BLIND).level.name == "Funnel"
    with pytest.raises(ValueError, match="render_mode"):
        CreateEnv("Push", config=BLIND, render_mode="human")


@pytest.mark.unit
def test_pictures_come_from_the_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets the sprites of the moment, before reached subgoals are removed."""
    seen = []

    def draw(sprites: tuple, mode: str, size: int = 0) -> np.ndarray:
        seen.append((mode, size, [sprite.kind.value for sprite in sprites]))
        return np.zeros((size, size), np.uint8)

    renderer = ModuleType("envs_host.create.drawing")
    renderer.draw = draw
    monkeypatch.setitem(sys.modules, "envs_host.create.drawing", renderer)
    env = CreateEnv("Belt", True, CreateConfig(render_size=40, action_ids="universe"))
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == (40, 40)
    assert seen[0][:2] == ("gray", 40)
    target = env.world.target.body
    target.position, target.velocity = ((-0.15 + 1) * 42, (0.28 + 1) * 42), (0.0, 1.3)
    env.step(act(2365))
    env.step(act(2365))
    assert [kinds.count("subgoal") for _, _, kinds in seen] == [3, 3, 2]


@pytest.mark.unit
def test_without_a_renderer_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envs_host.create.drawing", None)
    with pytest.raises(ImportError, match="set observation='none'"):
        CreateEnv("Push")
