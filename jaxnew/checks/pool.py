"""Whether environments on the host keep the promises that a pool of them relies on."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxnew.rollout.pool import HostPool
from jaxnew.task.places import UsageError
from jaxnew.task.task import HostDomain

_NUM_ENVS, _NUM_STEPS = 4, 8


def check_pool(host: HostDomain, environment: Any = None) -> None:
    """Plays a few steps in a pool of one worker, twice from the same seed; the pool is then closed.

    What one environment gives is checked by the pool itself.

    Args:
      host: whose pool is tried.
      environment: settings of the environments, None where there are none.

    Raises:
      UsageError: the pool does not fit what `host` says, gives numbers that are not finite, or
        other numbers the second time.
    """
    with host.environments(_NUM_ENVS, seed=0, num_workers=1, environment=environment) as made:
        pool, spec = made.pool, host.observation_spec
        declared = (tuple(spec.shape), np.dtype(spec.dtype), host.action_spec.position_dim)
        found = (pool.observation_shape, np.dtype(pool.observation_dtype), pool.position_dim)
        if found != declared:
            raise UsageError(
                f"The environments of the pool have observations {found[1]}{list(found[0])} and "
                f"positions of {found[2]} numbers; the task's observation_spec and action_spec say "
                f"{declared[1]}{list(declared[0])} and {declared[2]}."
            )
        first, again = _played(pool), _played(pool)
    if not all(map(np.array_equal, first, again)):
        raise UsageError(
            "The same seed and the same actions gave other episodes the second time; all that is "
            "random in an environment must follow from the seed of reset, and nothing may be left "
            "of before. A stopped run could not go on, nor a lost worker be replaced."
        )


def _played(pool: HostPool) -> list[np.ndarray]:
    """Observations, rewards and ends of a few steps, in order."""
    rng = np.random.default_rng(0)
    observations = pool.reset_numbered(0)
    found = [_finite("reset", observations.copy())]
    size = pool.num_envs // pool.num_halves
    for _ in range(_NUM_STEPS):
        for half in range(pool.num_halves):
            positions = rng.uniform(-1.0, 1.0, (size, pool.position_dim)).astype(np.float32)
            pool.send(half, np.zeros(size, np.int32), positions)
            step = pool.receive(half)
            found.append(_finite("step", np.array(step.final_observations)))
            found.append(_finite("step", np.array(step.rewards)))
            found.append(np.array([step.terminated, step.truncated]))
    return found


def _finite(what: str, numbers: np.ndarray) -> np.ndarray:
    if not np.isfinite(numbers).all():
        raise UsageError(
            f"{what}: an observation or a reward is NaN or infinite; the learner needs finite ones."
        )
    return numbers
