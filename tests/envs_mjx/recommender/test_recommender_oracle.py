"""The Recommender against plain NumPy that plays every tick by the text of docs/recommender.md.

What a state and a product decide is compared number by number; what is drawn is compared as
distributions. The keys are fixed, and a sound environment fails one comparison in a thousand.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from envs_mjx.recommender import Recommender, RecommenderState, environment
from jaxnew.environment import Action

pytestmark = [pytest.mark.oracle, pytest.mark.optimized]

ENV = Recommender()
PARAMS = ENV.default_params
NUM_USERS = 20_000  # Of the JAX environment; the oracle, a Python loop, plays fewer.
MIN_P = 1e-3
ORGANIC, BANDIT, STOP = 0, 1, 2


def oracle_products() -> tuple[np.ndarray, np.ndarray]:
    """(beta [10000, 16], mu [10000]) by "Products", in float64."""
    rng = np.random.RandomState(123)
    raw = rng.normal(size=(10_000, 16))
    return raw / np.sqrt((raw**2).sum(axis=1))[:, None], rng.normal(0, 3, size=10_000)


BETA, MU = oracle_products()


def oracle_probability(x: np.ndarray) -> np.ndarray:
    """Of a click, by the formula of "Click probability"."""

    def sig(u: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-u))

    return sig(14 * sig(2 * sig(0.3 * x) - 2) - 6)


def oracle_tick(rng: np.random.Generator, omega: np.ndarray, mode: int) -> tuple[np.ndarray, int]:
    """A new mode, and omega always moves, by one |n| for all coordinates."""
    u = rng.random()
    if mode == ORGANIC:
        mode = ORGANIC if u < 0.74 else BANDIT if u < 0.99 else STOP
    elif mode == BANDIT:
        mode = ORGANIC if u < 0.05 else BANDIT if u < 0.99 else STOP
    sigma = 0.1 * abs(rng.normal())
    return omega + sigma * rng.normal(size=16), mode


def oracle_browse(rng: np.random.Generator, omega: np.ndarray) -> tuple[np.ndarray, int, int]:
    """(omega, mode, number of ticks) once the user no longer browses."""
    mode, num_ticks = ORGANIC, 0
    while mode == ORGANIC:
        omega, mode = oracle_tick(rng, omega, mode)
        num_ticks += 1
    return omega, mode, num_ticks


def oracle_reset(rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """(omega, mode) at the first observation."""
    return oracle_browse(rng, rng.normal(size=16))[:2]


def oracle_step(
    rng: np.random.Generator, omega: np.ndarray, mode: int, product: int
) -> tuple[np.ndarray, int, bool]:
    """Rules 1 to 4 of "A step": (omega, mode, whether the product was clicked)."""
    is_clicked = rng.random() < oracle_probability(BETA[product] @ omega + MU[product])
    omega, mode = oracle_tick(rng, omega, mode)
    if is_clicked:
        mode = ORGANIC
    if mode == ORGANIC:
        omega, mode, _ = oracle_browse(rng, omega)
    return omega, mode, is_clicked


def oracle_episode(rng: np.random.Generator) -> tuple[int, int, float, bool]:
    """(length, clicks, |omega| at the end, whether the user left) with random products."""
    omega, mode = oracle_reset(rng)
    length = clicks = 0
    while length == 0 or (mode != STOP and length < 100):
        omega, mode, is_clicked = oracle_step(rng, omega, mode, rng.integers(10_000))
        length, clicks = length + 1, clicks + is_clicked
    return length, clicks, float(np.linalg.norm(omega)), mode == STOP


@pytest.fixture(scope="module")
def reset() -> Callable[[int], RecommenderState]:
    """`NUM_USERS` users from a seed."""
    reset_users = jax.jit(jax.vmap(ENV.reset_env, (0, None)))
    return lambda seed: reset_users(jax.random.split(jax.random.key(seed), NUM_USERS), PARAMS)


@pytest.fixture(scope="module")
def step() -> Callable[[int, RecommenderState, jax.Array], tuple]:
    """One raw step of `NUM_USERS` users: (seed, states, product ids) -> transition."""
    step_users = jax.jit(jax.vmap(ENV.step_env, (0, 0, 0, None)))

    def step(seed: int, state: RecommenderState, ids: jax.Array) -> tuple:
        keys = jax.random.split(jax.random.key(seed), NUM_USERS)
        return step_users(keys, state, Action.of(ids), PARAMS)

    return step


@pytest.fixture(scope="module")
def stepped(step) -> tuple[RecommenderState, np.ndarray, tuple]:
    """(states, product ids, transition) for tastes of many lengths and all counters."""
    rng = np.random.default_rng(0)
    omega = rng.normal(size=(NUM_USERS, 16)) * rng.uniform(0.1, 4, size=(NUM_USERS, 1))
    mode = rng.choice([BANDIT, STOP], size=NUM_USERS)
    num_recommendations = rng.integers(0, 104, size=NUM_USERS)
    num_clicks = rng.integers(0, num_recommendations + 1)
    ids = rng.integers(10_000, size=NUM_USERS, dtype=np.int32)
    counters = (jnp.asarray(n, jnp.int32) for n in (mode, num_recommendations, num_clicks))
    state = RecommenderState(jnp.asarray(omega, jnp.float32), *counters)
    return jax.device_get((state, ids, step(1, state, ids)))


@pytest.fixture(scope="module")
def oracle_stepped(stepped) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(moves of omega, modes, clicks) of the oracle on a quarter of the same users."""
    state, ids, _ = stepped
    rng, rows = np.random.default_rng(1), []
    for user in range(NUM_USERS // 4):
        omega = state.omega[user].astype(float)
        after, mode, is_clicked = oracle_step(rng, omega, int(state.mode[user]), ids[user])
        rows.append((after - omega, mode, is_clicked))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def assert_same_distribution(got: np.ndarray, expected: np.ndarray) -> None:
    """Two-sample Kolmogorov-Smirnov test, which is cautious where values repeat."""
    result = stats.ks_2samp(got, expected)
    assert result.pvalue > MIN_P, result


def assert_same_counts(got: np.ndarray, expected: np.ndarray) -> None:
    """Two-sample chi-square test of small integers."""
    size = max(got.max(), expected.max()) + 1
    table = np.stack([np.bincount(got, minlength=size), np.bincount(expected, minlength=size)])
    result = stats.chi2_contingency(table[:, table.sum(axis=0) > 0], correction=False)
    assert result.pvalue > MIN_P, (table, result.pvalue)


def assert_same_mean(got: np.ndarray, expected: np.ndarray) -> None:
    result = stats.ttest_ind(got, expected, equal_var=False)
    assert result.pvalue > MIN_P, (got.mean(), expected.mean(), result.pvalue)


def assert_same_moves(got: np.ndarray, expected: np.ndarray) -> None:
    """Moves of omega [n, 16]: one coordinate, variance, kurtosis and what coordinates share."""
    got, expected = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    assert_same_distribution(got[:, 0], expected[:, 0])
    assert_same_distribution(np.linalg.norm(got, axis=1), np.linalg.norm(expected, axis=1))
    for power in (1, 2, 4):
        assert_same_mean(np.mean(got**power, axis=1), np.mean(expected**power, axis=1))
    # Coordinates are not correlated: of 120 pairs, 4.5 standard errors for the largest.
    scaled = got / np.linalg.norm(got, axis=1, keepdims=True)
    off_diagonal = (scaled.T @ scaled / len(got) * 16)[np.triu_indices(16, 1)]
    assert np.abs(off_diagonal).max() <= 4.5 / np.sqrt(len(got))


def test_click_probability_of_given_states(stepped, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the step feeds into its draw, seen from inside the traced program."""
    state, ids, _ = stepped
    seen, original = [], environment.click_probability

    def spy(logit: jax.Array) -> jax.Array:
        seen.append((logit, original(logit)))
        return seen[-1][1]

    monkeypatch.setattr(environment, "click_probability", spy)

    @jax.jit
    @jax.vmap
    def logit_and_probability(state: RecommenderState, product: jax.Array) -> tuple:
        ENV.step_env(jax.random.key(0), state, Action.of(product), PARAMS)
        return seen.pop()

    logit, probability = logit_and_probability(state, jnp.asarray(ids))
    expected = np.einsum("nd,nd->n", BETA[ids], state.omega.astype(float)) + MU[ids]
    # float32 sums of 17 terms, of which the largest is below 20: 1e-6 each.
    np.testing.assert_allclose(logit, expected, atol=1e-5, rtol=0)
    # f climbs by less than 0.09 per unit of x.
    np.testing.assert_allclose(probability, oracle_probability(expected), atol=2e-6, rtol=0)


def test_clicks_follow_their_probability(stepped) -> None:
    """In twenty groups of rising probability, as many clicks as the probabilities add up to."""
    state, ids, (_, _, reward, *_) = stepped
    x = np.einsum("nd,nd->n", BETA[ids], state.omega.astype(float)) + MU[ids]
    order, p = np.argsort(x), oracle_probability(x)
    groups = np.array_split(order, 20)
    surplus = np.array([reward[g].sum() - p[g].sum() for g in groups])
    variance = np.array([(p[g] * (1 - p[g])).sum() for g in groups])
    assert stats.chi2.sf((surplus**2 / variance).sum(), df=20) > MIN_P


def test_what_follows_from_a_step_exactly(stepped) -> None:
    """Counters, flags, rate and observation, from the state that the step drew."""
    before, _, (obs, after, reward, terminated, truncated, info) = stepped
    assert set(np.unique(reward)) == {0, 1}
    assert set(np.unique(after.mode)) == {BANDIT, STOP}
    count, clicks = before.num_recommendations + 1, before.num_clicks + (reward == 1)
    np.testing.assert_array_equal(after.num_recommendations, count)
    np.testing.assert_array_equal(after.num_clicks, clicks)
    np.testing.assert_array_equal(terminated, after.mode == STOP)
    np.testing.assert_array_equal(truncated, (after.mode != STOP) & (count >= 100))
    assert (terminated & (count >= 100)).any()
    np.testing.assert_array_equal(info["episode_length"], count)
    np.testing.assert_array_equal(info["num_clicks"], clicks)
    assert not info["invalid_action"].any()
    # One float32 division; a sum of 16 squares, a root and a division.
    np.testing.assert_allclose(info["click_through_rate"], clicks / count, atol=1e-7, rtol=0)
    omega = after.omega.astype(float)
    direction = omega / np.sqrt((omega**2).sum(axis=1))[:, None]
    np.testing.assert_allclose(obs, direction, atol=1e-6, rtol=0)


def test_mode_after_a_step(stepped, oracle_stepped) -> None:
    """By mode before, click and mode after, together."""
    before, _, (_, after, reward, *_) = stepped
    _, modes, clicks = oracle_stepped
    some = before.mode[: len(modes)]
    code = before.mode * 6 + (reward == 1) * 3 + after.mode
    assert_same_counts(code, some * 6 + clicks * 3 + modes)
    # Nobody comes back without a click.
    assert (after.mode[(before.mode == STOP) & (reward == 0)] == STOP).all()


@pytest.mark.parametrize("mode", [BANDIT, STOP])
@pytest.mark.parametrize("is_clicked", [False, True])
def test_drift_in_a_step(stepped, oracle_stepped, mode: int, is_clicked: bool) -> None:
    before, _, (_, after, reward, *_) = stepped
    moves, _, clicks = oracle_stepped
    chosen = (before.mode == mode) & ((reward == 1) == is_clicked)
    oracle_chosen = (before.mode[: len(moves)] == mode) & (clicks == is_clicked)
    assert_same_moves((after.omega - before.omega)[chosen], moves[oracle_chosen])


def test_browsing_session() -> None:
    """Length and exit together, and the drift of as many ticks, played one by one."""
    rng = np.random.default_rng(2)
    oracle = [oracle_browse(rng, np.zeros(16)) for _ in range(10_000)]
    omega, oracle_mode, oracle_ticks = (np.array(c) for c in zip(*oracle, strict=True))

    @jax.jit
    @jax.vmap
    def session(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        key_session, key_drift = jax.random.split(key)
        num_ticks, mode = environment._browsing_session(key_session)
        return environment._drift(key_drift, jnp.zeros(16), num_ticks), mode, num_ticks

    moves, mode, num_ticks = jax.device_get(session(jax.random.split(jax.random.key(2), NUM_USERS)))
    assert (moves.dtype, mode.dtype, num_ticks.dtype) == ("f4", "i4", "i4")
    # Lengths from 15 on share a bin; they are 1.5 % of all.
    assert_same_counts(
        3 * np.minimum(num_ticks, 15) + mode, 3 * np.minimum(oracle_ticks, 15) + oracle_mode
    )
    assert_same_moves(moves, omega)
    for length in (1, 4):
        assert_same_moves(moves[num_ticks == length], omega[oracle_ticks == length])


def test_reset(reset) -> None:
    rng = np.random.default_rng(3)
    omega, mode = (np.array(c) for c in zip(*(oracle_reset(rng) for _ in range(5000)), strict=True))
    obs, state = jax.device_get(reset(3))
    assert_same_counts(state.mode, mode)
    assert_same_moves(state.omega, omega)
    assert not state.num_recommendations.any()
    assert not state.num_clicks.any()
    norm = np.linalg.norm(state.omega.astype(float), axis=1, keepdims=True)
    np.testing.assert_allclose(obs, state.omega / norm, atol=1e-6, rtol=0)


def test_episodes_of_random_products(reset, step) -> None:
    """What the parts add up to: length, clicks, rate, last |omega| and kind of end."""
    rng = np.random.default_rng(4)
    oracle = (np.array(c) for c in zip(*(oracle_episode(rng) for _ in range(1500)), strict=True))
    length, clicks, norm, has_left = oracle
    _, state = reset(4)
    last, running = {}, np.ones(NUM_USERS, bool)
    for seed in range(100):
        ids = rng.integers(10_000, size=NUM_USERS, dtype=np.int32)
        _, state, _, terminated, truncated, info = step(1000 + seed, state, ids)
        now = {"length": info["episode_length"], "clicks": info["num_clicks"]}
        now |= {"rate": info["click_through_rate"], "has_left": terminated}
        now |= {"norm": jnp.linalg.norm(state.omega, axis=1)}
        last = {name: np.where(running, now[name], last.get(name, 0)) for name in now}
        running &= ~np.asarray(terminated | truncated)
    assert not running.any()
    assert_same_distribution(last["length"], length)
    assert_same_distribution(last["clicks"], clicks)
    assert_same_distribution(last["rate"], clicks / length)
    assert_same_distribution(last["norm"], norm)
    assert_same_counts(last["has_left"].astype(int), has_left.astype(int))
