"""Proximal policy optimisation over changing action sets (paper algorithm 1, spec method 6)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxnew.policy import PolicyMethod
from jaxnew.ppo.advantages import gae
from jaxnew.ppo.objective import Hyperparameters, Minibatch, loss, normalize_advantages
from jaxnew.rollout.batch import RolloutBatch
from jaxnew.rollout.device import DeviceRollout, RolloutConfig, RolloutState
from jaxnew.sampling import ActionPool, AvailableSet

Metrics = dict[str, jax.Array]


@dataclass(frozen=True)
class PPOConfig:
    """Shapes and counts of the learner; all static.

    Attributes:
      rollout: shapes of a rollout.
      num_epochs: passes over a rollout.
      num_minibatches: gradient steps per pass.
      microbatch_size: transitions whose gradient is computed at a time, then averaged over the
        minibatch; 0 computes the whole minibatch at once. The function is the same; on a CPU a few
        hundred keep the `[B, m, 64]` arrays in cache and make an update several times faster.
      lr_steps: environment steps over which the learning rate falls to a tenth.
      max_grad_norm: bound on the global norm of the gradient.
      time_limits_are_ends: nothing is bootstrapped through a time limit. Spec method 6: the
        reported runs treated every end alike.
    """

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    num_epochs: int = 4
    num_minibatches: int = 4
    microbatch_size: int = 256
    lr_steps: int = 40_000_000
    max_grad_norm: float = 0.5
    time_limits_are_ends: bool = True

    def __post_init__(self) -> None:
        for name, low in (("num_epochs", 1), ("num_minibatches", 1), ("microbatch_size", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {low}.")
        if not self.max_grad_norm > 0:
            raise ValueError(f"max_grad_norm={self.max_grad_norm} must be positive.")
        num_transitions = self.steps_per_update
        if num_transitions % self.num_minibatches:
            raise ValueError(
                f"num_envs * num_steps = {num_transitions} is not divisible by num_minibatches="
                f"{self.num_minibatches}; change one of the three."
            )
        if self.microbatch_size and self.minibatch_size % self.microbatch_size:
            raise ValueError(
                f"A minibatch of {self.minibatch_size} transitions is not divisible by "
                f"microbatch_size={self.microbatch_size}; use a divisor, or 0 for no division."
            )
        if self.lr_steps < num_transitions:
            raise ValueError(
                f"lr_steps={self.lr_steps} is less than one update of {num_transitions} steps."
            )
        if self.rollout.bootstraps_time_limits == self.time_limits_are_ends:
            raise ValueError(
                "rollout.bootstraps_time_limits must be the opposite of time_limits_are_ends, got "
                f"{self.time_limits_are_ends} for both."
            )

    @property
    def steps_per_update(self) -> int:
        """Environment steps per update."""
        return self.rollout.num_envs * self.rollout.num_steps

    @property
    def minibatch_size(self) -> int:
        return self.steps_per_update // self.num_minibatches

    @property
    def lr_updates(self) -> int:
        """Updates over which the learning rate falls (J of spec method 6)."""
        return self.lr_steps // self.steps_per_update


@struct.dataclass
class TrainState:
    """Everything that a run goes on from.

    Attributes:
      params: of the policy method.
      opt_state: of Adam.
      rollout: environments, sets and running statistics.
      key: PRNG key of the run, never advanced: update `j` uses `fold_in(key, j)`.
      step: int32[] number of updates done.
    """

    params: Any
    opt_state: Any
    rollout: RolloutState
    key: jax.Array
    step: jax.Array


@dataclass(frozen=True)
class Learner:
    """The training step of one method in one environment.

    All methods are pure; `update` and `init` may be vmapped over members of a sweep.
    """

    rollout: DeviceRollout
    config: PPOConfig

    @property
    def method(self) -> PolicyMethod:
        return self.rollout.method

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Gradient clipping and Adam without its learning rate, which is traced."""
        return optax.chain(
            optax.clip_by_global_norm(self.config.max_grad_norm),
            optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-5),
        )

    def init(self, key: jax.Array, table: jax.Array, pool: ActionPool) -> TrainState:
        """A fresh run; consumes `key`."""
        key_run, key_params, key_rollout = jax.random.split(key, 3)
        rollout = self.rollout.init(key_rollout, pool)
        params = self.method.init(key_params, rollout.observation[0], table.shape[-1])
        opt_state = self.optimizer.init(params)
        return TrainState(params, opt_state, rollout, key_run, jnp.int32(0))

    def update(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
    ) -> tuple[TrainState, Metrics]:
        """One rollout and the gradient steps on it.

        Args:
          state: of the run.
          hyperparameters: traced numbers.
          table: f32[A, d] representations.
          pool: actions that sets are drawn from.

        Returns:
          The next state and scalars: `episodes/...` are sums over the episodes that ended,
          `nonfinite/...` counts, the rest means over the gradient steps.
        """
        key_rollout, key_learn = jax.random.split(jax.random.fold_in(state.key, state.step))
        rollout, batch, sums = self.rollout.collect(
            key_rollout, state.rollout, state.params, table, pool, hyperparameters.discount
        )
        params, opt_state, metrics = self.learn(
            key_learn,
            state.params,
            state.opt_state,
            batch,
            hyperparameters,
            table,
            state.step,
            rollout.available if batch.available is None else None,
        )
        metrics |= {f"episodes/{name}": value for name, value in sums.items()}
        next_state = TrainState(params, opt_state, rollout, state.key, state.step + 1)
        return next_state, metrics

    def updates(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
        num_updates: int,
    ) -> tuple[TrainState, Metrics]:
        """`num_updates` (static) times `update`, and the metrics over all of them.

        `episode/...` are means over the episodes that ended, NaN if none did.
        """

        def body(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
            return self.update(state, hyperparameters, table, pool)

        state, stacked = jax.lax.scan(body, state, None, length=num_updates)
        return state, reduce_metrics(stacked)

    def learn(
        self,
        key: jax.Array,
        params: Any,
        opt_state: Any,
        batch: RolloutBatch,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        step: jax.Array,
        fixed_set: AvailableSet | None = None,
    ) -> tuple[Any, Any, Metrics]:
        """Gradient steps on one rollout; consumes `key`. Returns (params, opt_state, metrics)."""
        terminated = batch.done if self.config.time_limits_are_ends else batch.terminated
        advantages, value_targets = gae(
            batch.reward,
            batch.value,
            batch.next_value,
            terminated,
            batch.done,
            hyperparameters.discount,
            hyperparameters.gae_lambda,
        )
        transitions = Minibatch(
            observation=batch.observation,
            available=batch.available,
            sample=batch.sample,
            log_prob=batch.log_prob,
            value=batch.value,
            advantage=normalize_advantages(advantages),
            value_target=value_targets,
        )
        transitions = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), transitions)
        learning_rate = hyperparameters.learning_rate * self._learning_rate_factor(step)

        def gradient_step(carry: tuple[Any, Any], indices: jax.Array) -> tuple[Any, Metrics]:
            params, opt_state = carry
            minibatch = jax.tree.map(lambda x: x[indices], transitions)
            grads, metrics = self._gradient(params, minibatch, hyperparameters, table, fixed_set)
            updates, opt_state = self.optimizer.update(grads, opt_state, params)
            params = optax.apply_updates(
                params, jax.tree.map(lambda u: -learning_rate * u, updates)
            )
            metrics["gradient_norm"] = optax.tree.norm(grads)
            return (params, opt_state), metrics

        indices = self._minibatch_indices(key)
        (params, opt_state), metrics = jax.lax.scan(gradient_step, (params, opt_state), indices)
        nonfinite = {
            f"nonfinite/{name}": jnp.sum(~jnp.isfinite(values)).astype(jnp.float32)
            for name, values in {
                "loss": metrics["loss/total"],
                "gradient": metrics["gradient_norm"],
                "advantage": advantages,
            }.items()
        }
        metrics = jax.tree.map(jnp.mean, metrics)
        residual_variance = jnp.var(value_targets - batch.value)
        metrics["value/explained_variance"] = 1.0 - residual_variance / (
            jnp.var(value_targets) + 1e-8
        )
        metrics["learning_rate"] = learning_rate
        return params, opt_state, {**metrics, **nonfinite}

    def _learning_rate_factor(self, step: jax.Array) -> jax.Array:
        """Linear from 1 to 0.1 over `lr_updates`, then constant (spec method 6)."""
        return 1.0 - 0.9 * jnp.minimum(1.0, step / self.config.lr_updates)

    def _minibatch_indices(self, key: jax.Array) -> jax.Array:
        """int32[epochs * minibatches, B]: a fresh permutation of all transitions per epoch."""
        keys = jax.random.split(key, self.config.num_epochs)
        orders = [jax.random.permutation(k, self.config.steps_per_update) for k in keys]
        return jnp.stack(orders).reshape(-1, self.config.minibatch_size)

    def _gradient(
        self,
        params: Any,
        minibatch: Minibatch,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        fixed_set: AvailableSet | None = None,
    ) -> tuple[Any, Metrics]:
        """Gradient of the minibatch's loss, and the metrics of it.

        What can be available is projected once; microbatches add up the gradient of the projected
        rows, which one backward pass then carries into the parameters of the projection.
        """
        rows = table if fixed_set is None else table[fixed_set.ids]
        projected, pull_back = jax.vjp(lambda p: self.method.project(p, rows), params)

        def gradient_of(part: Minibatch) -> tuple[Any, Metrics]:
            return jax.grad(loss, argnums=(0, 1), has_aux=True)(
                params, projected, part, self.method, hyperparameters, fixed_set
            )

        size = self.config.microbatch_size
        if size in (0, self.config.minibatch_size):
            grads, metrics = gradient_of(minibatch)
        else:
            parts = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), minibatch)
            grads, metrics = _mean_over(gradient_of, parts)
        grads_direct, grad_rows = grads
        return jax.tree.map(jnp.add, grads_direct, pull_back(grad_rows)[0]), metrics


def reduce_metrics(stacked: Metrics) -> Metrics:
    """Metrics of several updates, f32[n] each, as one f32[] each; see `Learner.updates`."""
    reduced = {
        name: jnp.sum(values) if name.startswith("nonfinite/") else jnp.mean(values)
        for name, values in stacked.items()
        if not name.startswith("episodes/")
    }
    num_episodes = jnp.sum(stacked["episodes/num_episodes"])
    for name, values in stacked.items():
        if name.startswith("episodes/") and name != "episodes/num_episodes":
            mean = jnp.sum(values) / jnp.maximum(num_episodes, 1.0)
            key = name.replace("episodes/", "episode/")
            reduced[key] = jnp.where(num_episodes > 0, mean, jnp.nan)
    return reduced | {"num_episodes": num_episodes}


def _mean_over(function: Any, parts: Any) -> Any:
    """The mean of `function` over the leading axis of `parts`, one part at a time."""
    num_parts = jax.tree.leaves(parts)[0].shape[0]
    shapes = jax.eval_shape(function, jax.tree.map(lambda x: x[0], parts))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def add(total: Any, part: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, function(part)), None

    total, _ = jax.lax.scan(add, zeros, parts)
    return jax.tree.map(lambda x: x / num_parts, total)
