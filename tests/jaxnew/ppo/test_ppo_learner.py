"""The learner against a plain re-implementation (docs/method.md, "PPO"), and what runs rely on."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.finiteness import cause_of
from jaxnew.policy import make_method
from jaxnew.ppo import Hyperparameters, Learner, PPOConfig, TrainState
from jaxnew.ppo.learner import reduce_metrics
from jaxnew.ppo.objective import Minibatch
from jaxnew.rollout.contract import RolloutBatch, RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions, AvailableSet, SetConfig
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy
from tests.jaxnew.ppo import naive

N, T, A, M, WIDTH, D = 4, 8, 7, 4, 5, 3  # Sets drawn by sorting, which compiles faster.
CONFIG = PPOConfig(
    rollout=RolloutConfig(num_envs=N, num_steps=T),
    num_epochs=2,
    num_minibatches=2,
    microbatch_size=4,
    lr_steps=10 * N * T,
)
BOOTSTRAPPED = replace(
    CONFIG,
    rollout=replace(CONFIG.rollout, bootstraps_time_limits=True),
    time_limits_are_ends=False,
)
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
ACTIONS = Actions.of(TABLE, np.arange(A), M, padded_size=WIDTH)
NO_STEP = jnp.int32(0)


def learner_of(config: PPOConfig) -> Learner:
    rollout = DeviceRollout(
        probe.TableWorld(A), probe.ladder(A), make_method("ours"), config.rollout
    )
    return Learner(rollout, config)


@functools.cache
def learn_of(config: PPOConfig) -> Any:
    return jax.jit(learner_of(config).learn)


@pytest.fixture(scope="module")
def params() -> Any:
    shapes = make_method("ours").init(jax.random.key(0), jnp.zeros(4), D)
    return numpy_policy.randomized(shapes, seed=1, scale=0.1)


def batch_of(params: Any, seed: int, value_scale: float) -> dict[str, np.ndarray]:
    """A rollout [T, N] of numbers as they may occur: the data are near the policy, not on it."""
    rng = np.random.default_rng(seed)
    observation = rng.normal(size=(T, N, 4)).astype(np.float32)
    ids = np.array([rng.permutation(A)[:WIDTH] for _ in range(T * N)], np.int32)
    ids = ids.reshape(T, N, WIDTH)
    mask = np.broadcast_to(np.arange(WIDTH) < M, ids.shape)
    sample = rng.integers(0, M, (T, N)).astype(np.int32)
    log_probs = numpy_policy.log_softmax(
        numpy_policy.utilities(params, observation, TABLE[ids]), mask
    )
    log_prob = np.take_along_axis(log_probs, sample[..., None], axis=-1)[..., 0]
    value = numpy_policy.value(params, observation)
    terminated = rng.random((T, N)) < 0.15
    data = {
        "log_prob": log_prob + rng.normal(0, 0.1, (T, N)),
        "value": value + rng.normal(0, 0.1, (T, N)),
        "next_value": value_scale * rng.normal(size=(T, N)),
        "reward": value_scale * rng.normal(size=(T, N)),
    }
    return {
        **{name: x.astype(np.float32) for name, x in data.items()},
        "observation": observation,
        "ids": ids,
        "mask": mask,
        "sample": sample,
        "terminated": terminated,
        "done": terminated | (rng.random((T, N)) < 0.15),
    }


def as_batch(data: dict[str, np.ndarray]) -> RolloutBatch:
    data = dict(data)
    return RolloutBatch(available=AvailableSet(data.pop("ids"), data.pop("mask")), **data)


@pytest.mark.oracle
@pytest.mark.parametrize("config", [CONFIG, BOOTSTRAPPED], ids=["ends", "bootstrapped"])
@pytest.mark.parametrize("value_scale", [0.05, 3.0])
def test_learning_from_two_batches_is_what_the_formulas_say(
    params: Any, config: PPOConfig, value_scale: float
) -> None:
    """GAE, normalisation, minibatches, both losses, clipping, Adam and its schedule, in one.

    Adam moves a parameter by up to `learning_rate`, 1e-3, per step; its eps of 1e-5 keeps float32
    roundings of the gradient (1e-8) to 1e-3 of that. Eight steps: below 1e-5.
    """
    hp = Hyperparameters(
        learning_rate=2e-3,
        entropy_coefficient=0.03,
        clip=0.15,
        discount=0.9,
        gae_lambda=0.8,
        value_coefficient=0.7,
    )
    learner, learn = learner_of(config), learn_of(config)
    state = params, learner.optimizer.init(params)
    expected = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    zeros = jax.tree.map(np.zeros_like, expected)
    adam = naive.Adam(zeros, zeros)
    norms: list[float] = []
    for update in (3, 40):  # On the slope and after it: J = 10.
        data = batch_of(params, seed=update, value_scale=value_scale)
        key = jax.random.key(update)
        *state, metrics = learn(key, *state, as_batch(data), hp, ACTIONS, jnp.int32(update))

        learning_rate = 2e-3 * (1 - 0.9 * min(1.0, update / 10))
        np.testing.assert_allclose(metrics["learning_rate"], learning_rate, rtol=1e-6)
        has_no_future = data["done"] if config is CONFIG else data["terminated"]
        advantages = naive.advantages_of(data, has_no_future, hp)
        normalized = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-5)
        flat = {
            name: x.reshape(-1, *x.shape[2:])
            for name, x in {
                **data,
                "advantage": normalized,
                "value_target": advantages + data["value"],
            }.items()
        }
        history: list[dict[str, float]] = []
        for indices in np.asarray(learner._minibatch_indices(key)):
            minibatch = {name: x[indices] for name, x in flat.items()}
            parts, grads = naive.gradient(expected, TABLE, minibatch, hp)
            expected, norm = adam.step(expected, grads, learning_rate)
            norms.append(norm)
            history.append({**parts, "gradient_norm": norm})
        assert len(history) == 4
        for name in history[0]:
            mean = np.mean([step[name] for step in history])
            np.testing.assert_allclose(metrics[name], mean, rtol=1e-4, atol=1e-5, err_msg=name)
        residual = flat["value_target"] - flat["value"]
        explained = 1 - residual.var() / flat["value_target"].var()
        np.testing.assert_allclose(metrics["value/explained_variance"], explained, atol=1e-4)
        assert {float(metrics[f"nonfinite/{x}"]) for x in ("loss", "gradient", "advantage")} == {0}

    for got, want in zip(jax.tree.leaves(state[0]), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-5)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), expected, params)
    assert max(jax.tree.leaves(moved)) > 2e-3  # Far more than the tolerance.
    # Both sides of the bound on the norm were tested.
    assert (max(norms) > 0.5) if value_scale == 3.0 else (min(norms) < 0.5), norms


@pytest.mark.property
@pytest.mark.parametrize("microbatch_size", [0, 1, 4, 16])
def test_gradient_of_projected_microbatches_is_that_of_the_naive_loss(
    params: Any, microbatch_size: int
) -> None:
    """The table projected once and microbatches added up, against the loss that looks rows up and
    projects them for the whole minibatch. Means of 16 terms: float32 roundings only."""
    learner = learner_of(replace(CONFIG, microbatch_size=microbatch_size))
    data = batch_of(params, seed=2, value_scale=1.0)
    flat = {name: x.reshape(-1, *x.shape[2:])[:16] for name, x in data.items()}
    extra = np.random.default_rng(3).normal(size=(2, 16)).astype(np.float32)
    minibatch = {
        **{
            name: flat[name]
            for name in ("observation", "ids", "mask", "sample", "log_prob", "value")
        },
        "advantage": extra[0],
        "value_target": extra[1],
    }
    hp = Hyperparameters()
    under_test = dict(minibatch)
    available = AvailableSet(under_test.pop("ids"), under_test.pop("mask"))
    grads, parts = jax.jit(learner._gradient)(
        params, Minibatch(available=available, **under_test), hp, ACTIONS, available
    )
    expected_parts, expected = naive.gradient(params, TABLE, minibatch, hp)
    for name, value in expected_parts.items():
        np.testing.assert_allclose(parts[name], value, rtol=2e-5, atol=2e-5, err_msg=name)
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(grads), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * largest)
    # The projection itself is among what was compared.
    assert np.abs(expected["utility"]["embed"]["kernel"]).max() > 1e-3 * largest


@pytest.mark.property
def test_every_epoch_is_a_fresh_permutation_of_all_transitions() -> None:
    learner = learner_of(replace(CONFIG, num_epochs=3))
    indices = np.asarray(learner._minibatch_indices(jax.random.key(0)))
    assert indices.shape == (6, 16)
    epochs = indices.reshape(3, 32)
    assert (np.sort(epochs, axis=1) == np.arange(32)).all()
    assert len({tuple(epoch) for epoch in epochs.tolist()} | {tuple(range(32))}) == 4
    other = np.asarray(learner._minibatch_indices(jax.random.key(1)))
    assert not np.array_equal(indices, other)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("num_steps", "lr_steps", "update", "expected"),
    [
        # Confirmed in a released CREATE checkpoint, J = 8138.
        (384, 100_000_000, 4849, 4.637e-4),
        # "lr at the end of training": CREATE, Grid World, Recommender, Shape Stacking.
        (384, 100_000_000, 4882, 4.6e-4),
        (512, 40_000_000, 2441, 1.0e-4),
        (256, 40_000_000, 4882, 1.0e-4),
        (128, 100_000_000, 732, 9.7e-4),
        # It stays there.
        (512, 40_000_000, 10_000, 1.0e-4),
        (512, 40_000_000, 0, 1.0e-3),
    ],
)
def test_learning_rate_schedule(
    num_steps: int, lr_steps: int, update: int, expected: float
) -> None:
    rollout = RolloutConfig(num_envs=32, num_steps=num_steps)
    config = PPOConfig(rollout=rollout, lr_steps=lr_steps)
    assert config.lr_updates == lr_steps // num_steps // 32
    if num_steps == 384:
        assert config.lr_updates == 8138
    learner = Learner(
        DeviceRollout(probe.TableWorld(A), None, make_method("ours"), rollout), config
    )
    got = 1e-3 * float(learner._learning_rate_factor(jnp.int32(update)))
    # To the digits given.
    np.testing.assert_allclose(got, expected, rtol=1.5e-2 if expected in (4.6e-4,) else 6e-3)
    if update == 4849:
        np.testing.assert_allclose(got, 4.637e-4, rtol=2e-4)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ("observation", "observation"),
        ("reward", "reward"),
        ("log_prob", "policy"),
        ("next_value", "next_value"),
        ("params", "loss"),
    ],
)
def test_nonfinite_numbers_are_counted(params: Any, broken: str, cause: str) -> None:
    """And the first of them is named."""
    data = batch_of(params, seed=5, value_scale=1.0)
    if broken != "params":
        data[broken][T - 1, 2] = np.nan
    else:
        params = jax.tree.map(np.copy, params)
        params["encoder"]["Dense_0"]["kernel"][0, 0] = np.nan
    learner = learner_of(CONFIG)
    *_, metrics = learn_of(CONFIG)(
        jax.random.key(0),
        params,
        learner.optimizer.init(params),
        as_batch(data),
        Hyperparameters(),
        ACTIONS,
        NO_STEP,
    )
    assert metrics["nonfinite/loss"] >= 1
    assert metrics["nonfinite/gradient"] >= 1
    assert cause_of(metrics) == cause
    if broken == "reward":
        # One that spreads to what came before it in its episode, and no further.
        assert 1 <= metrics["nonfinite/advantage"] <= T
    elif broken != "next_value":
        assert metrics["nonfinite/advantage"] == 0


# Whole updates on a probe environment.


@functools.cache
def updates_of(num_updates: int) -> Any:
    learner = learner_of(CONFIG)
    return jax.jit(lambda *args: learner.updates(*args, num_updates))


@functools.cache
def initial_state(seed: int) -> TrainState:
    return jax.jit(learner_of(CONFIG).init)(jax.random.key(seed), ACTIONS)


HP = Hyperparameters()


def plain(state: TrainState) -> list[np.ndarray]:
    return [
        np.asarray(x) for x in jax.tree.leaves(state.replace(key=jax.random.key_data(state.key)))
    ]


@pytest.mark.property
def test_two_updates_are_one_and_one_bit_for_bit() -> None:
    """`initial_state` is only read, so that the two ways start alike."""
    whole, metrics = updates_of(2)(initial_state(0), HP, ACTIONS)
    half, first = updates_of(1)(initial_state(0), HP, ACTIONS)
    halves, second = updates_of(1)(half, HP, ACTIONS)
    assert int(whole.step) == 2
    for a, b in zip(plain(whole), plain(halves), strict=True):
        np.testing.assert_array_equal(a, b)
    assert metrics["num_episodes"] == first["num_episodes"] + second["num_episodes"]
    assert not all(np.array_equal(a, b) for a, b in zip(plain(half), plain(halves), strict=True))
    # The key is a constant of the run; what is drawn with it is not.
    assert np.array_equal(jax.random.key_data(whole.key), jax.random.key_data(half.key))


@pytest.mark.property
def test_what_acted_with_noise_is_learned_from_with_the_same_noise() -> None:
    """One gradient step: its ratios of probabilities are 1, unless it sees another table."""
    config = replace(CONFIG, num_epochs=1, num_minibatches=1)
    learner = learner_of(config)
    update = jax.jit(learner.update)
    fresh = initial_state(0)
    state = replace(fresh, params=numpy_policy.randomized(fresh.params, seed=1))
    noisy = replace(HP, representation_noise=0.5)
    (clean, _), (moved, metrics) = (update(state, hp, ACTIONS) for hp in (HP, noisy))
    assert abs(metrics["policy/approximate_kl"]) < 1e-6
    assert not all(np.array_equal(a, b) for a, b in zip(plain(clean), plain(moved), strict=True))
    again, _ = update(state, noisy, ACTIONS)
    for a, b in zip(plain(moved), plain(again), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.property
def test_updates_are_the_same_however_they_are_run() -> None:
    """Three in one compiled call and three compiled calls: bit for bit. One member under `vmap`
    is another program, whose roundings Adam's eps dampens: to 1e-5, a hundredth of a step."""
    learner, state = learner_of(CONFIG), initial_state(0)
    together, metrics = updates_of(3)(state, HP, ACTIONS)
    update = jax.jit(learner.update)
    each = []
    for _ in range(3):
        state, found = update(state, HP, ACTIONS)
        each.append(found)
    assert update._cache_size() == 1
    for a, b in zip(plain(together), plain(state), strict=True):
        np.testing.assert_array_equal(a, b)
    reduced = reduce_metrics(jax.tree.map(lambda *values: jnp.stack(values), *each))
    assert set(metrics) == set(reduced)
    for name, value in reduced.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-6, atol=1e-7, err_msg=name)

    one = jax.tree.map(lambda x: x[None], initial_state(0))
    mapped = jax.jit(jax.vmap(lambda s: learner.updates(s, HP, ACTIONS, 3)[0]))(one)
    for a, b in zip(plain(mapped), plain(together), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-5, atol=1e-5)


