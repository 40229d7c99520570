"""Terms of the bound, one by one, against SciPy and NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.special
import scipy.stats

from jaxnew.representation import objective


@pytest.mark.oracle
def test_gaussian_log_likelihood_is_scipys():
    rng = np.random.default_rng(0)
    target, mean = rng.normal(size=(2, 7, 3))
    log_variance = np.array([-9.0, 0.5, 8.0])
    ours = objective.gaussian_log_likelihood(target, mean, log_variance)
    expected = scipy.stats.norm.logpdf(target, mean, np.exp(log_variance / 2)).sum(axis=1)
    np.testing.assert_allclose(ours, expected, rtol=1e-5)  # float32 sums of a few terms.


@pytest.mark.oracle
@pytest.mark.parametrize("is_shared", [False, True])
def test_the_optimal_variance_is_the_likeliest(is_shared):
    """SciPy searches for it; a number without errors has the least variance."""
    rng = np.random.default_rng(1)
    target, mean = rng.normal(size=(2, 2, 4, 3)) * [1.0, 20.0, 1.0]
    target[..., 2] = mean[..., 2]
    found = np.asarray(objective.optimal_log_variance(target, mean, is_shared))
    parts = [slice(None)] if is_shared else [0, 1]
    for part in parts:

        def cost(log_variance, part=part):
            std = np.exp(log_variance / 2)
            return -scipy.stats.norm.logpdf(target[..., part], mean[..., part], std).sum()

        expected = scipy.optimize.minimize_scalar(cost, bounds=(-15.0, 15.0), method="bounded").x
        np.testing.assert_allclose(found[part], expected, atol=1e-4)
    if not is_shared:
        assert found[2] == -12.0


@pytest.mark.unit
def test_no_gradient_flows_through_the_optimal_variance():
    target = jnp.array([[1.0, 2.0], [3.0, 4.0]])

    def loss(mean, log_variance=None):
        if log_variance is None:
            log_variance = objective.optimal_log_variance(target, mean, False)
        return objective.gaussian_log_likelihood(target, mean, log_variance).sum()

    mean = jnp.zeros_like(target)
    fixed = objective.optimal_log_variance(target, mean, False)
    np.testing.assert_array_equal(jax.grad(loss)(mean), jax.grad(loss)(mean, fixed))


@pytest.mark.oracle
def test_categorical_log_likelihood_sums_one_softmax_per_coordinate():
    rng = np.random.default_rng(1)
    logits = rng.normal(size=(5, 8)) * 3
    x, y = rng.integers(0, 4, (2, 5))
    target = np.concatenate([np.eye(4)[x], np.eye(4)[y]], axis=1)
    ours = objective.categorical_log_likelihood(jnp.asarray(target), jnp.asarray(logits), 4)
    rows = np.arange(5)
    expected = (
        scipy.special.log_softmax(logits[:, :4], axis=1)[rows, x]
        + scipy.special.log_softmax(logits[:, 4:], axis=1)[rows, y]
    )
    np.testing.assert_allclose(ours, expected, rtol=1e-5)


@pytest.mark.oracle
def test_gaussian_kl_is_the_integral():
    mean, log_variance, prior_mean, prior_log_variance = 0.7, -1.2, -0.4, 0.9
    x = np.linspace(-12, 12, 200_001)
    q = scipy.stats.norm(mean, np.exp(log_variance / 2))
    p = scipy.stats.norm(prior_mean, np.exp(prior_log_variance / 2))
    integral = np.trapezoid(q.pdf(x) * (q.logpdf(x) - p.logpdf(x)), x)
    ours = objective.gaussian_kl(
        *(jnp.array([v]) for v in (mean, log_variance, prior_mean, prior_log_variance))
    )
    np.testing.assert_allclose(ours, integral, rtol=1e-5)


@pytest.mark.unit
def test_kl_from_the_standard_normal_is_the_default():
    # 0.5 * (e^1 - 1 + 2^2 - 1) for mean 2, log-variance 1; 0 for the standard normal itself.
    kl = objective.gaussian_kl(jnp.array([[2.0, 0.0], [0.0, 0.0]]), jnp.array([[1.0, 0.0]] * 1))
    np.testing.assert_allclose(kl[0], 0.5 * (np.e - 1 + 4 - 1), rtol=1e-6)
    np.testing.assert_allclose(
        objective.gaussian_kl(jnp.zeros((1, 3)), jnp.zeros(3)), [0.0], atol=1e-7
    )


@pytest.mark.unit
def test_reconstruction_weight_starts_at_two_and_halves_its_excess():
    weights = [float(objective.reconstruction_weight(jnp.int32(e))) for e in (0, 1, 2, 3, 10_000)]
    assert weights == [2.0, 1.5, 1.25, 1.125, 1.0]


@pytest.mark.unit
def test_weighted_loss_divides_the_kl_by_the_weight():
    terms = objective.ElboTerms(jnp.float32(-3.0), jnp.float32(0.5), jnp.float32(1.5))
    assert float(objective.weighted_loss(terms, 2.0)) == 7.0  # -(2 * -3 - 2 / 2)
    assert float(objective.weighted_loss(terms, 1.0)) == 5.0  # The negative bound.


@pytest.mark.property
def test_terms_and_gradients_are_finite_at_the_ends():
    def total(mean, log_variance, coordinate):
        target = jnp.full((2,), coordinate)
        one_hot = jax.nn.one_hot(coordinate.astype(jnp.int32), 80)
        logits = 1e4 * (mean[0] - jnp.arange(80.0))
        return (
            objective.gaussian_log_likelihood(target, mean, log_variance)
            + objective.categorical_log_likelihood(one_hot, logits, 80)
            - objective.gaussian_kl(mean, log_variance)
            - objective.gaussian_kl(mean, jnp.zeros(2), 0.0, log_variance)
        )

    gradient_of = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    for log_variance, coordinate in itertools.product((-50.0, 0.0, 50.0), (0.0, 79.0)):
        value, gradient = gradient_of(
            jnp.array([79.0, -79.0]), jnp.full((2,), log_variance), jnp.float32(coordinate)
        )
        assert np.isfinite(value), (log_variance, coordinate)
        assert all(np.isfinite(leaf).all() for leaf in gradient), (log_variance, coordinate)


@pytest.mark.unit
def test_each_action_posterior_counts_once_and_each_recording_once():
    # B = 2 actions with S = 3 recordings, all distributions equal, so counts show in the ratios.
    ones = jnp.ones
    output = objective.VAEOutput(
        action_mean=2.0 * ones((2, 1)),
        action_log_variance=jnp.zeros((2, 1)),
        observation_mean=2.0 * ones((2, 3, 1)),
        observation_log_variance=jnp.zeros(1),
        prior_mean=jnp.zeros((2, 1, 1)),
        prior_log_variance=jnp.zeros(1),
        prediction=jnp.zeros((2, 3, 4, 1)),
        likelihood_log_variance=jnp.zeros(1),
    )
    features = jnp.zeros((2, 3, 5, 1)).at[:, :, 0].set(100.0)  # Step 0 must not be scored.
    terms = objective.elbo_terms(output, features, num_categories=0)
    kl = 0.5 * 2.0**2
    np.testing.assert_allclose(terms.kl_action, kl / 3, rtol=1e-6)
    np.testing.assert_allclose(terms.kl_observation, kl, rtol=1e-6)
    np.testing.assert_allclose(terms.reconstruction, -4 * 0.5 * np.log(2 * np.pi), rtol=1e-6)
