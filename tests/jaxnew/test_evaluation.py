"""Evaluation: known episodes, frozen statistics, numbers that do not depend on what runs beside."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from envs_mjx.grid_world import GridWorld, skill_universe
from jaxnew.actions import random_halves_split
from jaxnew.evaluation import (
    EVALUATION_SEED,
    mean_interval,
    measure,
    play,
    summarize,
    wilson_interval,
)
from jaxnew.policy import make_method
from jaxnew.rollout.contract import Policy, RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import Actions
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy

A, D = 24, 3
METHOD = make_method("ours")
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
LADDER = probe.ladder(A)
STATISTICS = RunningStatistics(
    jnp.array([3.0, 2.0, 0.1, 1.0]), jnp.array([9.0, 4.0, 1.0, 0.0]), jnp.float32(100.0)
)
SEED = 7
num_traces = 0


class CountedWorld(probe.TableWorld):
    """Counts how often it is traced."""

    def reset_env(self, key: jax.Array, params: Any) -> Any:
        global num_traces
        num_traces += 1
        return super().reset_env(key, params)


def rollout_of(env: Any, params: Any, width: int) -> DeviceRollout:
    """Evaluations read nothing of a config but whether observations are normalised."""
    return DeviceRollout(env, params, METHOD, RolloutConfig(), width)


@functools.cache
def ladder_of(width: int = 4) -> DeviceRollout:
    return rollout_of(CountedWorld(A), LADDER, width)


@functools.cache
def params() -> Any:
    shapes = METHOD.init(jax.random.key(0), jnp.zeros(4), D)
    return numpy_policy.randomized(shapes, seed=1)


def policy() -> Policy:
    return Policy(params(), STATISTICS)


def actions_of(ids: list[int] | np.ndarray, set_size: int = 4) -> Actions:
    return Actions.of(TABLE, np.asarray(ids), set_size, padded_size=5)


def run(
    set_size: int,
    ids: list[int] | np.ndarray,
    num_episodes: int,
    width: int = 4,
    seed: int = SEED,
    is_greedy: bool = False,
) -> Any:
    actions = actions_of(ids, set_size)
    return measure(ladder_of(width), policy(), actions, num_episodes, seed, is_greedy)


def known_episode(choose: Any) -> dict[str, float]:
    """The ladder climbed in NumPy; `choose` maps (rung) to an id."""
    rung, total, step, next_state = 0, 0.0, 0, np.asarray(LADDER.next_state)
    while step < int(LADDER.time_limit):
        step += 1
        action_id = choose(rung)
        reward = float(LADDER.reward[rung, action_id])
        total += reward
        is_over = bool(LADDER.terminates[rung, action_id])
        rung = int(next_state[rung, action_id])
        if is_over:
            break
    return {
        "is_success": float(reward > 0),
        "episode_return": total,
        "final_state": float(rung),
        "num_steps": float(step),
    }


def assert_episodes(got: dict[str, np.ndarray], expected: dict[str, float], count: int) -> None:
    assert set(got) == set(expected)
    for name, values in got.items():
        assert values.shape == (count,)
        np.testing.assert_allclose(values, expected[name], rtol=1e-5, err_msg=name)


@pytest.mark.oracle
def test_metrics_are_those_at_the_end_of_the_episode() -> None:
    """With one action to choose from, an episode is known. Action 3 climbs 4 rungs a step and is at
    the top after 3, where the evaluation goes on stepping until others have ended; action 0 climbs
    one and is stopped by the time limit of 4."""
    lengths = set()
    for action_id in range(8):
        expected = known_episode(lambda _, action_id=action_id: action_id)
        lengths.add(expected["num_steps"])
        assert_episodes(run(1, [action_id], 3), expected, 3)
    assert lengths == {3.0, 4.0}


@pytest.mark.oracle
def test_greedy_takes_the_best_of_the_set() -> None:
    """The set is the pool, in any order, so the most likely choice is known in every state; the
    observation is normalised with the given statistics."""
    for seed in range(6):
        ids = np.random.default_rng(seed).permutation(A)[:4]

        def choose(rung: int, ids: np.ndarray = ids) -> int:
            raw = np.asarray(LADDER.observations, np.float64)[rung]
            deviation = np.sqrt(np.asarray(STATISTICS.variance) + 1e-8)
            obs = np.clip((raw - np.asarray(STATISTICS.mean)) / deviation, -10, 10)
            return int(ids[numpy_policy.utilities(params(), obs, TABLE[ids]).argmax()])

        got = run(4, ids, 3, is_greedy=True)
        assert_episodes(got, known_episode(choose), 3)


@pytest.mark.oracle
def test_sampling_follows_the_policy() -> None:
    """First step of an episode, from the rung it leads to: `1 + id % 4`."""
    ids = np.array([0, 1, 2, 3])
    one_step = LADDER.replace(time_limit=jnp.int32(1))
    rollout = rollout_of(probe.TableWorld(A), one_step, width=1000)
    soft = jax.tree.map(lambda x: x / 2, params())
    rungs = measure(rollout, Policy(soft, STATISTICS), Actions.of(TABLE, ids, 4), 4000, SEED)[
        "final_state"
    ]
    deviation = np.sqrt(np.asarray(STATISTICS.variance) + 1e-8)
    obs = (np.asarray(LADDER.observations)[0] - np.asarray(STATISTICS.mean)) / deviation
    expected = 4000 * special.softmax(numpy_policy.utilities(soft, obs, TABLE[ids]))
    assert expected.min() > 20
    assert np.ptp(expected) > 200
    counts = np.bincount(rungs.astype(int), minlength=5)[1:]
    # Fixed key; right frequencies fail for one key in a million.
    assert ((counts - expected) ** 2 / expected).sum() < stats.chi2.isf(1e-6, 3)


@pytest.mark.property
def test_an_episode_does_not_depend_on_the_others() -> None:
    ids = np.arange(20)
    many = run(4, ids, 11)
    assert all(len(values) == 11 for values in many.values())
    # Ten episodes and more are not all alike, and blocks of four do not repeat.
    returns = many["episode_return"]
    assert len(np.unique(returns)) >= 9
    for count in (1, 4, 6):
        few = run(4, ids, count)
        for name, values in few.items():
            np.testing.assert_array_equal(values, many[name][:count])
    # Another width is another program, but the same sets, starts and choices.
    wide = run(4, ids, 11, width=16)
    for name, values in wide.items():
        np.testing.assert_allclose(values, many[name], rtol=1e-5)


@pytest.mark.property
def test_numbers_depend_on_the_key_alone() -> None:
    ids = np.arange(20)
    first, again = run(4, ids, 8), run(4, ids, 8)
    other = run(4, ids, 8, seed=8)
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
    assert (first["episode_return"] != other["episode_return"]).any()


@pytest.mark.property
def test_pools_of_every_size_run_the_same_program() -> None:
    run(4, np.arange(20), 1)
    before = num_traces
    returns = [
        run(4, ids, 4)["episode_return"].mean()
        for ids in (np.arange(12), np.arange(12, 18), np.arange(18, 24), np.arange(20, 24))
    ]
    assert num_traces == before > 0
    assert len(set(returns)) == 4


@pytest.mark.unit
def test_requests_that_cannot_be_met_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Sets of 4 .* 3 .*1\.\.3"):
        run(4, [0, 1, 2], 1)
    with pytest.raises(ValueError, match=r"num_episodes=0 must be at least 1"):
        run(4, np.arange(20), 0)
    for first, count in ((-1, 2), (0, 0)):
        with pytest.raises(ValueError, match=rf"first={first} .* count={count}"):
            play(ladder_of(), policy(), actions_of(np.arange(20)), first, count)


@pytest.mark.oracle
def test_random_play_in_grid_world() -> None:
    """docs/grid_world.md, "Anchors": of 40,000 episodes of uniform random skills.

    A policy with zero score weights is exactly uniform. Tolerances are four standard errors of the
    difference between 20,000 episodes and the anchor's 40,000, sigma * sqrt(1/20,000 + 1/40,000)
    with sigma = sqrt(0.0027), sqrt(0.126 * 0.874), 0.05 and 15, and the anchor's last digit.
    """
    env = GridWorld()
    rollout = rollout_of(env, env.default_params, width=2000)
    fresh = METHOD.init(jax.random.key(0), jnp.zeros(81), D)
    fresh["utility"]["score"] = jax.tree.map(jnp.zeros_like, fresh["utility"]["score"])
    split = random_halves_split(skill_universe(), seed=0)
    table = jax.random.normal(jax.random.key(1), (1024, D))
    episodes = measure(
        rollout,
        Policy(fresh, RunningStatistics.zeros((81,))),
        Actions.of(table, split.ids("all"), 50),
        num_episodes=20_000,
        seed=2,
    )
    assert all(len(values) == 20_000 for values in episodes.values())
    anchors = {
        "is_success": (0.0027, 0.0018),
        "has_reached_subgoal": (0.126, 0.012),
        "episode_return": (0.0136, 0.0018),
        "episode_length": (22.7, 0.57),
    }
    for name, (anchor, tolerance) in anchors.items():
        assert abs(episodes[name].mean(dtype=np.float64) - anchor) < tolerance, name
    # An agent step is up to five moves, and an episode ends within ten.
    assert (episodes["num_steps"] == np.ceil(episodes["episode_length"] / 5)).all()
    assert episodes["num_steps"].max() == 10


@pytest.mark.oracle
def test_intervals_are_wilson_for_proportions_and_normal_for_the_rest() -> None:
    rng = np.random.default_rng(4)
    episodes = {
        "is_success": (np.arange(50) < 3).astype(np.float32),
        "has_reached_subgoal": np.zeros(50, np.float32),
        "episode_return": rng.normal(2.0, 3.0, 50).astype(np.float32),
        "num_steps": np.ones(50, np.float32),  # Zeros and ones, yet no proportion.
    }
    summary = summarize(episodes)
    assert set(summary) == set(episodes)
    for name, successes in (("is_success", 3), ("has_reached_subgoal", 0)):
        wilson = stats.binomtest(successes, 50).proportion_ci(0.95, method="wilson")
        got = summary[name]
        assert got["interval"] == "Wilson 95 %"
        np.testing.assert_allclose(
            [got["mean"], got["low"], got["high"]],
            [successes / 50, wilson.low, wilson.high],
            atol=1e-6,
        )
    returns = episodes["episode_return"].astype(np.float64)
    half = stats.norm.ppf(0.975) * returns.std(ddof=1) / np.sqrt(50)
    got = summary["episode_return"]
    assert got["interval"] == "normal 95 %"
    np.testing.assert_allclose(
        [got["mean"], got["low"], got["high"]],
        [returns.mean(), returns.mean() - half, returns.mean() + half],
        rtol=1e-6,
    )
    assert summary["num_steps"] == {"mean": 1.0, "low": 1.0, "high": 1.0, "interval": "normal 95 %"}


class Patient(probe.TableWorld):
    """Says that episodes may last longer than they do."""

    def max_episode_steps(self, params: Any) -> int:
        return 3 * super().max_episode_steps(params)


@pytest.mark.unit
def test_nothing_counts_after_a_time_limit() -> None:
    rollout = rollout_of(Patient(A), LADDER, width=4)
    climbs_one = 4  # 4 % 4 = 0: one rung a step, so that four steps stay below the top.
    found = measure(rollout, policy(), Actions.of(TABLE, np.array([climbs_one]), 1), 2, SEED)
    np.testing.assert_array_equal(found["num_steps"], [4, 4])
    np.testing.assert_array_equal(found["final_state"], [4, 4])


@pytest.mark.property
def test_played_episodes_are_those_that_are_measured() -> None:
    """Over the border of a block; with every state, and with nothing of what came after the end."""
    ids = np.arange(20)
    numbers = run(4, ids, 11)
    found = play(ladder_of(), policy(), actions_of(ids), 2, 7, SEED)
    assert [episode.number for episode in found] == list(range(2, 9))
    seen = set()
    for episode in found:
        expected = {name: float(values[episode.number]) for name, values in numbers.items()}
        # The same program but for what it returns.
        assert episode.metrics == pytest.approx(expected, rel=1e-5)
        steps = int(episode.metrics["num_steps"])
        assert len(episode.actions) == len(episode.rewards) == len(episode.states) - 1 == steps
        assert sum(episode.rewards) == pytest.approx(episode.metrics["episode_return"], rel=1e-5)
        rungs = [int(state.state) for state in episode.states]
        assert rungs[0] == 0
        assert rungs[-1] == episode.metrics["final_state"]
        next_state = np.asarray(LADDER.next_state)
        for rung, action_id, after in zip(rungs, episode.action_ids, rungs[1:], strict=False):
            assert action_id in episode.available_ids
            assert next_state[rung, action_id] == after
        assert len(set(episode.available_ids.tolist())) == 4
        assert episode.seed is None
        seen |= {tuple(sorted(episode.available_ids.tolist()))}
    assert len(seen) > 4
    (alone,) = play(ladder_of(), policy(), actions_of(ids), 6, 1, SEED)
    assert alone.action_ids == found[4].action_ids
    np.testing.assert_array_equal(alone.available_ids, found[4].available_ids)


@pytest.mark.property
def test_a_growing_set_offers_its_beginning() -> None:
    """At first one action, then two, ...: what is chosen stands among the first of the set."""
    ids = np.arange(20)
    whole = play(ladder_of(), policy(), actions_of(ids), 0, 8, SEED)
    growing = play(ladder_of(), policy(), actions_of(ids).growing(1), 0, 8, SEED)
    for episode, same in zip(growing, whole, strict=True):
        np.testing.assert_array_equal(episode.available_ids, same.available_ids)
        for t, action_id in enumerate(episode.action_ids):
            assert action_id in episode.available_ids[: 1 + t]
    assert any(a.action_ids != b.action_ids for a, b in zip(growing, whole, strict=True))


@pytest.mark.unit
def test_all_runs_are_evaluated_on_the_same_episodes() -> None:
    assert EVALUATION_SEED == 2020
    ids = np.arange(20)
    default = measure(ladder_of(), policy(), actions_of(ids), 4)
    for name, values in run(4, ids, 4, seed=2020).items():
        np.testing.assert_array_equal(values, default[name])


# Intervals.


@pytest.mark.unit
def test_wilson_interval_worked_example() -> None:
    # 8 of 10, z = 1.96: centre (0.8 + 0.19208) / 1.38416 = 0.71674, half width 0.22659.
    interval = wilson_interval(8, 10)
    assert interval.mean == 0.8
    assert interval.low == pytest.approx(0.49016, abs=1e-4)
    assert interval.high == pytest.approx(0.94333, abs=1e-4)


@pytest.mark.property
@settings(max_examples=100, deadline=None)
@given(st.integers(1, 1000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_is_that_of_the_formula(case: tuple[int, int]) -> None:
    """SciPy's is used, so the formula is written out here: z^2 / n shrinks towards a half."""
    successes, trials = case
    z = stats.norm.ppf(0.975)
    share, extra = successes / trials, z**2 / trials
    center = (share + extra / 2) / (1 + extra)
    half = z * np.sqrt(share * (1 - share) / trials + extra / (4 * trials)) / (1 + extra)
    interval = wilson_interval(successes, trials)
    # Float rounding only.
    assert interval.low == pytest.approx(max(0.0, center - half), abs=1e-9)
    assert interval.high == pytest.approx(min(1.0, center + half), abs=1e-9)
    assert 0.0 <= interval.low <= interval.mean <= interval.high <= 1.0


@pytest.mark.unit
def test_mean_interval() -> None:
    # Standard deviation of 1, 2, 3 is 1; half width 1.95996 / sqrt(3) = 1.13159.
    interval = mean_interval(np.array([1, 2, 3]))
    assert interval.mean == 2.0
    assert interval.high - 2.0 == pytest.approx(1.13159, abs=1e-5)
    assert 2.0 - interval.low == pytest.approx(1.13159, abs=1e-5)
    assert mean_interval(np.array([4.0])) == (4.0, 4.0, 4.0)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("successes", "trials", "message"),
    [(0, 0, "n must be"), (-1, 3, "k must be"), (4, 3, "k .*n"), (0, -3, "n must be")],
)
def test_impossible_proportions_are_refused(successes: int, trials: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wilson_interval(successes, trials)


@pytest.mark.unit
@pytest.mark.parametrize("values", [np.zeros(0), np.zeros((2, 2)), np.float64(1)])
def test_means_need_a_vector(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="non-empty vector"):
        mean_interval(values)
