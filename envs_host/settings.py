"""How the workers of a pool are run. Nothing that an environment does depends on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

WorkerDeath = Literal["raise", "restart"]


@dataclass(frozen=True)
class PoolSettings:
    """What `HostPool` does about its workers.

    Attributes:
      on_worker_death: where a worker dies, raises or gives no answer, "raise" a `WorkerError` and
        close the pool, or "restart": replace it exactly, with a warning in the log.
      timeout_s: how long a worker may be silent while it is waited for, which includes other halves
        that it has to finish first.
      start_timeout_s: how long a worker may take to import the factory and to make its
        environments.
      max_restarts: in the life of the pool; where one more is needed, it raises.
      pin_cores: worker w keeps to the w-th of the cores that this process may use, in turn.

    Raises:
      ValueError: an argument is not as above.
    """

    on_worker_death: WorkerDeath = "raise"
    timeout_s: float = 60.0
    start_timeout_s: float = 120.0
    max_restarts: int = 10
    pin_cores: bool = False

    def __post_init__(self) -> None:
        if self.on_worker_death not in get_args(WorkerDeath):
            raise ValueError(
                f"on_worker_death={self.on_worker_death!r} must be 'raise' or 'restart'."
            )
        for name in ("timeout_s", "start_timeout_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name}={getattr(self, name)} must be above 0 seconds.")
        if self.max_restarts < 0:
            raise ValueError(f"max_restarts={self.max_restarts} must be 0 or more.")
