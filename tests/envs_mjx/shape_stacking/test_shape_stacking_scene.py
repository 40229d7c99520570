"""The compiled models: options of the world, bodies and geoms of the library."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from envs_mjx.shape_stacking import scene, shape_library
from envs_mjx.shape_stacking.engines.mujoco_pool import (
    GEOM_KINDS,
    Worlds,
    catalogue_model,
    pool_model,
    world_model,
)
from envs_mjx.shape_stacking.solids import CLASS_NAMES, solids

# One of each class, in two worlds; ids below 0 are unused bodies.
IDS = np.array(
    [
        [799, 799, 9, 80, 130, 185, 290, 315, 370, 402, 425, 500],
        [-1, 545, 625, 690, 735, 764, -1, 809, 726, 0, 539, -1],
    ],
    np.int32,
)


@pytest.fixture(scope="module")
def catalogue() -> mujoco.MjModel:
    return catalogue_model()


@pytest.fixture(scope="module")
def worlds() -> Worlds:
    made = Worlds(4, 1, False)
    qpos = np.tile(scene.parked_qpos(), (2, 1, 1))
    # Other shapes first: nothing of theirs may stay.
    made.run(IDS[::-1].copy(), qpos, np.zeros((2, 12, 6)), 1)
    made.run(IDS, qpos, np.zeros((2, 12, 6)), 1)
    return made


@pytest.mark.golden
def test_options_are_those_of_the_spec() -> None:
    for model in (pool_model(), world_model(IDS[0]), catalogue_model()):
        option = model.opt
        assert option.timestep == 0.01
        assert option.gravity.tolist() == [0.0, 0.0, -9.81]
        assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
        assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
        assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        assert (option.iterations, option.tolerance, option.impratio) == (100, 1e-8, 1.0)
        assert option.enableflags == 0
        off = mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_MULTICCD
        assert option.disableflags == off
        assert (model.geom_condim == 6).all()
        assert (model.geom_friction == [2.0, 2.0, 0.25]).all()
        assert (model.geom_solref == [0.02, 1.0]).all()
        assert (model.geom_solimp == [0.9, 0.95, 0.001, 0.5, 2.0]).all()
        assert not model.geom_margin.any()
        assert not model.geom_gap.any()
        assert model.geom_pos[0].tolist() == [0.0, 0.0, -0.5]
        assert model.geom_type[0] == mujoco.mjtGeom.mjGEOM_PLANE


@pytest.mark.unit
def test_limits_of_the_solver_can_be_set() -> None:
    text = scene.scene_text([], solver=scene.Solver(iterations=6, ls_iterations=10, tolerance=1e-5))
    option = mujoco.MjModel.from_xml_string(text).opt
    assert (option.iterations, option.ls_iterations, option.tolerance) == (6, 10, 1e-5)


@pytest.mark.unit
def test_forms_are_the_classes_and_scales() -> None:
    forms, form_of = scene.forms()
    library = shape_library()
    assert len(forms) == 232  # 7 classes of 6 scales, 4 of 10, 5 of 30.
    assert len({form.name for form in forms}) == 232
    for field, values in (("class_label", library.class_labels), ("s", library.s)):
        found = np.array([getattr(form, field) for form in forms])[form_of]
        np.testing.assert_array_equal(found, values)


@pytest.mark.unit
def test_a_primitive_has_no_mesh() -> None:
    forms, form_of = scene.forms()
    with pytest.raises(ValueError, match="sphere-3 is a sphere, not a mesh"):
        scene.hull_text(forms[form_of[723]])


@pytest.mark.oracle
def test_every_body_has_the_mass_and_inertia_of_the_library(catalogue: mujoco.MjModel) -> None:
    forms, _ = scene.forms()
    library, ids = shape_library(), np.array([form.shape_id for form in scene.forms()[0]])
    exact = {"rtol": 1e-12, "atol": 1e-12}
    np.testing.assert_allclose(catalogue.body_mass[1:], library.mass[ids], **exact)
    np.testing.assert_allclose(catalogue.body_ipos[1:], library.center_of_mass[ids], **exact)
    inertias = library.principal_inertia[ids]
    np.testing.assert_allclose(catalogue.body_inertia[1:], inertias, **exact)
    axes = np.zeros((len(forms), 9))
    for row, quaternion in zip(axes, catalogue.body_iquat[1:], strict=True):
        mujoco.mju_quat2Mat(row, quaternion)
    axes = axes.reshape(-1, 3, 3)
    full = np.einsum("nij,nj,nkj->nik", axes, catalogue.body_inertia[1:], axes)
    np.testing.assert_allclose(full, library.inertia[ids], rtol=1e-9, atol=1e-9)
    # What makes contacts soft.
    softness = np.stack([1.0 / library.mass[ids], (1.0 / inertias).mean(axis=1)], axis=1)
    np.testing.assert_allclose(catalogue.body_invweight0[1:], softness, rtol=1e-9)


@pytest.mark.oracle
def test_every_geom_is_the_solid_of_its_class(catalogue: mujoco.MjModel) -> None:
    """Corners in the body's axes: those of the library's hull, or the primitive's size."""
    forms, _ = scene.forms()
    library = shape_library()
    for geom, form in enumerate(forms, start=1):
        name = CLASS_NAMES[form.class_label]
        kind = mujoco.mjtGeom(catalogue.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        assert kind == (name if name in ("sphere", "capsule", "cylinder") else "mesh")
        if kind == "mesh":
            corners = mesh_corners(catalogue, geom)
            expected = form.s * solids()[form.class_label].hull.vertices
            distances = np.linalg.norm(corners[:, None] - expected, axis=-1)
            assert len(corners) == len(expected)
            assert distances.min(axis=1).max() < 1e-6  # Meshes are float32.
            assert distances.min(axis=0).max() < 1e-6
            # Contacts of several points need the polygons, and those the hull.
            assert catalogue.mesh_graphadr[catalogue.geom_dataid[geom]] >= 0
        else:
            expected_size = [form.s, 0.0 if kind == "sphere" else form.s, 0.0]
            np.testing.assert_allclose(catalogue.geom_size[geom], expected_size)
            assert not catalogue.geom_pos[geom].any()
        # The drop rule's radius is that of the original meshes, which are a little rounder. Of
        # bodies with equal inertias the engine may turn the axes, and the radius with them.
        ratio = catalogue.geom_rbound[geom] / library.bounding_radius[form.shape_id]
        is_ambiguous = name in ("cube", "tetrahedron", "rectangle")
        low, high = (0.85, 1.7) if is_ambiguous else (0.97, 1.03)
        assert low < ratio < high


def mesh_corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    return corners @ turn.reshape(3, 3).T + model.geom_pos[geom]


@pytest.mark.unit
def test_all_hulls_of_the_pool_are_compiled_as_hulls() -> None:
    """A mesh that no geom holds is easily left without its hull, and stands on one point then."""
    pool, catalogue = pool_model(), catalogue_model()
    assert (pool.mesh_graphadr >= 0).all()
    for field in ("mesh_graphadr", "mesh_polynum", "mesh_vertnum", "mesh_vert", "mesh_graph"):
        np.testing.assert_array_equal(getattr(pool, field), getattr(catalogue, field))


@pytest.mark.oracle
def test_worlds_of_the_pool_are_the_catalogue(worlds: Worlds, catalogue: mujoco.MjModel) -> None:
    """Every body of every world: mass and so on, and just one geom that collides, the right one."""
    _, form_of = scene.forms()
    for index, ids in enumerate(IDS):
        model = worlds.model(index)
        for slot, i in enumerate(ids):
            body, geoms = 1 + slot, 1 + 4 * slot + np.arange(4)
            bits = np.stack([model.geom_contype[geoms], model.geom_conaffinity[geoms]])
            if i < 0:
                assert not bits.any()
                continue
            form = form_of[i]
            kind = scene.forms()[0][form].kind
            expected = (np.array(GEOM_KINDS) == kind).astype(int)
            np.testing.assert_array_equal(bits, [expected, expected])
            geom = geoms[GEOM_KINDS.index(kind)]
            for field in vars_of("body_", model):
                np.testing.assert_array_equal(
                    getattr(model, field)[body], getattr(catalogue, field)[1 + form], field
                )
            for field in vars_of("geom_", model):
                np.testing.assert_array_equal(
                    getattr(model, field)[geom], getattr(catalogue, field)[1 + form], field
                )
            dofs = slice(6 * slot, 6 * slot + 6)
            of_form = slice(6 * form, 6 * form + 6)
            np.testing.assert_array_equal(
                model.dof_invweight0[dofs], catalogue.dof_invweight0[of_form]
            )


# Places in lists, names, and shortcuts for centred bodies, which the pool does not take.
STRUCTURE = ("adr", "id", "num", "simple", "sameframe", "user", "plugin")


def vars_of(prefix: str, model: mujoco.MjModel) -> list[str]:
    """Physical fields of bodies or geoms, but for the place where they were compiled."""
    names = [n for n in dir(model) if n.startswith(prefix) and not n.endswith(STRUCTURE)]
    names = [n for n in names if isinstance(getattr(model, n), np.ndarray)]
    found = [n for n in names if n not in ("body_pos", "body_quat")]
    assert len(found) > 5
    return [*found, "geom_dataid"] if prefix == "geom_" else found


@pytest.mark.unit
def test_parking_is_high_and_apart() -> None:
    places = scene.parked_qpos()
    np.testing.assert_array_equal(places[:, 0], 20.0 + 3.0 * np.arange(12))
    np.testing.assert_array_equal(places[:, 1:], np.tile([0.0, 100.0, 1, 0, 0, 0], (12, 1)))
    np.testing.assert_array_equal(pool_model().qpos0.reshape(12, 7), places)
