"""The reference figures of docs/recommender.md, by their numbers there, and its tables.

The policies of "Anchors" play sets that are drawn from all 10,000 products. Their published
figures come from 4,000 episodes each, so a tolerance covers both sampling errors.
"""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.recommender import Recommender, RecommenderParams, RecommenderState, environment
from envs_mjx.recommender.environment import BANDIT, ORGANIC, STOP, click_probability
from envs_mjx.recommender.products import product_constants, product_universe, product_vectors
from jaxnew.environment import Action, FixedActionSet
from jaxnew.sampling import ActionPool, draw_sets

pytestmark = [pytest.mark.golden, pytest.mark.optimized]

ENV = Recommender()
PARAMS = ENV.default_params
BATCH = 4000  # Episodes played at once.
# Those whose figures state a tolerance; it needs so many.
NUM_BATCHES = {("random", 50): 3, ("dot", 50): 2, ("oracle", 50): 4}
NUM_FORCED = 10_000  # Users of `forced_step`.
SET_SIZES = (25, 50, 500)
WEIGHTS = {"random": (0, 0), "dot": (1, 0), "mu": (0, 1), "oracle": (1, 1)}  # Of beta.omega, mu.
# "Anchors": CTR, clicks per episode, length, share of episodes that reach 100, browsing ticks.
REFERENCES = {
    ("random", 50): (0.156, 7.4, 48.7, 0.20, 40),
    ("random", 500): (0.159, 7.3, 48.3, 0.19, 40),
    ("dot", 50): (0.271, 11.1, 43.6, 0.15, 53),
    ("dot", 500): (0.299, 12.8, 44.2, 0.14, 59),
    ("mu", 50): (0.546, 18.2, 34.7, 0.07, 77),
    ("oracle", 25): (0.534, 18.2, 34.7, 0.07, 77),
    ("oracle", 50): (0.573, 19.3, 34.1, 0.07, 81),
    ("oracle", 500): (0.662, 20.9, 31.7, 0.05, 86),
}
# "Click probability".
CLICK_PROBABILITIES = {
    -20: 0.013075, -10: 0.014970, -8: 0.016778, -6: 0.020490, -5: 0.023748, -3: 0.036302,
    -2: 0.048284, -1: 0.067214, 0: 0.096667, 1: 0.140492, 2: 0.200759, 3: 0.275115,
    4: 0.356177, 5: 0.434627, 6: 0.503412, 8: 0.603275, 10: 0.661115, 20: 0.727642,
}  # fmt: skip


@jax.jit
def draw(key: jax.Array) -> jax.Array:
    """int32[N, 500] one set per episode; any m columns are a uniform draw of m too."""
    pool = ActionPool.of(np.arange(10_000), capacity=10_000)
    return draw_sets(jax.random.split(key, BATCH), pool, 500).ids


@jax.jit
def play_batch(key: jax.Array, ids: jax.Array, weights: jax.Array, set_size: jax.Array) -> tuple:
    """(first observations, first states, dict of [100, N] steps); there is no auto-reset."""
    vectors, constants = PARAMS.product_vectors[ids], PARAMS.product_constants[ids]
    key_reset, key_scan = jax.random.split(key)
    keys = jax.random.split(key_reset, BATCH)
    first_obs, first_state = jax.vmap(ENV.reset, (0, None))(keys, PARAMS)

    def any_one(key: jax.Array, omega: jax.Array) -> jax.Array:
        return jax.random.randint(key, (BATCH,), 0, set_size)

    def best(key: jax.Array, omega: jax.Array, size: int) -> jax.Array:
        logits = jnp.einsum("nmd,nd->nm", vectors[:, :size], omega)
        return jnp.argmax(weights[0] * logits + weights[1] * constants[:, :size], axis=1)

    choices = [any_one, *(partial(best, size=size) for size in SET_SIZES)]
    choice = weights.any() * (1 + jnp.searchsorted(jnp.array(SET_SIZES), set_size))

    def body(state: RecommenderState, key: jax.Array) -> tuple[RecommenderState, dict]:
        key_choice, key_env = jax.random.split(key)
        slot = jax.lax.switch(choice, choices, key_choice, state.omega)
        action = Action.of(jnp.take_along_axis(ids, slot[:, None], axis=1)[:, 0])
        obs, state, reward, terminated, truncated, info = jax.vmap(ENV.step_env, (0, 0, 0, None))(
            jax.random.split(key_env, BATCH), state, action, PARAMS
        )
        step = {"id": action.id, "reward": reward, "terminated": terminated, "obs": obs[:2]}
        step |= {"truncated": truncated, "norm": jnp.linalg.norm(obs, axis=1)}
        return state, step | info | {"square": jnp.sum(state.omega**2, axis=1)}

    return (
        first_obs,
        first_state,
        jax.lax.scan(body, first_state, jax.random.split(key_scan, 100))[1],
    )


