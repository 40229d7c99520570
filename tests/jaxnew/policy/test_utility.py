"""The utility policy (paper section 4.2): a function of a set, as the paper writes it."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import METHODS, UtilityMethod, make_method
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.method import MethodContext
from jaxnew.policy.modulated import ModulatedMethod, ModulatedUtility
from jaxnew.policy.utility import Utility
from jaxnew.sampling import AvailableSet
from tests.jaxnew.policy import numpy_policy

NUM_FEATURES, D, M, BATCH = 81, 16, 12, 7
METHOD = UtilityMethod()
NETWORK = NetworkConfig(state_width=24, critic_width=16, utility_width=40)
# Each with its forward pass in NumPy.
ORACLES = {
    METHOD: numpy_policy.utilities,
    UtilityMethod(NETWORK): numpy_policy.utilities,
    ModulatedMethod(NETWORK): numpy_policy.modulated_utilities,
    ModulatedMethod(NETWORK).for_evaluation(): numpy_policy.cautious_utilities,
}


def named(method: UtilityMethod) -> str:
    return f"{method.name}-{method.network.state_width}-{ORACLES[method].__name__}"


@pytest.fixture(scope="module", params=list(ORACLES), ids=named)
def method(request: pytest.FixtureRequest) -> UtilityMethod:
    chosen: UtilityMethod = request.param
    return chosen


# float32 sums of up to 128 products of order-one numbers: a few spacings of 1e-7 each.
TOLERANCE = {"rtol": 2e-5, "atol": 2e-5}


@pytest.fixture(scope="module")
def fresh() -> dict[str, Any]:
    return METHOD.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)


@pytest.fixture(scope="module")
def params(method: UtilityMethod) -> dict[str, Any]:
    init = functools.partial(method.init, representation_size=D)
    shapes = jax.eval_shape(init, jax.random.key(0), jnp.zeros(NUM_FEATURES))
    return numpy_policy.randomized(shapes, seed=1)


@pytest.fixture(scope="module")
def inputs() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    mask = rng.random((BATCH, M)) < 0.7
    mask[:, 4] = True
    return {
        "obs": rng.normal(size=(BATCH, NUM_FEATURES)).astype(np.float32),
        "representations": rng.normal(size=(BATCH, M, D)).astype(np.float32),
        "mask": mask,
    }


@functools.partial(jax.jit, static_argnums=0)
def log_probs(
    method: UtilityMethod, params: Any, obs: Any, representations: Any, mask: Any
) -> jax.Array:
    """f32[..., m] of every choice."""
    projected = method.project(params, representations)
    distribution = method.distribution(params, obs, projected, mask)
    choices = jnp.arange(mask.shape[-1])
    return jnp.stack(
        [distribution.log_prob(jnp.full(mask.shape[:-1], c)) for c in choices], axis=-1
    )


@pytest.mark.oracle
def test_policy_equals_the_numpy_forward_pass(
    method: UtilityMethod, params: Any, inputs: Any
) -> None:
    got = np.asarray(log_probs(method, params, **inputs))
    utilities = ORACLES[method](params, inputs["obs"], inputs["representations"])
    assert utilities.std() > 0.5  # Scores that differ, or the comparison says little.
    expected = numpy_policy.log_softmax(utilities, inputs["mask"])
    mask = inputs["mask"]
    np.testing.assert_allclose(got[mask], expected[mask], **TOLERANCE)
    assert (got[~mask] < -1e8).all()


@pytest.mark.oracle
def test_value_equals_the_numpy_forward_pass(
    method: UtilityMethod, params: Any, inputs: Any
) -> None:
    got = method.value(params, inputs["obs"])
    assert got.shape == (BATCH,)
    np.testing.assert_allclose(got, numpy_policy.value(params, inputs["obs"]), **TOLERANCE)


@pytest.mark.property
@pytest.mark.parametrize("d", [1, 16, 128])
@pytest.mark.parametrize("kind", [Utility, ModulatedUtility])
def test_the_factored_form_is_the_concatenated_form(kind: type[Utility], d: int) -> None:
    """The same sum over products in another order; hence float32 roundings only."""
    utility = kind(NETWORK)
    features = jax.random.normal(jax.random.key(3), (BATCH, NETWORK.state_width))
    representations = jax.random.normal(jax.random.key(4), (BATCH, M, d))
    shapes = utility.init(jax.random.key(5), features, representations, method="concatenated")
    variables = numpy_policy.randomized(shapes, seed=6)
    paper = utility.apply(variables, features, representations, method="concatenated")
    projected = utility.apply(variables, representations, method="project")
    assert projected.shape == (BATCH, M, NETWORK.utility_width)
    found = utility.apply(variables, features, projected, np.ones((BATCH, M), bool))
    np.testing.assert_allclose(found.logits, paper, **TOLERANCE)
    # The projection of a whole table and gathering of rows commute.
    rows = np.array([3, 0, 3])
    np.testing.assert_allclose(
        utility.apply(variables, representations[0][rows], method="project"),
        projected[0][rows],
        **TOLERANCE,
    )


@pytest.mark.property
def test_permuting_the_set_permutes_the_choices(
    method: UtilityMethod, params: Any, inputs: Any
) -> None:
    order = np.random.default_rng(7).permutation(M)
    permuted = {
        "obs": inputs["obs"],
        "representations": inputs["representations"][:, order],
        "mask": inputs["mask"][:, order],
    }
    np.testing.assert_allclose(
        log_probs(method, params, **permuted),
        log_probs(method, params, **inputs)[:, order],
        **TOLERANCE,
    )


@pytest.mark.property
def test_padding_is_not_seen(method: UtilityMethod, params: Any, inputs: Any) -> None:
    """Not its rows, not their number: also where a padded row would win."""
    mask = np.broadcast_to(np.arange(M) < 8, (BATCH, M))
    inputs = {**inputs, "mask": mask}
    padded = np.asarray(log_probs(method, params, **inputs))
    others = inputs["representations"].copy()
    others[:, 8:] = 1e3
    changed = np.asarray(log_probs(method, params, **{**inputs, "representations": others}))
    assert np.array_equal(changed[:, :8], padded[:, :8])
    bare = log_probs(
        method, params, inputs["obs"], inputs["representations"][:, :8], np.ones((BATCH, 8), bool)
    )
    np.testing.assert_allclose(padded[:, :8], bare, **TOLERANCE)

    def entropy(representations: jax.Array) -> jax.Array:
        projected = method.project(params, representations)
        return jnp.sum(method.distribution(params, inputs["obs"], projected, mask).entropy())

    grad = np.asarray(jax.grad(entropy)(jnp.asarray(inputs["representations"])))
    assert (grad[:, 8:] == 0).all()
    assert (grad[:, :8] != 0).any()


@pytest.mark.unit
def test_parameter_counts_are_those_of_the_release(fresh: Any) -> None:
    """Used layers only. Grid World, 81 numbers seen, d = 16:

    actor    81*64 + 64 + 64*64 + 64 = 9,408
    critic   9,408 + 64 + 1          = 9,473
    utility  (16*64 + 64) + (128*64 + 64) + (64 + 1) = 1,088 + 8,256 + 65 = 9,409
    together 28,290; Recommender (16 and 16): 2 * (1,088 + 4,160) + 65 + 9,409 = 19,970.
    """

    def count(tree: Any) -> int:
        return sum(x.size for x in jax.tree.leaves(tree))

    assert {name: count(tree) for name, tree in fresh.items()} == {
        "encoder": 9408,
        "critic": 9473,
        "utility": 9409,
    }
    assert count(fresh) == 28_290
    assert count(METHOD.init(jax.random.key(0), jnp.zeros(16), 16)) == 19_970


def assert_orthogonal(kernel: np.ndarray, gain: float) -> None:
    """The smaller side's Gram matrix is gain^2 times the identity, to float32 accuracy."""
    kernel = np.asarray(kernel, np.float64)
    gram = kernel.T @ kernel if kernel.shape[0] >= kernel.shape[1] else kernel @ kernel.T
    np.testing.assert_allclose(gram, gain**2 * np.eye(len(gram)), atol=1e-5 * gain**2)


