"""The categorical distribution against SciPy and closed forms, with and without masks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy import special, stats

from jaxnew.policy import Categorical

LARGEST_UNIFORM = 1.0 - 2.0**-23  # What `jax.random.uniform` can give in float32: k / 2**23.


@jax.jit
def evaluate(distribution: Categorical) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(log_prob of every choice [..., m], entropy, mode)."""
    m = distribution.logits.shape[-1]
    log_probs = jax.vmap(
        lambda i: distribution.log_prob(jnp.full(distribution.logits.shape[:-1], i))
    )(jnp.arange(m))
    return jnp.moveaxis(log_probs, 0, -1), distribution.entropy(), distribution.mode()


draw = jax.jit(lambda distribution, key: distribution.sample(key))


def sample_many(logits: np.ndarray, mask: np.ndarray | None, count: int, seed: int) -> np.ndarray:
    """int[count] draws from one distribution f[m]."""
    logits = jnp.broadcast_to(jnp.asarray(logits, jnp.float32), (count, len(logits)))
    distribution = Categorical(logits)
    if mask is not None:
        distribution = Categorical.masked(logits, jnp.asarray(mask))
    return np.asarray(draw(distribution, jax.random.key(seed)))


LOGITS = npst.arrays(
    np.float32,
    (5, 7),
    elements=st.floats(-30, 30, width=32, allow_subnormal=False)
    | st.sampled_from([-1e4, 0.0, 1e4]),
)
MASKS = npst.arrays(bool, (5, 7)).map(lambda mask: mask | (np.arange(7) == 3))


@pytest.mark.oracle
@settings(max_examples=80, deadline=None, derandomize=True)
@given(logits=LOGITS)
def test_unmasked_against_scipy(logits: np.ndarray) -> None:
    log_probs, entropy, mode = map(np.asarray, evaluate(Categorical(jnp.asarray(logits))))
    expected = special.log_softmax(logits.astype(np.float64), axis=-1)
    # float32 spacing at 1e4 is 1e-3; below 100 it is under 8e-6 and a few roundings.
    np.testing.assert_allclose(log_probs, expected, rtol=1e-6, atol=2e-5)
    expected_entropy = stats.entropy(np.exp(expected), axis=-1)
    np.testing.assert_allclose(entropy, expected_entropy, atol=2e-5)
    assert np.array_equal(mode, logits.argmax(axis=-1))


@pytest.mark.oracle
@settings(max_examples=80, deadline=None, derandomize=True)
@given(logits=LOGITS, mask=MASKS)
def test_masked_is_the_distribution_over_the_real_entries(
    logits: np.ndarray, mask: np.ndarray
) -> None:
    distribution = Categorical.masked(jnp.asarray(logits), jnp.asarray(mask))
    log_probs, entropy, mode = map(np.asarray, evaluate(distribution))
    for row in range(len(logits)):
        real = mask[row]
        expected = special.log_softmax(logits[row, real].astype(np.float64))
        np.testing.assert_allclose(log_probs[row, real], expected, rtol=1e-6, atol=2e-5)
        np.testing.assert_allclose(entropy[row], stats.entropy(np.exp(expected)), atol=2e-5)
        # A probability of zero for the rest, and finite.
        assert (log_probs[row, ~real] < -1e8).all()
        assert np.isfinite(log_probs[row]).all()
        assert mode[row] == np.flatnonzero(real)[logits[row, real].argmax()]


@pytest.mark.unit
def test_worked_numbers() -> None:
    # p = (1/4, 1/2, 1/4): entropy = 1/4 ln 4 * 2 + 1/2 ln 2 = 1.5 ln 2 = 1.03972.
    distribution = Categorical(jnp.log(jnp.array([1.0, 2.0, 1.0])))
    log_probs, entropy, mode = evaluate(distribution)
    np.testing.assert_allclose(log_probs, np.log([0.25, 0.5, 0.25]), atol=1e-6)
    np.testing.assert_allclose(entropy, 1.03972, atol=1e-5)
    assert int(mode) == 1
    assert mode.dtype == jnp.int32
    # Equal logits: the first; ln 4.
    log_probs, entropy, mode = evaluate(Categorical(jnp.full(4, 3.0)))
    assert int(mode) == 0
    np.testing.assert_allclose(entropy, np.log(4), atol=1e-6)


