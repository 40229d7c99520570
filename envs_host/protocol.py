"""What a process pool asks of an environment, how it runs, Gymnasium environments in that form."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, get_args

import numpy as np

if TYPE_CHECKING:
    import gymnasium

Metrics = Mapping[str, float]
WorkerDeath = Literal["raise", "restart"]


class Step(NamedTuple):
    """What a step of a host environment returns; a plain tuple of five will do.

    Attributes:
      observation: after the step; of the pool's shape and dtype.
      reward: finite or not, it is handed on as float32.
      terminated: a natural end.
      truncated: an end by a limit.
      metrics: numbers about the episode so far, one for each of `episode_metrics`.
    """

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    metrics: Metrics


class HostEnvironment(Protocol):
    """An environment that lives in a worker process.

    Everything random in an episode follows from the seed of its `reset`, so that the same seed and
    the same actions give the same episode to the bit, whatever the object did before. Restoring a
    pool relies on it. A `close()` without arguments is called at the end where there is one.

    Attributes:
      observation_shape: of one observation.
      observation_dtype: uint8 or float32.
      position_dim: k, how many numbers a position has; 0 if actions are ids alone.
      episode_metrics: names of the metrics, in the order in which the pool reports them.
    """

    @property
    def observation_shape(self) -> tuple[int, ...]: ...

    @property
    def observation_dtype(self) -> Any: ...

    @property
    def position_dim(self) -> int: ...

    @property
    def episode_metrics(self) -> tuple[str, ...]: ...

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        """Starts a fresh episode; returns its first observation."""
        ...

    def step(self, action_id: int, position: np.ndarray) -> tuple[Any, float, bool, bool, Metrics]:
        """Acts with an id and a position f32[k]; returns the five entries of `Step`."""
        ...


def load_factory(name: str) -> Callable[..., HostEnvironment]:
    """Imports a factory that is named `package.module:NAME`; NAME may have dots.

    Raises:
      ValueError: the name has another form, or there is no such thing.
      ImportError: the module cannot be imported.
    """
    module_name, _, path = name.partition(":")
    if not module_name or not path:
        raise ValueError(f"factory={name!r} must look like 'package.module:NAME'.")
    found: Any = importlib.import_module(module_name)
    for part in path.split("."):
        if not hasattr(found, part):
            raise ValueError(f"factory={name!r}: {module_name} has no {path}.")
        found = getattr(found, part)
    if not callable(found):
        raise ValueError(f"factory={name!r} is a {type(found).__name__} and cannot be called.")
    return found


@dataclass(frozen=True)
class PoolSettings:
    """How `HostPool` runs its workers. Nothing that an environment does depends on it.

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


class GymnasiumHost:
    """A Gymnasium environment as a host environment.

    Its action space is a `Dict` of one `Discrete`, the id, and one `Box` of shape (k,), the
    position; the keys do not matter. A bare `Discrete` has k = 0. Ids are handed on as they are;
    positions are cast to the dtype of the box. Floating point observations are cast to float32.
    An episode's seed is 32 bits of its `SeedSequence`, which every seeding function accepts.

    Use it in a pool as `HostPool("envs_host.protocol:GymnasiumHost.make", {"id": "Name-v0"}, ...)`.

    Args:
      env: the environment. It has to draw everything anew from the seed of a reset.
      episode_metrics: names of numbers in `info`. One that is absent before the end of an episode
        is NaN; absent at the end, it is an error.

    Raises:
      ValueError: a space is not of the kinds above.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], episode_metrics: Sequence[str] = ()) -> None:
        self._env = env
        self.episode_metrics = tuple(episode_metrics)
        self._id_key, self._position_key, self.position_dim, self._position_dtype = _action_format(
            env.action_space
        )
        self.observation_shape, self.observation_dtype = _observation_format(env.observation_space)

    @classmethod
    def make(cls, id: str, episode_metrics: Sequence[str] = (), **kwargs: Any) -> GymnasiumHost:
        """A registered environment; `id` may be `module:Name-v0`, `kwargs` go to it."""
        import gymnasium

        return cls(gymnasium.make(id, **kwargs), episode_metrics)

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        observation, _ = self._env.reset(seed=int(seed.generate_state(1, np.uint32)[0]))
        return np.asarray(observation, self.observation_dtype)

    def step(self, action_id: int, position: np.ndarray) -> Step:
        action: Any = action_id
        if self._id_key is not None:
            position = position.astype(self._position_dtype, copy=False)
            action = {self._id_key: action_id, self._position_key: position}
        observation, reward, terminated, truncated, info = self._env.step(action)
        return Step(
            np.asarray(observation, self.observation_dtype),
            float(reward),
            bool(terminated),
            bool(truncated),
            self._metrics(info, is_end=bool(terminated or truncated)),
        )

    def _metrics(self, info: Mapping[str, Any], is_end: bool) -> Metrics:
        if not self.episode_metrics:
            return {}
        absent = [name for name in self.episode_metrics if name not in info]
        if absent and is_end:
            raise ValueError(
                f"The episode ended without {absent} in its info, which has {sorted(info)}. "
                "Name metrics that are there at the end."
            )
        return {name: float(info.get(name, np.nan)) for name in self.episode_metrics}

    def close(self) -> None:
        self._env.close()


def _action_format(space: Any) -> tuple[str | None, str | None, int, Any]:
    """Keys of the id and of the position, k and the position's dtype."""
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return None, None, 0, np.float32
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {}
    ids = [key for key, part in parts.items() if isinstance(part, spaces.Discrete)]
    boxes = [key for key, part in parts.items() if isinstance(part, spaces.Box)]
    if len(parts) != 2 or len(ids) != 1 or len(parts[boxes[0]].shape or ()) != 1:
        raise ValueError(
            f"The action space {space} must be a Dict of one Discrete and one Box of shape (k,), "
            "or a Discrete. Wrap the environment."
        )
    box = parts[boxes[0]]
    return ids[0], boxes[0], int((box.shape or ())[0]), box.dtype


def _observation_format(space: Any) -> tuple[tuple[int, ...], Any]:
    from gymnasium import spaces

    if not isinstance(space, spaces.Box) or not (
        space.dtype == np.uint8 or np.issubdtype(space.dtype, np.floating)
    ):
        raise ValueError(
            f"The observation space {space} must be a Box of uint8 or floating point numbers. "
            "Wrap the environment."
        )
    dtype = np.uint8 if space.dtype == np.uint8 else np.float32
    return tuple(int(size) for size in space.shape), dtype