@pytest.mark.oracle
def test_initial_weights_are_orthogonal_with_the_gains_of_the_spec(fresh: Any) -> None:
    root_2 = np.sqrt(2.0)
    for trunk in (fresh["encoder"], fresh["critic"]["VectorEncoder_0"]):
        assert trunk["Dense_0"]["kernel"].shape == (81, 64)
        assert trunk["Dense_1"]["kernel"].shape == (64, 64)
        assert_orthogonal(trunk["Dense_0"]["kernel"], root_2)
        assert_orthogonal(trunk["Dense_1"]["kernel"], root_2)
    assert_orthogonal(fresh["critic"]["value"]["kernel"], root_2)
    utility = fresh["utility"]
    assert utility["embed"]["kernel"].shape == (16, 64)
    assert utility["kernel"].shape == (128, 64)
    assert utility["score"]["kernel"].shape == (64, 1)
    for kernel in (utility["embed"]["kernel"], utility["kernel"], utility["score"]["kernel"]):
        assert_orthogonal(kernel, 0.01)
    biases = [x for x in jax.tree.leaves(fresh) if x.ndim == 1]
    assert len(biases) == 8
    assert all((np.asarray(bias) == 0).all() for bias in biases)
    # The critic's trunk is a copy of the architecture, not of the numbers.
    actor, critic = fresh["encoder"], fresh["critic"]["VectorEncoder_0"]
    assert not np.allclose(actor["Dense_0"]["kernel"], critic["Dense_0"]["kernel"])
    other = METHOD.init(jax.random.key(1), jnp.zeros(NUM_FEATURES), D)
    assert all(
        not np.allclose(a, b)
        for a, b in zip(jax.tree.leaves(fresh), jax.tree.leaves(other), strict=True)
        if a.ndim == 2
    )


