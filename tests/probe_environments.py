"""Tiny environments given by tables, for tests of rollout, learner and evaluation.

Every probe is the same class with other tables, and tables are traced: one compiled program serves
all of them (`jit` a function of `TableParams`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec, Transition


@struct.dataclass
class TableParams:
    """A Markov decision process with `S` states and `A` actions.

    Attributes:
      observations: f32[S, n] what each state looks like.
      next_state: int32[S, A].
      reward: f32[S, A].
      terminates: bool[S, A] the episode ends naturally with this action.
      starts: int32[K] states that episodes start in, drawn uniformly.
      time_limit: int32[] steps after which an episode is truncated.
    """

    observations: jax.Array
    next_state: jax.Array
    reward: jax.Array
    terminates: jax.Array
    starts: jax.Array
    time_limit: jax.Array


@struct.dataclass
class TableState:
    """state int32[], steps int32[] and episode_return f32[] since the start."""

    state: jax.Array
    steps: jax.Array
    episode_return: jax.Array


class TableWorld(Environment[TableState, TableParams]):
    """What `TableParams` says. `is_success` is true where the last reward was positive."""

    name = "TableWorld-v0"
    episode_metrics = ("is_success", "episode_return", "final_state")

    def __init__(self, num_actions: int) -> None:
        self._num_actions = num_actions

    @property
    def action_spec(self) -> ActionSpec:
        return ActionSpec(self._num_actions)

    def observation_spec(self, params: TableParams) -> ObservationSpec:
        return ObservationSpec(params.observations.shape[1:], jnp.float32, -np.inf, np.inf)

    def max_episode_steps(self, params: TableParams) -> int:
        return int(params.time_limit)

    def reset_env(self, key: jax.Array, params: TableParams) -> tuple[jax.Array, TableState]:
        start = params.starts[jax.random.randint(key, (), 0, params.starts.shape[0])]
        state = TableState(start, jnp.int32(0), jnp.float32(0.0))
        return params.observations[start], state

    def step_env(
        self, key: jax.Array, state: TableState, action: Action, params: TableParams
    ) -> Transition:
        del key
        reward = params.reward[state.state, action.id]
        terminated = params.terminates[state.state, action.id]
        state = TableState(
            params.next_state[state.state, action.id],
            state.steps + 1,
            state.episode_return + reward,
        )
        truncated = ~terminated & (state.steps >= params.time_limit)
        info = {
            "is_success": reward > 0,
            "episode_return": state.episode_return,
            "final_state": state.state,
            "invalid_action": (action.id < 0) | (action.id >= self._num_actions),
        }
        return params.observations[state.state], state, reward, terminated, truncated, info


def table_params(
    observations: np.ndarray,
    next_state: np.ndarray,
    reward: np.ndarray,
    terminates: np.ndarray,
    starts: tuple[int, ...] = (0,),
    time_limit: int = 10,
) -> TableParams:
    """`TableParams` of the right types from NumPy tables; see there for the shapes."""
    return TableParams(
        jnp.asarray(observations, jnp.float32),
        jnp.asarray(next_state, jnp.int32),
        jnp.asarray(reward, jnp.float32),
        jnp.asarray(terminates, bool),
        jnp.asarray(starts, jnp.int32),
        jnp.int32(time_limit),
    )


def bandit(reward: np.ndarray, observations: np.ndarray) -> TableParams:
    """One step per episode: `reward` f[S, A], and each of the S states starts equally often."""
    reward = np.asarray(reward)
    return table_params(
        observations,
        np.zeros(reward.shape, np.int32),
        reward,
        np.ones(reward.shape, bool),
        starts=tuple(range(len(reward))),
    )


def ladder(num_actions: int, num_rungs: int = 10, time_limit: int = 4) -> TableParams:
    """Deterministic but for the policy: action `a` climbs `1 + a % 4` rungs from rung 0.

    The top terminates, `time_limit` steps truncate, and both happen often. Rewards are irregular
    numbers of both signs. Observation: (rung, its square / 10, an arbitrary number, 1 always).
    """
    rung = np.arange(num_rungs + 1)[:, None]
    action = np.arange(num_actions)[None]
    next_state = np.minimum(rung + 1 + action % 4, num_rungs)
    rng = np.random.default_rng(5)
    observations = np.column_stack(
        [rung[:, 0], rung[:, 0] ** 2 / 10, rng.normal(size=num_rungs + 1), 0 * rung[:, 0] + 1]
    )
    return table_params(
        observations,
        next_state,
        rng.normal(0.3, 1.0, next_state.shape),
        next_state == num_rungs,
        time_limit=time_limit,
    )


@struct.dataclass
class HybridParams:
    """A one-step task of a choice, a position and a stop bit.

    Attributes:
      targets: f32[A, k] best position of each action.
      is_good: bool[A] the actions that are worth anything.
    """

    targets: jax.Array
    is_good: jax.Array


class HybridBandit(Environment[TableState, HybridParams]):
    """A good action at its own place is worth up to 1; in half of the starts stopping is, alone.

    Observation: one-hot of whether to stop. Reward: where acting is right and the choice is good,
    `1 - mean |position - target|`; where stopping is right, 1 for a stop.
    """

    name = "HybridBandit-v0"
    episode_metrics = ("episode_return", "has_stopped")

    def __init__(self, num_actions: int, position_dim: int, has_stop: bool) -> None:
        self._spec = ActionSpec(num_actions, position_dim, has_stop)

    @property
    def action_spec(self) -> ActionSpec:
        return self._spec

    def observation_spec(self, params: HybridParams) -> ObservationSpec:
        return ObservationSpec((2,), jnp.float32, 0.0, 1.0)

    def max_episode_steps(self, params: HybridParams) -> int:
        return 1

    def reset_env(self, key: jax.Array, params: HybridParams) -> tuple[jax.Array, TableState]:
        start = jax.random.bernoulli(key).astype(jnp.int32) * self._spec.has_stop
        return jnp.eye(2)[start], TableState(start, jnp.int32(0), jnp.float32(0.0))

    def step_env(
        self, key: jax.Array, state: TableState, action: Action, params: HybridParams
    ) -> Transition:
        del key
        distance = jnp.abs(action.position - params.targets[action.id])
        acted = params.is_good[action.id] * (1.0 - jnp.mean(distance)) * ~action.stop
        reward = jnp.where(state.state == 1, action.stop.astype(jnp.float32), acted)
        state = TableState(state.state, state.steps + 1, reward)
        info = {"episode_return": reward, "has_stopped": action.stop}
        obs = jnp.eye(2)[state.state]
        return obs, state, reward, jnp.bool_(True), jnp.bool_(False), info
