"""The reference figures of docs/grid_world.md, by their numbers there.

Layouts are written as there: "V4/4" is a vertical river at x = 4 with its opening at y = 4.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld, skill_universe
from envs_mjx.grid_world.environment import decode_layout, encode_layout
from envs_mjx.grid_world.play import record
from envs_mjx.grid_world.skills import moves_of, net_displacement, skill_name
from jaxnew.actions import random_halves_split
from jaxnew.environment import Action

pytestmark = pytest.mark.golden

ENV = GridWorld()
# Rewards are float32 sums of at most two terms near 1: one unit in the last place is 6e-8.
REWARD_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Played:
    """What happened in an episode, one entry per skill in the lists."""

    cells: list[tuple[int, int]]
    rewards: list[float]
    terminated: list[bool]
    truncated: list[bool]
    num_moves: int
    is_success: bool
    has_reached_subgoal: bool
    episode_return: float


@pytest.fixture(scope="module")
def step_env():
    return jax.jit(ENV.step_env)


@pytest.fixture(scope="module")
def play(step_env):
    """Plays skills in a layout such as "V4/4", without auto-reset."""

    def play(layout: str, skills: list[int]) -> Played:
        layout_id = encode_layout(layout[0] == "H", int(layout[1]), int(layout[3]))
        params = ENV.default_params.replace(fixed_layout=layout_id)
        _, state = ENV.reset(jax.random.key(0), params)
        cells, rewards, terminated, truncated = [], [], [], []
        for skill in skills:
            _, state, reward, is_terminated, is_truncated, info = step_env(
                jax.random.key(0), state, Action.of(skill), params
            )
            cells.append(tuple(state.agent_xy.tolist()))
            rewards.append(float(reward))
            terminated.append(bool(is_terminated))
            truncated.append(bool(is_truncated))
        return Played(
            cells=cells,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            num_moves=int(info["episode_length"]),
            is_success=bool(info["is_success"]),
            has_reached_subgoal=bool(info["has_reached_subgoal"]),
            episode_return=float(info["episode_return"]),
        )

    return play


def assert_rewards(played: Played, expected: list[float]) -> None:
    np.testing.assert_allclose(played.rewards, expected, atol=REWARD_TOLERANCE, rtol=0)
    np.testing.assert_allclose(played.episode_return, sum(expected), atol=REWARD_TOLERANCE, rtol=0)


def assert_ends_once(played: Played, kind: str) -> None:
    """The last skill ends the episode in the named way, and none before it."""
    ends = [False] * (len(played.cells) - 1) + [True]
    never = [False] * len(played.cells)
    assert played.terminated == (ends if kind == "terminated" else never)
    assert played.truncated == (ends if kind == "truncated" else never)


def assert_success(played: Played, num_moves: int) -> None:
    assert_ends_once(played, "terminated")
    assert played.is_success
    assert played.cells[-1] == (7, 7)
    assert played.num_moves == num_moves


def test_01_layouts_are_uniform_and_well_formed() -> None:
    keys = jax.random.split(jax.random.key(1), 42_000)
    observations, states = jax.jit(jax.vmap(ENV.reset, (0, None)))(keys, ENV.default_params)
    counts = np.bincount(states.layout, minlength=42)
    assert len(counts) == 42
    assert np.abs(counts - 1000).max() <= 150  # the page's bound, 4.8 standard deviations
    is_lava = np.asarray(observations).reshape(-1, 9, 9) == 9
    assert (is_lava.sum(axis=(1, 2)) == 6).all()
    rows_hit, columns_hit = is_lava.sum(axis=1).max(axis=1), is_lava.sum(axis=2).max(axis=1)
    assert (np.maximum(rows_hit, columns_hit) == 6).all()
    for line in (2, 6):
        assert is_lava[:, line, :].sum(axis=1).max() <= 1
        assert is_lava[:, :, line].sum(axis=1).max() <= 1


def test_02_skill_table() -> None:
    content = skill_universe().content
    assert content.shape == (1024, 5)
    assert len(np.unique(content, axis=0)) == 1024
    assert len(np.unique(net_displacement(), axis=0)) == 36
    names = {0: "RRRRR", 1: "DRRRR", 4: "RDRRR", 5: "DDRRR", 21: "DDDRR", 340: "RDDDD"}
    names |= {264: "RLRRD", 320: "RRRDD", 341: "DDDDD", 682: "LLLLL", 1012: "RDUUU"}
    names |= {1023: "UUUUU"}
    assert {skill_id: skill_name(skill_id) for skill_id in names} == names
    assert {i: skill_universe().action_names[i] for i in names} == names
    assert np.array_equal(moves_of(np.array([21, 1012])), [[1, 1, 1, 0, 0], [0, 1, 3, 3, 3]])


def test_03_shortest_path_through_the_opening(play) -> None:
    played = play("V4/4", [21, 320, 1012])
    assert played.cells == [(3, 4), (6, 6), (7, 7)]
    assert_rewards(played, [0.0, 0.1, 0.784])
    assert_success(played, num_moves=12)


def test_04_subgoal_entered_twice_is_paid_once(play) -> None:
    played = play("V4/4", [21, 264, 5])
    assert_rewards(played, [0.0, 0.1, 0.748])
    assert_success(played, num_moves=14)


def test_05_lava_ends_without_reward(play) -> None:
    played = play("V4/4", [0])
    assert played.cells == [(4, 1)]
    assert_rewards(played, [0.0])
    assert_ends_once(played, "terminated")
    assert (played.num_moves, played.is_success, played.has_reached_subgoal) == (3, False, False)


@pytest.mark.parametrize("layout", ["V3/1", "V5/7", "H3/1", "H4/5"])
def test_06_bumping_runs_into_the_time_limit(play, layout: str) -> None:
    played = play(layout, [682] * 10)
    assert played.cells == [(1, 1)] * 10
    assert_rewards(played, [0.0] * 10)
    assert_ends_once(played, "truncated")
    assert (played.num_moves, played.is_success) == (50, False)


def test_07_opening_below_the_start(play) -> None:
    played = play("H3/1", [341, 1, 0])
    assert_rewards(played, [0.1, 0.0, 0.784])
    assert_success(played, num_moves=12)


@pytest.mark.parametrize(
    ("layout", "skills", "rewards"),
    [("V3/7", [341, 1, 0], [0.0, 0.1, 0.784]), ("V4/1", [0, 340, 341], [0.1, 0.0, 0.784])],
)
def test_08_openings_at_the_walls(play, layout: str, skills: list, rewards: list) -> None:
    played = play(layout, skills)
    assert_rewards(played, rewards)
    assert_success(played, num_moves=12)


def test_09_subgoal_then_lava_in_one_skill(play) -> None:
    played = play("V4/4", [21, 682, 320])
    assert played.cells[-1] == (4, 5)
    assert_rewards(played, [0.0, 0.0, 0.1])
    assert_ends_once(played, "terminated")
    assert (played.num_moves, played.is_success, played.has_reached_subgoal) == (14, False, True)


def test_10_a_bump_is_counted(play) -> None:
    played = play("H5/6", [0, 341, 5])
    assert_rewards(played, [0.0, 0.1, 0.766])
    assert_success(played, num_moves=13)


def test_11_goal_on_move_48(play) -> None:
    played = play("H5/6", [1023] * 7 + [0, 341, 5])
    assert_rewards(played, [0.0] * 8 + [0.1, 0.136])
    assert_success(played, num_moves=48)


def test_12_time_limit_with_the_subgoal(play) -> None:
    played = play("H5/6", [1023] * 8 + [0, 341])
    assert played.cells[-1] == (6, 6)
    assert_rewards(played, [0.0] * 9 + [0.1])
    assert_ends_once(played, "truncated")
    assert (played.num_moves, played.is_success, played.has_reached_subgoal) == (50, False, True)


def test_13_observation_of_a_start() -> None:
    params = ENV.default_params.replace(fixed_layout=encode_layout(False, 5, 6))
    obs = np.asarray(ENV.reset(jax.random.key(0), params)[0])
    assert (obs.shape, obs.dtype) == ((81,), np.float32)
    assert (obs[10], obs[70], obs[51]) == (10, 8, 11)
    assert obs[[46, 47, 48, 49, 50, 52]].tolist() == [9] * 6
    assert ((obs == 2).sum(), (obs == 1).sum(), obs.sum()) == (32, 40, 187)


def test_14_subgoal_pays_once_within_a_skill(play) -> None:
    played = play("V4/1", [128])
    assert played.cells == [(4, 1)]
    assert_rewards(played, [0.1])
    assert (played.terminated, played.truncated, played.num_moves) == ([False], [False], 5)


def test_15_every_layout_needs_twelve_moves() -> None:
    """Breadth-first search over single moves on the observed grids."""
    layouts = jnp.arange(42)
    params = ENV.default_params.replace(fixed_layout=layouts)
    axes = jax.tree.map(lambda _: None, ENV.default_params).replace(fixed_layout=0)
    reset = jax.jit(jax.vmap(ENV.reset, (None, axes)))
    observations, _ = reset(jax.random.key(0), params)
    for grid in np.asarray(observations).reshape(42, 9, 9):
        distance = {(1, 1): 0}
        queue = deque(distance)
        while queue:
            x, y = queue.popleft()
            for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
                if grid[cell] not in (2, 9) and cell not in distance:
                    distance[cell] = distance[x, y] + 1
                    queue.append(cell)
        assert distance[7, 7] == 12


def test_16_random_policy() -> None:
    num_episodes = 40_000

    @jax.jit
    def run(key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Ten skills of each episode; what follows an end is masked out."""
        key_reset, key_scan = jax.random.split(key)
        params = ENV.default_params
        keys = jax.random.split(key_reset, num_episodes)
        _, state = jax.vmap(ENV.reset, (0, None))(keys, params)

        def body(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            state, is_dead, last = carry
            ids = jax.random.randint(key, (num_episodes,), 0, 1024)
            _, next_state, _, terminated, truncated, info = jax.vmap(
                ENV.step_env, (None, 0, 0, None)
            )(key, state, Action.of(ids), params)
            running = ~last["done"]
            info = {**info, "done": terminated | truncated}
            last = {k: jnp.where(running, info[k], v) for k, v in last.items()}
            is_dead = jnp.where(running, terminated & ~info["is_success"], is_dead)
            return (next_state, is_dead, last), None

        zeros = jnp.zeros(num_episodes, bool)
        last = {"done": zeros, "is_success": zeros, "has_reached_subgoal": zeros}
        last |= {"episode_return": zeros.astype(jnp.float32)}
        last |= {"episode_length": zeros.astype(jnp.int32)}
        carry, _ = jax.lax.scan(body, (state, zeros, last), jax.random.split(key_scan, 10))
        return carry[1], carry[2]

    is_dead, last = jax.tree.map(np.asarray, run(jax.random.key(16)))
    assert last["done"].all()
    # Tolerances are the page's.
    assert abs(last["is_success"].mean() - 0.0027) <= 0.0006
    assert abs(is_dead.mean() - 0.857) <= 0.006
    assert abs(last["has_reached_subgoal"].mean() - 0.126) <= 0.006
    assert abs(last["episode_return"].mean() - 0.0136) <= 0.001
    # The page has 22.7, that is +-0.05; 40,000 lengths of deviation 16 have a standard error of
    # 0.08, theirs the same: 0.05 + 4 * 0.08 * sqrt(2).
    assert abs(last["episode_length"].mean() - 22.7) <= 0.5


def test_17_play_data() -> None:
    stored = np.asarray(record(jax.random.key(17), np.array([0, 21]), 100_000)).astype(int)
    starts, ends = stored[:, :, 0], stored[:, :, -1]
    assert (starts.min(), starts.max()) == (1, 78)
    assert (stored.min(), stored.max()) == (1, 78)
    is_far = ((starts >= 6) & (starts <= 73)).all(axis=-1)
    for row, skill_id in enumerate((0, 21)):
        moved = (ends - starts)[row][is_far[row]]
        assert (moved == net_displacement()[skill_id]).all()
    # x moves 5, but 4, 3, 2, 1, 0 from x = 74..78: deviation 0.82, four standard errors at 100,000.
    assert abs((ends - starts)[0, :, 0].mean() - 4.808) <= 0.0104
    open_room = np.asarray(record(jax.random.key(17), np.array([0]), 1000, has_border=False))
    assert (open_room[0, :, -1, 0].astype(int) - open_room[0, :, 0, 0] == 5).all()


def test_18_split_sizes_hash_and_content() -> None:
    """Drawing the sets of 50 from a split belongs to jaxnew.sampling and its tests."""
    universe = skill_universe()
    split = random_halves_split(universe, seed=0)
    assert [len(split.ids(name)) for name in ("train", "validation", "test")] == [512, 256, 256]
    assert random_halves_split(universe, seed=0).hash == split.hash
    assert random_halves_split(universe, seed=1).hash != split.hash
    split.check(universe)
    keys = universe.action_hashes
    parts = [{keys[i] for i in split.ids(name)} for name in ("train", "validation", "test")]
    assert [len(part) for part in parts] == [512, 256, 256]
    assert not parts[0] & parts[1]
    assert not parts[0] & parts[2]
    assert not parts[1] & parts[2]
    assert np.array_equal(split.ids("all"), np.arange(1024))


def test_layout_ids_decode_as_recommended() -> None:
    """Orientation id // 21, position 3 + (id // 7) % 3, opening 1 + id % 7."""
    ids = [encode_layout(h, p, o) for h in (False, True) for p in (3, 4, 5) for o in range(1, 8)]
    assert ids == list(range(42))
    decoded = zip(*decode_layout(np.arange(42)), strict=True)
    assert [encode_layout(*row) for row in decoded] == ids
    with pytest.raises(ValueError, match=r"positions are 3\.\.5"):
        encode_layout(False, 2, 1)
    with pytest.raises(ValueError, match=r"openings 1\.\.7"):
        encode_layout(False, 3, 8)