def summarise(first_obs: np.ndarray, first: RecommenderState, steps: dict) -> dict:
    """Of each episode its first state, what the last step says of it, and its sums; all [N]."""
    done = steps["terminated"] | steps["truncated"]
    assert done.any(axis=0).all()
    last = done.argmax(axis=0)
    named = (
        "terminated",
        "truncated",
        "num_clicks",
        "episode_length",
        "click_through_rate",
        "square",
    )
    total = {name: steps[name][last, np.arange(BATCH)] for name in named}
    rewards = np.where(np.arange(100)[:, None] <= last, steps["reward"], 0)
    total |= {"num_steps": last + 1, "return": rewards.sum(axis=0)}
    total |= {"is_binary": np.isin(rewards, [0, 1]).all(axis=0)}
    norms = np.vstack([np.linalg.norm(first_obs, axis=1), steps["norm"]])
    total |= {"norm_error": np.abs(norms - 1).max(axis=0)}
    return total | {"first_mode": first.mode, "first_omega": first.omega}


@pytest.fixture(scope="module")
def ids() -> jax.Array:
    return draw(jax.random.key(0))


@pytest.fixture(scope="module")
def play(ids):
    """(policy, m) -> arrays over the episodes of `NUM_BATCHES`, played once."""

    @cache
    def play(policy: str, size: int) -> dict[str, np.ndarray]:
        weights, batches = jnp.array(WEIGHTS[policy], jnp.float32), []
        for batch in range(NUM_BATCHES.get((policy, size), 1)):
            key = jax.random.key(100 * list(REFERENCES).index((policy, size)) + batch)
            own_ids = jnp.roll(ids, 50 * batch, axis=1)  # Sets of their own for each batch.
            recorded = play_batch(key, own_ids, weights, jnp.int32(size))
            batches.append(summarise(*jax.device_get(recorded)))
        return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}

    return play


