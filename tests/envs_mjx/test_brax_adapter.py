"""Brax's wrappers and its PPO accept the house's environments and see the same episodes."""

from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training
from brax.training.agents.ppo import networks, networks_vision
from brax.training.agents.ppo import train as ppo
from flax import struct

from envs_mjx.brax_adapter import PIXELS, BraxEnvironment, trainers
from envs_mjx.grid_world import GridWorld
from envs_mjx.grid_world.environment import GridWorldParams, encode_layout
from envs_mjx.recommender import Recommender
from envs_mjx.shape_stacking import ShapeStacking
from envs_mjx.shape_stacking.engines import Settled
from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec, Transition
from tests.test_import_rules import MODULES, loaded_after

ROOT = Path(__file__).resolve().parents[2]
NUM_ENVS, NUM_STEPS = 5, 23


@struct.dataclass
class DialState:
    """count int32[] steps so far; start f32[] drawn at the reset; total f32[] of the rewards."""

    count: jax.Array
    start: jax.Array
    total: jax.Array


@struct.dataclass
class DialParams:
    """limit: int32[] steps after which an episode is truncated."""

    limit: int | jax.Array = 4


class Dial(Environment[DialState, DialParams]):
    """Reward: id + 100 x + 10,000 y + noise. Ends: by the stop bit, or after some steps."""

    name = "Dial-v0"
    episode_metrics = ("total", "is_stopped")
    shape: tuple[int, ...] = (3,)

    @property
    def default_params(self) -> DialParams:
        return DialParams()

    @property
    def action_spec(self) -> ActionSpec:
        return ActionSpec(num_actions=20, position_dim=2, has_stop=True)

    def observation_spec(self, params: DialParams) -> ObservationSpec:
        return ObservationSpec(self.shape, jnp.float32, 0.0, 100.0)

    def reset_env(self, key: jax.Array, params: DialParams) -> tuple[jax.Array, DialState]:
        state = DialState(jnp.int32(0), jax.random.uniform(key), jnp.float32(0.0))
        return self._observe(state), state

    def step_env(
        self, key: jax.Array, state: DialState, action: Action, params: DialParams
    ) -> Transition:
        x, y = action.position
        reward = action.id + 100.0 * x + 10_000.0 * y + 0.1 * jax.random.uniform(key)
        state = DialState(state.count + 1, state.start, state.total + reward)
        truncated = ~action.stop & (state.count >= params.limit)
        info = {"total": state.total, "is_stopped": action.stop}
        return self._observe(state), state, reward, action.stop, truncated, info

    def _observe(self, state: DialState) -> jax.Array:
        numbers = jnp.stack([state.count.astype(jnp.float32), state.start, state.total])
        return jnp.broadcast_to(numbers, self.shape)


class DialPicture(Dial):
    """Its observation is an image."""

    shape = (84, 84, 3)


IDS = np.array([11, 3, 17, 5])
DIAL = BraxEnvironment(Dial(), IDS)


@pytest.mark.unit
def test_sizes() -> None:
    assert (DIAL.action_size, DIAL.observation_size) == (4 + 2 + 1, 3)
    grid = BraxEnvironment(GridWorld(), range(50))
    assert (grid.action_size, grid.observation_size) == (50, 81)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.1, -0.9, 0.8, 0.2, 0.5, -0.25, -0.7], (17, [0.5, -0.25], False)),
        ([0.1, -0.9, -0.8, 0.2, 3.0, -7.0, 0.01], (5, [1.0, -1.0], True)),
        # The first of equal ones; what lies exactly on 0 does not stop.
        ([-1.0, -0.5, -0.5, -0.5, 0.0, 9.0, 0.0], (3, [0.0, 1.0], False)),
        # Position and stop do not choose, however large.
        ([9.0, 0.0, 0.0, 0.0, 50.0, 60.0, 70.0], (11, [1.0, 1.0], True)),
    ],
)
def test_what_an_action_means(values: list[float], expected: tuple[Any, ...]) -> None:
    action = DIAL.decode(jnp.array(values, jnp.float32))
    assert (int(action.id), action.position.tolist(), bool(action.stop)) == expected


