"""An interactive page of a tower: it needs a browser and nothing else, no network either.

Lengths are metres. The page is trimesh's, which holds three.js, and a script that moves the bodies.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import jax
import numpy as np
import trimesh
from trimesh.viewer.notebook import scene_to_html

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.camera import TABLE_COLOR, TABLE_HALF_SIZES
from envs_mjx.shape_stacking.shapes import Shape, shape_library
from envs_mjx.shape_stacking.solids import ARCH_OPENING_RADIUS, CLASS_NAMES, solids

_TABLE = "table"
_TABLE_THICKNESS = 0.05
_SECTIONS = 48  # Of round shapes.
_ARCH_SEGMENTS = 32

# `THREE`, `scene`, `camera`, `controls`, `tracklight` and `render` are those of trimesh's page. It
# reads the bodies in the background. There is a slider, which moves until it is touched.
_SCRIPT = """
<input id="time" type="range" min="0" step="any" value="0"
 style="position: fixed; bottom: 1em; left: 5%%; width: 90%%">
<script>
const film = %s;
const slider = document.getElementById("time"), end = film.times[film.times.length - 1];
slider.max = end;
let isPlaying = end > 0, time = 0, before = performance.now();
tracklight.intensity = 0.5;
const sky = new THREE.HemisphereLight(0xffffff, 0x888888, 0.6);
sky.position.set(0, 0, 1);
scene.add(sky);
slider.addEventListener("pointerdown", () => { isPlaying = false; });
const bodies = [];
function show(now) {
  time = (time + (now - before) / 1000) %% (end + 2);  // The tower is seen for 2 s.
  if (isPlaying) slider.value = time;
  before = now;
  const shown = Number(slider.value);
  for (const body of bodies) {
    body.node.visible = shown >= body.from;
    body.node.position.fromArray(body.positions.evaluate(shown));
    body.node.quaternion.fromArray(body.rotations.evaluate(shown));
  }
  render();
  requestAnimationFrame(show);
}
function begin() {
  scene.traverse((node) => {
    const body = film.bodies[node.userData.name];
    if (!body) return;
    const positions = new THREE.VectorKeyframeTrack("p", film.times, body.positions);
    const rotations = new THREE.QuaternionKeyframeTrack("q", film.times, body.rotations);
    bodies.push({node: node, from: body.from,
      positions: positions.createInterpolant(), rotations: rotations.createInterpolant()});
  });
  if (!bodies.length) return setTimeout(begin, 50);
  camera.up.set(0, 0, 1);
  camera.position.set(2, -6, 1.5);
  controls.target.set(0, 0, 0.3);
  requestAnimationFrame(show);
}
begin();
</script>
"""


def tower_html(
    shape_ids: jax.Array | np.ndarray,
    qpos: jax.Array | np.ndarray,
    seconds_per_frame: float = 0.5,
    shapes: tuple[Shape, ...] = (),
) -> str:
    """A page that plays the bodies of an episode; the mouse turns the view.

    Bodies are drawn as they collide in MuJoCo's C engine: spheres, capsules and cylinders as such,
    all others as the flat-sided hulls of the library. Only the arch, whose hull is a full box, is
    drawn with its opening, as in the agent's images. Between frames bodies move evenly; one that
    still waits for its turn is not seen.

    Args:
      shape_ids: int32[12] shape of each body at the end, below 0 for unused ones: the last
        `Bodies.shape_ids` of an episode.
      qpos: f32[T, 12, 7] `Bodies.qpos` at each moment: position and quaternion (w, x, y, z). A body
        waits where it is at its place of `scene.parked_qpos`.
      seconds_per_frame: on the viewer's clock, s.
      shapes: of the user's own, with ids from 810.

    Returns:
      HTML text, to be written to a file; 0.7 MB are three.js.

    Raises:
      ValueError: arrays that do not fit together or are not finite, unknown ids, no body at all, or
        a time that is not positive.
    """
    shape_ids, qpos = np.asarray(shape_ids), np.asarray(qpos)
    _check(shape_ids, qpos, seconds_per_frame, len(shape_library(shapes).s))
    times = (seconds_per_frame * np.arange(len(qpos))).tolist()
    world, bodies = trimesh.Scene(), {}
    world.add_geometry(_table(), node_name=_TABLE, geom_name=_TABLE)
    for slot in np.flatnonzero(shape_ids >= 0).tolist():
        name = _body_name(slot, int(shape_ids[slot]), shapes)
        poses = qpos[:, slot].astype(np.float64)
        first = int(np.argmin((poses == scene.parked_qpos()[slot]).all(axis=-1)))
        poses[:first] = poses[first]
        mesh = body_mesh(int(shape_ids[slot]), shapes)
        world.add_geometry(mesh, node_name=name, geom_name=name, transform=_matrix(poses[-1]))
        bodies[name] = {
            "from": times[first],
            "positions": poses[:, :3].ravel().tolist(),
            "rotations": poses[:, [4, 5, 6, 3]].ravel().tolist(),
        }
    # Where it stands is the script's business; unnamed ones get names by chance.
    world.camera = trimesh.scene.Camera("camera", fov=(60.0, 45.0))
    film = json.dumps({"times": times, "bodies": bodies})
    return scene_to_html(world).replace("</body>", _SCRIPT % film + "</body>")


def body_mesh(shape_id: int, shapes: tuple[Shape, ...] = ()) -> trimesh.Trimesh:
    """What is drawn for a shape, in the axes of its body and in its colour.

    Args:
      shape_id: of the library.
      shapes: of the user's own, with ids from 810.
    """
    all_forms, form_of = scene.forms(shapes)
    form = all_forms[form_of[shape_id]]
    s = form.s  # Radius 1 and half-length 1 at s = 1.
    if form.kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=s)
    elif form.kind == "capsule":
        mesh = trimesh.creation.capsule(height=2.0 * s, radius=s, count=(_SECTIONS, _SECTIONS // 2))
    elif form.kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=s, height=2.0 * s, sections=_SECTIONS)
    else:
        mesh = _mesh([s * polygon for polygon in _polygons(form.class_label)])
    return _painted(mesh, shape_library(shapes).color[shape_id])


def _check(
    shape_ids: np.ndarray, qpos: np.ndarray, seconds_per_frame: float, num_shapes: int
) -> None:
    num_slots = scene.NUM_SLOTS
    if shape_ids.shape != (num_slots,) or qpos.shape[1:] != (num_slots, 7) or not len(qpos):
        raise ValueError(
            f"shape_ids and qpos have the shapes {shape_ids.shape} and {qpos.shape}; give "
            f"({num_slots},) and (T, {num_slots}, 7) with at least one frame."
        )
    if (shape_ids >= num_shapes).any() or (shape_ids < 0).all():
        raise ValueError(
            f"shape_ids={shape_ids.tolist()}: give ids 0..{num_shapes - 1}, or below 0 for unused "
            "bodies, and at least one body."
        )
    if not np.isfinite(qpos[:, shape_ids >= 0]).all():
        raise ValueError("qpos holds numbers that are not finite; give the poses of a sound world.")
    if not 0.0 < seconds_per_frame < np.inf:
        raise ValueError(
            f"seconds_per_frame={seconds_per_frame} must be positive, for example 0.5."
        )


def _body_name(slot: int, shape_id: int, shapes: tuple[Shape, ...]) -> str:
    """Such as `02_cube_690`: by it the script finds a body."""
    return f"{slot:02d}_{CLASS_NAMES[shape_library(shapes).class_labels[shape_id]]}_{shape_id}"


def _table() -> trimesh.Trimesh:
    x, y = TABLE_HALF_SIZES
    mesh = trimesh.creation.box((2.0 * x, 2.0 * y, _TABLE_THICKNESS))
    mesh.apply_translation((0.0, 0.0, scene.TABLE_HEIGHT - _TABLE_THICKNESS / 2.0))
    return _painted(mesh, [TABLE_COLOR] * 3)


def _painted(mesh: trimesh.Trimesh, color: Sequence[float] | np.ndarray) -> trimesh.Trimesh:
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[*np.round(255.0 * np.asarray(color)).astype(np.uint8).tolist(), 255],
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def _matrix(pose: np.ndarray) -> np.ndarray:
    """f64[4, 4] of a position and a quaternion (w, x, y, z), f64[7]."""
    matrix = trimesh.transformations.quaternion_matrix(pose[3:])
    matrix[:3, 3] = pose[:3]
    return np.asarray(matrix)


def _polygons(class_label: int) -> list[np.ndarray]:
    """Convex faces f64[k, 3] of a flat-sided class at s = 1, counter-clockwise from outside."""
    solid = solids()[class_label]
    if solid.name == "arch":
        return _arch()
    assert solid.hull is not None
    return [solid.hull.vertices[list(face)] for face in solid.hull.faces]


def _arch() -> list[np.ndarray]:
    """The box (2, 1, 1) with its opening, cut into columns along x.

    The opening is drawn with 32 chords, which make it 0.2 % smaller.
    """
    angles = np.linspace(np.pi, 0.0, _ARCH_SEGMENTS + 1)
    x, z = ARCH_OPENING_RADIUS * np.cos(angles), ARCH_OPENING_RADIUS * np.sin(angles) - 1.0
    below = np.concatenate([[(-2.0, -1.0)], np.stack([x, z], axis=-1), [(2.0, -1.0)]])
    above = np.stack([below[:, 0], np.ones(len(below))], axis=-1)

    def sheet(corners: Sequence[np.ndarray], y: Sequence[float]) -> np.ndarray:
        return np.array([(x, depth, z) for (x, z), depth in zip(corners, y, strict=True)])

    front, back, across = (-1.0,) * 4, (1.0,) * 4, (-1.0, -1.0, 1.0, 1.0)
    faces = []
    for i in range(len(below) - 1):
        a, b, c, d = below[i], below[i + 1], above[i + 1], above[i]
        faces += [
            sheet((a, b, c, d), front),
            sheet((d, c, b, a), back),
            sheet((b, a, a, b), across),
            sheet((d, c, c, d), across),
        ]
    faces.append(sheet((below[0], above[0], above[0], below[0]), across))
    faces.append(sheet((above[-1], below[-1], below[-1], above[-1]), across))
    return faces


def _mesh(polygons: Sequence[np.ndarray]) -> trimesh.Trimesh:
    """Triangles of convex polygons. They share no corner, so that the edges are seen."""
    starts = np.cumsum([0, *map(len, polygons)])
    faces = [
        [int(start), int(start) + i, int(start) + i + 1]
        for start, polygon in zip(starts, polygons, strict=False)
        for i in range(1, len(polygon) - 1)
    ]
    return trimesh.Trimesh(np.concatenate(polygons), faces, process=False)
