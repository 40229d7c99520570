"""Positions and stop bits that come with a choice."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxnew.environment import ActionSpec
from jaxnew.evaluation import measure
from jaxnew.policy import Categorical, make_method
from jaxnew.policy.auxiliary import AuxiliaryMethod, HybridDistribution, HybridSample
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import Beta
from jaxnew.policy.method import MethodContext
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions, AvailableSet
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy

N, M, D, K, A, NUM_OBS = 3, 5, 4, 2, 12, 6
SPEC = ActionSpec(A, position_dim=K, has_stop=True)
TRAIN_IDS = np.arange(A, dtype=np.int32)
RNG = np.random.default_rng(0)
TABLE = jnp.asarray(RNG.normal(size=(A, D)), jnp.float32)
OBS = jnp.asarray(RNG.normal(size=(N, NUM_OBS)), jnp.float32)
SETS = AvailableSet(
    jnp.asarray([RNG.permutation(A)[:M] for _ in range(N)], jnp.int32), jnp.ones((N, M), bool)
)


KINDS = [("ours", False), ("ours", True), ("modulated", True)]


def method_of(
    name: str = "ours", is_conditioned: bool = False, spec: ActionSpec = SPEC
) -> AuxiliaryMethod:
    # Widths that differ from each other, where the paper's are all alike.
    network = NetworkConfig(24, 16, 40) if name == "modulated" else NetworkConfig()
    context = MethodContext(TRAIN_IDS, False, spec, is_conditioned, network)
    method = make_method(name, context)
    assert isinstance(method, AuxiliaryMethod)
    return method


def moved(params: Any, seed: int = 5) -> Any:
    """Parameters none of which is at its start, so that nothing is zero by chance."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    shifted = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, shifted)


def distribution_of(
    method: AuxiliaryMethod, params: Any, sets: AvailableSet = SETS
) -> HybridDistribution:
    rows = method.project(params, TABLE)[sets.ids]
    return method.distribution(params, OBS, rows, sets.mask)


# ---- Beta ----


@pytest.mark.oracle
@pytest.mark.parametrize("a", [1.0, 1.7, 12.0, 500.0])
@pytest.mark.parametrize("b", [1.0, 3.3, 90.0])
def test_beta_equals_scipy(a: float, b: float) -> None:
    ours, theirs = Beta(jnp.float32([a, b]), jnp.float32([b, a])), stats.beta([a, b], [b, a])
    points = np.array([[0.01, 0.3], [0.5, 0.999], [1e-6, 1 - 1e-6]], np.float32)
    expected = theirs.logpdf(points.astype(np.float64)).sum(axis=-1)
    # gammaln of 590 is 3,170: float32 rounds it, and what is added to it, by up to 1e-3.
    np.testing.assert_allclose(ours.log_prob(jnp.asarray(points)), expected, rtol=1e-4, atol=2e-3)
    np.testing.assert_allclose(ours.entropy(), theirs.entropy().sum(), rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(ours.mode(), theirs.mean(), rtol=1e-6)


@pytest.mark.oracle
@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (2.5, 1.2), (40.0, 9.0)])
def test_beta_samples_have_its_distribution(a: float, b: float) -> None:
    shape = jnp.full((5000, 1), a), jnp.full((5000, 1), b)
    samples = np.asarray(Beta(*shape).sample(jax.random.key(1)))[:, 0]
    assert stats.kstest(samples, stats.beta(a, b).cdf).pvalue > 1e-3


@pytest.mark.unit
def test_samples_and_gradients_are_finite_at_the_ends() -> None:
    # Nearly all mass at 1: float32 draws are 1.0 before they are clipped.
    extreme = Beta(jnp.full((1000, 1), 1e7), jnp.ones((1000, 1)))
    samples = extreme.sample(jax.random.key(0))
    assert float(samples.max()) <= 1 - 1e-6 + 1e-7
    assert float(samples.min()) >= 1e-6
    gradient = jax.grad(lambda a: Beta(a, jnp.ones(1)).log_prob(samples[0]))(jnp.ones(1))
    assert np.isfinite(gradient).all()
    assert np.isfinite(extreme.log_prob(samples)).all()


# ---- Joint distribution ----


