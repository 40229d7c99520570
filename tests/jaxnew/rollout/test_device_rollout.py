"""A rollout re-played in NumPy from its recorded choices (docs/method.md)."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import make_method
from jaxnew.rollout.contract import RolloutBatch, RolloutConfig
from jaxnew.rollout.device import DeviceRollout, RolloutState
from jaxnew.sampling import Actions
from tests import probe_environments as probe
from tests.jaxnew.policy import numpy_policy

N, T, A, M, WIDTH, D = 5, 11, 24, 4, 6, 3
DISCOUNT = 0.9
CONFIG = RolloutConfig(num_envs=N, num_steps=T, bootstraps_time_limits=True)
MDP = probe.ladder(A)
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
ACTIONS = Actions.of(TABLE, np.arange(2, 22), M, padded_size=WIDTH)  # 20 of the 24 actions.

# float32 against float64: some hundred operations on order-one numbers; and the constant feature,
# whose deviation falls to 1e-3, magnifies roundings of 6e-8 to 6e-5.
TOLERANCE = {"rtol": 3e-4, "atol": 3e-4}


@functools.cache
def rollout_of(config: RolloutConfig) -> tuple[DeviceRollout, Any, Any]:
    rollout = DeviceRollout(probe.TableWorld(A), MDP, make_method("ours"), config)
    return rollout, jax.jit(rollout.init), jax.jit(rollout.collect)


def play(
    config: RolloutConfig, num_rollouts: int = 2
) -> tuple[Any, list[RolloutState], RolloutBatch, list[dict[str, float]]]:
    """Parameters, the states between rollouts, all steps in one batch [K T, N, ...], the sums."""
    rollout, init, collect = rollout_of(config)
    states = [init(jax.random.key(1), ACTIONS)]
    params = rollout.method.init(jax.random.key(2), states[0].observation[0], D)
    params = numpy_policy.randomized(params, seed=3)
    batches, sums = [], []
    for k in range(num_rollouts):
        key = jax.random.fold_in(jax.random.key(4), k)
        state, batch, total = collect(key, states[-1], params, ACTIONS, jnp.float32(DISCOUNT))
        states.append(state)
        batches.append(batch)
        sums.append({name: float(value) for name, value in total.items()})
    batch = jax.tree.map(lambda *parts: np.concatenate(parts), *batches)
    return params, states, batch, sums


class Moments:
    """Mean and variance over all values so far with a prior of 1e-4 values (0, 1), in float64."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.count, self.total, self.squares = 1e-4, np.zeros(shape), 1e-4 * np.ones(shape)

    def update(self, batch: np.ndarray) -> None:
        self.count += len(batch)
        self.total = self.total + batch.sum(axis=0)
        self.squares = self.squares + (batch**2).sum(axis=0)

    @property
    def mean(self) -> np.ndarray:
        return self.total / self.count

    @property
    def deviation(self) -> np.ndarray:
        return np.sqrt(self.squares / self.count - self.mean**2 + 1e-8)


