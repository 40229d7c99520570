"""The paper's baselines and random play behind the interface of ours."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import log_softmax

from jaxnew.policy import make_method
from jaxnew.policy.continuous import ContinuousMethod, DiagonalGaussian
from jaxnew.policy.discrete import DiscreteMethod
from jaxnew.policy.distributions import nearest_id
from jaxnew.policy.method import MethodContext
from jaxnew.sampling import AvailableSet
from tests.jaxnew.policy import numpy_policy

NUM_FEATURES, A, D, M, BATCH = 9, 30, 4, 6, 5
RNG = np.random.default_rng(3)
TABLE = RNG.normal(size=(A, D)).astype(np.float32)
TRAIN_IDS = np.arange(0, A, 2)
OBS = RNG.normal(size=(BATCH, NUM_FEATURES)).astype(np.float32)
CONTINUOUS, DISCRETE = ContinuousMethod(), DiscreteMethod(TRAIN_IDS)


def sets_of(seed: int, num_real: int = M) -> AvailableSet:
    """BATCH sets of M ids, of which the last are padding."""
    rng = np.random.default_rng(seed)
    ids = np.stack([rng.permutation(A)[:M] for _ in range(BATCH)])
    mask = np.broadcast_to(np.arange(M) < num_real, ids.shape)
    return AvailableSet(jnp.asarray(ids, jnp.int32), jnp.asarray(mask))


def fresh(method: Any) -> Any:
    return method.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)


def randomized(method: Any) -> Any:
    return numpy_policy.randomized(fresh(method), seed=1)


@pytest.mark.oracle
@pytest.mark.parametrize("sums_entropy", [False, True])
def test_gaussian_is_scipys(sums_entropy: bool) -> None:
    mean, variance, point = RNG.normal(size=(3, BATCH, D))
    variance = np.exp(variance)
    found = DiagonalGaussian(jnp.asarray(mean), jnp.asarray(variance), sums_entropy)
    expected = [stats.multivariate_normal(mean[b], np.diag(variance[b])) for b in range(BATCH)]
    log_probs = [expected[b].logpdf(point[b]) for b in range(BATCH)]
    np.testing.assert_allclose(found.log_prob(jnp.asarray(point)), log_probs, rtol=1e-5)
    entropies = np.array([of_one.entropy() for of_one in expected])
    scale = 1.0 if sums_entropy else 1.0 / D
    np.testing.assert_allclose(found.entropy(), entropies * scale, rtol=1e-5)
    np.testing.assert_array_equal(found.mode(), jnp.asarray(mean))


@pytest.mark.property
def test_gaussian_samples_have_its_mean_and_variance() -> None:
    mean, variance = jnp.array([1.0, -2.0]), jnp.array([0.25, 4.0])
    shape = (100_000, 2)
    samples = DiagonalGaussian(
        jnp.broadcast_to(mean, shape), jnp.broadcast_to(variance, shape)
    ).sample(jax.random.key(0))
    # Five standard errors of a mean, and of a variance.
    np.testing.assert_allclose(samples.mean(0), mean, atol=0.032)
    np.testing.assert_allclose(samples.var(0), variance, rtol=0.023)
    assert abs(np.corrcoef(np.asarray(samples).T)[0, 1]) < 0.016


@pytest.mark.unit
def test_log_probability_is_bounded() -> None:
    narrow = DiagonalGaussian(jnp.zeros(1), jnp.full(1, 1e-12))
    assert float(narrow.log_prob(jnp.ones(1))) == -1e5


@pytest.mark.unit
def test_continuous_head_starts_as_the_spec_says() -> None:
    """Standard deviation sqrt(softplus(0)) = 0.83 where features vanish; orthogonal, gain 1."""
    params = fresh(CONTINUOUS)
    for name in ("mean", "variance"):
        kernel = np.asarray(params["policy"][name]["kernel"])
        np.testing.assert_allclose(kernel.T @ kernel, np.eye(D), atol=1e-5)
        np.testing.assert_array_equal(params["policy"][name]["bias"], 0.0)
    # Observations of zero give features of zero: tanh, and biases of zero.
    at_zero = CONTINUOUS.distribution(
        params, jnp.zeros(NUM_FEATURES), jnp.zeros((M, D)), jnp.ones(M, bool)
    )
    np.testing.assert_allclose(np.sqrt(at_zero.variance), 0.8325546, rtol=1e-5)
    np.testing.assert_array_equal(at_zero.mean, 0.0)


@pytest.mark.oracle
def test_continuous_output_is_the_numpy_forward_pass() -> None:
    params = randomized(CONTINUOUS)
    found = CONTINUOUS.distribution(params, OBS, TABLE[:M], jnp.ones(M, bool))
    features = numpy_policy.encode(params["policy"]["encoder"], OBS)
    mean = numpy_policy.dense(params["policy"]["mean"], features)
    variance = np.log1p(np.exp(numpy_policy.dense(params["policy"]["variance"], features)))
    np.testing.assert_allclose(found.mean, mean, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(found.variance, variance, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(
        CONTINUOUS.value(params, OBS), numpy_policy.value(params, OBS), rtol=2e-5, atol=2e-5
    )


@pytest.mark.oracle
def test_discrete_output_is_the_numpy_forward_pass() -> None:
    params = randomized(DISCRETE)
    found = DISCRETE.distribution(params, OBS, TABLE[:M], jnp.ones(M, bool))
    features = numpy_policy.encode(params["policy"]["encoder"], OBS)
    logits = numpy_policy.dense(params["policy"]["logits"], features)
    assert logits.shape == (BATCH, len(TRAIN_IDS))
    for choice in (0, len(TRAIN_IDS) - 1):
        np.testing.assert_allclose(
            found.log_prob(jnp.full(BATCH, choice)),
            log_softmax(logits, axis=-1)[:, choice],
            rtol=2e-5,
            atol=2e-5,
        )
    fresh_kernel = np.asarray(fresh(DISCRETE)["policy"]["logits"]["kernel"])
    np.testing.assert_allclose(
        fresh_kernel.T @ fresh_kernel, 1e-4 * np.eye(len(TRAIN_IDS)), atol=1e-9
    )


@pytest.mark.oracle
@pytest.mark.parametrize("num_real", [1, 4, M])
def test_nearest_is_by_brute_force_and_never_padding(num_real: int) -> None:
    available = sets_of(7, num_real)
    points = RNG.normal(size=(BATCH, D)).astype(np.float32)
    found = np.asarray(nearest_id(jnp.asarray(points), available, jnp.asarray(TABLE)))
    for b in range(BATCH):
        real = np.asarray(available.ids)[b, :num_real]
        distances = [float(((TABLE[i] - points[b]) ** 2).sum()) for i in real]
        assert found[b] == real[int(np.argmin(distances))]


@pytest.mark.unit
def test_of_equally_near_actions_the_first_in_the_set_is_taken() -> None:
    table = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    for ids in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        available = AvailableSet(jnp.array(ids), jnp.ones(3, bool))
        assert int(nearest_id(jnp.zeros(2), available, table)) == ids[0]
    assert int(nearest_id(jnp.array([0.9, 0.0]), available, table)) == 2


@pytest.mark.property
def test_the_order_of_a_set_changes_no_action() -> None:
    available = sets_of(11)
    order = np.array([3, 0, 5, 1, 4, 2])
    shuffled = AvailableSet(available.ids[:, order], available.mask)
    points = jnp.asarray(RNG.normal(size=(BATCH, D)), jnp.float32)
    for method, sample in ((CONTINUOUS, points), (DISCRETE, jnp.array([0, 3, 7, 14, 2]))):
        ids = [method.decode(sample, sets, TABLE).id.tolist() for sets in (available, shuffled)]
        assert ids[0] == ids[1]


@pytest.mark.unit
def test_discrete_acts_itself_where_it_is_available() -> None:
    """In training all train actions are, as one set for all environments."""
    train_set = AvailableSet(jnp.asarray(TRAIN_IDS), jnp.ones(len(TRAIN_IDS), bool))
    samples = jnp.arange(len(TRAIN_IDS))
    found = DISCRETE.decode(samples, train_set, jnp.asarray(TABLE)).id
    np.testing.assert_array_equal(found, TRAIN_IDS)
    with pytest.raises(ValueError, match="ids of the actions it is trained on"):
        make_method("discrete")


@pytest.mark.unit
def test_neither_baseline_sees_the_set() -> None:
    masks = (jnp.ones((BATCH, M), bool), jnp.arange(M) < jnp.ones((BATCH, 1)))
    for method in (CONTINUOUS, DISCRETE):
        params = randomized(method)
        leaves = [
            jax.tree.leaves(method.distribution(params, OBS, projected, mask))
            for mask in masks
            for projected in (TABLE[:M], -TABLE[M : 2 * M])
        ]
        for other in leaves[1:]:
            for a, b in zip(leaves[0], other, strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.unit
def test_random_play_is_uniform_whatever_it_is_given() -> None:
    method = make_method("random", MethodContext())
    mask = sets_of(1, 4).mask
    found = method.distribution(randomized(method), OBS, TABLE[:M], mask)
    np.testing.assert_allclose(found.entropy(), np.full(BATCH, np.log(4)), rtol=1e-6)
    np.testing.assert_allclose(
        found.log_prob(jnp.full(BATCH, 3)), np.full(BATCH, -np.log(4)), rtol=1e-6
    )


@pytest.mark.unit
def test_ids_behind_choices_of_one_set_and_of_many() -> None:
    one = AvailableSet(jnp.array([5, 6, 7]), jnp.ones(3, bool))
    np.testing.assert_array_equal(one.id_of(jnp.array([[2, 0], [1, 1]])), [[7, 5], [6, 6]])
    many = AvailableSet(jnp.array([[5, 6, 7], [8, 9, 10]]), jnp.ones((2, 3), bool))
    np.testing.assert_array_equal(many.id_of(jnp.array([2, 0])), [7, 8])