@pytest.mark.oracle
@pytest.mark.parametrize(("name", "is_conditioned"), KINDS)
def test_joint_log_prob_and_entropy_are_sums_of_the_parts(name: str, is_conditioned: bool) -> None:
    method = method_of(name, is_conditioned)
    distribution = distribution_of(method, moved(method.init(jax.random.key(0), OBS[0], D)))
    sample = distribution.sample(jax.random.key(2))
    rows = np.arange(N)
    choice, stop = np.asarray(sample.choice), np.asarray(sample.stop)
    alpha, beta = np.asarray(distribution.position.alpha), np.asarray(distribution.position.beta)
    if is_conditioned:
        assert alpha.shape == (N, M, K)
        alpha, beta = alpha[rows, choice], beta[rows, choice]
    of_choice = np.asarray(jax.nn.log_softmax(distribution.choice.logits))
    of_stop = np.asarray(jax.nn.log_softmax(distribution.stop.logits))
    of_position = stats.beta(alpha, beta)
    log_prob = of_choice[rows, choice] + of_stop[rows, stop]
    log_prob = log_prob + of_position.logpdf(np.asarray(sample.position)).sum(-1)
    np.testing.assert_allclose(distribution.log_prob(sample), log_prob, rtol=1e-4, atol=1e-4)
    entropy = -(np.exp(of_choice) * of_choice).sum(-1) - (np.exp(of_stop) * of_stop).sum(-1)
    entropy = entropy + 0.1 * of_position.entropy().sum(-1)
    np.testing.assert_allclose(distribution.entropy(sample), entropy, rtol=1e-4, atol=1e-4)
    mode = distribution.mode()
    np.testing.assert_array_equal(mode.choice, of_choice.argmax(-1))
    np.testing.assert_array_equal(mode.stop, of_stop.argmax(-1))


@pytest.mark.unit
def test_the_entropy_of_a_conditioned_position_needs_the_choice() -> None:
    method = method_of(is_conditioned=True)
    distribution = distribution_of(method, method.init(jax.random.key(0), OBS[0], D))
    with pytest.raises(ValueError, match="needs the sampled choice"):
        distribution.entropy()


@pytest.mark.oracle
def test_the_conditioned_head_is_the_one_of_the_paper() -> None:
    """Both forms of the head, for every action of the sets; the paper's reads `[f, a]`."""
    method = method_of(is_conditioned=True)
    params = moved(method.init(jax.random.key(0), OBS[0], D))
    found = distribution_of(method, params)
    features = method._base.features(params, OBS)
    # a = Lin(d, 64)(c), by hand.
    layer = params["utility"]["embed"]
    embedded = TABLE @ layer["kernel"] + layer["bias"]
    for name in ("alpha", "beta"):
        head = params["auxiliary"][name]
        for i in range(N):
            for j in range(M):
                both = np.concatenate([features[i], embedded[SETS.ids[i, j]]])
                hidden = np.maximum(both @ head["kernel"] + head["bias"], 0.0)
                x = hidden @ head["out"]["kernel"] + head["out"]["bias"]
                expected = 1.0 + np.log1p(np.exp(x))
                ours = getattr(found.position, name)[i, j]
                np.testing.assert_allclose(ours, expected, rtol=2e-4)
                written = method._conditioned.apply(
                    {"params": head},
                    features[i],
                    embedded[SETS.ids[i, j]],
                    method="concatenated",
                )
                np.testing.assert_allclose(ours, written, rtol=2e-4)


@pytest.mark.property
@pytest.mark.parametrize(("name", "is_conditioned"), KINDS)
def test_the_order_of_a_set_and_its_padding_do_not_matter(name: str, is_conditioned: bool) -> None:
    method = method_of(name, is_conditioned)
    params = moved(method.init(jax.random.key(0), OBS[0], D))
    sample = distribution_of(method, params).sample(jax.random.key(2))
    order = np.array([3, 0, 4, 1, 2])
    shuffled = AvailableSet(SETS.ids[:, order], SETS.mask)
    inverse = np.argsort(order)
    moved_sample = HybridSample(jnp.asarray(inverse)[sample.choice], sample.stop, sample.position)
    expected = distribution_of(method, params).log_prob(sample)
    np.testing.assert_allclose(
        distribution_of(method, params, shuffled).log_prob(moved_sample), expected, rtol=1e-5
    )
    wide = AvailableSet(
        jnp.pad(SETS.ids, ((0, 0), (0, 3)), constant_values=7),
        jnp.pad(SETS.mask, ((0, 0), (0, 3))),
    )
    padded = distribution_of(method, params, wide)
    np.testing.assert_allclose(padded.log_prob(sample), expected, rtol=1e-5)
    np.testing.assert_allclose(
        padded.entropy(sample), distribution_of(method, params).entropy(sample), rtol=1e-5
    )
    nothing = AvailableSet(SETS.ids, jnp.zeros_like(SETS.mask))
    drawn = distribution_of(method, params, nothing)
    sample = drawn.sample(jax.random.key(1))
    assert all(np.isfinite(x).all() for x in (drawn.log_prob(sample), drawn.entropy(sample)))


