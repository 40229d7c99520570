"""Evaluation in a pool: the same episodes in pools of any size; training goes on undisturbed."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew.host_evaluation import HostEvaluator
from jaxnew.rollout.pool import HostEnvironments
from jaxnew.sampling import ActionPool, draw_sets
from tests import toy_host
from tests.jaxnew.rollout import host_setup as host

M, KEY, EPISODES = 4, jax.random.key(2020), 13
TABLE, POOL = host.TABLE, host.POOL
PROGRAMS = ("_draw", "_project", "_act_sampled", "_act_greedy")


@functools.cache
def compiled(**options: int) -> HostEvaluator:
    return HostEvaluator(host.environments_of(), host.method_of(), M, width=4, **options)


def evaluator_of(environments: HostEnvironments, **options: int) -> HostEvaluator:
    first = compiled(**options)
    evaluator = replace(first, environments=environments)
    for program in PROGRAMS:
        evaluator.__dict__[program] = getattr(first, program)
    return evaluator


def run(num_envs: int = 4, num_halves: int = 2, episodes: int = EPISODES, **options: Any) -> Any:
    is_greedy = options.pop("is_greedy", False)
    evaluator = evaluator_of(host.environments_of(num_envs, num_halves, seed=1), **options)
    return evaluator.run(host.params_of(), None, TABLE, POOL, KEY, episodes, is_greedy)


def seed_of(key: jax.Array) -> int:
    words = np.asarray(jax.random.key_data(key)).tolist()
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1))


@pytest.mark.property
def test_numbers_depend_on_no_size() -> None:
    whole = run()
    assert all(values.shape == (EPISODES,) for values in whole.values())
    assert set(whole) == {*toy_host.METRICS, "num_steps"}
    for num_envs, num_halves in ((1, 1), (3, 1), (4, 4), (16, 2)):
        other = run(num_envs, num_halves)
        for name, values in whole.items():
            np.testing.assert_array_equal(values, other[name], err_msg=name)
    fewer = run(episodes=5)
    for name, values in whole.items():
        np.testing.assert_array_equal(values[:5], fewer[name])
    # Bad actions are worth 0; other returns are equal only if episodes are.
    returns = whole["episode_return"]
    assert len(np.unique(returns[returns > 0])) == (returns > 0).sum() > 5


@pytest.mark.oracle
def test_greedy_episodes_are_those_of_the_policy() -> None:
    """Each episode again, on its own: seed, set, stacks and the most likely action."""
    method, params = host.method_of(), host.params_of()

    @jax.jit
    def mode(image: Any, ids: Any) -> Any:
        rows = method.project(params, TABLE)[ids][None]
        distribution = method.distribution(params, image[None], rows, np.ones((1, M), bool))
        return distribution.mode()

    found = run(is_greedy=True)
    for number in range(6):
        env = toy_host.ToyEnv()
        seed = np.random.SeedSequence(seed_of(KEY), spawn_key=(number,))
        frames = [np.zeros((toy_host.SIZE, toy_host.SIZE), np.uint8)] * 2 + [env.reset(seed)]
        key_set = jax.random.split(jax.random.fold_in(KEY, number), 3)[0]
        ids = np.asarray(draw_sets(key_set[None], POOL, M).ids[0])
        assert ids[0] == host.NO_OP
        num_steps = 0
        while True:
            num_steps += 1
            sample = mode(np.stack(frames[-3:], axis=-1), ids)
            position = 2 * (np.asarray(sample.position[0]) - 0.5)
            frame, _, terminated, truncated, metrics = env.step(
                int(ids[int(sample.choice[0])]), position
            )
            frames.append(frame)
            if terminated or truncated:
                break
        assert found["num_steps"][number] == num_steps
        for name in toy_host.METRICS:
            np.testing.assert_allclose(found[name][number], metrics[name], rtol=1e-4)


@pytest.mark.unit
def test_training_goes_on_where_it_was() -> None:
    """One pool: an evaluation between two rollouts changes neither."""
    calm, _, _ = host.play(host.rollout_of())
    rollout = host.rollout_of()
    states, _, _ = host.play(rollout, 1)
    evaluator = evaluator_of(rollout.environments)
    first = evaluator.run(host.params_of(), None, TABLE, POOL, KEY, 9)
    key = jax.random.fold_in(jax.random.key(4), 1)
    last, _, _ = rollout.collect(key, states[-1], host.params_of(), TABLE, POOL)
    host.assert_equal(last, calm[-1])
    again = evaluator.run(host.params_of(), None, TABLE, POOL, KEY, 9)
    host.assert_equal(first, again)


@pytest.mark.unit
def test_halves_rest_when_their_episodes_are_over() -> None:
    """Of five episodes the first of four environments plays two, and the second half two in all."""
    environments = host.environments_of(4, 2)
    evaluator = evaluator_of(environments)
    found = evaluator.run(host.params_of(), None, TABLE, POOL, KEY, 5)["num_steps"]
    events = environments.pool.events
    assert events[0] == "reset_numbered"
    assert events.count(("send", 1)) == found[2:4].max()
    assert events.count(("send", 0)) == max(found[0] + found[4], found[1])
    evaluator.run(host.params_of(), None, TABLE, POOL, KEY, 2)
    assert events.count(("send", 1)) == found[2:4].max()


@pytest.mark.unit
def test_a_growing_set_starts_small() -> None:
    """Of one action at first, which is the no-op, and all at the second step."""
    taken: list[list[int]] = []

    class Watched(toy_host.ToyPool):
        def send(self, half: int, ids: np.ndarray, positions: np.ndarray) -> None:
            taken.append(ids.tolist())
            super().send(half, ids, positions)

    pool = HostEnvironments(functools.partial(Watched, 4, 1), toy_host.MAX_STEPS, host.K)
    evaluator = evaluator_of(pool, first_size=1, growth=3)
    evaluator.run(host.params_of(), None, TABLE, POOL, KEY, 4)
    assert taken[0] == [host.NO_OP] * 4
    assert any(action != host.NO_OP for action in taken[1])


@pytest.mark.unit
def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"first_size=5 must be in 0\.\.4"):
        HostEvaluator(host.environments_of(), host.method_of(), M, first_size=5)
    with pytest.raises(ValueError, match="num_episodes=0"):
        run(episodes=0)
    small = ActionPool.of(np.arange(2), capacity=toy_host.NUM_ACTIONS)
    evaluator = evaluator_of(host.environments_of())
    with pytest.raises(ValueError, match="Sets of 4 actions cannot be drawn"):
        evaluator.run(host.params_of(), None, TABLE, small, KEY, 3)