@pytest.mark.property
@pytest.mark.parametrize(
    ("kind", "bound"),
    [
        # |f| <= 8 (64 tanhs), so |hidden| <= 0.01 * (8 + 0.01 |c|) and |u| <= 0.01 |hidden| < 1e-3
        # for |c| < 100: log-probabilities within 2e-3 of -ln m.
        (UtilityMethod, 2e-3),
        # |hidden| <= 1.5 * (8 + 1.5 |c|) < 30 for |c| < 8, and its weights 0.01 |f| <= 0.08; these
        # have random signs: a few of 30 * 0.08 / 64 ** 0.5.
        (ModulatedMethod, 0.5),
    ],
)
def test_initial_policy_is_almost_uniform(
    kind: type[UtilityMethod], bound: float, inputs: Any
) -> None:
    method = kind()
    fresh = method.init(jax.random.key(0), jnp.zeros(NUM_FEATURES), D)
    inputs = {**inputs, "mask": np.ones((BATCH, M), bool)}
    got = np.asarray(log_probs(method, fresh, **inputs))
    assert np.abs(got + np.log(M)).max() < bound
    assert got.std() > 0  # ... but not exactly.


@pytest.mark.unit
def test_actor_and_critic_share_nothing(method: UtilityMethod, params: Any, inputs: Any) -> None:
    @jax.jit
    def gradients(params: Any) -> tuple[Any, Any]:
        value_grad = jax.grad(lambda p: jnp.sum(method.value(p, inputs["obs"])))(params)
        policy_grad = jax.grad(lambda p: log_probs(method, p, **inputs)[:, 4].sum())(params)
        return value_grad, policy_grad

    value_grad, policy_grad = gradients(params)

    def is_zero(tree: Any) -> bool:
        return all((np.asarray(x) == 0).all() for x in jax.tree.leaves(tree))

    assert is_zero(value_grad["encoder"])
    assert is_zero(value_grad["utility"])
    assert is_zero(policy_grad["critic"])
    for tree in (value_grad["critic"], policy_grad["encoder"], policy_grad["utility"]):
        assert all((np.asarray(x) != 0).any() for x in jax.tree.leaves(tree) if x.ndim == 2)


@pytest.mark.unit
def test_decode_names_the_id_behind_the_choice() -> None:
    available = AvailableSet(jnp.array([[7, 3, 9], [4, 4, 1]]), jnp.ones((2, 3), bool))
    action = METHOD.decode(jnp.array([2, 0]), available, jnp.zeros((0, D)))
    assert action.id.tolist() == [9, 4]
    assert action.position.shape == (2, 0)
    assert action.stop.tolist() == [False, False]


@pytest.mark.unit
def test_methods_by_name() -> None:
    assert isinstance(make_method("ours"), UtilityMethod)
    assert make_method("ours").name == "ours"
    context = MethodContext(train_ids=np.arange(3))
    assert all(make_method(name, context).name == name for name in METHODS)
    with pytest.raises(ValueError, match=r"Unknown method 'our'; choose one of .*'ours'"):
        make_method("our")