# ---- The method ----


@pytest.mark.unit
@pytest.mark.parametrize("name", ["ours", "modulated", "continuous", "discrete", "random"])
def test_every_method_gets_heads_beside_its_own_parameters(name: str) -> None:
    plain = make_method(name, MethodContext(train_ids=TRAIN_IDS))
    method = method_of(name)
    params = method.init(jax.random.key(0), OBS[0], D)
    plain_tree = jax.tree.structure(plain.init(jax.random.key(0), OBS[0], D))
    heads = params.pop("auxiliary")["heads"]
    assert jax.tree.structure(params) == plain_tree
    # w x 2 + 2 each for stop, alpha, beta (k = 2).
    assert sum(x.size for x in jax.tree.leaves(heads)) == 3 * (method.network.state_width * 2 + 2)
    params["auxiliary"] = {"heads": heads}
    distribution = distribution_of(method, params)
    sample = distribution.sample(jax.random.key(1))
    action = method.decode(sample, SETS, TABLE)
    rows = np.asarray(SETS.ids)
    assert all(i in rows[n] for n, i in enumerate(np.asarray(action.id)))
    np.testing.assert_allclose(action.position, 2 * np.asarray(sample.position) - 1, atol=1e-6)
    assert action.position.shape == (N, K)
    np.testing.assert_array_equal(action.stop, np.asarray(sample.stop) == 1)
    assert distribution.log_prob(sample).shape == distribution.entropy(sample).shape == (N,)
    # At the start, a stop is as likely as not, and positions have densities without poles.
    np.testing.assert_allclose(jax.nn.softmax(distribution.stop.logits), 0.5, atol=0.02)
    assert float(distribution.position.alpha.min()) > 1.0


@pytest.mark.unit
@pytest.mark.parametrize(("name", "is_conditioned"), KINDS)
def test_the_gradient_reaches_every_parameter(name: str, is_conditioned: bool) -> None:
    method = method_of(name, is_conditioned)
    params = moved(method.init(jax.random.key(0), OBS[0], D))
    sample = distribution_of(method, params).sample(jax.random.key(2))

    def total(params: Any) -> jax.Array:
        found = distribution_of(method, params)
        total = jnp.sum(found.log_prob(sample)) + jnp.sum(method.value(params, OBS))
        if name == "modulated":
            failed = np.ones(N, bool)
            total += jnp.sum(method.failure_loss(params, found, TABLE[:N], failed))
        return total

    gradients = jax.grad(total)(params)
    silent = [
        jax.tree_util.keystr(path)
        for path, g in jax.tree_util.tree_leaves_with_path(gradients)
        if not np.abs(g).max() > 1e-4
    ]
    # A softmax does not feel what is added to all utilities.
    assert silent == (["['utility']['score']['bias']"] if name == "ours" else [])


@pytest.mark.unit
@pytest.mark.parametrize("is_conditioned", [False, True])
def test_in_evaluations_the_choice_is_cautious_and_the_rest_as_it_was(is_conditioned: bool) -> None:
    method = method_of("modulated", is_conditioned)
    params = moved(method.init(jax.random.key(0), OBS[0], D))
    learning, evaluated = (distribution_of(m, params) for m in (method, method.for_evaluation()))
    scores, odds = numpy_policy.modulated(params, OBS, np.asarray(TABLE)[SETS.ids])
    for found, expected in (
        (learning, scores),
        (evaluated, scores - 8.0 * np.logaddexp(0.0, odds.max(axis=-1))),
    ):
        shifted = np.asarray(found.choice.logits) - np.asarray(found.choice.logits)[:, :1]
        expected = expected - expected[:, :1]
        np.testing.assert_allclose(shifted, expected, rtol=1e-3, atol=1e-3)
    for part in ("stop", "position"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(learning, part), getattr(evaluated, part)
        )