@pytest.fixture(scope="module")
def forced_step():
    """One step of `NUM_FORCED` users that click where told: a product's constant is its p."""
    params = RecommenderParams(jnp.zeros((2, 16)), jnp.array([0.0, 1.0]), jnp.int32(10**6))

    @jax.jit
    def step(key: jax.Array, omega: jax.Array, mode: jax.Array, is_clicked: jax.Array) -> tuple:
        state = RecommenderState(omega, mode, jnp.int32(0), jnp.int32(0))
        keys, action = jax.random.split(key, NUM_FORCED), Action.of(is_clicked)
        axes = 0, RecommenderState(0, None, None, None), None, None
        _, state, reward, terminated, *_ = jax.vmap(ENV.step_env, axes)(keys, state, action, params)
        return state.omega, reward, terminated

    omega, mode = jnp.zeros((NUM_FORCED, 16)), jnp.int32(BANDIT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(environment, "click_probability", lambda logit: logit)
        return step.lower(jax.random.key(0), omega, mode, jnp.int32(0)).compile()


def assert_mean(values: np.ndarray, expected: float, tolerance: float) -> None:
    """Within the tolerance, which is no less than four standard errors of these values."""
    error = np.std(values) / np.sqrt(len(values))
    assert 4 * error <= tolerance, f"{len(values)} values have a standard error of {error}."
    assert abs(np.mean(values) - expected) <= tolerance, (np.mean(values), expected)


def test_01_golden_products() -> None:
    """The constants of "Products"; the draw is repeated here, since raw vectors are not kept."""
    rng = np.random.RandomState(123)
    raw, constants = rng.normal(size=(10_000, 16)), rng.normal(0, 3, size=10_000)
    norms = np.linalg.norm(raw, axis=1)
    # Half a unit of the last printed digit.
    golden = [-1.0856306, 0.99734545, 0.2829785, -1.50629471]
    np.testing.assert_allclose(raw[0, :4], golden, atol=5e-8, rtol=0)
    np.testing.assert_allclose([norms[0], raw[9999, 15]], [4.415763, -1.433682], atol=5e-7, rtol=0)
    beta, mu = product_vectors(), product_constants()
    assert (beta.shape, beta.dtype, mu.shape, mu.dtype) == ((10_000, 16), "f4", (10_000,), "f4")
    # Further half a unit of float32: 1.5e-8 below 0.5, 1.2e-7 below 4.
    golden = [-0.24585347, 0.22586029, 0.06408372, -0.34111767]
    np.testing.assert_allclose(beta[0, :4], golden, atol=2e-8, rtol=0)
    golden = [-2.36895569, 0.78356737, 2.29559665, -1.10448448]
    np.testing.assert_allclose(mu[:4], golden, atol=1.3e-7, rtol=0)
    stats = [mu.astype(float).mean(), mu.astype(float).std(), mu.min(), mu.max()]
    golden = [0.02027, 3.02034, -11.26191, 11.03853]
    np.testing.assert_allclose(stats, golden, atol=6e-6, rtol=0)
    assert mu.argmax() == 6226
    np.testing.assert_array_equal(beta, (raw / norms[:, None]).astype(np.float32))
    np.testing.assert_array_equal(mu, constants.astype(np.float32))
    assert np.abs(np.linalg.norm(beta.astype(float), axis=1) - 1).max() <= 1e-6


def test_02_click_probability() -> None:
    points = jnp.array(list(CLICK_PROBABILITIES), jnp.float32)
    golden = list(CLICK_PROBABILITIES.values())
    np.testing.assert_allclose(click_probability(points), golden, atol=1e-6, rtol=0)
    values = np.asarray(click_probability(jnp.linspace(-25.0, 25.0, 501)))
    assert (np.diff(values) > 0).all()
    limits = click_probability(jnp.array([-1e4, 1e4]))
    np.testing.assert_allclose(limits, [0.012982, 0.731059], atol=1e-6, rtol=0)


def test_03_logits_of_a_known_taste() -> None:
    logits = PARAMS.product_vectors[:4] @ jnp.ones(16) + PARAMS.product_constants[:4]
    # Half a unit of the last printed digit and a few roundings of float32.
    golden = [-3.16035, 1.11256, 2.08527, 0.35846]
    np.testing.assert_allclose(logits, golden, atol=6e-6, rtol=0)
    golden = [0.034839, 0.146451, 0.206625, 0.110550]
    np.testing.assert_allclose(click_probability(logits), golden, atol=1e-6, rtol=0)


def test_04_mean_click_probability(play) -> None:
    omega = play("random", 50)["first_omega"][:2000]
    by_user = [
        np.mean(click_probability(part @ PARAMS.product_vectors.T + PARAMS.product_constants), 1)
        for part in np.split(omega, 10)
    ]
    assert_mean(np.concatenate(by_user), 0.150, tolerance=0.002)


def test_05_transition_table() -> None:
    table = [[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0, 0, 1]]
    assert (ORGANIC, BANDIT, STOP) == (0, 1, 2)
    np.testing.assert_array_equal(environment.TRANSITIONS, table)
    np.testing.assert_allclose(environment.TRANSITIONS.sum(axis=1), 1, atol=1e-15, rtol=0)
    num_ticks = 10**6
    ticks = jax.jit(jax.vmap(environment._next_mode, (0, None)))
    for mode, tolerance in [(BANDIT, 0.001), (ORGANIC, 0.0018), (STOP, 0)]:
        modes = ticks(jax.random.split(jax.random.key(mode), num_ticks), mode)
        shares = np.bincount(modes, minlength=3) / num_ticks
        # The page's bound, 4.2 standard errors; from organic, four of them.
        np.testing.assert_allclose(shares, table[mode], atol=tolerance, rtol=0)


def test_06_browsing_session() -> None:
    keys = jax.random.split(jax.random.key(6), 10**6)
    num_ticks, mode = jax.jit(jax.vmap(environment._browsing_session))(keys)
    assert num_ticks.min() == 1
    # Half a unit of the last printed digit and four standard errors, 3.31 / 1000 at most.
    assert_mean(np.asarray(num_ticks), 3.846, tolerance=0.014)
    assert_mean(num_ticks == 1, 0.26, tolerance=0.0018)
    assert_mean(mode == STOP, 0.0385, tolerance=0.0009)
    assert set(np.unique(mode)) == {BANDIT, STOP}
    # Where a session leads does not depend on its length.
    assert_mean(np.asarray(num_ticks)[mode == STOP], 3.846, tolerance=0.07)


def test_07_users_who_left_before_the_first_recommendation(play) -> None:
    played = [play("random", 50), play("oracle", 50)]
    assert_mean(np.concatenate([p["first_mode"] for p in played]) == STOP, 0.0385, tolerance=0.005)
    for p in played:
        unclicked = (p["first_mode"] == STOP) & (p["num_clicks"] == 0)
        assert (p["episode_length"][unclicked] == 1).all()
        assert p["terminated"][unclicked].all()
        # Of those who click, 25 in 26 come back.
        clicked = (p["first_mode"] == STOP) & (p["num_clicks"] > 0)
        assert (p["episode_length"][clicked] > 1).mean() > 0.8


@pytest.mark.parametrize("is_clicked", [True, False])
def test_08_ends_after_forced_answers(forced_step, is_clicked: bool) -> None:
    """A click cancels the tick's stop, so that neither the tick nor the mode before it matters."""
    omega, ends = jnp.zeros((NUM_FORCED, 16)), {BANDIT: [], STOP: []}
    for mode, terminated in ends.items():
        for key in jax.random.split(jax.random.key(8), 20):
            _, reward, is_end = forced_step(key, omega, jnp.int32(mode), jnp.int32(is_clicked))
            assert (reward == is_clicked).all()
            terminated.append(np.asarray(is_end))
    if is_clicked:
        assert_mean(np.concatenate(ends[BANDIT]), 1 / 26, tolerance=0.0018)
        assert_mean(np.concatenate(ends[STOP]), 1 / 26, tolerance=0.0018)
    else:
        assert_mean(np.concatenate(ends[BANDIT]), 0.01192, tolerance=0.001)
        assert np.all(ends[STOP])


def test_09_drift(forced_step) -> None:
    """A user who has left, and never clicks, ticks once per step: `stop` leads to `stop` alone."""
    omega, moves = jnp.zeros((NUM_FORCED, 16)), []
    for key in jax.random.split(jax.random.key(9), 100):
        next_omega, *_ = forced_step(key, omega, jnp.int32(STOP), jnp.int32(0))
        moves.append(np.asarray(next_omega - omega, np.float64))
        omega = next_omega
    omega = np.asarray(omega, np.float64)
    assert_mean(np.mean(omega**2, axis=1), 1.0, tolerance=0.02)
    # Of one coordinate: a standard error of sqrt(2.06 / 10,000).
    np.testing.assert_allclose(np.mean(omega**2, axis=0), 1.0, atol=0.058, rtol=0)
    squares = np.concatenate(moves) ** 2 / 0.01
    assert_mean(np.mean(squares, axis=1), 1.0, tolerance=0.008)
    # Normal times |normal|: E n^4 z^4 = 9. One n for all coordinates: E n^4 z_i^2 z_j^2 = 3, not 1.
    assert_mean(np.mean(squares**2, axis=1), 9.0, tolerance=0.2)
    assert_mean(np.mean(squares * np.roll(squares, 1, axis=1), axis=1), 3.0, tolerance=0.06)


def test_10_observations_are_directions(play) -> None:
    played = [play("random", 50), play("oracle", 50)]
    assert max(p["norm_error"].max() for p in played) <= 1e-6
    norms = np.linalg.norm(np.concatenate([p["first_omega"] for p in played]), axis=1)
    assert_mean(norms, 4.0, tolerance=0.05)


def test_11_random_policy(play) -> None:
    played = play("random", 50)
    assert_mean(played["click_through_rate"], 0.156, tolerance=0.006)
    assert_mean(played["episode_length"], 48.7, tolerance=1.5)
    assert_mean(played["episode_length"] == 100, 0.20, tolerance=0.015)


def test_12_best_policies(play) -> None:
    # For sets of 500 the page gives no tolerance: four standard errors.
    for policy, size, rate, tolerance in [
        ("oracle", 50, 0.573, 0.01),
        ("dot", 50, 0.271, 0.01),
        ("oracle", 500, 0.662, 0.013),
        ("dot", 500, 0.299, 0.013),
    ]:
        assert_mean(play(policy, size)["click_through_rate"], rate, tolerance)
    assert_mean(play("oracle", 50)["episode_length"], 34, tolerance=1.0)


@pytest.mark.parametrize(("policy", "size"), REFERENCES)
def test_reference_policies(play, policy: str, size: int) -> None:
    """A tick adds 0.16 to E|omega|^2 whatever the policy does, which counts browsing."""
    played = play(policy, size)
    length = played["episode_length"]
    browsing = (played["square"] - 16) / 0.16 - length
    columns = played["click_through_rate"], played["num_clicks"], length, length == 100, browsing
    half_units = 0.0005, 0.05, 0.05, 0.005, 0.5
    for values, expected, half_unit in zip(
        columns, REFERENCES[policy, size], half_units, strict=True
    ):
        # Four standard errors of the difference from the page's 4,000 episodes.
        tolerance = half_unit + 4 * np.std(values) * np.sqrt(1 / 4000 + 1 / len(values))
        assert abs(np.mean(values) - expected) <= tolerance, (np.mean(values), expected)


def test_13_at_most_100_recommendations(play) -> None:
    for policy, size in [("random", 50), ("dot", 500)]:
        played = play(policy, size)
        np.testing.assert_array_equal(played["episode_length"], played["num_steps"])
        at_limit = played["num_steps"] == 100
        np.testing.assert_array_equal(played["truncated"], at_limit & ~played["terminated"])
        # Some leave at the limit: a natural end.
        assert (at_limit & played["terminated"]).any()


def test_14_rewards_and_rate(play) -> None:
    for policy, size in [("random", 50), ("oracle", 50)]:
        played = play(policy, size)
        assert played["is_binary"].all()
        np.testing.assert_array_equal(played["return"], played["num_clicks"])
        mean_reward = played["return"] / played["num_steps"]
        # One float32 division of a number of at most 1.
        np.testing.assert_allclose(played["click_through_rate"], mean_reward, atol=1e-7, rtol=0)


def test_15_representations() -> None:
    universe = product_universe()
    assert set(universe.engineered) == {"product", "product-mu"}
    np.testing.assert_array_equal(universe.engineered["product"], product_vectors())
    shown = universe.engineered["product-mu"]
    assert shown.shape == (10_000, 17)
    np.testing.assert_array_equal(shown[:, :16], product_vectors())
    np.testing.assert_array_equal(shown[:, 16], product_constants())
    np.testing.assert_array_equal(universe.content, shown)


def test_16_same_episode_under_jit_and_vmap(ids) -> None:
    """Two of the 4,000 users, replayed alone and without `jit`."""
    key = jax.random.key(16)
    *_, steps = jax.device_get(play_batch(jax.random.clone(key), ids, jnp.ones(2), jnp.int32(50)))
    key_reset, key_scan = jax.random.split(key)
    keys_env = [jax.random.split(key)[1] for key in jax.random.split(key_scan, 100)[:10]]
    for user in range(2):
        _, state = ENV.reset_env(jax.random.split(jax.random.clone(key_reset), BATCH)[user], PARAMS)
        for t, key_env in enumerate(keys_env):
            key_user = jax.random.split(jax.random.clone(key_env), BATCH)[user]
            action = Action.of(steps["id"][t, user])
            obs, state, reward, terminated, *_ = ENV.step_env(key_user, state, action, PARAMS)
            assert reward == steps["reward"][t, user]
            assert terminated == steps["terminated"][t, user]
            # Sums of 16 terms may be taken in another order: a few roundings of float32.
            np.testing.assert_allclose(obs, steps["obs"][t, user], atol=1e-6, rtol=0)


def test_16_order_of_the_action_set_does_not_matter() -> None:
    ids = np.arange(100, 150)
    forwards, backwards = FixedActionSet(ENV, ids), FixedActionSet(ENV, ids[::-1])
    _, state = forwards.reset(jax.random.key(0), PARAMS)
    for t in range(3):
        one = forwards.step(jax.random.key(t), state, jnp.int32(7), PARAMS)
        other = backwards.step(jax.random.key(t), state, jnp.int32(49 - 7), PARAMS)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)
        state = one[1]
