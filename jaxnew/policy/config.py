"""Sizes of the policy's networks (`docs/method.md`, "Policy networks")."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a policy's networks; the defaults are the paper's.

    Attributes:
      state_width: of the state feature f(s), of the layers in front of it, and of an action's
        embedding.
      critic_width: of the critic's own layers, for states that are vectors.
      utility_width: of the hidden layer in which a state meets an action.

    Raises:
      TypeError: a width is not an integer.
      ValueError: a width is below 1.
    """

    state_width: int = 64
    critic_width: int = 64
    utility_width: int = 64

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise TypeError(f"{field.name}={value!r} must be an integer.")
            if value < 1:
                raise ValueError(f"{field.name}={value} must be at least 1.")
