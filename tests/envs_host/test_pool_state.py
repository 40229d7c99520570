"""The state of a pool: small, and enough to go on exactly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_host.pool import HostPool, ReplayMismatch, WorkerError
from tests.envs_host.pool_toys import CHAOTIC, NAME
from tests.envs_host.test_pool_faults import numbers

NUM_ENVS, SEED = 8, 5


def actions(t: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(t)
    return rng.integers(0, 10, NUM_ENVS), rng.uniform(-1, 1, (NUM_ENVS, 2))


def play(pool: HostPool, times: range) -> list[np.ndarray]:
    return [value for t in times for value in numbers(pool.step(*actions(t)))]


def pool_of(num_workers: int = 2, num_halves: int = 2, seed: int = SEED, **kwargs: Any) -> HostPool:
    return HostPool(CHAOTIC, {}, NUM_ENVS, num_workers, seed, num_halves=num_halves, **kwargs)


@pytest.mark.integration
def test_resuming_is_exact_whatever_the_workers_and_halves(tmp_path: Path) -> None:
    with pool_of() as pool:
        pool.reset()
        pool.reset()  # So that episodes do not begin at 0.
        play(pool, range(30))
        current = pool.step(*actions(30)).observations.copy()
        state = pool.state_dict()
        expected = play(pool, range(31, 60))
        end = pool.state_dict()
    np.savez(tmp_path / "state.npz", **state)
    with np.load(tmp_path / "state.npz") as loaded:
        saved = dict(loaded)
    for num_workers, num_halves in ((1, 1), (4, 2)):
        with pool_of(num_workers, num_halves, seed=0) as pool:
            np.testing.assert_array_equal(pool.load_state(saved), current)
            assert pool.seed == SEED
            for x, y in zip(play(pool, range(31, 60)), expected, strict=True):
                np.testing.assert_array_equal(x, y)
            for name, value in pool.state_dict().items():
                np.testing.assert_array_equal(value, end[name])
    assert (end["episodes"] > state["episodes"]).all()


@pytest.mark.integration
def test_a_pool_goes_back_to_an_earlier_state() -> None:
    with pool_of() as pool:
        pool.reset()
        play(pool, range(10))
        state = pool.state_dict()
        expected = play(pool, range(10, 30))
        pool.load_state(state)
        for x, y in zip(play(pool, range(10, 30)), expected, strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.unit
def test_the_state_has_the_running_episodes_only() -> None:
    with pool_of() as pool:
        pool.reset()
        play(pool, range(30))
        for now in range(30, 60):
            step = pool.step(*actions(now))
            is_end = step.terminated | step.truncated
            if is_end.any():
                break
        state = pool.state_dict()
        # Some episodes ended, and are empty; some did not.
        assert 0 < is_end.sum() < NUM_ENVS
        lengths = np.where(is_end, 0, step.metrics["length"])
        np.testing.assert_array_equal(state["lengths"], lengths)
        assert state["ids"].shape == (lengths.max(), NUM_ENVS)
        assert state["positions"].shape == (lengths.max(), NUM_ENVS, 2)
        for i in range(NUM_ENVS):
            length = state["lengths"][i]
            times = range(now + 1 - length, now + 1)
            np.testing.assert_array_equal(
                state["ids"][:length, i], [actions(t)[0][i] for t in times]
            )
            np.testing.assert_array_equal(
                state["positions"][:length, i],
                np.array([actions(t)[1][i] for t in times], np.float32).reshape(length, 2),
            )
            assert not state["ids"][length:, i].any()
            assert not state["positions"][length:, i].any()
        dtypes = {name: value.dtype.name for name, value in state.items()}
        assert dtypes == {
            "seed": "int64",
            "episodes": "int64",
            "lengths": "int64",
            "ids": "int32",
            "positions": "float32",
            "observation_crc": "int64",
        }


@pytest.mark.unit
def test_a_state_of_fixed_shape() -> None:
    with pool_of(1) as pool:
        pool.reset()
        shapes = {name: value.shape for name, value in pool.state_dict(25).items()}
        play(pool, range(3))
        state = pool.state_dict(25)
        assert {name: value.shape for name, value in state.items()} == shapes
        assert shapes["positions"] == (25, NUM_ENVS, 2)
        with pytest.raises(ValueError, match="num_steps=2, but an episode has run for 3 steps"):
            pool.state_dict(2)
        pool.load_state(state)
        np.testing.assert_array_equal(pool.state_dict()["ids"], state["ids"][:3])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": None}, r"lacks \['seed'\]"),
        ({"episodes": np.zeros(4, int)}, r"state\['episodes'\] has shape \(4,\); a pool of 8"),
        ({"ids": np.zeros((2, 8), np.int32)}, r"state\['positions'\] has shape"),
        ({"lengths": np.full(8, 4)}, r"lengths must be 0 .. 3"),
        ({"lengths": np.full(8, -1)}, r"lengths must be 0 .. 3"),
        ({"episodes": np.full(8, -1)}, "episodes at least 0"),
    ],
)
def test_a_state_that_is_none(changes: dict[str, Any], message: str) -> None:
    with pool_of(1) as pool:
        pool.reset()
        play(pool, range(3))
        good = pool.state_dict(3)
        changed = {name: value for name, value in {**good, **changes}.items() if value is not None}
        with pytest.raises(ValueError, match=message):
            pool.load_state(changed)
        for name, value in pool.state_dict(3).items():
            np.testing.assert_array_equal(value, good[name])


@pytest.mark.integration
def test_a_state_that_replays_to_something_else_is_refused() -> None:
    with pool_of(1) as pool:
        pool.reset()
        play(pool, range(3))
        state = pool.state_dict()
        state["positions"][1, 6, 1] += 0.5
        with pytest.raises(ReplayMismatch, match=r"environments \[6\] have other observations"):
            pool.load_state(state)
        with pytest.raises(RuntimeError, match="The pool is closed: replaying"):
            pool.reset()


@pytest.mark.integration
def test_an_episode_that_ends_while_it_is_replayed_is_refused() -> None:
    with HostPool(f"{NAME}:Unfaithful", {"how": "length"}, 4, 1, 0) as pool:
        pool.reset()
        for _ in range(3):
            pool.step(np.zeros(4, int), np.zeros((4, 2)))
        with pytest.raises(WorkerError, match="Replaying 3 actions, the episode ended after 1"):
            pool.load_state(pool.state_dict())


def numbered_episodes(pool: HostPool, num_episodes: int) -> list[list[float]]:
    """The rewards of the first episodes of an evaluation whose actions are their episode's."""
    pool.reset_numbered(7)
    rewards: list[list[float]] = [[] for _ in range(num_episodes + 64)]
    number = np.arange(pool.num_envs)
    while number.min() < num_episodes:
        t = np.array([len(rewards[n]) for n in number])
        ids = (3 * number + t) % 10
        positions = np.stack([np.sin(number + t), np.cos(number - t)], axis=1).astype(np.float32)
        step = pool.step(ids.astype(np.int32), positions)
        for i, n in enumerate(number):
            rewards[n].append(float(step.rewards[i]))
        number = number + np.where(step.terminated | step.truncated, pool.num_envs, 0)
        number = np.minimum(number, len(rewards) - 1)
    return rewards[:num_episodes]


@pytest.mark.integration
def test_numbered_episodes_are_the_same_in_pools_of_any_size() -> None:
    played = []
    for num_envs, num_workers, num_halves in ((8, 2, 2), (3, 1, 1)):
        with HostPool(CHAOTIC, {}, num_envs, num_workers, SEED, num_halves=num_halves) as pool:
            played.append(numbered_episodes(pool, 16))
    assert played[0] == played[1]
    assert len({tuple(rewards) for rewards in played[0]}) == 16
    assert min(len(rewards) for rewards in played[0]) < max(len(rewards) for rewards in played[0])


@pytest.mark.integration
def test_an_evaluation_has_no_state_and_training_goes_on_after_it() -> None:
    with pool_of() as pool:
        pool.reset()
        play(pool, range(10))
        state = pool.state_dict()
        expected = play(pool, range(10, 20))
        pool.reset_numbered(3)
        play(pool, range(5))
        with pytest.raises(RuntimeError, match="An evaluation has no state"):
            pool.state_dict()
        pool.load_state(state)
        for x, y in zip(play(pool, range(10, 20)), expected, strict=True):
            np.testing.assert_array_equal(x, y)
        assert pool.seed == SEED