class Replay:
    """The environments, the normalisation and the bookkeeping, step by step in NumPy."""

    def __init__(self, normalizes: bool) -> None:
        self.normalizes = normalizes
        self.tables = {
            name: np.asarray(getattr(MDP, name), np.float64) for name in ("observations", "reward")
        }
        self.seen, self.returns = Moments((4,)), Moments(())
        self.state, self.age = np.zeros(N, int), np.zeros(N, int)
        self.episode_return, self.discounted = np.zeros(N), np.zeros(N)
        self.observation = self.observe(self.tables["observations"][self.state])
        self.finished: list[dict[str, float]] = []

    def observe(self, raw: np.ndarray, updates: bool = True) -> np.ndarray:
        if not self.normalizes:
            return raw
        if updates:
            self.seen.update(raw)
        return np.clip((raw - self.seen.mean) / self.seen.deviation, -10, 10)

    def step(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        """One step of every environment, with auto-reset to rung 0."""
        reward = self.tables["reward"][self.state, ids]
        terminated = np.asarray(MDP.terminates)[self.state, ids]
        self.state = np.asarray(MDP.next_state)[self.state, ids]
        self.age += 1
        self.episode_return += reward
        done = terminated | (self.age >= int(MDP.time_limit))
        final_raw = self.tables["observations"][self.state]
        for i in np.flatnonzero(done):
            self.finished.append(
                {
                    "is_success": float(reward[i] > 0),
                    "episode_return": self.episode_return[i],
                    "final_state": self.state[i],
                }
            )
        self.state = np.where(done, 0, self.state)
        self.age = np.where(done, 0, self.age)
        self.episode_return = np.where(done, 0.0, self.episode_return)
        # The statistics see what the policy will see: the first observation of the next episode.
        self.observation = self.observe(self.tables["observations"][self.state])
        final_observation = self.observe(final_raw, updates=False)
        self.discounted = DISCOUNT * self.discounted + reward
        scaled = reward
        if self.normalizes:
            self.returns.update(self.discounted)
            scaled = np.clip(reward / self.returns.deviation, -10, 10)
        self.discounted = np.where(done, 0.0, self.discounted)
        return {
            "reward": scaled,
            "terminated": terminated,
            "done": done,
            "final_observation": final_observation,
        }


@pytest.mark.oracle
@pytest.mark.parametrize(("normalizes", "bootstraps"), [(True, True), (False, False)])
def test_a_rollout_is_what_the_recorded_choices_lead_to(normalizes: bool, bootstraps: bool) -> None:
    config = replace(
        CONFIG,
        normalize_observations=normalizes,
        normalize_rewards=normalizes,
        bootstraps_time_limits=bootstraps,
    )
    params, states, batch, sums = play(config)
    replay = Replay(normalizes)
    np.testing.assert_allclose(states[0].observation, replay.observation, **TOLERANCE)

    ids = np.take_along_axis(batch.available.ids, batch.sample[..., None], axis=-1)[..., 0]
    for t in range(2 * T):
        np.testing.assert_allclose(batch.observation[t], replay.observation, **TOLERANCE)
        utilities = numpy_policy.utilities(
            params, replay.observation, TABLE[batch.available.ids[t]]
        )
        log_probs = numpy_policy.log_softmax(utilities, batch.available.mask[t])
        log_prob = np.take_along_axis(log_probs, batch.sample[t][:, None], axis=-1)[:, 0]
        np.testing.assert_allclose(batch.log_prob[t], log_prob, **TOLERANCE)
        value = numpy_policy.value(params, replay.observation)
        np.testing.assert_allclose(batch.value[t], value, **TOLERANCE)

        step = replay.step(ids[t])
        assert np.array_equal(batch.terminated[t], step["terminated"])
        assert np.array_equal(batch.done[t], step["done"])
        np.testing.assert_allclose(batch.reward[t], step["reward"], **TOLERANCE)
        # Of the observation that the step really produced, also at the rollout's last step.
        next_value = numpy_policy.value(params, step["final_observation"])
        if not bootstraps:
            next_value = np.where(step["done"], 0.0, next_value)
        np.testing.assert_allclose(batch.next_value[t], next_value, **TOLERANCE)
        if (t + 1) % T == 0:
            state = states[(t + 1) // T]
            np.testing.assert_allclose(state.discounted_return, replay.discounted, **TOLERANCE)
            assert np.array_equal(state.env_state.state, replay.state)
            if normalizes:
                seen = state.observation_statistics
                np.testing.assert_allclose(seen.mean, replay.seen.mean, **TOLERANCE)
                # The variance of the constant feature ends near 5e-5: relative error is float32's.
                np.testing.assert_allclose(seen.variance, replay.seen.deviation**2, **TOLERANCE)
                np.testing.assert_allclose(seen.count, (t + 2) * N + 1e-4, rtol=1e-6)
                variance = state.return_statistics.variance
                np.testing.assert_allclose(variance, replay.returns.deviation**2, **TOLERANCE)

    # Ends of both kinds happened, so all of the above was tested.
    assert batch.terminated.sum() > 3
    assert (batch.done & ~batch.terminated).sum() > 3
    assert sum(total["num_episodes"] for total in sums) == len(replay.finished)
    for name in ("is_success", "episode_return", "final_state"):
        expected = sum(episode[name] for episode in replay.finished)
        np.testing.assert_allclose(sum(total[name] for total in sums), expected, **TOLERANCE)


@pytest.mark.property
def test_sets_change_exactly_where_episodes_end() -> None:
    _, states, batch, _ = play(CONFIG)
    ids, mask = batch.available.ids, batch.available.mask
    assert ids.shape == mask.shape == (2 * T, N, WIDTH)
    assert (mask == (np.arange(WIDTH) < M)).all()
    real = np.sort(ids[..., :M], axis=-1)
    assert (np.diff(real, axis=-1) > 0).all()
    assert real.min() >= 2
    assert real.max() < 22
    # 20 * 19 * 18 * 17 ordered sets: that two in a row are equal by chance does not happen.
    changes = (ids[1:] != ids[:-1]).any(axis=-1)
    assert np.array_equal(changes, batch.done[:-1])
    last_changes = (states[-1].available.ids != ids[-1]).any(axis=-1)
    assert np.array_equal(last_changes, batch.done[-1])
    # Sets of different environments and of different rollouts differ.
    distinct = {tuple(row) for row in ids.reshape(-1, WIDTH).tolist()}
    assert len(distinct) == N + changes.sum()
    assert (batch.sample < M).all()


@pytest.mark.property
def test_every_episode_has_a_set_of_its_own_however_many_end() -> None:
    num_steps = 50  # Episodes of one step: three times as many sets as are drawn at once.
    config = replace(CONFIG, num_steps=num_steps)
    one_step = replace(MDP, time_limit=jnp.int32(1))
    rollout = DeviceRollout(probe.TableWorld(A), one_step, make_method("ours"), config)
    state = rollout.init(jax.random.key(1), ACTIONS)
    weights = rollout.method.init(jax.random.key(2), state.observation[0], D)
    _, batch, _ = jax.jit(rollout.collect)(
        jax.random.key(3), state, weights, ACTIONS, jnp.float32(DISCOUNT)
    )
    assert batch.done.all()
    ids = np.asarray(batch.available.ids)[..., :M]
    counts = np.bincount(ids.ravel(), minlength=A)
    # Expected 250 * 4 / 20 = 50 each, with a deviation of 6.3.
    assert counts[2:22].min() > 20
    assert counts.sum() == counts[2:22].sum()
    # Of 116,280 ordered sets: 250 draws repeat one about 0.27 times.
    assert len({tuple(row) for row in ids.reshape(-1, M).tolist()}) >= num_steps * N - 3


@pytest.mark.unit
def test_fields_are_time_by_environment() -> None:
    _, states, batch, sums = play(CONFIG, num_rollouts=1)
    shapes = {
        name: (getattr(batch, name).shape, str(getattr(batch, name).dtype))
        for name in ("observation", "sample", "log_prob", "value", "next_value", "reward", "done")
    }
    assert shapes == {
        "observation": ((T, N, 4), "float32"),
        "sample": ((T, N), "int32"),
        "log_prob": ((T, N), "float32"),
        "value": ((T, N), "float32"),
        "next_value": ((T, N), "float32"),
        "reward": ((T, N), "float32"),
        "done": ((T, N), "bool"),
    }
    # What goes in comes out: the state scans.
    before, after = (jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in states)
    assert before == after
    assert set(sums[0]) == {"num_episodes", "is_success", "episode_return", "final_state"}


@pytest.mark.unit
def test_choices_differ_between_environments_steps_and_rollouts() -> None:
    """A key used twice would show as equal columns, rows or halves."""
    _, _, batch, _ = play(CONFIG)
    sample = batch.sample
    # 4**5 rows are possible: 0.2 pairs of equal ones are expected.
    assert len({tuple(row) for row in sample.tolist()}) >= 2 * T - 2
    assert len({tuple(column) for column in sample.T.tolist()}) == N
    assert not np.array_equal(sample[:T], sample[T:])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 0}, "num_envs=0 must be at least 1"),
        ({"num_steps": 0}, "num_steps=0 must be at least 1"),
    ],
)
def test_bad_configs_are_refused(changes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes)
