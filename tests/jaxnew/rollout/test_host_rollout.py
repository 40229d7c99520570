"""Rollouts of a pool on the host: re-played step by step, and the same however the pool is cut."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.ppo import Hyperparameters, Learner, PPOConfig
from jaxnew.rollout.frames import FrameHistory
from jaxnew.rollout.host import HostRollout
from jaxnew.rollout.pool import HostEnvironments
from jaxnew.storage.checkpoint import Checkpointer
from tests import toy_host
from tests.jaxnew.rollout.host_setup import (
    ACTIONS,
    ALL_ACTIONS,
    CONFIG,
    IDS,
    NO_OP,
    PADDED,
    SEEN,
    TABLE,
    K,
    M,
    N,
    T,
    assert_equal,
    environments_of,
    method_of,
    params_of,
    play,
    rollout_of,
)


@pytest.mark.oracle
def test_a_rollout_is_what_the_recorded_choices_lead_to() -> None:
    """Every environment again, on its own, from its seeds and the recorded actions."""
    config = replace(CONFIG, bootstraps_time_limits=True)
    states, batches, sums = play(rollout_of(config=config))
    method, params = method_of(), params_of()
    value_of = jax.jit(method.value)
    totals = dict.fromkeys(("num_episodes", *toy_host.METRICS), 0.0)
    num_truncated = num_terminated = 0
    for n in range(N):
        env, episode = toy_host.ToyEnv(), 0
        frames = [env.reset(np.random.SeedSequence(5, spawn_key=(n, 0)))]
        first = np.asarray(states[0].available.ids[n])
        for k, batch in enumerate(batches):
            seen = np.asarray(batch.observations(jnp.arange(T) * N + n))
            for t in range(T):
                ids = batch.available.ids[t, n]
                np.testing.assert_array_equal(ids, first)
                assert batch.available.mask[t, n].tolist() == [True] * M + [False]
                assert ids[0] == NO_OP
                empty = np.zeros_like(frames[0])
                stack = np.stack([*[empty] * (K - len(frames)), *frames[-K:]], axis=-1)
                np.testing.assert_array_equal(seen[t], stack)
                action = int(ids[batch.sample.choice[t, n]])
                position = 2 * (batch.sample.position[t, n] - 0.5)
                frame, reward, terminated, truncated, metrics = env.step(action, position)
                np.testing.assert_allclose(batch.reward[t, n], reward, rtol=1e-5, atol=1e-6)
                assert batch.terminated[t, n] == terminated
                assert batch.done[t, n] == (terminated or truncated)
                final = np.stack([*[empty] * (K - 1), *frames, frame][-K:], axis=-1)
                if not terminated:
                    # The value of what the step really produced, also at the rollout's last step.
                    expected = value_of(params, final[None])[0]
                    np.testing.assert_allclose(batch.next_value[t, n], expected, rtol=1e-4)
                frames.append(frame)
                num_truncated += truncated
                num_terminated += terminated
                if terminated or truncated:
                    episode += 1
                    totals["num_episodes"] += 1
                    for name in toy_host.METRICS:
                        totals[name] += metrics[name]
                    frames = [env.reset(np.random.SeedSequence(5, spawn_key=(n, episode)))]
                    following = (
                        batch.available.ids[t + 1, n]
                        if t + 1 < T
                        else np.asarray(states[k + 1].available.ids[n])
                    )
                    assert set(following[1:M]) != set(first[1:M])
                    first = following
    assert num_terminated > 3
    assert num_truncated > 3
    for name, total in totals.items():
        np.testing.assert_allclose(sum(float(s[name]) for s in sums), total, rtol=1e-4)


@pytest.mark.oracle
def test_log_probabilities_and_values_are_those_of_the_policy() -> None:
    _, (batch,), _ = play(rollout_of(), 1)
    method, params = method_of(), params_of()
    indices = jnp.arange(T * N)
    rows = method.project(params, TABLE)[batch.available.ids.reshape(-1, PADDED)]
    mask = jnp.asarray(batch.available.mask.reshape(-1, PADDED))

    @jax.jit
    def again(observation: Any, sample: Any) -> Any:
        distribution = method.distribution(params, observation, rows, mask)
        return distribution.log_prob(sample), method.value(params, observation)

    sample = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch.sample)
    log_prob, value = again(batch.observations(indices), sample)
    np.testing.assert_allclose(batch.log_prob.ravel(), log_prob, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(batch.value.ravel(), value, rtol=1e-4, atol=1e-4)


@pytest.mark.property
def test_halves_do_not_change_a_bit() -> None:
    results = [play(rollout_of(num_halves)) for num_halves in (1, 2, 4, 8)]
    for other in results[1:]:
        assert_equal(other, results[0])


@pytest.mark.unit
def test_one_half_simulates_while_the_policy_looks_at_the_other() -> None:
    rollout = rollout_of()
    states, _, _ = play(rollout, 1)
    found = rollout.environments.pool.events
    turn = [("receive", 0), ("send", 0), ("receive", 1), ("send", 1)]
    ends = [("receive", 0), ("receive", 1)]
    assert found == ["reset", ("send", 0), ("send", 1), *turn * (T - 1), *ends]
    del states


@pytest.mark.property
def test_steps_environments_and_rollouts_draw_of_their_own() -> None:
    _, batches, _ = play(rollout_of())
    positions = np.stack([batch.sample.position for batch in batches])
    assert len(np.unique(positions)) == positions.size
    sets = {
        tuple(row) for row in np.concatenate([b.available.ids for b in batches]).reshape(-1, PADDED)
    }
    ends = sum(batch.done[:-1].sum() for batch in batches) + batches[0].done[-1].sum()
    assert len(sets) == N + ends


@pytest.mark.unit
def test_a_fixed_set_is_stored_once_and_every_method_acts() -> None:
    config = replace(CONFIG, num_steps=2)
    for name in ("ours", "discrete", "continuous", "random"):
        states, (batch,), _ = play(rollout_of(config=config, name=name), 1, name, ALL_ACTIONS)
        assert states[1].available is states[0].available
        assert batch.available is states[0].available
        assert batch.available.ids.shape == (len(IDS) + 1,)
        assert batch.available.mask.tolist() == [True] * len(IDS) + [False]
        assert batch.log_prob.shape == (2, N)


@pytest.mark.unit
def test_going_on_costs_nothing_and_a_checkpoint_is_brought_back() -> None:
    rollout = rollout_of()
    states, batches, _ = play(rollout)
    assert "load_state" not in rollout.environments.pool.events
    key = jax.random.fold_in(jax.random.key(4), 1)
    again = rollout.collect(key, states[1], params_of(), ACTIONS, 0.9)
    assert rollout.environments.pool.events.count("load_state") == 1
    assert_equal(again[:2], (states[2], batches[1]))


@pytest.mark.unit
def test_a_run_begins_at_the_beginning_every_time() -> None:
    """With a new pool, as one that was used goes on with its next episodes."""
    rollout = rollout_of()
    states, _, _ = play(rollout, 1)
    used = rollout.environments.pool
    assert_equal(rollout.init(jax.random.key(1), ACTIONS), states[0])
    assert used.is_closed


@pytest.mark.unit
def test_stacks_are_those_of_the_frames() -> None:
    frames = np.random.default_rng(0).integers(1, 255, (7, 2, 4, 5)).astype(np.uint8)
    age = np.array([[0, 2], [1, 0], [2, 1], [2, 2], [0, 2]], np.int32)
    history = FrameHistory(frames, age)
    assert history.stack_size == 3
    indices = np.array([9, 0, 3, 4, 5, 3])
    got = np.asarray(jax.jit(lambda h, i: h.take(i))(history, indices))
    assert got.dtype == np.uint8
    for stack, index in zip(got, indices, strict=True):
        t, n = divmod(int(index), 2)
        for back in range(3):
            expected = frames[t + 2 - back, n] if back <= age[t, n] else 0 * frames[0, n]
            np.testing.assert_array_equal(stack[..., 2 - back], expected)


@pytest.mark.unit
def test_wrong_configs_and_pools_are_refused() -> None:
    for field in ("normalize_observations", "normalize_rewards"):
        with pytest.raises(ValueError, match=f"ppo.rollout.{field}"):
            HostRollout(environments_of(), method_of(), replace(CONFIG, **{field: True}), SEEN)
    rollout = HostRollout(environments_of(num_envs=4), method_of(), CONFIG, SEEN)
    with pytest.raises(ValueError, match="4 environments, the rollout num_envs=8"):
        rollout.init(jax.random.key(0), ACTIONS)

    class Vectors(toy_host.ToyPool):
        observation_shape = (7,)

    environments = HostEnvironments(lambda: Vectors(2), 5, stack_size=3)
    with pytest.raises(ValueError, match=r"Stacks of 3 frames need .* got \(7,\)"):
        _ = environments.pool


# ---- Learner ----

PPO = PPOConfig(
    rollout=replace(CONFIG, num_steps=8),
    num_epochs=2,
    num_minibatches=2,
    microbatch_size=16,
    lr_steps=10_000,
)


@functools.cache
def learner_of() -> Learner:
    return Learner(rollout_of(config=PPO.rollout), PPO)


def fresh_learner() -> Learner:
    """With a pool of its own, and the compiled programs of the others."""
    learner = Learner(rollout_of(config=PPO.rollout), PPO)
    learner.__dict__["_compiled_learn"] = learner_of()._compiled_learn
    return learner


@pytest.mark.property
def test_four_updates_are_two_and_two_after_a_checkpoint(tmp_path: Path) -> None:
    straight = fresh_learner()
    state = straight.init(jax.random.key(7), ACTIONS)
    numbers = Hyperparameters()
    whole, metrics = straight.updates(state, numbers, ACTIONS, 4)
    assert int(whole.step) == 4
    assert "episode/is_success" in metrics
    seconds = {name: float(metrics[f"time/{name}_s"]) for name in ("act", "wait", "rollout")}
    assert min(seconds.values()) > 0.0
    assert seconds["act"] + seconds["wait"] < seconds["rollout"]
    assert metrics["time/learn_s"] > 0.0

    first = fresh_learner()
    half, _ = first.updates(first.init(jax.random.key(7), ACTIONS), numbers, ACTIONS, 2)
    Checkpointer(tmp_path).save("latest", 2, half)
    second = fresh_learner()
    example = second.init(jax.random.key(0), ACTIONS)
    restored, _ = Checkpointer(tmp_path).restore("latest", example)
    resumed, _ = second.updates(restored, numbers, ACTIONS, 2)
    assert_equal(
        jax.tree.map(np.asarray, replace(resumed, key=jax.random.key_data(resumed.key))),
        jax.tree.map(np.asarray, replace(whole, key=jax.random.key_data(whole.key))),
    )


@pytest.mark.unit
def test_frames_teach_what_stacks_teach() -> None:
    """The learner, on the frames of a rollout and on the same observations as an array."""
    learner = fresh_learner()
    state = learner.init(jax.random.key(7), ACTIONS)
    _, batch, _ = learner.rollout.collect(
        jax.random.key(1), state.rollout, state.params, ACTIONS, 0.9
    )
    shape = batch.done.shape
    stacks = batch.observations(jnp.arange(batch.done.size))
    dense = replace(batch, observation=stacks.reshape(*shape, *stacks.shape[1:]))
    results = [
        learner._compiled_learn(
            jax.random.key(2), state.params, state.opt_state, b, Hyperparameters(), ACTIONS, 0
        )[0]
        for b in (batch, dense)
    ]
    moved = jax.tree.map(lambda x, y: np.abs(x - y).max(), results[0], state.params)
    assert max(jax.tree.leaves(moved)) > 1e-4
    for one, two in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-6)
