"""Whole updates on a probe environment: what runs rely on."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.ppo import Hyperparameters, PPOConfig, TrainState
from jaxnew.ppo.learner import reduce_metrics
from jaxnew.sampling import Actions, SetConfig
from tests.jaxnew.policy import numpy_policy
from tests.jaxnew.ppo.learners import ACTIONS, CONFIG, TABLE, WIDTH, A, M, learner_of


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
        "final_entropy": 1.0,
        "clip": 0.1,
        "discount": 0.99,
        "gae_lambda": 0.95,
        "value_coefficient": 0.5,
        "failure_coefficient": 1.0,
        "representation_noise": 0.0,
    }
    assert (config.rollout.num_envs, config.rollout.num_steps) == (32, 512)
    assert (config.num_epochs, config.num_minibatches, config.minibatch_size) == (4, 4, 4096)
    assert (config.lr_steps, config.max_grad_norm) == (40_000_000, 0.5)
    assert SetConfig() == SetConfig(size=50, padded_size=0, is_fixed=False, training_size=0)
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
