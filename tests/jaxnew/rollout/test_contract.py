"""The two rollouts keep one contract: the same toy inside jit and on the host."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.policy import Categorical, PolicyMethod, UtilityMethod, make_method
from jaxnew.rollout.contract import Episode, Policy, Rollout, RolloutBatch, RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.host import HostRollout
from jaxnew.rollout.pool import HostEnvironments
from jaxnew.sampling import Actions
from tests import probe_environments as probe
from tests import toy_host
from tests.jaxnew.policy import numpy_policy

N, T, A, M, D, LIMIT = 4, 6, 12, 3, 2, 4
LADDER = probe.ladder(A, time_limit=LIMIT)
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
ACTIONS = Actions.of(TABLE, np.arange(1, 10), M, padded_size=M + 1)
METHOD = make_method("ours")
CONFIG = RolloutConfig(
    num_envs=N, num_steps=T, normalize_observations=False, normalize_rewards=False
)
KEY = jax.random.key(3)
METRICS = probe.TableWorld.episode_metrics
PLACES = ("device", "host")


class LadderEnv:
    """The ladder in NumPy."""

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        del seed
        self.rung, self.t, self.total = 0, 0, np.float32(0.0)
        return np.asarray(LADDER.observations)[0]

    def step(self, action_id: int, position: np.ndarray) -> tuple[Any, ...]:
        del position
        place = self.rung, action_id
        reward = np.asarray(LADDER.reward)[place]
        terminated = bool(np.asarray(LADDER.terminates)[place])
        self.rung = int(np.asarray(LADDER.next_state)[place])
        self.t, self.total = self.t + 1, self.total + reward
        metrics = {
            "is_success": float(reward > 0),
            "episode_return": float(self.total),
            "final_state": float(self.rung),
        }
        truncated = not terminated and self.t >= LIMIT
        seen = np.asarray(LADDER.observations)[self.rung]
        return seen, float(reward), terminated, truncated, metrics


class LadderPool(toy_host.ToyPool):
    make_env = LadderEnv
    observation_shape, observation_dtype = (4,), np.dtype(np.float32)
    position_dim, episode_metrics, max_steps = 0, METRICS, LIMIT


class OfEvaluations(UtilityMethod):
    """Takes what it is offered first."""

    def distribution_of(self, params: Any, features: Any, projected: Any, mask: Any) -> Any:
        del params, features, projected
        is_first = np.arange(mask.shape[-1]) == 0
        return Categorical.masked(jnp.zeros(mask.shape), mask & is_first)


class Learning(UtilityMethod):
    """As ours, but for evaluations."""

    def for_evaluation(self) -> OfEvaluations:
        return OfEvaluations(self.network)


@functools.cache
def rollout_in(place: str, method: PolicyMethod = METHOD) -> Rollout:
    """A rollout that is known by its contract alone."""
    if place == "device":
        return DeviceRollout(probe.TableWorld(A), LADDER, method, CONFIG, width=4)
    pool = HostEnvironments(functools.partial(LadderPool, N, 2), LIMIT)
    return HostRollout(pool, method, CONFIG, jax.ShapeDtypeStruct((4,), jnp.float32), width=4)


@functools.cache
def policy() -> Policy:
    shapes = METHOD.init(jax.random.key(0), jnp.zeros(4), D)
    return Policy(numpy_policy.randomized(shapes, seed=1))


@functools.cache
def collected(place: str) -> tuple[Any, Any, RolloutBatch, dict[str, Any]]:
    """(state before, state after, batch, sums)."""
    rollout = rollout_in(place)
    state = rollout.init(jax.random.key(1), ACTIONS)
    return state, *rollout.collect(jax.random.key(2), state, policy().params, ACTIONS, 0.9)


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_members_are_those_of_the_contract(place: str) -> None:
    rollout = rollout_in(place)
    members = {name for name in vars(Rollout) if not name.startswith("_")}
    assert {"init", "collect", "measure", "episodes", "close", "observation"} < members
    assert all(hasattr(rollout, name) for name in members)
    assert rollout.method is METHOD
    assert rollout.config is CONFIG
    assert rollout.is_traced == (place == "device")
    assert rollout.max_episode_steps == LIMIT
    assert rollout.episode_metrics == METRICS
    assert (rollout.observation.shape, rollout.observation.dtype) == ((4,), jnp.float32)


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_a_rollout_has_the_documented_shapes(place: str) -> None:
    before, after, batch, sums = collected(place)
    fields = ("log_prob", "value", "next_value", "reward", "terminated", "done", "sample")
    shapes = {name: np.asarray(getattr(batch, name)).shape for name in fields}
    assert shapes == dict.fromkeys(fields, (T, N))
    dtypes = {name: np.asarray(getattr(batch, name)).dtype for name in fields}
    assert dtypes == {
        **dict.fromkeys(fields[:4], np.float32),
        **dict.fromkeys(fields[4:6], np.bool_),
        "sample": np.int32,
    }
    assert batch.available.ids.shape == batch.available.mask.shape == (T, N, M + 1)
    seen = batch.observations(jnp.arange(T * N))
    assert (seen.shape, seen.dtype) == ((T * N, 4), jnp.float32)
    numbers = {name for name in sums if not name.startswith("time/")}
    assert numbers == {"num_episodes", *METRICS}
    assert float(sums["num_episodes"]) == np.asarray(batch.done).sum() > 0
    # What goes in comes out, so that a state may be carried, and saved at any time.
    kinds = [jax.tree.map(lambda x: (np.shape(x), x.dtype), s) for s in (before, after)]
    assert kinds[0] == kinds[1]
    assert hasattr(after, "observation_statistics")


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_who_acts_in_evaluations_is_up_to_the_method(place: str) -> None:
    rollout = rollout_in(place, Learning())
    state = rollout.init(jax.random.key(1), ACTIONS)
    _, batch, _ = rollout.collect(jax.random.key(2), state, policy().params, ACTIONS, 0.9)
    assert len(np.unique(np.asarray(batch.sample))) > 1
    episodes = rollout.episodes(policy(), ACTIONS, KEY, 0, 5)
    assert all(e.action_ids == [e.available_ids[0]] * len(e.actions) for e in episodes)
    lengths = rollout.measure(policy(), ACTIONS, KEY, 5)["num_steps"]
    assert lengths.tolist() == [len(e.actions) for e in episodes]


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_a_rollout_is_what_the_ladder_says(place: str) -> None:
    """Rewards and ends of the recorded choices, and values of what was seen."""
    _, _, batch, _ = collected(place)
    ids = np.take_along_axis(
        np.asarray(batch.available.ids), np.asarray(batch.sample)[..., None], axis=-1
    )[..., 0]
    values = numpy_policy.value(policy().params, np.asarray(batch.observations(jnp.arange(T * N))))
    np.testing.assert_allclose(np.asarray(batch.value).ravel(), values, rtol=1e-4, atol=1e-4)
    for n in range(N):
        env = LadderEnv()
        env.reset(np.random.SeedSequence(0))
        for t in range(T):
            _, reward, terminated, truncated, _ = env.step(int(ids[t, n]), np.zeros(0))
            assert float(batch.reward[t, n]) == pytest.approx(reward, rel=1e-6)
            assert (bool(batch.terminated[t, n]), bool(batch.done[t, n])) == (
                terminated,
                terminated or truncated,
            )
            if terminated or truncated:
                env.reset(np.random.SeedSequence(0))


@pytest.mark.contract
@pytest.mark.parametrize("is_greedy", [False, True])
def test_both_play_the_same_episodes(is_greedy: bool) -> None:
    """Sets, actions and ends follow from `fold_in(key, i)` alone, wherever they are played."""
    found = [rollout_in(p).measure(policy(), ACTIONS, KEY, 11, is_greedy) for p in PLACES]
    assert set(found[0]) == set(found[1]) == {*METRICS, "num_steps"}
    for name, values in found[0].items():
        assert values.shape == found[1][name].shape == (11,)
        assert values.dtype == found[1][name].dtype == np.float32
        # Sums of up to four rewards.
        np.testing.assert_allclose(values, found[1][name], rtol=1e-5, atol=1e-6, err_msg=name)
    assert len(np.unique(found[0]["episode_return"])) > 3


@pytest.mark.contract
def test_both_return_the_same_episodes() -> None:
    played: list[list[Episode]] = [
        rollout_in(place).episodes(policy(), ACTIONS, KEY, 2, 5) for place in PLACES
    ]
    for inside, outside in zip(*played, strict=True):
        assert inside.number == outside.number
        assert inside.action_ids == outside.action_ids
        np.testing.assert_array_equal(inside.available_ids, outside.available_ids)
        np.testing.assert_allclose(inside.rewards, outside.rewards, rtol=1e-6)
        assert inside.metrics == pytest.approx(outside.metrics, rel=1e-5)
        assert (len(inside.states), outside.states) == (len(inside.actions) + 1, ())
        assert (inside.seed is None, outside.seed is None) == (True, False)


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_a_fixed_set_is_there_once(place: str) -> None:
    rollout, fixed = rollout_in(place), Actions.of(TABLE, np.arange(1, 10))
    state = rollout.init(jax.random.key(1), fixed)
    state, batch, _ = rollout.collect(jax.random.key(2), state, policy().params, fixed, 0.9)
    assert batch.available.ids.tolist() == state.available.ids.tolist() == list(range(1, 10))
    (episode,) = rollout.episodes(policy(), fixed, KEY, 0, 1)
    assert episode.available_ids.tolist() == list(range(1, 10))


@pytest.mark.contract
@pytest.mark.parametrize("place", PLACES)
def test_closing_ends_what_is_held(place: str) -> None:
    rollout_in.cache_clear()
    rollout = rollout_in(place)
    rollout.measure(policy(), ACTIONS, KEY, 1)
    pool = rollout.environments.pool if isinstance(rollout, HostRollout) else None
    rollout.close()
    assert pool is None or pool.is_closed  # type: ignore[attr-defined]
