"""The pool against a plain loop over the same environments, and its manners."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs_host import pool as pool_module
from envs_host.pool import HostPool, HostStep, WorkerError
from tests.envs_host.pool_toys import CHAOTIC, NAME, Chaotic

ROOT = Path(__file__).resolve().parents[2]
NUM_ENVS, NUM_STEPS, SEED = 8, 60, 3


def actions(num_steps: int = NUM_STEPS) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    return [
        (rng.integers(0, 10, NUM_ENVS), rng.uniform(-1, 1, (NUM_ENVS, 2))) for _ in range(num_steps)
    ]


def serial(num_steps: int = NUM_STEPS) -> dict[str, np.ndarray]:
    """What a loop over environments gives, stacked over steps; independent of the pool's code."""
    envs, episodes = [Chaotic() for _ in range(NUM_ENVS)], [0] * NUM_ENVS

    def start(i: int) -> np.ndarray:
        return envs[i].reset(np.random.SeedSequence(SEED, spawn_key=(i, episodes[i])))

    columns: dict[str, list[list[Any]]] = {"observations": [[start(i) for i in range(NUM_ENVS)]]}
    for ids, positions in actions(num_steps):
        rows: dict[str, list[Any]] = {}
        for i, env in enumerate(envs):
            position = positions[i].astype(np.float32)
            final, reward, terminated, truncated, metrics = env.step(int(ids[i]), position)
            observation = final
            if terminated or truncated:
                episodes[i] += 1
                observation = start(i)
            values = {
                "observations": observation,
                "final_observations": final,
                "rewards": np.float32(reward),
                "terminated": terminated,
                "truncated": truncated,
                "length": np.float32(metrics["length"]),
                "total": np.float32(metrics["total"]),
            }
            for name, value in values.items():
                rows.setdefault(name, []).append(value)
        for name, row in rows.items():
            columns.setdefault(name, []).append(row)
    return {name: np.array(column) for name, column in columns.items()}


def entries(step: HostStep) -> dict[str, np.ndarray]:
    """Copies of everything in a step."""
    named = {name: value for name, value in vars(step).items() if name != "metrics"}
    return {name: np.array(value) for name, value in {**named, **step.metrics}.items()}


