"""Engines: what happens to the bodies in the 3 s after an action.

`make_engine` makes one by its name. Each is a module of its own, since simulators take long to
import. See docs/shape_stacking.md, "Engines".
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal, get_args

import jax

from envs_mjx.shape_stacking.engines.contract import Engine, Settled, check_state
from envs_mjx.shape_stacking.shapes import Shape

__all__ = ["PHYSICS", "Engine", "Physics", "Settled", "check_state", "make_engine"]

Physics = Literal["auto", "mjx", "mujoco"]
PHYSICS = get_args(Physics)


def make_engine(physics: str = "auto", shapes: tuple[Shape, ...] = (), **options: Any) -> Engine:
    """An engine by its name; the same one for equal arguments, since it keeps nothing.

    Args:
      physics: `mjx`: in the program, for accelerators. `mujoco`: MuJoCo's C engine, on the host's
        cores. `auto`: `mjx` where jax has an accelerator, else `mujoco`, which is many times
        faster on a CPU.
      shapes: of the user's own, with ids from 810.
      options: arguments of `mjx.Mjx` or `mujoco_c.MujocoC`; both have `settle_steps`.

    Raises:
      ValueError: there is no such engine.
      TypeError: it has no such option.
      ImportError: as `mjx.Mjx`.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics={physics!r} is unknown; choose from {PHYSICS}.")
    if physics == "auto":
        physics = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return _made(physics, shapes=shapes, **options)


@lru_cache(maxsize=4)
def _made(physics: str, **options: Any) -> Engine:
    if physics == "mjx":
        from envs_mjx.shape_stacking.engines.mjx import Mjx

        return Mjx(**options)
    from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC

    return MujocoC(**options)