@pytest.mark.property
def test_every_update_draws_numbers_of_its_own() -> None:
    """What happened in the rollout, which knows neither learning rate nor gradient."""
    update = jax.jit(learner_of(CONFIG).update)
    state = initial_state(0)
    states = [state, replace(state, step=jnp.int32(1)), replace(state, key=jax.random.key(9))]
    returns = [float(update(s, HP, ACTIONS)[1]["episodes/episode_return"]) for s in states]
    assert len(set(returns)) == 3


@pytest.mark.unit
def test_compiled_parts_are_compiled_once() -> None:
    learner = learner_of(CONFIG)
    state = learner.compiled_init(jax.random.key(0), ACTIONS)
    for a, b in zip(plain(state), plain(initial_state(0)), strict=True):
        np.testing.assert_array_equal(a, b)
    for _ in range(2):
        state, _ = learner.compiled_updates(state, HP, ACTIONS, num_updates=1)
    assert int(state.step) == 2
    assert learner.compiled_updates._cache_size() == 1
    # Other actions of as many rows run the same program.
    others = Actions.of(TABLE, np.arange(1, A), M, padded_size=WIDTH)
    learner.compiled_updates(state, HP, others, num_updates=1)
    assert learner.compiled_updates._cache_size() == 1


@pytest.mark.unit
def test_shapes_of_what_acts_are_those_of_a_state() -> None:
    """Without an environment being started; what only training needs is left out."""
    shapes = learner_of(CONFIG).policy_shapes(ACTIONS)
    state = initial_state(0)
    kinds = [jax.tree.map(lambda x: (x.shape, x.dtype), found.policy) for found in (shapes, state)]
    assert kinds[0] == kinds[1]
    assert shapes.opt_state is shapes.key is None
    assert (shapes.step.shape, shapes.step.dtype) == (state.step.shape, state.step.dtype)
    raw = replace(CONFIG.rollout, normalize_observations=False)
    statistics = learner_of(replace(CONFIG, rollout=raw)).policy_shapes(ACTIONS).policy
    assert statistics.observation_statistics is None


