"""The whole transition table against plain NumPy, by the text of docs/grid_world.md.

Swept are all states in which a skill can begin: 42 layouts x the 42 interior cells that are
neither lava nor goal (39 walls and lava cells of the 81 cannot be stood on between skills, the goal
neither) x 1024 skills, at move 0; the opening counts as visited exactly where the agent stands on
it. A second sweep draws states near the time limit, with both values of the visited flag.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld, GridWorldState
from jaxnew.environment import Action

pytestmark = pytest.mark.oracle

ENV = GridWorld()


def oracle_grids() -> np.ndarray:
    """int8[42, 9, 9] ids [layout, x, y], by the sentences of "World" and "Layouts"."""
    grids = np.ones((42, 9, 9), np.int8)
    grids[:, [0, 8], :] = 2
    grids[:, :, [0, 8]] = 2
    grids[:, 7, 7] = 8
    for layout in range(42):
        orientation, position, opening = layout // 21, 3 + (layout // 7) % 3, 1 + layout % 7
        for along in range(1, 8):
            x, y = (position, along) if orientation == 0 else (along, position)
            grids[layout, x, y] = 11 if along == opening else 9
    return grids


def oracle_skill(
    grids: np.ndarray,
    layout: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    num_moves: np.ndarray,
    visited: np.ndarray,
    skill: np.ndarray,
) -> dict[str, np.ndarray]:
    """One skill by the six rules of "A step", for flat arrays of states, in float64."""
    x, y, num_moves, visited = x.copy(), y.copy(), num_moves.copy(), visited.copy()
    reward = np.zeros(len(x))
    ended, success = np.zeros(len(x), bool), np.zeros(len(x), bool)
    lava = np.zeros(len(x), bool)
    for t in range(5):
        move = (skill // 4**t) % 4
        running = ~ended
        num_moves += running  # rule 1
        target_x = x + np.choose(move, [1, 0, -1, 0])
        target_y = y + np.choose(move, [0, 1, 0, -1])
        target = grids[layout, target_x, target_y]
        enters = running & (target != 2)  # rule 2
        x, y = np.where(enters, target_x, x), np.where(enters, target_y, y)
        pays = enters & (target == 11) & ~visited  # rule 3
        reward += 0.1 * pays
        visited |= pays
        goal = enters & (target == 8)  # rule 4
        reward += goal * (1 - 0.9 * num_moves / 50)
        success |= goal
        lava |= enters & (target == 9)  # rule 5
        ended |= success | lava | (num_moves >= 50)  # rule 6
    return {
        "x": x,
        "y": y,
        "num_moves": num_moves,
        "visited": visited,
        "reward": reward,
        "terminated": success | lava,
        "truncated": ended & ~success & ~lava,
        "is_success": success,
    }


@jax.jit
def jax_skill(
    layout: jax.Array,
    x: jax.Array,
    y: jax.Array,
    num_moves: jax.Array,
    visited: jax.Array,
    skill: jax.Array,
) -> dict[str, jax.Array]:
    """The same from `GridWorld.step_env`."""

    def one(*args: jax.Array) -> dict[str, jax.Array]:
        layout, x, y, num_moves, visited, skill = args
        state = GridWorldState(layout, jnp.stack([x, y]), num_moves, visited, jnp.float32(0.0))
        _, state, reward, terminated, truncated, info = ENV.step_env(
            jax.random.key(0), state, Action.of(skill), ENV.default_params
        )
        return {
            "x": state.agent_xy[0],
            "y": state.agent_xy[1],
            "num_moves": state.num_moves,
            "visited": state.has_reached_subgoal,
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "is_success": info["is_success"],
        }

    return jax.vmap(one)(layout, x, y, num_moves, visited, skill)


def assert_same(grids: np.ndarray, states: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
    expected, got = oracle_skill(grids, *states), jax.device_get(jax_skill(*states))
    for name, value in expected.items():
        if name == "reward":
            # float32 sums of two terms below 1: a few units of 6e-8.
            np.testing.assert_allclose(got[name], value, atol=5e-7, rtol=0)
        else:
            np.testing.assert_array_equal(got[name], value, err_msg=name)
    return expected


def test_whole_transition_table() -> None:
    grids = oracle_grids()
    layout, x, y = (a.astype(np.int32) for a in np.nonzero(np.isin(grids, [1, 11])))
    assert len(layout) == 42 * 42
    outcomes = {"is_success": 0, "terminated": 0, "truncated": 0, "visited": 0}
    for rows in np.array_split(np.arange(len(layout)), 6):
        skill = np.tile(np.arange(1024, dtype=np.int32), len(rows))
        at = np.repeat(rows, 1024)
        visited = grids[layout[at], x[at], y[at]] == 11
        num_moves = np.zeros(len(at), np.int32)
        expected = assert_same(grids, (layout[at], x[at], y[at], num_moves, visited, skill))
        for name in outcomes:
            outcomes[name] += int(expected[name].sum())
    assert outcomes["truncated"] == 0
    assert min(outcomes["is_success"], outcomes["terminated"], outcomes["visited"]) > 10_000


def test_states_near_the_time_limit() -> None:
    grids = oracle_grids()
    rng = np.random.default_rng(0)
    layout, x, y = (a.astype(np.int32) for a in np.nonzero(np.isin(grids, [1, 11])))
    at = rng.integers(len(layout), size=300_000)
    visited = rng.random(len(at)) < 0.5
    visited |= grids[layout[at], x[at], y[at]] == 11
    num_moves = rng.integers(40, 50, size=len(at), dtype=np.int32)
    skill = rng.integers(1024, size=len(at), dtype=np.int32)
    expected = assert_same(grids, (layout[at], x[at], y[at], num_moves, visited, skill))
    at_limit = expected["num_moves"] == 50
    # Every kind of end falls on the last move somewhere, and some episodes go on.
    assert (at_limit & expected["is_success"]).any()
    assert (at_limit & expected["terminated"] & ~expected["is_success"]).any()
    assert (at_limit & expected["truncated"]).any()
    assert (~expected["terminated"] & ~expected["truncated"]).any()


def test_observations_of_every_state() -> None:
    """81 ids in x-major order, the agent on top, for each layout and interior cell."""
    grids = oracle_grids()
    layout, x, y = np.nonzero(grids != 2)
    expected = grids[layout].copy()
    expected[np.arange(len(layout)), x, y] = 10

    @jax.jit
    @jax.vmap
    def observe(layout: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        """The observation after a skill of no effect, which leaves the agent where it is."""
        zero, false = jnp.int32(0), jnp.bool_(False)
        state = GridWorldState(layout, jnp.stack([x, y]), zero, false, jnp.float32(0.0))
        key, invalid = jax.random.key(0), Action.of(-1)
        return ENV.step_env(key, state, invalid, ENV.default_params)[0]

    got = observe(*(jnp.asarray(a, jnp.int32) for a in (layout, x, y)))
    np.testing.assert_array_equal(got, expected.reshape(len(layout), 81))
