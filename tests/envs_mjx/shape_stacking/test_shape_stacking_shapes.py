"""The shape library: ids, colours, mass and inertia of every class.

Figures: docs/shape_stacking.md, "Ids", "Solids" and "Radius and mass".
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs_mjx.shape_stacking import shape_library, shape_universe
from envs_mjx.shape_stacking.shapes import shape_name
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from tests.envs_mjx.shape_stacking.mujoco_pictures import faces, pieces, text
from tests.envs_mjx.shape_stacking.shape_solids import SOLIDS

pytestmark = pytest.mark.golden

PI = np.pi
# First id, last id, class, scales, range of s, angles, upper end of the angles.
IDS = [
    (0, 59, "middle_triangle", 6, 0.08, 0.40, 10, PI),
    (60, 119, "hat", 6, 0.08, 0.40, 10, PI),
    (120, 179, "triangle", 6, 0.08, 0.40, 10, 2 * PI),
    (180, 239, "tall_triangle", 6, 0.08, 0.24, 10, 2 * PI),
    (240, 299, "horizontal_rectangle", 6, 0.08, 0.40, 10, PI),
    (300, 359, "dome", 6, 0.16, 0.48, 10, PI),
    (360, 389, "cone-hires", 30, 0.08, 0.48, 1, 0),
    (390, 419, "cone", 30, 0.08, 0.48, 1, 0),
    (420, 479, "tetrahedron", 10, 0.08, 0.48, 6, PI / 4),
    (480, 539, "arch", 6, 0.08, 0.40, 10, PI),
    (540, 599, "rectangle", 10, 0.08, 0.24, 6, PI),
    (600, 659, "half_rectangle", 10, 0.08, 0.48, 6, PI),
    (660, 719, "cube", 10, 0.08, 0.48, 6, PI / 4),
    (720, 749, "sphere", 30, 0.08, 0.64, 1, 0),
    (750, 779, "capsule", 30, 0.08, 0.32, 1, 0),
    (780, 809, "cylinder", 30, 0.08, 0.48, 1, 0),
]
# Base, top, centre of mass (x, z), volume, radius of the drop rule; s = 1.
GEOMETRY = {
    "cube": (-1, 1, (0, 0), 8, 1.732),
    "rectangle": (-2, 2, (0, 0), 16, 2.449),
    "half_rectangle": (-0.5, 0.5, (0, 0), 8, 2.291),
    "horizontal_rectangle": (-1, 1, (0, 0), 16, 2.449),
    "arch": (-1, 1, (0, 0.208), 11.09, 2.498),
    "dome": (-0.5, 0.5, (0, -0.0756), PI, 1.538),
    "triangle": (-1, 1, (-1 / 3, -1 / 3), 4, 1.972),
    "tall_triangle": (-2, 2, (-1 / 3, -2 / 3), 8, 3.096),
    "middle_triangle": (-1, 1, (0, -1 / 3), 4, 1.943),
    "hat": (0, 1.414, (0, 0.4714), 4, 1.969),
    "tetrahedron": (-1, 1, (0, -0.5), 8 / 3, 2.42),
    "cone": (-1, 1, (0, -0.5), 2 * PI / 3, 2.079),
    "cone-hires": (-1, 1, (0, -0.5), 2 * PI / 3, 2.080),
    "sphere": (-1, 1, (0, 0), 4.189, 1),
    "capsule": (-2, 2, (0, 0), 10.472, 2),
    "cylinder": (-1, 1, (0, 0), 6.283, 1.414),
}


def ids_of(name: str) -> np.ndarray:
    return np.flatnonzero(shape_library().class_labels == CLASS_NAMES.index(name))


@pytest.mark.parametrize("row", IDS, ids=lambda row: row[2])
def test_ids_are_classes_then_scales_then_angles(row: tuple) -> None:
    first, last, name, num_scales, low, high, num_angles, turn = row
    library = shape_library()
    assert np.array_equal(ids_of(name), np.arange(first, last + 1))
    s = library.s[first : last + 1].reshape(num_scales, num_angles)
    yaw = library.yaw[first : last + 1].reshape(num_scales, num_angles)
    steps = np.arange(num_scales)[:, None]
    # 1e-12: the sums below and NumPy's differ in the last bits only.
    np.testing.assert_allclose(
        s, np.tile(low + (high - low) * steps / (num_scales - 1), num_angles)
    )
    np.testing.assert_allclose(
        yaw, np.tile(turn * np.arange(num_angles) / num_angles, (num_scales, 1))
    )
    assert np.array_equal(library.scale_index[first : last + 1], np.repeat(steps, num_angles))
    angle = 2 * np.arctan2(
        library.quaternion[first : last + 1, 3], library.quaternion[first : last + 1, 0]
    )
    np.testing.assert_allclose(angle, yaw.ravel(), atol=1e-12)
    assert not library.quaternion[:, 1:3].any()


def test_counts_and_start_cylinders() -> None:
    library = shape_library()
    assert len(library.s) == 810
    assert sorted(np.bincount(library.class_labels)) == [30] * 5 + [60] * 11
    assert [CLASS_NAMES[label] for label in library.class_labels[798:801]] == ["cylinder"] * 3
    np.testing.assert_allclose(library.s[798:801], [0.32828, 0.34207, 0.35586], atol=5e-6)


def test_colors_of_the_original() -> None:
    color = shape_library().color
    np.testing.assert_allclose(color[799], (0.2321, 0.6973, 0.5357), atol=5e-5)
    # The page gives three digits, the first of id 690 cut instead of rounded.
    np.testing.assert_allclose(color[690], (0.136, 0.839, 0.648), atol=6e-4)
    np.testing.assert_allclose(color[290], (0.179, 0.934, 0.922), atol=6e-4)


@pytest.mark.parametrize("name", CLASS_NAMES)
def test_geometry_of_the_spec_scales_with_s(name: str) -> None:
    base, top, (x, z), volume, radius = GEOMETRY[name]
    library, ids = shape_library(), ids_of(name)
    s = library.s[ids]
    # Half a unit of the last digit of the page's table, relative to lengths of about 1.
    np.testing.assert_allclose(library.base[ids], base * s, atol=1e-12)
    np.testing.assert_allclose(library.top[ids] / s, top, atol=3e-4)
    np.testing.assert_allclose(library.volume[ids] / s**3, volume, rtol=2e-4)
    np.testing.assert_allclose(library.mass[ids], 1000 * library.volume[ids])
    np.testing.assert_allclose(library.bounding_radius[ids], radius * s, rtol=1e-12)
    center = library.center_of_mass[ids] / s[:, None]
    np.testing.assert_allclose(center, np.tile((x, 0.0, z), (len(ids), 1)), atol=3e-4)


@pytest.mark.oracle
@pytest.mark.parametrize("name", CLASS_NAMES)
def test_moments_equal_sums_over_random_points(name: str) -> None:
    half, outside = SOLIDS[name]
    points = np.random.default_rng(0).uniform(-1, 1, (400_000, 3)) * half
    cell = np.prod(half) * 8 / len(points)
    points = points[outside(*points.T) <= 0]
    library, i = shape_library(), ids_of(name)[-1]
    s = library.s[i]
    # A fraction q of n points lies inside: a deviation of sqrt((1 - q) / (q n)) < 0.3 %, q > 0.2.
    assert len(points) * cell == pytest.approx(library.volume[i] / s**3, rel=0.01)
    center = points.mean(axis=0)
    np.testing.assert_allclose(center, library.center_of_mass[i] / s, atol=0.012)
    offsets = points - center
    inertia = (np.sum(offsets**2) * np.eye(3) - offsets.T @ offsets) * cell * 1000
    expected = library.inertia[i] / s**5
    np.testing.assert_allclose(inertia, expected, atol=0.02 * expected.max())


def compile_body(parts: list[np.ndarray], quaternion: np.ndarray) -> mujoco.MjModel:
    meshes, geoms = "", ""
    for k, points in enumerate(parts):
        meshes += f"<mesh name='m{k}' inertia='exact' vertex='{text(points)}' "
        meshes += f"face='{text(faces(points))}'/>"
        geoms += f"<geom type='mesh' mesh='m{k}'/>"
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{meshes}</asset><worldbody>"
        f"<body quat='{text(quaternion)}'><freejoint/>{geoms}</body></worldbody></mujoco>"
    )


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("name", "tolerance"),
    # Flat sides are exact; 96 chords of a circle lack (2 pi / 96)^2 / 6 = 0.0007 of its area,
    # half as much for 192 of them.
    [
        ("triangle", 1e-6),
        ("tall_triangle", 1e-6),
        ("tetrahedron", 1e-6),
        ("cone", 2e-3),
        ("dome", 1e-3),
        ("arch", 1e-3),
    ],
)
def test_mujoco_compiles_the_same_mass_and_inertia(name: str, tolerance: float) -> None:
    library, i = shape_library(), ids_of(name)[-1]
    model = compile_body([library.s[i] * piece for piece in pieces(name)], library.quaternion[i])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body_mass[1] == pytest.approx(library.mass[i], rel=tolerance)
    np.testing.assert_allclose(
        model.body_ipos[1], library.center_of_mass[i], atol=tolerance * library.s[i]
    )
    np.testing.assert_allclose(
        model.body_inertia[1], library.principal_inertia[i], rtol=2 * tolerance
    )
    axes = data.ximat[1].reshape(3, 3)
    yaw = Rotation.from_quat(library.quaternion[i], scalar_first=True).as_matrix()
    np.testing.assert_allclose(
        axes @ np.diag(model.body_inertia[1]) @ axes.T,
        yaw @ library.inertia[i] @ yaw.T,
        atol=2 * tolerance * library.inertia[i].max(),
    )


@pytest.mark.parametrize("name", CLASS_NAMES)
def test_principal_axes_give_the_inertia_back(name: str) -> None:
    library, i = shape_library(), ids_of(name)[0]
    axes = Rotation.from_quat(library.principal_quaternion[i], scalar_first=True).as_matrix()
    values = library.principal_inertia[i]
    assert list(values) == sorted(values, reverse=True)
    np.testing.assert_allclose(
        axes @ np.diag(values) @ axes.T, library.inertia[i], atol=1e-12 * values.max()
    )
    assert np.linalg.norm(library.principal_quaternion[i]) == pytest.approx(1.0)


def test_drop_heights_of_the_spec() -> None:
    """Reference figure 5: cylinders 799 at rest, then a cube and a sphere."""
    library = shape_library()
    top = -0.5 + library.s[799] + library.bounding_radius[799]
    for shape_id, height in ((690, 0.819), (735, 0.658)):
        z = top + library.bounding_radius[shape_id] - 0.1 * library.s[shape_id]
        assert z == pytest.approx(height, abs=6e-4)


def test_universe() -> None:
    library, universe = shape_library(), shape_universe()
    assert universe.class_names[universe.class_labels[500]] == "arch"
    assert np.array_equal(universe.primary_parameter, library.s)
    assert universe.action_names[690] == shape_name(690) == "cube 0.302 m, 0 deg"
    assert universe.action_names[64] == "hat 0.080 m, 72 deg"
    assert universe.content.shape == (810, 6)
    assert len(set(universe.action_hashes)) == 810
    # Without its colour a cone is the cone-hires of the same scale.
    np.testing.assert_array_equal(universe.content[360:390, 1:3], universe.content[390:420, 1:3])


def test_engineered_21() -> None:
    gt21 = shape_universe().engineered["gt21"]
    assert gt21.shape == (810, 21)
    assert gt21.dtype == np.float32
    # Triangle 177: the largest scale, 7 of 10 steps of a full turn; third class.
    expected = [0.4, 0, 0, 1, 1.4 * PI, 0, 0, 1, *[0] * 13]
    np.testing.assert_allclose(gt21[177], expected, rtol=1e-6)
    assert np.array_equal(gt21[:, 5:].argmax(axis=1), shape_library().class_labels)
    assert np.array_equal(gt21[:, 5:].sum(axis=1), np.ones(810))


def test_library_is_shared_and_read_only() -> None:
    assert shape_library() is shape_library()
    with pytest.raises(ValueError, match="read-only"):
        shape_library().s[0] = 1.0


@pytest.mark.parametrize("shape_id", [-1, 810])
def test_names_of_shapes_that_do_not_exist(shape_id: int) -> None:
    with pytest.raises(ValueError, match=rf"shape_id={shape_id} .* 0\.\.809"):
        shape_name(shape_id)
