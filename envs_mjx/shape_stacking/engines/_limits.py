"""What no world of this task can come to, for every engine."""

from __future__ import annotations

from typing import Any

# In a settling of 3 s a body falls at most 44 m and reaches 29 m/s; the smallest sphere would then
# roll at 370 rad/s. Parking ends at x = 53 and z = 100.
MAX_DISTANCE_M = 200.0
MAX_SPEED = 50.0
MAX_SPIN = 1000.0


def is_plausible(qpos: Any, qvel: Any) -> Any:
    """bool[...] worlds with finite numbers whose bodies are neither too far nor too fast.

    Args:
      qpos: f[..., n, 7] of n bodies, of NumPy or jax.
      qvel: f[..., n, 6].
    """
    # Comparisons with NaN are false.
    is_near = (abs(qpos) < MAX_DISTANCE_M).all(axis=(-2, -1))
    is_slow = (abs(qvel[..., :3]) < MAX_SPEED).all(axis=(-2, -1))
    return is_near & is_slow & (abs(qvel[..., 3:]) < MAX_SPIN).all(axis=(-2, -1))
