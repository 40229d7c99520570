"""Any environment of the house as a Brax environment.

The one module that imports Brax (0.14), which takes seconds: import it by its own name.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.actions import checked_ids
from jaxnew.environment import Action, Environment

try:
    from brax.envs.base import Env, State
except ImportError as err:
    raise ImportError(
        "envs_mjx.brax_adapter needs Brax, which cannot be imported; install it: "
        "pip install 'brax>=0.14'"
    ) from err

# What Brax's networks for images (`make_ppo_networks_vision`) look for.
PIXELS = "pixels/view_0"

_GONE = "device_put_replicated"


@struct.dataclass
class Progress:
    """`pipeline_state` of a `BraxEnvironment`: what Brax puts back when an episode starts again.

    Attributes:
      state: of the environment.
      metrics: f32[] of each name in `episode_metrics`: what it is at this point of the episode; 0
        at its start.
    """

    state: Any
    metrics: dict[str, jax.Array]


class BraxEnvironment(Env):
    """`env` with one fixed list of action ids, for Brax's wrappers, trainers and evaluators.

    Action: f32[m + k + 1], of which the last element exists only where `env` has a stop bit. What
      Brax's Gaussian policies draw fits without a change, with or without their tanh:

      * `0..m-1`: the largest chooses, `ids[argmax]`; the first of equal ones;
      * `m..m+k-1`: the position, clipped to [-1, 1];
      * the last: stop where it is above 0.
    Observation: f32[n], flattened; images (three axes) are `{"pixels/view_0": f32[H, W, C]}`, as
      `make_ppo_networks_vision` wants them. Values are not scaled.
    Done: 1 where the episode terminated or was truncated by `env` itself. Brax knows one end only.
      A finished episode stays as it is, with reward 0, until a wrapper starts the next one.
    Metrics: of each of `episode_metrics` the change in this step, so that Brax's sums over an
      episode (`EpisodeWrapper`, `EvalWrapper`) are its value at the end, whoever ended it.
    Info: `time_out` f32[] 1 where `env` truncated, which `ppo.train(bootstrap_on_timeout=True)`
      reads; `truncation` f32[] the same, until `EpisodeWrapper` writes its own over it: 1 only
      where *its* `episode_length` cut an episode that `env` did not end in that step. So Brax's
      trainers take a truncation by `env` for an end, as the paper's runs do, unless they are told
      to bootstrap. `final_observation`: what the step really produced, also where
      `AutoResetWrapper` has put the next episode's first one into `obs`. `rng`: what the next
      steps draw from, in the form that was given.
    Starts: `AutoResetWrapper` sends every episode of an instance back to its first start. With this
      environment each gets a start of its own: the wrapper's stored start is renewed in each step.

    A step uses its key as `Environment.step` does: with `rng, key = jax.random.split(rng)`, step
    and next start are those of `env.step(key, ...)` of the base class.

    `EpisodeWrapper`'s `episode_length` should be at least `env.max_episode_steps(params)`, its
    `action_repeat` 1: it drops the metrics of all but the last repeat. Batched keys must be old
    ones (`jax.random.PRNGKey`), from whose shape it reads the batch's. There is no `sys`, so no
    `randomization_fn`.

    Example:
      env = BraxEnvironment(GridWorld(), ids=range(50))
      with trainers():
          make_policy, params, metrics = ppo.train(
              env, num_timesteps=100_000, num_envs=256, episode_length=10)
    """

    def __init__(self, env: Environment, ids: Sequence[int] | np.ndarray, params: Any = None):
        """
        Args:
          env: not wrapped; its automatic reset is not used.
          ids: m action ids that exist in `env`.
          params: of `env`; None for its default.

        Raises:
          ValueError: `ids` is empty or names an action that `env` does not have.
        """
        self._env = env
        self._ids = checked_ids(ids, env.action_spec.num_actions)
        self._params = env.default_params if params is None else params

    @property
    def action_size(self) -> int:
        """m + k, and 1 for the stop bit where there is one."""
        spec = self._env.action_spec
        return len(self._ids) + spec.position_dim + int(spec.has_stop)

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:
        """n, or the shape of an image under its name."""
        shape = self._env.observation_spec(self._params).shape
        return {PIXELS: shape} if len(shape) == 3 else int(np.prod(shape))

    @property
    def backend(self) -> str:
        """`jaxnew`: none of Brax's physics."""
        return "jaxnew"

    def decode(self, action: jax.Array) -> Action:
        """The environment's action behind Brax's, f32[action_size]; see the class."""
        chex.assert_shape(action, (self.action_size,))
        spec, num_ids = self._env.action_spec, len(self._ids)
        return Action(
            id=jnp.asarray(self._ids)[jnp.argmax(action[:num_ids])],
            position=jnp.clip(action[num_ids : num_ids + spec.position_dim], -1.0, 1.0),
            stop=action[-1] > 0.0 if spec.has_stop else jnp.bool_(False),
        )

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; consumes `rng`, one key of either form."""
        rng, key = jax.random.split(rng)
        obs, start = self._start(key)
        zero = jnp.float32(0.0)
        info = {"rng": rng, "time_out": zero, "truncation": zero, "final_observation": obs}
        return State(start, obs, zero, zero, dict(start.metrics), info)

    def step(self, state: State, action: jax.Array) -> State:
        """One agent step.

        Args:
          state: not batched. What wrappers keep in its `info` and `metrics` is handed on.
          action: f32[action_size].
        """
        rng, key = jax.random.split(state.info["rng"])
        key_step, key_start = jax.random.split(key)
        progress = state.pipeline_state
        obs, env_state, reward, terminated, truncated, info = self._env.step_env(
            key_step, progress.state, self.decode(action), self._params
        )
        obs = self._observation(obs)
        metrics = {name: jnp.float32(info[name]) for name in self._env.episode_metrics}
        changes = {name: value - progress.metrics[name] for name, value in metrics.items()}
        time_out = jnp.float32(truncated & ~terminated)
        own = {"time_out": time_out, "truncation": time_out, "final_observation": obs}
        after = state.replace(
            pipeline_state=Progress(env_state, metrics),
            obs=obs,
            reward=jnp.float32(reward),
            done=jnp.float32(terminated | truncated),
            metrics={**state.metrics, **changes},
            info={**state.info, **own},
        )
        still = {**state.metrics, **{name: jnp.float32(0.0) for name in changes}}
        over = state.replace(reward=jnp.float32(0.0), metrics=still)
        after = jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), after, over)
        return after.replace(info={**after.info, "rng": rng, **self._next_start(key_start, state)})

    def _next_start(self, key: jax.Array, state: State) -> dict[str, Any]:
        """What `AutoResetWrapper` puts in at an end, drawn anew; nothing where it is absent."""
        if "first_pipeline_state" not in state.info:
            return {}
        obs, start = self._start(key)
        return {"first_pipeline_state": start, "first_obs": obs}

    def _start(self, key: jax.Array) -> tuple[Any, Progress]:
        obs, env_state = self._env.reset_env(key, self._params)
        metrics = {name: jnp.float32(0.0) for name in self._env.episode_metrics}
        return self._observation(obs), Progress(env_state, metrics)

    def _observation(self, obs: jax.Array) -> Any:
        obs = jnp.asarray(obs, jnp.float32)
        return {PIXELS: obs} if obs.ndim == 3 else obs.reshape(-1)


@contextmanager
def trainers() -> Iterator[None]:
    """Inside, Brax's trainers run on jax 0.10 and later.

    PPO, SAC and APG of Brax 0.14.2 call `jax.device_put_replicated`, which those versions no longer
    have. It is put back for as long as this context lasts, and left alone where it exists.
    """
    if hasattr(jax, _GONE):
        yield
        return
    setattr(jax, _GONE, _replicated)
    try:
        yield
    finally:
        delattr(jax, _GONE)


def _replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """A copy of every leaf on each device, along a new leading axis."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    copies = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * len(devices)), tree)
    return jax.device_put(copies, sharding)
