"""The gradient steps of PPO (docs/method.md, "PPO"), wherever the rollout was made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxnew import finiteness
from jaxnew.finiteness import counts_along
from jaxnew.optimizer import in_32_bits
from jaxnew.policy import PolicyMethod
from jaxnew.ppo.advantages import failures, gae, temporal_differences
from jaxnew.ppo.config import PPOConfig
from jaxnew.ppo.objective import Hyperparameters, Minibatch, loss, normalize_advantages
from jaxnew.rollout.contract import Policy, Rollout, RolloutBatch
from jaxnew.rollout.frames import FrameHistory
from jaxnew.sampling import Actions, AvailableSet

Metrics = dict[str, jax.Array]


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
    rollout: Any
    key: jax.Array
    step: jax.Array

    @property
    def policy(self) -> Policy:
        """What acts."""
        return Policy(self.params, self.rollout.observation_statistics)


@dataclass(frozen=True)
class GradientSteps:
    """The gradient steps on one rollout. All methods are pure.

    Attributes:
      rollout: has the `method` that is trained.
      config: shapes and counts.
    """

    rollout: Rollout
    config: PPOConfig

    @property
    def method(self) -> PolicyMethod:
        """The policy."""
        return self.rollout.method

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Gradient clipping and Adam without its learning rate, which is traced."""
        return in_32_bits(
            optax.chain(
                optax.clip_by_global_norm(self.config.max_grad_norm),
                optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-5),
            )
        )

    def learn(
        self,
        key: jax.Array,
        params: Any,
        opt_state: Any,
        batch: RolloutBatch,
        hyperparameters: Hyperparameters,
        actions: Actions,
        step: jax.Array,
    ) -> tuple[Any, Any, Metrics]:
        """Gradient steps on one rollout; consumes `key`. Returns (params, opt_state, metrics)."""
        terminated = batch.done if self.config.time_limits_are_ends else batch.terminated
        discount = hyperparameters.discount
        seen = (batch.reward, batch.value, batch.next_value, terminated)
        advantages, value_targets = gae(*seen, batch.done, discount, hyperparameters.gae_lambda)
        transitions = Minibatch(
            observation=jnp.zeros_like(batch.done),  # Looked up per minibatch.
            available=None if actions.is_fixed else batch.available,
            sample=batch.sample,
            log_prob=batch.log_prob,
            value=batch.value,
            advantage=normalize_advantages(advantages),
            value_target=value_targets,
            is_failure=failures(terminated, temporal_differences(*seen, discount)),
        )
        transitions = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), transitions)
        learning_rate = hyperparameters.learning_rate * self._falling_to(0.1, step)
        of_entropy: Any = hyperparameters.entropy_coefficient
        of_entropy *= self._falling_to(hyperparameters.final_entropy, step)
        hyperparameters = replace(hyperparameters, entropy_coefficient=of_entropy)

        def gradient_step(carry: tuple[Any, Any], indices: jax.Array) -> tuple[Any, Metrics]:
            params, opt_state = carry
            minibatch = jax.tree.map(lambda x: x[indices], transitions)
            minibatch = replace(minibatch, observation=batch.observations(indices))
            grads, metrics = self._gradient(
                params, minibatch, hyperparameters, actions, batch.available
            )
            updates, opt_state = self.optimizer.update(grads, opt_state, params)
            params = optax.apply_updates(
                params, jax.tree.map(lambda u: -learning_rate * u, updates)
            )
            metrics["gradient_norm"] = optax.tree.norm(grads)
            return (params, opt_state), metrics

        indices = self._minibatch_indices(key)
        (params, opt_state), metrics = jax.lax.scan(gradient_step, (params, opt_state), indices)
        learned = {"loss": metrics["loss/total"], "gradient": metrics["gradient_norm"]}
        nonfinite = {
            **_counts_of(batch),
            "advantage": finiteness.count(advantages),
            **finiteness.first({name: counts_along(of) for name, of in learned.items()}),
            "parameter": finiteness.count(params),
        }
        metrics = jax.tree.map(jnp.mean, metrics)
        residual_variance = jnp.var(value_targets - batch.value)
        metrics["value/explained_variance"] = 1.0 - residual_variance / (
            jnp.var(value_targets) + 1e-8
        )
        metrics["learning_rate"] = learning_rate
        metrics |= {finiteness.PREFIX + name: value for name, value in nonfinite.items()}
        return params, opt_state, metrics

    def _falling_to(self, end: float | jax.Array, step: jax.Array) -> jax.Array:
        """Linear from 1 to `end` over `lr_updates`, then constant."""
        share = jnp.minimum(1.0, step.astype(jnp.float32) / self.config.lr_updates)
        return 1.0 - (1.0 - end) * share

    def _minibatch_indices(self, key: jax.Array) -> jax.Array:
        """int32[epochs * minibatches, B]: a fresh permutation of all transitions per epoch."""
        keys = jax.random.split(key, self.config.num_epochs)
        transitions = jnp.arange(self.config.steps_per_update, dtype=jnp.int32)
        orders = [jax.random.permutation(key, transitions) for key in keys]
        return jnp.stack(orders).reshape(-1, self.config.minibatch_size)

    def _gradient(
        self,
        params: Any,
        minibatch: Minibatch,
        hyperparameters: Hyperparameters,
        actions: Actions,
        available: AvailableSet,
    ) -> tuple[Any, Metrics]:
        """Gradient of the minibatch's loss, and the metrics of it.

        What can be available is projected once; microbatches add up the gradient of the projected
        rows, which one backward pass then carries into the parameters of the projection.
        """
        offered = actions.offered(available)
        projected, pull_back = jax.vjp(lambda p: self.method.project(p, offered), params)

        def gradient_of(part: Minibatch) -> tuple[Any, Metrics]:
            sets = available if actions.is_fixed else part.available
            return jax.grad(loss, argnums=(0, 1), has_aux=True)(
                params, projected, part, sets, self.method, hyperparameters, actions
            )

        size = self.config.microbatch_size
        if size in (0, self.config.minibatch_size):
            grads, metrics = gradient_of(minibatch)
        else:
            parts = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), minibatch)
            grads, metrics = _mean_over(gradient_of, parts)
        grads_direct, grad_rows = grads
        return jax.tree.map(jnp.add, grads_direct, pull_back(grad_rows)[0]), metrics


def _counts_of(batch: RolloutBatch) -> Metrics:
    """What of a rollout is not finite, at the first step at which anything is not."""
    seen = batch.observation
    at_steps = {
        # Of stacked frames the newest.
        "observation": seen.frames[-len(batch.done) :] if isinstance(seen, FrameHistory) else seen,
        "policy": (batch.value, batch.log_prob),
        "reward": batch.reward,
    }
    counts = finiteness.first({name: counts_along(of) for name, of in at_steps.items()})
    return {**counts, "next_value": finiteness.count(batch.next_value)}


def _mean_over(function: Any, parts: Any) -> Any:
    """The mean of `function` over the leading axis of `parts`, one part at a time."""
    num_parts = jax.tree.leaves(parts)[0].shape[0]
    shapes = jax.eval_shape(function, jax.tree.map(lambda x: x[0], parts))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def add(total: Any, part: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, function(part)), None

    total, _ = jax.lax.scan(add, zeros, parts)
    return jax.tree.map(lambda x: x / num_parts, total)