@pytest.mark.unit
def test_an_action_without_position_and_stop_is_the_choice() -> None:
    action = BraxEnvironment(GridWorld(), [7, 800]).decode(jnp.array([0.2, 0.9]))
    assert (int(action.id), action.position.shape, bool(action.stop)) == (800, (0,), False)


@pytest.mark.unit
def test_bad_input() -> None:
    for ids in ([], [20], [-1, 2]):
        with pytest.raises(
            ValueError, match=r"ids: (must be a non-empty list|action .* is not in 0\.\.19)"
        ):
            BraxEnvironment(Dial(), ids)
    with pytest.raises(AssertionError, match=r"shape \(4,\) but expected \(7\)"):
        DIAL.decode(jnp.zeros(4))


def random_actions(env: BraxEnvironment, seed: int) -> np.ndarray:
    """f32[T, N, action_size] in [-1, 1], as Brax's policies draw them; few stop."""
    shape = (NUM_STEPS, NUM_ENVS, env.action_size)
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, shape)
    if env is DIAL:
        actions[..., -1] -= 0.75
    return actions.astype(np.float32)


def brax_rollout(env: Any, actions: np.ndarray, seed: int) -> tuple[Any, Any]:
    """The first state and those after each step, all leaves [T, N, ...], in one scan."""

    @jax.jit
    def run(rng: jax.Array, actions: jax.Array) -> tuple[Any, Any]:
        def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
            state = env.step(state, action)
            return state, state

        first = env.reset(rng)
        return first, jax.lax.scan(step, first, actions)[1]

    rng = jax.random.split(jax.random.PRNGKey(seed), actions.shape[1])
    return jax.tree.map(np.asarray, run(rng, actions))


