"""What an environment for the pool must keep to; NumPy only, for workers too."""

from __future__ import annotations

from typing import Any

import numpy as np

_NUM_SEEDS, _NUM_STEPS = 8, 8
_FORMAT = ("observation_shape", "observation_dtype", "position_dim", "episode_metrics")
_MEMBERS = (*_FORMAT, "reset", "step")


def checked_step(
    what: str, step: Any, names: tuple[str, ...]
) -> tuple[Any, float, bool, bool, Any]:
    """The five parts of what `step` gave: observation, reward, terminated, truncated, metrics.

    Args:
      what: which step, for messages.
      step: what it gave.
      names: of the metrics.

    Raises:
      ValueError: they are not of their kinds.
    """
    if not isinstance(step, tuple) or len(step) != 5:
        size = f"{len(step)} parts" if isinstance(step, tuple) else f"a {type(step).__name__}"
        raise ValueError(
            f"{what} gives {size}; it must give 5: observation, reward, terminated, truncated, "
            "metrics."
        )
    observation, reward, terminated, truncated, metrics = step
    if np.ndim(reward) or not isinstance(reward, int | float | np.number | np.ndarray):
        raise ValueError(f"{what}: the reward is {_form(reward)}; it must be one number.")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if np.ndim(flag) or np.asarray(flag).dtype != np.bool_:
            raise ValueError(f"{what}: {name} is {_form(flag)}; it must be one bool.")
    if set(metrics) != set(names):
        raise ValueError(
            f"{what}: the metrics of a step are {sorted(metrics)}; episode_metrics says {names}."
        )
    return observation, float(reward), bool(terminated), bool(truncated), metrics


def checked_observation(what: str, env: Any, observation: Any) -> np.ndarray:
    """The observation as an array.

    Raises:
      ValueError: it has not the shape and dtype that the environment declares.
    """
    array = np.asarray(observation)
    shape, dtype = tuple(env.observation_shape), np.dtype(env.observation_dtype)
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(
            f"{what}: the observation is {array.dtype}{list(array.shape)}; observation_shape and "
            f"observation_dtype say {dtype}{list(shape)}."
        )
    return array


def check_host_environment(env: Any, has_fixed_start: bool = False) -> None:
    """Refuses an environment that a pool could not run or restore; a few short episodes are played.

    Args:
      env: see `envs_host.protocol.HostEnvironment`.
      has_fixed_start: every episode may begin in the same way.

    Raises:
      ValueError: the first mistake that was found, in one sentence.
    """
    name = type(env).__name__
    lacking = [member for member in _MEMBERS if not hasattr(env, member)]
    if lacking:
        raise ValueError(
            f"{name} lacks {', '.join(lacking)}. Inside jit, subclass jaxnew.Environment; for the "
            "pool see envs_host.protocol.HostEnvironment, and GymnasiumHost there."
        )
    if np.dtype(env.observation_dtype) not in (np.dtype(np.uint8), np.dtype(np.float32)):
        raise ValueError(
            f"{name}.observation_dtype is {np.dtype(env.observation_dtype)}; it must be uint8 or "
            "float32."
        )
    first, *others = [_played(env, seed) for seed in range(_NUM_SEEDS)]
    again = _played(env, 0)
    if len(again) != len(first) or not all(map(np.array_equal, again, first)):
        raise ValueError(
            f"{name}: the same seed and the same actions gave another episode the second time; all "
            "that is random must follow from the seed of reset, and nothing may be left of before."
        )
    if not has_fixed_start and all(np.array_equal(other[0], first[0]) for other in others):
        raise ValueError(
            f"{name}.reset: {_NUM_SEEDS} seeds gave one and the same first observation; draw the "
            "start from the seed, or say has_fixed_start=True."
        )


def _played(env: Any, seed: int) -> list[np.ndarray]:
    """All that an episode of action 0 gives: observations and numbers, in order."""
    name, names = type(env).__name__, tuple(env.episode_metrics)
    rng = np.random.default_rng(seed)
    try:
        observation = env.reset(np.random.SeedSequence(seed))
    except Exception as err:
        raise ValueError(f"{name}.reset fails: {type(err).__name__}: {first_line(err)}") from err
    found = [_finite(f"{name}.reset", env, observation)]
    for _ in range(_NUM_STEPS):
        position = rng.uniform(-1.0, 1.0, env.position_dim).astype(np.float32)
        try:
            step = env.step(0, position)
        except Exception as err:
            raise ValueError(f"{name}.step fails: {type(err).__name__}: {first_line(err)}") from err
        observation, reward, terminated, truncated, metrics = checked_step(
            f"{name}.step", step, names
        )
        if not np.isfinite(reward):
            raise ValueError(f"{name}.step: a reward is {reward}.")
        found.append(_finite(f"{name}.step", env, observation))
        found.append(np.array([reward, terminated, truncated, *(metrics[n] for n in names)]))
        if terminated or truncated:
            break
    return found


def _finite(what: str, env: Any, observation: Any) -> np.ndarray:
    array = checked_observation(what, env, observation).copy()
    if not np.isfinite(array).all():
        raise ValueError(f"{what}: the observation is not finite; it must never hold NaN.")
    return array


def _form(found: Any) -> str:
    """Such as `float32[3, 4]`."""
    if isinstance(found, np.ndarray):
        return f"{found.dtype}{list(found.shape)}"
    return f"{found!r}, a {type(found).__name__}"


def first_line(err: object) -> str:
    """The first line of what an error says."""
    return str(err).strip().partition("\n")[0]