@pytest.mark.property
def test_members_of_a_sweep_are_single_runs() -> None:
    """After one update (rounding may later turn a choice): to 1e-5, as Adam's eps dampens the
    roundings of the gradient to 1e-3 of its step, 1e-3."""
    members = [
        Hyperparameters(),
        Hyperparameters(learning_rate=3e-3, entropy_coefficient=0.5),
        Hyperparameters(clip=0.01, discount=0.5, gae_lambda=0.1, value_coefficient=2.0),
    ]
    states = [initial_state(seed) for seed in (0, 0, 1)]
    stack = lambda *trees: jax.tree.map(lambda *x: jnp.stack(x), *trees)  # noqa: E731
    learner = learner_of(CONFIG)
    sweep = jax.jit(jax.vmap(lambda *args: learner.updates(*args, 1), in_axes=(0, 0, None)))
    together, metrics = sweep(stack(*states), stack(*members), ACTIONS)
    singles = []
    for i, (state, hp) in enumerate(zip(states, members, strict=True)):
        single, single_metrics = updates_of(1)(state, hp, ACTIONS)
        member = jax.tree.map(lambda x, i=i: x[i], together)
        for a, b in zip(plain(member), plain(single), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
        for name, value in single_metrics.items():
            np.testing.assert_allclose(metrics[name][i], value, rtol=1e-4, atol=1e-5, err_msg=name)
        singles.append(single)
    # Members 0 and 1 saw the same rollout, and the numbers matter.
    first, second = (jax.tree.leaves(single.params) for single in singles[:2])
    assert max(np.abs(a - b).max() for a, b in zip(first, second, strict=True)) > 1e-3
    assert updates_of(1)._cache_size() == 1


@pytest.mark.property
@pytest.mark.parametrize(
    "name",
    ["learning_rate", "entropy_coefficient", "clip", "discount", "gae_lambda", "value_coefficient"],
)
def test_every_hyperparameter_matters(name: str) -> None:
    base, _ = updates_of(1)(initial_state(0), HP, ACTIONS)
    changed_hp = HP.replace(**{name: 0.7 * getattr(HP, name)})
    changed, _ = updates_of(1)(initial_state(0), changed_hp, ACTIONS)
    # The same program and the same draws, so any difference is the number's. (That of the entropy
    # coefficient is small: the entropy of the first policy is almost at its maximum.)
    leaves = zip(jax.tree.leaves(base.params), jax.tree.leaves(changed.params), strict=True)
    assert max(np.abs(a - b).max() for a, b in leaves) > 0


@pytest.mark.unit
def test_defaults_are_those_of_the_paper_in_grid_world() -> None:
    """docs/method.md, "PPO", column Grid World."""
    config = PPOConfig()
    assert vars(HP) == {
        "learning_rate": 1e-3,
        "entropy_coefficient": 0.05,
        "clip": 0.1,
        "discount": 0.99,
        "gae_lambda": 0.95,
        "value_coefficient": 0.5,
        "representation_noise": 0.0,
    }
    assert (config.rollout.num_envs, config.rollout.num_steps) == (32, 512)
    assert (config.num_epochs, config.num_minibatches, config.minibatch_size) == (4, 4, 4096)
    assert (config.lr_steps, config.max_grad_norm) == (40_000_000, 0.5)
    assert SetConfig() == SetConfig(size=50, padded_size=0, is_fixed=False)
    assert config.time_limits_are_ends


@pytest.mark.unit
def test_metrics_of_several_updates_are_reduced() -> None:
    stacked = {
        "loss/total": jnp.array([1.0, 3.0]),
        "nonfinite/loss": jnp.array([0.0, 2.0, 5.0]),
        "nonfinite/reward": jnp.array([0.0, 0.0, 1.0]),
        "episodes/num_episodes": jnp.array([3.0, 1.0]),
        "episodes/is_success": jnp.array([2.0, 1.0]),
    }
    assert {name: float(x) for name, x in reduce_metrics(stacked).items()} == {
        "loss/total": 2.0,
        "nonfinite/loss": 2.0,  # Of the first update that has any: rewards came later.
        "nonfinite/reward": 0.0,
        "num_episodes": 4.0,
        "episode/is_success": 0.75,  # 3 of 4 episodes, not the mean of 2/3 and 1.
    }
    none = {**stacked, "episodes/num_episodes": jnp.zeros(2), "episodes/is_success": jnp.zeros(2)}
    assert np.isnan(reduce_metrics(none)["episode/is_success"])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_minibatches": 3}, r"32 is not divisible by num_minibatches=3"),
        ({"microbatch_size": 5}, r"16 transitions is not divisible by microbatch_size=5.*0"),
        ({"rollout": RolloutConfig(1, 1)}, "one advantage has no deviation"),
        ({"lr_steps": 31}, r"lr_steps=31 is less than one update of 32 steps"),
        ({"time_limits_are_ends": False}, r"opposite of time_limits_are_ends, got False"),
        ({"num_minibatches": 0}, "num_minibatches"),
        ({"num_minibatches": -2}, "num_minibatches"),
        ({"num_epochs": 0}, "num_epochs"),
        ({"microbatch_size": -4}, "microbatch_size"),
        ({"max_grad_norm": 0.0}, "max_grad_norm"),
    ],
)
def test_bad_configs_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes)
