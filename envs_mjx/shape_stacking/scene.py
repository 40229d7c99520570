"""The physical scene as MJCF text, for both engines (docs/shape_stacking.md, "World").

A plane, and a pool of free bodies whose geometry is data: each engine says what a body of the pool
holds. Positions are metres, angles radians, masses kilograms. Text and NumPy only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from envs_mjx.shape_stacking.shapes import Shape, shape_library
from envs_mjx.shape_stacking.solids import CLASS_NAMES, solids

# Two start cylinders and ten placements.
NUM_START_CYLINDERS = 2
NUM_PLACEMENTS = 10
NUM_SLOTS = NUM_START_CYLINDERS + NUM_PLACEMENTS

TABLE_HEIGHT = -0.5
TIMESTEP_S = 0.01
SETTLE_STEPS = 300
GRAVITY = (0.0, 0.0, -9.81)

# Sliding, torsional and rolling friction of every contact. The plane carries them too, so that
# they do not hang on how an engine combines two geoms.
FRICTION = (2.0, 2.0, 0.25)
CONDIM = 6
SOLREF = (0.02, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)

# Unused bodies wait here, high and far apart: in 3 s they fall 44 m and touch nothing. Below
# the table they would count as deep contacts.
PARKING_X = 20.0
PARKING_GAP = 3.0
PARKING_HEIGHT = 100.0

PRIMITIVES = ("sphere", "capsule", "cylinder")


@dataclass(frozen=True)
class Solver:
    """How contact forces are found; the defaults are the original's.

    Attributes:
      iterations, ls_iterations: upper bounds of Newton's steps and of its line searches.
      tolerance: of the improvement of the cost, at which it stops.
    """

    iterations: int = 100
    ls_iterations: int = 50
    tolerance: float = 1e-8


@dataclass(frozen=True)
class Form:
    """What shapes of one class and scale share: all but yaw and colour.

    Attributes:
      name: unique, such as `cube-4`.
      class_label: index into `solids.CLASS_NAMES`.
      shape_id: the first shape of this form.
      s: scale.
    """

    name: str
    class_label: int
    shape_id: int
    s: float

    @property
    def kind(self) -> str:
        """What collides: `sphere`, `capsule`, `cylinder`, or `mesh` for all others."""
        name = CLASS_NAMES[self.class_label]
        return name if name in PRIMITIVES else "mesh"


@lru_cache(maxsize=8)
def forms(shapes: tuple[Shape, ...] = ()) -> tuple[tuple[Form, ...], np.ndarray]:
    """All forms of the library with `shapes`, and the form of each shape, int32[A]."""
    library = shape_library(shapes)
    keys = np.stack([library.class_labels, library.scale_index], axis=-1)
    _, first, form_of = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    found = []
    for shape_id in map(int, first):
        label, index = map(int, keys[shape_id])
        name = f"{CLASS_NAMES[label]}-{index}"
        found.append(Form(name, label, shape_id, float(library.s[shape_id])))
    form_of = form_of.reshape(-1).astype(np.int32)
    form_of.setflags(write=False)
    return tuple(found), form_of


def parked_qpos() -> np.ndarray:
    """f32[12, 7] where unused bodies wait: position and quaternion (w, x, y, z)."""
    qpos = np.zeros((NUM_SLOTS, 7), np.float32)
    qpos[:, 0] = PARKING_X + PARKING_GAP * np.arange(NUM_SLOTS)
    qpos[:, 2] = PARKING_HEIGHT
    qpos[:, 3] = 1.0
    return qpos


def scene_text(
    bodies: Iterable[str], assets: Iterable[str] = (), solver: Solver | None = None, extra: str = ""
) -> str:
    """The whole model: options, the table and the bodies.

    Args:
      bodies: of `body_text`.
      assets: of `hull_text`.
      solver: its limits; None for the original's.
      extra: elements of an engine's own, such as `<custom>` or `<size>`.
    """
    solver = solver or Solver()
    return f"""<mujoco model="shape_stacking">
  <compiler angle="radian" inertiafromgeom="false"/>
  <option timestep="{TIMESTEP_S}" gravity="{_text(GRAVITY)}" integrator="Euler" solver="Newton"
    cone="pyramidal" impratio="1" iterations="{solver.iterations}"
    ls_iterations="{solver.ls_iterations}" tolerance="{solver.tolerance}"/>
  <default><geom condim="{CONDIM}" friction="{_text(FRICTION)}" margin="0"
    solref="{_text(SOLREF)}" solimp="{_text(SOLIMP)}"/></default>
  {extra}
  <asset>{"".join(assets)}</asset>
  <worldbody>
    <geom name="table" type="plane" pos="0 0 {TABLE_HEIGHT}" size="0 0 1"/>
    {"".join(bodies)}
  </worldbody>
</mujoco>"""


def body_text(
    name: str, inertial: str, geoms: Iterable[str], qpos: Sequence[float] | np.ndarray
) -> str:
    """A free body.

    Args:
      name: of the body.
      inertial: of `inertial_text`.
      geoms: of `geom_text`.
      qpos: position and quaternion (w, x, y, z) at which the model is compiled.
    """
    return (
        f'<body name="{name}" pos="{_text(qpos[:3])}" quat="{_text(qpos[3:])}"><freejoint/>'
        f"{inertial}{''.join(geoms)}</body>\n"
    )


def inertial_text(shape_id: int, shapes: tuple[Shape, ...] = ()) -> str:
    """Mass, centre of mass and inertia of a shape, from the library's true solids."""
    library = shape_library(shapes)
    return (
        f'<inertial mass="{_text([library.mass[shape_id]])}"'
        f' pos="{_text(library.center_of_mass[shape_id])}"'
        f' quat="{_text(library.principal_quaternion[shape_id])}"'
        f' diaginertia="{_text(library.principal_inertia[shape_id])}"/>'
    )


def geom_text(form: Form) -> str:
    """What a form collides with, in the axes of its body: a primitive, or the mesh of its name."""
    if form.kind == "mesh":
        return f'<geom type="mesh" mesh="{form.name}"/>'
    # Radius 1 and half-length 1 at s = 1; a sphere has no length.
    size = [form.s] if form.kind == "sphere" else [form.s, form.s]
    return f'<geom type="{form.kind}" size="{_text(size)}"/>'


def hull_text(form: Form) -> str:
    """The mesh asset of a form with flat sides: the library's convex hull of its class."""
    hull = solids()[form.class_label].hull
    if form.kind != "mesh" or hull is None:
        raise ValueError(f"{form.name} is a {form.kind}, not a mesh; it needs no asset.")
    # Without faces the compiler makes the convex hull itself, also for a mesh that no geom of the
    # compiled model holds. Contacts of several points need that hull.
    return f'<mesh name="{form.name}" vertex="{_text(form.s * hull.vertices)}"/>\n'


def _text(values: Sequence[float] | np.ndarray) -> str:
    """Numbers with all their digits, separated by blanks."""
    return " ".join(repr(value) for value in np.asarray(values).ravel().tolist())