def rollout(pool: HostPool, num_steps: int = NUM_STEPS) -> dict[str, np.ndarray]:
    """The same of a pool, by `step`."""
    columns: dict[str, list[np.ndarray]] = {"observations": [pool.reset().copy()]}
    for ids, positions in actions(num_steps):
        for name, value in entries(pool.step(ids, positions)).items():
            columns.setdefault(name, []).append(value)
    return {name: np.array(column) for name, column in columns.items()}


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """To the bit."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].dtype == value.dtype, name
        np.testing.assert_array_equal(found[name], value, err_msg=name)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("num_workers", "num_halves"), [(1, 1), (1, 2), (2, 1), (2, 2), (3, 2), (4, 2), (2, 4)]
)
def test_any_number_of_workers_and_halves_gives_the_rollout_of_a_loop(
    num_workers: int, num_halves: int
) -> None:
    expected = serial()
    with HostPool(CHAOTIC, {}, NUM_ENVS, num_workers, SEED, num_halves=num_halves) as pool:
        assert_same(rollout(pool), expected)
        np.testing.assert_array_equal(
            pool.episodes, (expected["terminated"] | expected["truncated"]).sum(0)
        )
    # The rollout has what it is to test: both ends, several episodes of every environment.
    assert expected["terminated"].any(0).all()
    assert expected["truncated"].any()
    assert expected["terminated"].sum() > 3 * NUM_ENVS


@pytest.mark.oracle
def test_halves_overlap_and_come_back_in_any_order() -> None:
    expected = serial(20)
    with HostPool(CHAOTIC, {}, NUM_ENVS, 2, SEED) as pool:
        pool.reset()
        first, second = pool.rows(0), pool.rows(1)
        for t, (ids, positions) in enumerate(actions(20)):
            pool.send(0, ids[first], positions[first])
            pool.send(1, ids[second], positions[second])
            order = (0, 1) if t % 3 else (1, 0)
            for half in order:
                found, rows = entries(pool.receive(half)), pool.rows(half)
                observations = found.pop("observations")
                np.testing.assert_array_equal(observations, expected["observations"][t + 1, rows])
                assert_same(found, {name: expected[name][t, rows] for name in found})


@pytest.mark.oracle
def test_a_half_may_run_ahead() -> None:
    expected, steps = serial(20), actions(20)
    with HostPool(CHAOTIC, {}, NUM_ENVS, 2, SEED) as pool:
        pool.reset()
        for half in (1, 0):
            rows = pool.rows(half)
            for t, (ids, positions) in enumerate(steps):
                pool.send(half, ids[rows], positions[rows])
                found = entries(pool.receive(half))
                observations = found.pop("observations")
                np.testing.assert_array_equal(observations, expected["observations"][t + 1, rows])
                assert_same(found, {name: expected[name][t, rows] for name in found})


@pytest.mark.property
@given(st.integers(1, 6), st.integers(1, 20), st.data())
def test_workers_share_every_half_evenly(num_halves: int, size: int, data: st.DataObject) -> None:
    num_workers = data.draw(st.integers(1, size))
    setups = pool_module._setups("", {}, num_halves * size, num_workers, num_halves, False)
    for half in range(num_halves):
        held = [list(range(*setup.halves[half])) for setup in setups]
        together = [i for environments in held for i in environments]
        assert together == list(range(half * size, (half + 1) * size))
        assert {len(environments) for environments in held} <= {
            size // num_workers,
            -(-size // num_workers),
        }


@pytest.mark.unit
def test_a_second_reset_starts_the_next_episodes() -> None:
    with HostPool(CHAOTIC, {}, 4, 2, SEED) as pool:
        np.testing.assert_array_equal(pool.episodes, -1)
        for episode in range(3):
            found = pool.reset()
            for i in range(4):
                seed = np.random.SeedSequence(SEED, spawn_key=(i, episode))
                np.testing.assert_array_equal(found[i], Chaotic().reset(seed))
            np.testing.assert_array_equal(pool.episodes, episode)
            pool.step(np.zeros(4, int), np.zeros((4, 2)))


@pytest.mark.unit
def test_observations_are_views_and_the_rest_are_copies() -> None:
    with HostPool(CHAOTIC, {}, NUM_ENVS, 1, SEED) as pool:
        start = pool.reset()
        steps = [pool.step(*action) for action in actions(2)]
        assert np.shares_memory(steps[0].observations, steps[1].observations)
        assert np.shares_memory(steps[0].observations, start)
        assert np.shares_memory(steps[0].final_observations, steps[1].final_observations)
        for name in ("rewards", "terminated", "truncated"):
            assert not np.shares_memory(getattr(steps[0], name), getattr(steps[1], name))
        assert (steps[0].rewards != steps[1].rewards).all()
        assert not np.shares_memory(steps[0].metrics["total"], steps[1].metrics["total"])
        with pytest.raises(ValueError, match="read-only"):
            steps[1].observations[0] = 0.0
        with pytest.raises(ValueError, match="read-only"):
            start[0] = 0.0
        last = start.copy()
    np.testing.assert_array_equal(start, last)  # Also when the pool is closed.


@pytest.mark.unit
def test_what_the_environments_are() -> None:
    with HostPool(CHAOTIC, {}, 4, 2, SEED, num_halves=1) as pool:
        assert pool.observation_shape == (3, 2)
        assert pool.observation_dtype == np.float32
        assert pool.position_dim == 2
        assert pool.episode_metrics == ("length", "total")
        assert pool.rows(0) == slice(0, 4)
        assert len(set(pool.worker_pids)) == 2


@pytest.fixture
def ctrl_c_raises() -> Iterator[None]:
    """Also where the tests run in a shell's background, so that it is ignored from the start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.integration