@pytest.mark.unit
def test_positions_and_stops_are_there_only_where_the_domain_has_them() -> None:
    placing = method_of(spec=ActionSpec(A, position_dim=1))
    params = placing.init(jax.random.key(0), OBS[0], D)
    sample = distribution_of(placing, params).sample(jax.random.key(0))
    assert sample.stop is None
    assert not placing.decode(sample, SETS, TABLE).stop.any()
    stopping = method_of(spec=ActionSpec(A, has_stop=True))
    params = stopping.init(jax.random.key(0), OBS[0], D)
    sample = distribution_of(stopping, params).sample(jax.random.key(0))
    assert sample.position is None
    assert stopping.decode(sample, SETS, TABLE).position.shape == (N, 0)
    plain = make_method("ours", MethodContext(action_spec=ActionSpec(A)))
    assert not isinstance(plain, AuxiliaryMethod)
    with pytest.raises(ValueError, match="neither a position nor a stop bit"):
        AuxiliaryMethod(plain, ActionSpec(A))


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "spec"),
    [("continuous", SPEC), ("discrete", SPEC), ("ours", ActionSpec(A, has_stop=True))],
)
def test_what_cannot_be_conditioned_is_refused(name: str, spec: ActionSpec) -> None:
    with pytest.raises(ValueError, match="Only a position that comes with a choice of the util"):
        method_of(name, True, spec)


@pytest.mark.unit
def test_hand_made_joint_entropy_weighs_the_position_by_a_tenth() -> None:
    distribution = HybridDistribution(
        Categorical(jnp.zeros((1, 4))), None, Beta(jnp.full((1, 1), 2.0), jnp.full((1, 1), 3.0))
    )
    expected = np.log(4) + 0.1 * stats.beta(2, 3).entropy()
    np.testing.assert_allclose(distribution.entropy()[0], expected, rtol=1e-5)


# ---- Learning ----

NUM, SIZE = 64, 4
VECTORS = np.random.default_rng(2).normal(size=(NUM, 3)).astype(np.float32)
# What an action is worth, and where it belongs, are functions of its representation.
WORLD = probe.HybridParams(
    jnp.asarray(np.clip(VECTORS[:, 1:2], -0.9, 0.9), jnp.float32),
    jnp.asarray(VECTORS[:, 0] > -0.3),
)


def learned(is_conditioned: bool) -> dict[str, float]:
    """Metrics on held-out actions after training with the others."""
    env = probe.HybridBandit(NUM, 1, True)
    context = MethodContext(action_spec=env.action_spec, conditions_position=is_conditioned)
    method = make_method("ours", context)
    shapes = RolloutConfig(num_envs=32, num_steps=16, normalize_observations=False)
    config = PPOConfig(rollout=shapes, num_minibatches=2, microbatch_size=0, lr_steps=10**9)
    numbers = Hyperparameters(learning_rate=3e-3, entropy_coefficient=0.002, clip=0.2)
    rollout = DeviceRollout(env, WORLD, method, shapes)
    learner = Learner(rollout, config)
    actions = Actions.of(VECTORS, np.arange(48, dtype=np.int32), SIZE)
    state = learner.compiled_init(jax.random.key(0), actions)
    state, _ = learner.compiled_updates(state, numbers, actions, num_updates=60)
    new = Actions.of(VECTORS, np.arange(48, NUM, dtype=np.int32), SIZE)
    episodes = measure(rollout, state.policy, new, 512, seed=9, is_greedy=True)
    return {name: float(values.mean()) for name, values in episodes.items()}


@pytest.mark.learning
def test_a_place_that_depends_on_the_choice_needs_the_conditioned_head() -> None:
    """Half of the episodes ask for a stop, and both heads learn it. In the others every action
    belongs elsewhere: one place for all is at best near one of a set's few good actions."""
    conditioned, shared = learned(True), learned(False)
    assert conditioned["has_stopped"] == pytest.approx(0.5, abs=0.08)
    assert shared["has_stopped"] == pytest.approx(0.5, abs=0.08)
    assert conditioned["episode_return"] > 0.9
    assert conditioned["episode_return"] > shared["episode_return"] + 0.1
