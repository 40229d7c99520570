"""Episodes in a pool: the same in pools of any size; training goes on undisturbed."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew.evaluation import EVALUATION_SEED, measure, play
from jaxnew.rollout.host import HostRollout
from jaxnew.rollout.pool import HostEnvironments
from jaxnew.sampling import Actions
from tests import toy_host
from tests.jaxnew.rollout import host_setup as host

M, KEY, EPISODES = 4, jax.random.key(EVALUATION_SEED), 13
TABLE = host.TABLE
ACTIONS = Actions.of(TABLE, host.IDS, M, always_available=host.ALWAYS)


def rollout_of(num_envs: int = 4, num_halves: int = 2) -> HostRollout:
    """Of a pool that need not be as large as training's."""
    return host.rollout_of(environments=host.environments_of(num_envs, num_halves, seed=1))


def run(
    num_envs: int = 4,
    num_halves: int = 2,
    episodes: int = EPISODES,
    is_greedy: bool = False,
    actions: Actions = ACTIONS,
) -> Any:
    rollout = rollout_of(num_envs, num_halves)
    return measure(rollout, host.policy_of(), actions, episodes, is_greedy=is_greedy)


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
        ids = np.asarray(ACTIONS.draw(key_set[None]).ids[0])
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
    first = rollout.measure(host.policy_of(), ACTIONS, KEY, 9)
    key = jax.random.fold_in(jax.random.key(4), 1)
    last, _, _ = rollout.collect(key, states[-1], host.params_of(), host.ACTIONS, 0.9)
    host.assert_equal(last, calm[-1])
    again = rollout.measure(host.policy_of(), ACTIONS, KEY, 9)
    host.assert_equal(first, again)


@pytest.mark.unit
def test_halves_rest_when_their_episodes_are_over() -> None:
    """Of five episodes the first of four environments plays two, and the second half two in all."""
    rollout = rollout_of(4, 2)
    found = rollout.measure(host.policy_of(), ACTIONS, KEY, 5)["num_steps"]
    events = rollout.environments.pool.events
    assert events[0] == "reset_numbered"
    assert events.count(("send", 1)) == found[2:4].max()
    assert events.count(("send", 0)) == max(found[0] + found[4], found[1])
    rollout.measure(host.policy_of(), ACTIONS, KEY, 2)
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
    measure(host.rollout_of(environments=pool), host.policy_of(), ACTIONS.growing(1, 3), 4)
    assert taken[0] == [host.NO_OP] * 4
    assert any(action != host.NO_OP for action in taken[1])


@pytest.mark.property
def test_played_episodes_are_those_that_are_measured() -> None:
    """Number, set, seed and every action: whoever plays them again on one environment sees them."""
    numbers = run()
    found = play(rollout_of(), host.policy_of(), ACTIONS, 3, 6)
    assert [episode.number for episode in found] == list(range(3, 9))
    for episode in found:
        for name, values in numbers.items():
            assert episode.metrics[name] == values[episode.number]
        assert len(episode.actions) == len(episode.rewards) == episode.metrics["num_steps"]
        assert set(episode.action_ids) <= set(episode.available_ids.tolist())
        assert len(episode.available_ids) == M
        assert episode.states == ()
        assert episode.seed is not None
        assert episode.seed.entropy == seed_of(KEY)
        env = toy_host.ToyEnv()
        env.reset(episode.seed)
        for action, reward in zip(episode.actions, episode.rewards, strict=True):
            *_, metrics = played = env.step(int(action.id), np.asarray(action.position))
            np.testing.assert_allclose(reward, played[1], rtol=1e-6, atol=1e-6)
        assert metrics["episode_return"] == pytest.approx(episode.metrics["episode_return"])


@pytest.mark.unit
def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="num_episodes=0"):
        run(episodes=0)
    with pytest.raises(ValueError, match="count=0"):
        play(rollout_of(), host.policy_of(), ACTIONS, 0, 0)