def test_workers_have_no_jax_one_thread_and_no_ctrl_c(ctrl_c_raises: None) -> None:
    import jax

    assert jax.__name__ in sys.modules
    with HostPool(f"{NAME}:Spy", {}, 4, 2, SEED) as pool:
        pool.reset()
        spied = pool.step(np.zeros(4, int)).metrics
        np.testing.assert_array_equal(spied["has_jax"], 0)
        np.testing.assert_array_equal(spied["ignores_sigint"], 1)
        np.testing.assert_array_equal(spied["num_threads"], 1)
        np.testing.assert_array_equal(spied["num_cores"], len(os.sched_getaffinity(0)))
        pids = [pid % 2**16 for pid in pool.worker_pids]
        np.testing.assert_array_equal(spied["pid"], pids * 2)  # Both halves.


@pytest.mark.integration
def test_pinned_workers_keep_to_one_core_each() -> None:
    with HostPool(f"{NAME}:Spy", {}, 2, 2, SEED, num_halves=1, pin_cores=True) as pool:
        pool.reset()
        spied = pool.step(np.zeros(2, int)).metrics
        np.testing.assert_array_equal(spied["num_cores"], 1)
        pinned = [os.sched_getaffinity(pid) for pid in pool.worker_pids]
        assert len(set.union(*pinned)) == min(2, len(os.sched_getaffinity(0)))


@pytest.mark.integration
def test_what_workers_print_is_on_stderr_until_environments_are_closed() -> None:
    script = (
        "import numpy as np; from envs_host.pool import HostPool\n"
        f"with HostPool('{NAME}:Spy', {{}}, 4, 2, 0) as pool:\n"
        "    pool.reset(); pool.step(np.arange(4)); print('printed by the parent')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "printed by the parent\n"
    lines = done.stderr.splitlines()
    assert sorted(lines[:4]) == [f"printed by {i}" for i in range(4)]
    assert lines[4:] == ["closed"] * 4


@pytest.mark.integration
def test_a_gymnasium_environment_in_a_pool() -> None:
    factory, kwargs = "envs_host.protocol:GymnasiumHost.make", {"id": "CartPole-v1"}
    with HostPool(factory, kwargs, 4, 2, SEED) as pool:
        env = gymnasium.make("CartPole-v1")
        assert pool.observation_shape == (4,)
        assert pool.position_dim == 0
        starts = pool.reset().copy()
        found = [entries(pool.step(np.array([1, 0, 1, 1]))) for _ in range(5)]
    for i, action in enumerate([1, 0, 1, 1]):
        seed = np.random.SeedSequence(SEED, spawn_key=(i, 0)).generate_state(1, np.uint32)[0]
        start, _ = env.reset(seed=int(seed))
        np.testing.assert_array_equal(start, starts[i])
        for step in found:
            observation, reward, terminated, _, _ = env.step(action)
            np.testing.assert_array_equal(step["observations"][i], observation)
            assert step["rewards"][i] == reward
            assert step["terminated"][i] == terminated


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 7}, "num_envs=7 must be a multiple of num_halves=2; try 8"),
        ({"num_envs": 0}, "num_envs=0 must be a multiple of num_halves=2; try 2"),
        ({"num_workers": 0}, "num_workers=0 must be 1 .. 4"),
        ({"num_workers": 5}, "num_workers=5 must be 1 .. 4"),
        ({"num_halves": 0}, "num_halves=0 must be 1 .. 199"),
        ({"num_halves": 200, "num_envs": 200}, "num_halves=200 must be 1 .. 199"),
        ({"seed": -1}, "seed=-1 must be 0"),
        ({"seed": 2**63}, "must be 0 .. 2"),
        ({"on_worker_death": "ignore"}, "'ignore' must be 'raise' or 'restart'"),
        ({"timeout_s": 0.0}, "timeout_s=0.0 must be above 0 seconds"),
        ({"start_timeout_s": -1.0}, "start_timeout_s=-1.0 must be above 0 seconds"),
        ({"max_restarts": -1}, "max_restarts=-1 must be 0 or more"),
        ({"kwargs": {"split": np.zeros(3)}}, "must be plain numbers"),
    ],
)
def test_wrong_arguments(changes: dict[str, Any], message: str) -> None:
    arguments = {"factory": CHAOTIC, "kwargs": {}, "num_envs": 8, "num_workers": 2, "seed": 0}
    with pytest.raises(ValueError, match=message):
        HostPool(**{**arguments, **changes})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("factory", "kwargs", "message"),
    [
        ("tests.envs_host.pool_toys", {}, "must look like 'package.module:NAME'"),
        ("tests.envs_host.pool_toys:Nothing", {}, "tests.envs_host.pool_toys has no Nothing"),
        ("tests.envs_host.pool_toys:NAME", {}, "is a str and cannot be called"),
        ("tests.envs_host.no_such_module:X", {}, "ModuleNotFoundError"),
        (CHAOTIC, {"size": 3}, "TypeError"),
        (f"{NAME}:Broken", {"how": "int64"}, "observation_dtype=int64 must be uint8 or float32"),
        (f"{NAME}:Broken", {"how": "differing"}, "makes different environments"),
    ],
)
def test_a_factory_that_does_not_work(factory: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(WorkerError, match=message) as caught:
        HostPool(factory, kwargs, 4, 1, 0)
    assert caught.value.worker == 0
    assert caught.value.environments == (0, 1, 2, 3)
    # A broken promise is told without one.
    assert ("Traceback" in caught.value.traceback) != ("how" in kwargs)


@pytest.mark.unit
def test_workers_that_make_different_environments() -> None:
    with pytest.raises(ValueError, match="The workers made different environments"):
        HostPool(f"{NAME}:Broken", {"how": "process"}, 4, 2, 0)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("shape", r"observation is float32\[2\]; .* say float32\[3, 2\]"),
        ("dtype", r"observation is float64\[3, 2\]; .* say float32\[3, 2\]"),
        ("metrics", r"metrics of a step are \['length'\]; episode_metrics says"),
    ],
)
def test_an_environment_that_is_not_what_it_declares(how: str, message: str) -> None:
    with HostPool(f"{NAME}:Broken", {"how": how}, 4, 1, 0) as pool:
        pool.reset()
        with pytest.raises(WorkerError, match=message):
            pool.step(np.zeros(4, int), np.zeros((4, 2)))


