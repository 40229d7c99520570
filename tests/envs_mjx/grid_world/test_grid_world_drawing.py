"""Pictures of Grid World have the right sizes, and the right things in the right places."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld, GridWorldState, drawing
from envs_mjx.grid_world.environment import encode_layout
from jaxnew.environment import Action

pytestmark = pytest.mark.unit

CELL = 20
PIXELS = 9 * CELL


def state_at(x: int, y: int, layout: int = 10, num_moves: int = 0) -> GridWorldState:
    """By default in V4/4: river at x = 4, opening at (4, 4)."""
    return GridWorldState(
        layout=jnp.int32(layout),
        agent_xy=jnp.array([x, y]),
        num_moves=jnp.int32(num_moves),
        has_reached_subgoal=jnp.bool_(False),
        episode_return=jnp.float32(0.0),
    )


def center_of(image: np.ndarray, x: int, y: int) -> tuple[int, ...]:
    return tuple(image[CELL * y + CELL // 2, CELL * x + CELL // 2].tolist())


def test_sizes() -> None:
    plain = drawing.draw_state(state_at(1, 1), pixels=PIXELS)
    assert (plain.shape, plain.dtype) == ((PIXELS, PIXELS, 3), np.uint8)
    assert drawing.draw_state(state_at(1, 1), pixels=100).shape == (99, 99, 3)
    captioned = drawing.draw_state(state_at(1, 1), pixels=PIXELS, caption="RRDLU")
    assert captioned.shape[1:] == (PIXELS, 3)
    assert captioned.shape[0] > PIXELS
    assert np.array_equal(captioned[:PIXELS], plain)
    assert len(np.unique(captioned[PIXELS:])) > 2  # there is text
    for pixels in (50, 10**6):
        with pytest.raises(ValueError, match=f"pixels={pixels} must be 90 to 4,096"):
            drawing.draw_state(state_at(1, 1), pixels=pixels)


def test_every_kind_of_cell_looks_different() -> None:
    image = drawing.draw_state(state_at(1, 1), pixels=PIXELS)
    cells = [
        image[CELL * y + 2 : CELL * (y + 1) - 2, CELL * x + 2 : CELL * (x + 1) - 2]
        for x, y in [(0, 0), (2, 2), (4, 2), (4, 4), (7, 7), (1, 1)]
    ]
    means = np.array([cell.reshape(-1, 3).mean(axis=0) for cell in cells])
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1)
    assert (distances[~np.eye(6, dtype=bool)] > 25).all(), distances.round()


def test_things_are_where_the_state_says() -> None:
    assert encode_layout(False, 4, 4) == 10
    image = drawing.draw_state(state_at(2, 6), pixels=PIXELS)
    assert center_of(image, 2, 6) == drawing.AGENT_COLOR
    assert center_of(image, 6, 2) == drawing.FLOOR_COLOR
    assert center_of(image, 4, 4) == drawing.SUBGOAL_MARK_COLOR
    assert center_of(image, 0, 5) == drawing.WALL_COLOR
    horizontal = drawing.draw_state(state_at(2, 6, encode_layout(True, 3, 5)), pixels=PIXELS)
    assert center_of(horizontal, 5, 3) == drawing.SUBGOAL_MARK_COLOR
    # The same picture again: the cached background was not drawn upon.
    assert np.array_equal(drawing.draw_state(state_at(2, 6), pixels=PIXELS), image)
    on_lava = drawing.draw_state(state_at(4, 2), pixels=PIXELS)
    assert (on_lava[CELL * 2 : CELL * 3, CELL * 4 : CELL * 5] != drawing.AGENT_COLOR).any(-1).all()


def test_path_covers_its_cells() -> None:
    """R R D: the line runs through the cells of the path and leaves the others alone."""
    path = [(1, 1), (2, 1), (3, 1), (3, 2)]
    without = drawing.draw_state(state_at(3, 2), pixels=PIXELS)
    with_path = drawing.draw_state(state_at(3, 2), path, pixels=PIXELS)
    changed = (with_path != without).any(axis=-1).reshape(9, CELL, 9, CELL).any(axis=(1, 3))
    assert {(int(x), int(y)) for y, x in np.argwhere(changed)} == set(path)
    # A path of bumps only, and one over its own track.
    assert np.array_equal(drawing.draw_state(state_at(3, 2), [(3, 2)] * 3, pixels=PIXELS), without)
    back = [(1, 1), (2, 1), (1, 1), (2, 1)]
    assert (drawing.draw_state(state_at(3, 2), back, pixels=PIXELS) != without).any()


def test_skill_path_stops_where_the_episode_did() -> None:
    """V4/4: R R R R R dies on (4, 1) after three moves; L bumps; an invalid id stays."""
    died = drawing.skill_path(state_at(1, 1), state_at(4, 1, num_moves=3), 0)
    assert list(died) == [(1, 1), (2, 1), (3, 1), (4, 1)]
    bumped = drawing.skill_path(state_at(1, 1), state_at(1, 1, num_moves=5), 682)
    assert list(bumped) == [(1, 1)] * 6
    invalid = drawing.skill_path(state_at(2, 2), state_at(2, 2, num_moves=5), -1)
    assert list(invalid) == [(2, 2)] * 6


def test_frames_of_an_episode() -> None:
    """V4/4, skills 21, 320, 1012: a start and twelve moves."""
    env = GridWorld()
    params = env.default_params.replace(fixed_layout=10)
    step_env = jax.jit(env.step_env)
    skills, rewards = [21, 320, 1012], []
    states = [env.reset(jax.random.key(0), params)[1]]
    for skill in skills:
        _, state, reward, *_ = step_env(jax.random.key(0), states[-1], Action.of(skill), params)
        states.append(state)
        rewards.append(float(reward))
    frames = drawing.draw_episode(states, skills, rewards, pixels=PIXELS)
    assert len(frames) == 13
    assert len({frame.shape for frame in frames}) == 1
    assert center_of(frames[-1], 7, 7) == drawing.AGENT_COLOR
    way = drawing.draw_way(states, skills, rewards, PIXELS)
    assert way.shape == frames[0].shape
    # All of the path, not of the last skill alone: the start's cell has its colour, too.
    assert not np.array_equal(way[:PIXELS], frames[-1][:PIXELS])
    with pytest.raises(ValueError, match="T skills need"):
        drawing.draw_episode(states, skills[:2], rewards)
