"""What the learner, the rollout and the evaluation need of a policy, whichever it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import jax
import numpy as np

from jaxnew.environment import Action, ActionSpec
from jaxnew.policy.auxiliary import AuxiliaryMethod
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.continuous import ContinuousMethod
from jaxnew.policy.discrete import DiscreteMethod
from jaxnew.policy.modulated import ModulatedMethod
from jaxnew.policy.utility import RandomMethod, UtilityMethod
from jaxnew.sampling import AvailableSet

Params = Any


class Distribution(Protocol):
    """A distribution over samples; a sample is a pytree, stored as it is by PPO."""

    def sample(self, key: jax.Array) -> Any:
        """A draw for every state [...]; consumes `key`."""
        ...

    def log_prob(self, sample: Any) -> jax.Array:
        """f32[...] log-probability or log-density of a sample."""
        ...

    def entropy(self, sample: Any = None) -> jax.Array:
        """f32[...] nats; a part that is conditioned on another has those at `sample`."""
        ...

    def mode(self) -> Any:
        """The sample that a greedy evaluation takes."""
        ...


class PolicyMethod(Protocol):
    """A policy as pure functions of its parameters.

    It may have more. `distribution_and_value`, with the arguments of `distribution`, where the two
    share work. `for_evaluation() -> PolicyMethod`, who acts with its parameters where nothing is
    learned. `failure_loss(params, distribution, representations, is_failure) -> f32[...]`, of the
    actions f32[..., d] that were taken and whether they failed, which is minimised beside the
    objective (`jaxnew.policy.modulated`).
    """

    name: str

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> Params:
        """Fresh parameters for an observation like `obs` and rows of size d; consumes `key`."""
        ...

    def project(self, params: Params, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., p]: the part of the work that depends on an action alone.

        Computed once per gradient step for the whole table; the rows of the available actions are
        then gathered. A method with no such part returns the representations unchanged.
        """
        ...

    def distribution(
        self, params: Params, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Distribution:
        """What is sampled from.

        Args:
          params: as `init` makes them.
          obs: f32[..., n] normalised observations, or uint8[..., H, W, C] images.
          projected: f32[..., m, p] `project` of the available representations.
          mask: bool[..., m] true for a real entry of the set.
        """
        ...

    def value(self, params: Params, obs: jax.Array) -> jax.Array:
        """f32[...] values of observations, as in `distribution`."""
        ...

    def decode(self, sample: Any, available: AvailableSet, table: jax.Array) -> Action:
        """The available action that a sample means.

        Args:
          sample: of `distribution`.
          available: sets [..., m], or one set [m] for all samples.
          table: f32[A, d] representations of all actions, for methods whose sample is not a choice
            from the set.
        """
        ...


def distribution_and_value(
    method: PolicyMethod, params: Params, obs: jax.Array, projected: jax.Array, mask: jax.Array
) -> tuple[Distribution, jax.Array]:
    """`method.distribution` and `method.value`, with what they share computed once if it can be."""
    joint = getattr(method, "distribution_and_value", None)
    if joint is not None:
        found: tuple[Distribution, jax.Array] = joint(params, obs, projected, mask)
        return found
    return method.distribution(params, obs, projected, mask), method.value(params, obs)


def method_of_evaluations(method: PolicyMethod) -> PolicyMethod:
    """Who acts with a method's parameters where nothing is learned."""
    changed = getattr(method, "for_evaluation", None)
    return method if changed is None else cast(PolicyMethod, changed())


@dataclass(frozen=True)
class MethodContext:
    """What some methods must know of the run.

    Attributes:
      train_ids: int32[n] ids of the fixed action space of a discrete policy.
      sums_gaussian_entropy: whether the entropy of a continuous output is summed over its
        dimensions, as in Grid World, or averaged, as elsewhere.
      action_spec: of the domain; what comes with a choice there gets heads. None: nothing does.
      conditions_position: the position's head reads the chosen action too.
      network: sizes.
      representations: f32[n, d] of the actions that are trained with, whose units a method may
        take; None: unknown.
    """

    train_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    sums_gaussian_entropy: bool = False
    action_spec: ActionSpec | None = None
    conditions_position: bool = False
    network: NetworkConfig = field(default_factory=NetworkConfig)
    representations: np.ndarray | None = None


METHODS: dict[str, Callable[[MethodContext], PolicyMethod]] = {
    "ours": lambda context: UtilityMethod(context.network),
    "modulated": lambda context: ModulatedMethod(context.network, context.representations),
    "continuous": lambda context: ContinuousMethod(context.sums_gaussian_entropy, context.network),
    "discrete": lambda context: DiscreteMethod(context.train_ids, context.network),
    "random": lambda context: RandomMethod(context.network),
}


def make_method(name: str, context: MethodContext | None = None) -> PolicyMethod:
    """The policy method called `name`.

    Raises:
      ValueError: there is none of that name, or `context` lacks what it needs.
    """
    if name not in METHODS:
        raise ValueError(f"Unknown method {name!r}; choose one of {sorted(METHODS)}.")
    context = context or MethodContext()
    method = METHODS[name](context)
    actions = context.action_spec or ActionSpec(0)
    if context.conditions_position or actions.position_dim or actions.has_stop:
        return AuxiliaryMethod(method, actions, context.conditions_position)
    return method