def house_rollout(
    env: BraxEnvironment, house: Environment, actions: np.ndarray, seed: int, episode_length: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The same by the environment's own contract and auto-reset; episodes that reach
    `episode_length` are cut."""
    params = house.default_params

    def one(rng: jax.Array, actions: jax.Array) -> Any:
        def step(carry: Any, action: jax.Array) -> Any:
            rng, state, count = carry
            rng, key = jax.random.split(rng)
            obs, state, reward, terminated, truncated, info = Environment.step(
                house, key, state, env.decode(action), params
            )
            is_cut = ~(terminated | truncated) & (count + 1 >= episode_length)
            start = house.reset_env(jax.random.split(key)[1], params)
            obs, state = jax.tree.map(
                lambda new, old: jnp.where(is_cut, new, old), start, (obs, state)
            )
            seen = {name: info[name] for name in house.episode_metrics}
            seen |= {"obs": obs, "reward": reward, "final_observation": info["final_observation"]}
            seen |= {"terminated": terminated, "truncated": truncated, "is_cut": is_cut}
            count = jnp.where(terminated | truncated | is_cut, 0, count + 1)
            return (rng, state, count), seen

        rng, key = jax.random.split(rng)
        obs, state = house.reset_env(key, params)
        return obs, jax.lax.scan(step, (rng, state, jnp.int32(0)), actions)[1]

    rng = jax.random.split(jax.random.PRNGKey(seed), actions.shape[1])
    obs, seen = jax.jit(jax.vmap(one, in_axes=(0, 1), out_axes=(0, 1)))(rng, actions)
    return np.asarray(obs), {key: np.asarray(value) for key, value in seen.items()}


@pytest.mark.contract
@pytest.mark.parametrize(
    ("house", "episode_length"), [(Dial(), 100), (Dial(), 4), (Dial(), 3), (GridWorld(), 100)]
)
def test_brax_wrappers_see_the_episodes_of_the_house(
    house: Environment, episode_length: int
) -> None:
    """Observations, rewards, both ends, cuts by Brax and new starts, step by step.

    Dial truncates after 4 steps: after, at and before the place where Brax would cut.
    """
    env = DIAL if house.name == "Dial-v0" else BraxEnvironment(house, range(0, 1024, 3))
    actions = random_actions(env, 0)
    first, after = brax_rollout(training.wrap(env, episode_length), actions, 1)
    first_obs, seen = house_rollout(env, house, actions, 1, episode_length)

    assert first.obs.shape == (NUM_ENVS, env.observation_size)
    assert (first.done.tolist(), first.reward.tolist()) == ([0.0] * NUM_ENVS, [0.0] * NUM_ENVS)
    np.testing.assert_array_equal(first.obs, first_obs)
    np.testing.assert_array_equal(after.obs, seen["obs"])
    np.testing.assert_array_equal(after.info["final_observation"], seen["final_observation"])
    np.testing.assert_array_equal(after.reward, seen["reward"])
    ends = seen["terminated"] | seen["truncated"]
    np.testing.assert_array_equal(after.done, ends | seen["is_cut"])
    np.testing.assert_array_equal(after.info["time_out"], seen["truncated"])
    np.testing.assert_array_equal(after.info["truncation"], seen["is_cut"])
    for array in (after.obs, after.reward, after.done, *after.metrics.values()):
        assert array.dtype == np.float32
    # Each kind of end did occur.
    is_cutting = episode_length == 3
    assert seen["is_cut"].any() == is_cutting
    assert seen["terminated"].any()
    assert seen["truncated"].any() == (not is_cutting)


class Still:
    """A physics engine that moves nothing."""

    name, settle_steps, shapes = "still", 1, ()

    def settle(self, shape_ids: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Settled:
        return Settled(qpos, qvel, jnp.bool_(True))


@pytest.mark.contract
@pytest.mark.parametrize(
    ("house", "num_actions"),
    [
        (Recommender(), 10_000),
        pytest.param(ShapeStacking(Still()), 810, marks=pytest.mark.slow),
    ],
)
def test_the_other_environments_too(house: Environment, num_actions: int) -> None:
    env = BraxEnvironment(house, range(0, num_actions, num_actions // 30))
    actions = random_actions(env, 0)[:12, :3]
    if house.action_spec.has_stop:
        actions[..., -1] -= 0.75
    first, after = brax_rollout(training.wrap(env, 9), actions, 1)
    first_obs, seen = house_rollout(env, house, actions, 1, 9)
    if isinstance(env.observation_size, dict):
        first, after = (state.replace(obs=state.obs[PIXELS]) for state in (first, after))
        after.info["final_observation"] = after.info["final_observation"][PIXELS]
    np.testing.assert_array_equal(first.obs, first_obs)
    np.testing.assert_array_equal(after.obs, seen["obs"])
    np.testing.assert_array_equal(after.info["final_observation"], seen["final_observation"])
    np.testing.assert_array_equal(after.reward, seen["reward"])
    ends = seen["terminated"] | seen["truncated"]
    np.testing.assert_array_equal(after.done, ends | seen["is_cut"])
    np.testing.assert_array_equal(after.info["truncation"], seen["is_cut"])
    assert seen["is_cut"].any()
    assert after.reward.any()


@pytest.mark.contract
def test_every_episode_has_a_start_of_its_own() -> None:
    first, after = brax_rollout(training.wrap(DIAL, 100), random_actions(DIAL, 0), 1)
    starts = np.concatenate([first.obs[:, 1], after.obs[after.done > 0][:, 1]])
    assert len(starts) > 3 * NUM_ENVS
    assert len(np.unique(starts)) == len(starts)


@pytest.mark.contract
@pytest.mark.parametrize("episode_length", [100, 3])
def test_metrics_add_up_to_the_episode(episode_length: int) -> None:
    """In the sums of `EvalWrapper` (first episode) and of `EpisodeWrapper` (each episode)."""
    actions = random_actions(DIAL, 2)
    wrapped = training.EvalWrapper(training.wrap(DIAL, episode_length))
    _, after = brax_rollout(wrapped, actions, 3)
    _, seen = house_rollout(DIAL, Dial(), actions, 3, episode_length)
    first_end = np.argmax(after.done > 0, axis=0)
    where = first_end, np.arange(NUM_ENVS)
    sums = after.info["eval_metrics"].episode_metrics
    # Some 10^4 and five terms of f32, whose rounding is 10^-3 at that size.
    np.testing.assert_allclose(sums["total"][-1], seen["total"][where], atol=5e-3)
    np.testing.assert_array_equal(sums["is_stopped"][-1], seen["is_stopped"][where])
    assert (first_end < NUM_STEPS - 5).all()
    is_end = after.done > 0
    sums = after.info["episode_metrics"]
    np.testing.assert_allclose(sums["total"][is_end], seen["total"][is_end], atol=5e-3)
    np.testing.assert_array_equal(sums["is_stopped"][is_end], seen["is_stopped"][is_end])
    assert seen["is_stopped"][is_end].any()


@pytest.mark.contract
def test_a_finished_episode_stays_as_it_is() -> None:
    """Also within `action_repeat`: of the second half of an action, nothing is executed."""
    step = jax.jit(DIAL.step)
    go, stop = jnp.array([1.0, 0, 0, 0, 0, 0, -1]), jnp.array([1.0, 0, 0, 0, 0, 0, 1])
    state = step(DIAL.reset(jax.random.PRNGKey(0)), go)
    ended = step(state, stop)
    assert (float(state.done), float(ended.done)) == (0.0, 1.0)
    assert float(ended.reward) >= 11.0
    later = step(ended, go)
    assert (float(later.done), float(later.reward), float(later.metrics["total"])) == (1.0, 0, 0)
    np.testing.assert_array_equal(later.obs, ended.obs)
    assert int(later.pipeline_state.state.count) == 2

    repeated = training.EpisodeWrapper(DIAL, 100, 2)
    ended = jax.jit(repeated.step)(repeated.reset(jax.random.PRNGKey(0)), stop)
    assert int(ended.pipeline_state.state.count) == 1
    assert 11.0 <= float(ended.reward) < 11.2
    assert (float(ended.done), float(ended.info["truncation"])) == (1.0, 0.0)


@pytest.mark.unit
def test_without_wrappers_both_flags_tell_a_truncation() -> None:
    env = BraxEnvironment(Dial(), IDS, DialParams(limit=2))
    step, go = jax.jit(env.step), jnp.array([1.0, 0, 0, 0, 0, 0, -1])
    states = [env.reset(jax.random.PRNGKey(0))]
    for _ in range(2):
        states.append(step(states[-1], go))
    assert [float(s.done) for s in states] == [0, 0, 1]
    assert [float(s.info["time_out"]) for s in states] == [0, 0, 1]
    assert [float(s.info["truncation"]) for s in states] == [0, 0, 1]
    stopped = step(states[1], go.at[-1].set(1.0))
    assert (float(stopped.done), float(stopped.info["time_out"])) == (1.0, 0.0)


@pytest.mark.unit
def test_both_forms_of_keys_give_the_same_episode() -> None:
    old, new = DIAL.reset(jax.random.PRNGKey(7)), DIAL.reset(jax.random.key(7))
    go = jnp.array([1.0, 0, 0, 0, 0, 0, -1])
    for _ in range(2):
        np.testing.assert_array_equal(old.obs, new.obs)
        np.testing.assert_array_equal(old.info["rng"], jax.random.key_data(new.info["rng"]))
        assert jnp.issubdtype(new.info["rng"].dtype, jax.dtypes.prng_key)
        old, new = DIAL.step(old, go), DIAL.step(new, go)
    assert float(old.reward) == float(new.reward)


@pytest.mark.contract
def test_images_are_what_the_vision_networks_take() -> None:
    env = BraxEnvironment(DialPicture(), IDS)
    assert env.observation_size == {PIXELS: (84, 84, 3)}
    wrapped = training.wrap(env, 100)

    def policy_parameters(rng: jax.Array) -> Any:
        state = wrapped.reset(rng)
        state = wrapped.step(state, jnp.zeros((NUM_ENVS, env.action_size)))
        made = networks_vision.make_ppo_networks_vision(env.observation_size, env.action_size)
        params = made.policy_network.init(jax.random.PRNGKey(0))
        return state.obs, made.policy_network.apply(None, params, state.obs)

    obs, found = jax.eval_shape(policy_parameters, jax.random.split(jax.random.PRNGKey(0), 5))
    assert obs[PIXELS].shape == (NUM_ENVS, 84, 84, 3)
    assert found.shape == (NUM_ENVS, 2 * env.action_size)


@pytest.mark.unit
def test_trainers_lend_jax_what_it_lost() -> None:
    devices = jax.devices()[:1]
    had = hasattr(jax, "device_put_replicated")
    with trainers():
        copies = jax.device_put_replicated({"a": jnp.arange(3), "b": 2.5}, devices)
    assert hasattr(jax, "device_put_replicated") == had
    with pytest.raises(KeyError, match="inside"), trainers():
        raise KeyError("inside")
    assert hasattr(jax, "device_put_replicated") == had
    assert copies["a"].tolist() == [[0, 1, 2]]
    assert copies["b"].tolist() == [2.5]
    assert copies["a"].addressable_shards[0].data.shape == (1, 3)


@pytest.mark.unit
def test_only_the_adapter_imports_brax() -> None:
    behind = {"envs_mjx.brax_adapter", "envs_mjx.shape_stacking.viewer"}
    others = {m for m in MODULES if m.split(".")[0] in ("envs_mjx", "jaxnew")} - behind
    assert len(others) > 50
    loaded = loaded_after(*(f"import {module}" for module in sorted(others)))
    assert {"envs_mjx", "jaxnew", "jax"} <= loaded
    assert "brax" not in loaded
    assert "brax" in loaded_after("import envs_mjx.brax_adapter")


@pytest.mark.unit
def test_without_brax_the_error_says_what_to_install() -> None:
    lines = "import sys; sys.modules['brax'] = None; import envs_mjx.brax_adapter"
    done = subprocess.run(
        [sys.executable, "-c", lines], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert "ImportError: envs_mjx.brax_adapter needs Brax" in done.stderr
    assert "pip install 'brax>=0.14'" in done.stderr


def skill(moves: str) -> int:
    return sum("RDLU".index(move) * 4**i for i, move in enumerate(moves))


@pytest.mark.learning
@pytest.mark.slow
def test_brax_ppo_learns_grid_world() -> None:
    """One river, three skills that cross it in this order and one that ends in the lava."""
    params = GridWorldParams(fixed_layout=encode_layout(False, 4, 4))
    ids = [skill(moves) for moves in ("DDDRR", "RRRRD", "DDDDD", "RRRRR")]
    rewards = {}

    def progress(num_steps: int, metrics: dict[str, float]) -> None:
        rewards[num_steps] = metrics["eval/episode_reward"]
        episode_return = metrics["eval/episode_episode_return"]
        np.testing.assert_allclose(episode_return, rewards[num_steps], atol=1e-5)

    with trainers():
        ppo.train(
            BraxEnvironment(GridWorld(), ids, params),
            num_timesteps=8192,
            num_envs=32,
            episode_length=10,
            unroll_length=8,
            batch_size=32,
            num_minibatches=4,
            num_updates_per_batch=4,
            learning_rate=3e-3,
            entropy_cost=1e-2,
            normalize_observations=True,
            num_evals=2,
            network_factory=functools.partial(
                networks.make_ppo_networks,
                policy_hidden_layer_sizes=(32,),
                value_hidden_layer_sizes=(32,),
            ),
            progress_fn=progress,
        )
    assert list(rewards) == [0, 8192]
    # 0.11 before and 0.87 after; 0.884 is the most that can be reached.
    assert rewards[0] < 0.3
    assert rewards[8192] > 0.75
