"""What the learner, the rollout and the evaluation need of a policy, whichever it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax

from jaxnew.environment import Action
from jaxnew.policy.utility import UtilityMethod
from jaxnew.sampling import AvailableSet

Params = Any


class Distribution(Protocol):
    """A distribution over samples; a sample is a pytree, stored as it is by PPO."""

    def sample(self, key: jax.Array) -> Any: ...

    def log_prob(self, sample: Any) -> jax.Array: ...

    def entropy(self) -> jax.Array: ...

    def mode(self) -> Any: ...


class PolicyMethod(Protocol):
    """A policy as pure functions of its parameters.

    `project` is the part that depends on an action alone. It is computed once per gradient step for
    the whole table; the rows of the available actions are then gathered and handed to
    `distribution`. A method with no such part returns the representations unchanged.
    """

    name: str

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> Params: ...

    def project(self, params: Params, representations: jax.Array) -> jax.Array: ...

    def distribution(
        self, params: Params, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Distribution: ...

    def value(self, params: Params, obs: jax.Array) -> jax.Array: ...

    def decode(self, sample: Any, available: AvailableSet) -> Action: ...


METHODS: dict[str, Callable[[], PolicyMethod]] = {"ours": UtilityMethod}


def make_method(name: str) -> PolicyMethod:
    """The policy method called `name`.

    Raises:
      ValueError: there is none of that name.
    """
    if name not in METHODS:
        raise ValueError(f"Unknown method {name!r}; choose one of {sorted(METHODS)}.")
    return METHODS[name]()