@pytest.mark.unit
def test_all_masked_is_uniform_and_finite() -> None:
    logits = jnp.array([[1e4, -1e4, 0.0, 5.0]])
    distribution = Categorical.masked(logits, jnp.zeros((1, 4), bool))
    log_probs, entropy, mode = evaluate(distribution)
    np.testing.assert_allclose(log_probs, np.log(np.full((1, 4), 0.25)), atol=1e-6)
    np.testing.assert_allclose(entropy, [np.log(4)], atol=1e-6)
    assert 0 <= int(mode[0]) < 4
    grad = jax.grad(
        lambda x: jnp.sum(Categorical.masked(x, jnp.zeros((1, 4), bool)).log_prob(jnp.array([2])))
    )(logits)
    assert np.isfinite(grad).all()
    drawn = sample_many(np.zeros(4), np.zeros(4, bool), 4000, seed=0)
    # Binomial(4000, 1/4): deviation 27, five of them.
    assert np.abs(np.bincount(drawn, minlength=4) - 1000).max() < 137


@pytest.mark.unit
@pytest.mark.parametrize("masked_logit", [-1e4, 0.0, 1e4])
def test_gradients_are_finite_and_do_not_reach_masked_entries(masked_logit: float) -> None:
    logits = jnp.array([masked_logit, 1.0, -1e4, 1e4])
    mask = jnp.array([False, True, True, True])

    def both(x: jax.Array) -> jax.Array:
        distribution = Categorical.masked(x, mask)
        return distribution.log_prob(jnp.array(1)) + distribution.entropy()

    value, grad = jax.value_and_grad(both)(logits)
    assert np.isfinite(value)
    assert np.isfinite(grad).all()
    assert grad[0] == 0.0
    # d log p_1 / d logits = onehot(1) - p, and p is one on entry 3.
    np.testing.assert_allclose(grad, [0, 1, 0, -1], atol=1e-3)


@pytest.mark.oracle
@pytest.mark.parametrize(
    "logits",
    [
        np.zeros(50),
        np.linspace(0, 6, 50),  # Probabilities from 3e-4 to 0.12.
        np.log([0.97, 0.01, 0.01, 0.005, 0.005]),
        np.log([1e-3, 1 - 2e-3, 1e-3]),
        1e4 + np.log([0.2, 0.3, 0.5]),  # Spacing 1e-3 at 1e4: compared with the rounded logits.
        -1e4 + np.log([0.2, 0.3, 0.5]),
        np.array([7.0, 6.0] + [0.0] * 398),  # Longer than a block of the cumulative sum.
    ],
)
def test_sampling_frequencies(logits: np.ndarray) -> None:
    count = 40_000
    counts = np.bincount(sample_many(logits, None, count, seed=1), minlength=len(logits))
    expected = count * special.softmax(logits.astype(np.float32).astype(np.float64))
    assert expected.min() >= 10  # The chi-square approximation holds.
    statistic = ((counts - expected) ** 2 / expected).sum()
    # Fixed keys; a right sampler fails with one key in a million.
    assert statistic < stats.chi2.isf(1e-6, len(logits) - 1)


@pytest.mark.oracle
def test_sampling_frequencies_of_rare_choices() -> None:
    """Ten choices of 1e-5 beside one: their number among 400,000 draws is Poisson, mean 40."""
    probabilities = np.full(11, 1e-5)
    probabilities[4] = 1 - 1e-4
    drawn = sample_many(np.log(probabilities), None, 400_000, seed=2)
    rare = drawn[drawn != 4]
    assert stats.poisson.ppf(1e-6, 40) <= len(rare) <= stats.poisson.isf(1e-6, 40)
    assert len(np.unique(rare)) >= 8  # (10 cells, 40 draws: on average 0.15 stay empty.)


