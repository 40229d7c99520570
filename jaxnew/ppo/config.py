"""Shapes and counts of the learner."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxnew.rollout.contract import RolloutConfig


@dataclass(frozen=True)
class PPOConfig:
    """Shapes and counts of the learner; all static.

    Attributes:
      rollout: shapes of a rollout.
      num_epochs: passes over a rollout.
      num_minibatches: gradient steps per pass.
      microbatch_size: transitions whose gradient is computed at a time, then averaged over the
        minibatch; 0 computes the whole minibatch at once. The function is the same; on a CPU a few
        hundred keep the `[B, m, 64]` arrays in cache and make an update several times faster; of
        images, 16.
      lr_steps: environment steps over which the learning rate falls to a tenth.
      max_grad_norm: bound on the global norm of the gradient.
      time_limits_are_ends: nothing is bootstrapped through a time limit. The paper's reported
        runs treated every end alike.
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
        if num_transitions < 2:
            raise ValueError("num_envs * num_steps = 1: one advantage has no deviation; take more.")
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
        """Updates over which the learning rate falls."""
        return self.lr_steps // self.steps_per_update