@pytest.mark.unit
def test_wrong_calls() -> None:
    ids, positions = np.zeros(2, int), np.zeros((2, 2))
    with HostPool(CHAOTIC, {}, 4, 2, 0) as pool:
        for call in (lambda: pool.send(0, ids, positions), pool.state_dict):
            with pytest.raises(RuntimeError, match="No episode has begun"):
                call()
        pool.reset()
        with pytest.raises(RuntimeError, match="Half 0 is not running"):
            pool.receive(0)
        for half in (-1, 2):
            with pytest.raises(ValueError, match=rf"half={half} must be 0 .. 1"):
                pool.send(half, ids, positions)
        with pytest.raises(ValueError, match=r"ids are int64\[3\]; they must be integer\[2\]"):
            pool.send(0, np.zeros(3, int), positions)
        with pytest.raises(ValueError, match=r"ids are float64\[2\]"):
            pool.send(0, np.zeros(2), positions)
        with pytest.raises(ValueError, match="must fit into 32 bits"):
            pool.send(0, np.array([0, 2**31]), positions)
        with pytest.raises(ValueError, match=r"must be float\[2, 2\]"):
            pool.send(0, ids, np.zeros((2, 3)))
        with pytest.raises(ValueError, match=r"positions are int64\[2, 2\]"):
            pool.send(0, ids, np.zeros((2, 2), int))
        with pytest.raises(ValueError, match="positions are"):
            pool.send(0, ids)
        pool.send(0, ids, positions)
        with pytest.raises(RuntimeError, match="Half 0 is running"):
            pool.send(0, ids, positions)
        state = {}
        for call in (
            pool.reset,
            pool.state_dict,
            lambda: pool.load_state(state),
            lambda: pool.step(np.zeros(4, int), np.zeros((4, 2))),
        ):
            with pytest.raises(RuntimeError, match=r"Halves \[0\] are running"):
                call()
        pool.receive(0)
    for call in (
        pool.reset,
        lambda: pool.send(0, ids, positions),
        lambda: pool.receive(0),
        lambda: pool.step(np.zeros(4, int), np.zeros((4, 2))),
    ):
        with pytest.raises(RuntimeError, match=r"The pool is closed: close\(\) was called"):
            call()
    pool.close()  # A second time does nothing.
