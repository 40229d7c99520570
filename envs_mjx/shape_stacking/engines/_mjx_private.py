"""Everything of mujoco-mjx that has no public name, and the versions that have it.

MJX moves the bodies and solves for the contact forces. Where bodies touch is found by this
project's own code, since MJX wants shapes to be part of the program;
`_impl.contact` of MJX's data is where the two meet. Nothing of MJX is replaced or patched.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import inspect
import io
from collections.abc import Callable, Iterator
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from envs_mjx.shape_stacking import scene

# It prints that it has no Warp, which nothing here uses.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["Contacts", "check_version", "in_32_bits", "is_as_expected", "mjx", "private", "step"]

WRITTEN_FOR = "3.17"

_SOURCE = "mujoco.mjx._src"
# Functions with the names of their arguments, and classes with those of their fields.
FUNCTIONS = {
    "collision_convex._capsule_convex": ("cap", "convex"),
    "math.closest_segment_to_segment_points": ("a0", "a1", "b0", "b1"),
    "math.make_frame": ("a",),
}
CLASSES = {
    "collision_types.GeomInfo": ("pos", "mat", "size"),
    "collision_types.ConvexInfo": (
        *("pos", "mat", "size"),
        *("vert", "face", "face_normal", "edge", "edge_face_normal"),
    ),
    "types.Contact": (
        *("dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction"),
        *("solimp", "dim", "geom1", "geom2", "geom", "efc_address"),
    ),
}


class Contacts(NamedTuple):
    """Places where two bodies touch, or might.

    Attributes:
      distance: f32[n] m; negative where they overlap, and forces act there only.
      position: f32[n, 3] m.
      normal: f32[n, 3] unit vector from the first body to the second.
      bodies: int32[n, 2] indices into MJX's bodies; 0 is the world, which holds the table.
    """

    distance: jax.Array
    position: jax.Array
    normal: jax.Array
    bodies: jax.Array


def check_version() -> None:
    """Refuses a mujoco-mjx that this was not written for.

    Raises:
      ImportError: it is another version, or a name has gone.
    """
    version = importlib.metadata.version("mujoco-mjx")
    if not version.startswith(f"{WRITTEN_FOR}."):
        raise ImportError(
            f"mujoco-mjx {version} is installed; the MJX engine was written against "
            f"{WRITTEN_FOR}, of which it uses private names. pip install 'mujoco-mjx=="
            f"{WRITTEN_FOR}.*' 'mujoco=={WRITTEN_FOR}.*', or choose physics='mujoco'."
        )
    broken = [name for name in (*FUNCTIONS, *CLASSES) if not is_as_expected(name)]
    if broken:
        raise ImportError(
            f"mujoco-mjx {version} lacks {', '.join(broken)} or has them in another form; this "
            f"was written against {WRITTEN_FOR}. Choose physics='mujoco'."
        )


def is_as_expected(name: str) -> bool:
    """Whether a name of `FUNCTIONS` or `CLASSES` is there, with these arguments or fields."""
    module, attribute = name.rsplit(".", 1)
    found = getattr(importlib.import_module(f"{_SOURCE}.{module}"), attribute, None)
    if found is None:
        return False
    if name in CLASSES:
        return tuple(getattr(found, "__dataclass_fields__", ())) == CLASSES[name]
    return tuple(inspect.signature(found).parameters) == FUNCTIONS[name]


@lru_cache(maxsize=1)
def private() -> SimpleNamespace:
    """The functions and classes by their last names, without leading underscores.

    Raises:
      ImportError: as `check_version`.
    """
    check_version()
    found = {}
    for name in (*FUNCTIONS, *CLASSES):
        module, attribute = name.rsplit(".", 1)
        value = getattr(importlib.import_module(f"{_SOURCE}.{module}"), attribute)
        found[attribute.lstrip("_")] = value
    return SimpleNamespace(**found)


@contextlib.contextmanager
def in_32_bits() -> Iterator[None]:
    """Inside, MJX makes arrays of f32 and int32, whatever JAX is set to."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        yield


def step(model: Any, data: Any, find_contacts: Callable[[Any], Contacts]) -> Any:
    """One physics step: `mjx.step`, but with contacts of our own.

    What this task's scene does not have is left out: tendons, actuators, sensors, cameras.

    Args:
      model: `mjx.Model`.
      data: `mjx.Data` of the JAX backend.
      find_contacts: (`mjx.Data` with the poses of all bodies) -> `Contacts`, any number; the
        deepest of them are kept, as many as the data has room for.

    Returns:
      `mjx.Data` after the step.
    """
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.factor_m(model, mjx.crb(model, data))
    data = _with_contacts(data, find_contacts(data))
    data = mjx.make_constraint(model, data)
    data = mjx.fwd_acceleration(model, mjx.fwd_velocity(model, data))
    return mjx.euler(model, mjx.solve(model, data))


def _with_contacts(data: Any, contacts: Contacts) -> Any:
    room = len(data._impl.contact.dim)
    distance, position, normal, bodies = contacts
    if len(distance) > room:
        _, best = jax.lax.top_k(-distance, room)
        distance, position, normal, bodies = (x[best] for x in contacts)
    missing = room - len(distance)
    if missing:
        pad = [(0, missing)]
        distance = jnp.pad(distance, pad, constant_values=1.0)
        position, bodies = (jnp.pad(x, [*pad, (0, 0)]) for x in (position, bodies))
        normal = jnp.pad(normal, [*pad, (0, 0)], constant_values=1.0)
    sliding, torsion, rolling = scene.FRICTION
    friction = jnp.array([sliding, sliding, torsion, rolling, rolling], jnp.float32)
    # Body k of the scene has geom k.
    contact = data._impl.contact.replace(
        dist=distance,
        pos=position,
        frame=jax.vmap(private().make_frame)(normal),
        includemargin=jnp.zeros(room),
        friction=jnp.tile(friction, (room, 1)),
        solref=jnp.tile(jnp.array(scene.SOLREF, jnp.float32), (room, 1)),
        solreffriction=jnp.zeros((room, mujoco.mjNREF)),
        solimp=jnp.tile(jnp.array(scene.SOLIMP, jnp.float32), (room, 1)),
        geom=bodies,
        geom1=bodies[:, 0],
        geom2=bodies[:, 1],
    )
    return data.tree_replace({"_impl.contact": contact})