@pytest.mark.property
@pytest.mark.parametrize("m", [4, 50, 400])
@pytest.mark.parametrize("kind", ["first", "last", "first and last", "all but one", "scattered"])
def test_masked_entries_are_never_sampled(m: int, kind: str) -> None:
    rng = np.random.default_rng(3)
    mask = np.ones(m, bool)
    if kind.startswith("first"):
        mask[: m // 4] = False
    if kind.endswith("last"):
        mask[-(m // 4) :] = False
    if kind == "all but one":
        mask = np.arange(m) == m // 2
    if kind == "scattered":
        mask = rng.random(m) < 0.5
    logits = rng.normal(size=m).astype(np.float32)
    logits[~mask] = 1e4  # What is masked would have had all the probability.
    drawn = sample_many(logits, mask, 5000, seed=4)
    assert mask[drawn].all()
    # One real entry has nearly everything; the rest are masked or improbable.
    logits[np.flatnonzero(mask)[0]] = 1e4
    assert (sample_many(logits, mask, 5000, seed=5) == np.flatnonzero(mask)[0]).all()


def sample_with_uniform(
    monkeypatch: pytest.MonkeyPatch, distribution: Categorical, uniform: float
) -> np.ndarray:
    """The draws if every uniform number were `uniform`."""
    monkeypatch.setattr(
        jax.random, "uniform", lambda key, shape=(), *_args, **_kwargs: jnp.full(shape, uniform)
    )
    return np.asarray(distribution.sample(jax.random.key(0)))


@pytest.mark.property
@pytest.mark.parametrize("uniform", [0.0, 2.0**-23, 0.5, LARGEST_UNIFORM])
@pytest.mark.parametrize("m", [5, 50, 256, 400, 1098])
def test_extreme_uniform_numbers_never_select_a_masked_entry(
    monkeypatch: pytest.MonkeyPatch, m: int, uniform: float
) -> None:
    """A cumulative sum in blocks rounds differently before and after a masked entry, so it may rise
    there, and the inverse may land on it: 2**-23 per draw, which a run of 4e7 steps meets."""
    rng = np.random.default_rng(6)
    logits = jnp.asarray(rng.normal(size=(300, m)) * 2, jnp.float32)
    real = np.arange(m) < m * 9 // 10
    for mask in (real, real[::-1], np.arange(m) % 3 == 1):
        distribution = Categorical.masked(logits, jnp.asarray(mask))
        drawn = sample_with_uniform(monkeypatch, distribution, uniform)
        assert mask[drawn].all()


@pytest.mark.golden
def test_a_real_key_that_selected_a_masked_entry() -> None:
    """The uniform number of this key is the largest there is, and the 400 entries end in 40 masked
    ones. (jax 0.10 on a CPU; the test above does not depend on the bits of a key.)"""
    logits = jnp.asarray(np.random.default_rng(0).normal(size=(1, 400)) * 2, jnp.float32)
    distribution = Categorical.masked(logits, jnp.arange(400)[None] < 360)
    choice = draw(distribution, jax.random.key(20192286))
    assert int(choice[0]) < 360
    assert float(distribution.log_prob(choice)[0]) > -100


@pytest.mark.unit
def test_extreme_uniform_numbers_select_the_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    distribution = Categorical(jnp.zeros((1, 10)))
    assert sample_with_uniform(monkeypatch, distribution, 0.0).tolist() == [0]
    assert sample_with_uniform(monkeypatch, distribution, LARGEST_UNIFORM).tolist() == [9]
    assert sample_with_uniform(monkeypatch, distribution, 0.45).tolist() == [4]


@pytest.mark.unit
def test_samples_have_the_batch_shape_and_differ_within_it() -> None:
    drawn = draw(Categorical(jnp.zeros((6, 8, 50))), jax.random.key(7))
    assert drawn.shape == (6, 8)
    assert drawn.dtype == jnp.int32
    # 48 draws of 50: about 31 distinct values.
    assert len(np.unique(drawn)) > 20
    assert int(draw(Categorical(jnp.zeros(1)), jax.random.key(8))) == 0
