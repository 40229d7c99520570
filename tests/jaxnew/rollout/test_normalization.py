"""Running statistics against float64 NumPy (docs/method.md, "Normalisation")."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnew.rollout.normalization import RunningStatistics


@jax.jit
def update_all(statistics: RunningStatistics, batches: jax.Array) -> RunningStatistics:
    """After batches f32[K, N, ...] in order."""
    return jax.lax.scan(lambda s, batch: (s.update(batch), None), statistics, batches)[0]


def expected_moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and population variance of values f[n, ...] and the prior: 1e-4 values with mean 0 and
    variance 1, in float64."""
    values = values.astype(np.float64)
    count, prior = len(values), 1e-4
    mean = values.sum(axis=0) / (count + prior)
    squares = ((values - mean) ** 2).sum(axis=0) + prior * (1.0 + mean**2)
    return mean, squares / (count + prior)


@pytest.mark.oracle
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31),
    location=st.floats(-10, 10),
    scale=st.floats(0.1, 100),
)
def test_statistics_are_those_of_all_values(seed: int, location: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    batches = rng.normal(location, scale, (9, 6, 3)).astype(np.float32)
    got = update_all(RunningStatistics.zeros((3,)), batches)
    mean, variance = expected_moments(batches.reshape(-1, 3))
    # float32: roundings of 6e-8 relative to the largest value; in the variance to its product with
    # the deviation and, at the start, to the variance of 1 and the square of the mean.
    largest = np.abs(batches).max()
    np.testing.assert_allclose(got.mean, mean, atol=2e-6 * largest)
    atol = 1e-6 * largest * scale + 1e-7 * (1 + location**2)
    np.testing.assert_allclose(got.variance, variance, rtol=1e-5, atol=atol)
    np.testing.assert_allclose(got.count, 54 + 1e-4, rtol=1e-6)


@pytest.mark.unit
def test_one_batch_worked_by_hand() -> None:
    # Values 1 and 3: mean 2, population variance 1; the prior weighs 1e-4 / 2.0001 = 5e-5.
    got = RunningStatistics.zeros(()).update(jnp.array([1.0, 3.0]))
    np.testing.assert_allclose(got.mean, 2 * (1 - 5e-5), rtol=1e-6)
    np.testing.assert_allclose(got.variance, 1 + 4 * 5e-5, rtol=1e-5)
    # (3 - 2) / 1 and 3 / 1, to the prior's share.
    np.testing.assert_allclose(got.normalize(jnp.array(3.0)), 1.0, atol=2e-4)
    np.testing.assert_allclose(got.scale(jnp.array(3.0)), 3.0, atol=4e-4)


@pytest.mark.unit
def test_both_maps_clip_at_ten() -> None:
    statistics = RunningStatistics(jnp.float32(5.0), jnp.float32(4.0), jnp.float32(100.0))
    values = jnp.array([-1e9, 5.0 - 20.0, 5.0, 6.0, 5.0 + 19.0, 1e9])
    np.testing.assert_allclose(statistics.normalize(values), [-10, -10, 0, 0.5, 9.5, 10], rtol=1e-6)
    values = jnp.array([-1e9, -19.0, 0.0, 1.0, 20.0, 1e9])
    np.testing.assert_allclose(statistics.scale(values), [-10, -9.5, 0, 0.5, 10, 10], rtol=1e-6)


@pytest.mark.unit
def test_epsilon_is_added_to_the_variance() -> None:
    # 1 / sqrt(0 + 1e-8) = 1e4.
    statistics = RunningStatistics(jnp.float32(0.0), jnp.float32(0.0), jnp.float32(1.0))
    np.testing.assert_allclose(statistics.normalize(jnp.float32(5e-4)), 5.0, rtol=1e-5)
    np.testing.assert_allclose(statistics.scale(jnp.float32(5e-4)), 5.0, rtol=1e-5)


@pytest.mark.oracle
def test_long_stream_stays_accurate() -> None:
    """200,000 updates of 32 in float32 (6.4e6 values) against the exact moments in float64: a
    feature far from zero for its spread, a rare flag, and one whose law drifts.

    The mean stops moving when its increments, `w` times a batch's distance of 0.1 / sqrt(32), fall
    below half a spacing: at 100 (4e-6) after about 140,000 values, where it is known to
    1 / sqrt(140,000) = 0.003 deviations. A sum of squares would lose everything here: 100^2 has a
    spacing of 1e-3, the variance is 1e-2.
    """
    rng = np.random.default_rng(0)
    block = np.stack(
        [
            rng.normal(100.0, 0.1, (10_000, 32)),
            rng.random((10_000, 32)) < 1e-3,
            rng.normal(0.0, 1.0, (10_000, 32)),
        ],
        axis=-1,
    ).astype(np.float32)
    statistics, values = RunningStatistics.zeros((3,)), []
    for i in range(20):
        drift = np.array([0.0, 0.0, 0.1 * i], np.float32)
        statistics = update_all(statistics, block + drift)
        values.append((block + drift).reshape(-1, 3))
    mean, variance = expected_moments(np.concatenate(values))
    np.testing.assert_allclose(statistics.count, 6.4e6, rtol=1e-6)
    deviation = np.sqrt(variance)
    # What matters: in units of the deviation, and relative.
    np.testing.assert_allclose((statistics.mean - mean) / deviation, 0.0, atol=1e-2)
    np.testing.assert_allclose(statistics.variance, variance, rtol=1e-3)


def features(num_values: int) -> np.ndarray:
    """f32[N, 7]: constants, as Grid World's walls are, a rare flag, and numbers far from zero."""
    rng = np.random.default_rng(num_values)
    constants = np.tile([0.0, 0.1, 2.0, -3.0], (num_values, 1))
    flag = rng.random(num_values) < 1e-3
    offset, usual = rng.normal(100.0, 0.1, num_values), rng.normal(0.0, 1.0, num_values)
    return np.column_stack([constants, flag, offset, usual]).astype(np.float32)


def first_batch(batch: jax.Array) -> tuple[RunningStatistics, jax.Array]:
    """As a rollout begins: all in one program, whose constants the compiler adds up."""
    statistics = RunningStatistics.zeros(batch.shape[1:]).update(batch)
    return statistics, statistics.normalize(batch)


@pytest.mark.oracle
@pytest.mark.parametrize("exponent", [5, 10, 11, 16])
def test_batches_of_any_width(exponent: int) -> None:
    """From 2,048 on, 1e-4 is lost in a float32 sum: constants had the variance 0, and were NaN."""
    values = features(2**exponent)
    members = np.stack([values, 2.0 * values])
    for found, batch in zip(
        (*jax.jit(jax.vmap(first_batch))(members), *jax.jit(first_batch)(values)),
        (members, members, values, values),
        strict=True,
    ):
        mean, variance = np.moveaxis(
            np.array([expected_moments(one) for one in batch.reshape(-1, *values.shape)]), 1, 0
        ).reshape(2, *batch.shape[:-2], 1, -1)
        if isinstance(found, RunningStatistics):
            np.testing.assert_allclose(found.variance, variance[..., 0, :], rtol=1e-5)
        else:
            # A sum's rounding, some 1e-8 of a number, over the floor of the deviation, 1e-4.
            expected = np.clip((batch - mean) / np.sqrt(variance + 1e-8), -10, 10)
            np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.unit
def test_the_floor_of_the_deviation_is_no_constant_to_add_up() -> None:
    """(1 + x) + 1e-8 is compiled to x + 1, which is 0 for x = -1."""

    @jax.jit
    def scaled(x: jax.Array) -> jax.Array:
        return RunningStatistics(jnp.float32(0.0), 1.0 + x, jnp.float32(1.0)).scale(1e-4)

    np.testing.assert_allclose(scaled(jnp.float32(-1.0)), 1.0, rtol=1e-5)


@pytest.mark.property
@pytest.mark.parametrize("constant", [0.0, 1.0, 2.0, -3.0])
def test_constant_features_become_zero(constant: float) -> None:
    """As Grid World's walls, which are 2 in every state: to a hundredth of a deviation.

    At first the prior's share of the mean, 1e-4 |c| / n, over its share of the deviation,
    sqrt(1e-4 (1 + c^2) / n), leaves at most 0.01 / sqrt(n) with n >= 32. Later the mean stands
    still when its increments are below half a spacing, some 3e-7 |c| off, over sqrt(1e-8) or more.
    """
    batches = jnp.full((2000, 32, 1), constant)
    first = RunningStatistics.zeros((1,)).update(batches[0])
    for statistics in (first, update_all(first, batches[:100]), update_all(first, batches)):
        assert abs(float(statistics.normalize(batches[0, 0])[0])) < 0.01
