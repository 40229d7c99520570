"""The padded collision hulls (docs/shape_stacking.md, "Solids", "Engines")."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from envs_mjx.shape_stacking.hulls import hull_table
from envs_mjx.shape_stacking.shapes import shape_library
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from tests.envs_mjx.shape_stacking.shape_solids import SOLIDS

pytestmark = pytest.mark.golden

BOX, WEDGE, PYRAMID, CONE, DOME, CYLINDER = (
    (8, 6, 12),
    (6, 5, 9),
    (5, 5, 8),
    (13, 13, 24),
    (18, 11, 27),
    (24, 14, 36),
)
# Vertices, faces, edges; volume.
HULLS = {
    "middle_triangle": (WEDGE, 4),
    "hat": (WEDGE, 4),
    "triangle": (WEDGE, 4),
    "tall_triangle": (WEDGE, 8),
    "horizontal_rectangle": (BOX, 16),
    # A fan of 8 triangles of 22.5 degrees, 2 deep: 8 sin(22.5 deg).
    "dome": (DOME, 8 * np.sin(np.pi / 8)),
    # Equal area, so equal volume.
    "cone-hires": (CONE, 2 * np.pi / 3),
    "cone": (CONE, 2 * np.pi / 3),
    "tetrahedron": (PYRAMID, 8 / 3),
    "arch": (BOX, 16),
    "rectangle": (BOX, 16),
    "half_rectangle": (BOX, 8),
    "cube": (BOX, 8),
    "cylinder": (CYLINDER, 2 * np.pi),
}
ROUND = ("dome", "cone-hires", "cone", "cylinder", "arch")
LABELS = [CLASS_NAMES.index(name) for name in HULLS]


def test_which_classes_have_hulls() -> None:
    table = hull_table()
    assert {CLASS_NAMES[i] for i in np.flatnonzero(table.has_hull)} == set(HULLS)
    cube = CLASS_NAMES.index("cube")
    for name in ("sphere", "capsule"):
        label = CLASS_NAMES.index(name)
        np.testing.assert_array_equal(table.vertices[label], table.vertices[cube])
        assert table.num_vertices[label] == 8


def test_format() -> None:
    table = hull_table()
    assert table.vertices.shape == (16, 24, 3)
    assert table.faces.shape == (16, 14, 12)
    assert table.face_normals.shape == (16, 14, 3)
    assert table.edges.shape == (16, 36, 2)
    assert table.edge_normals.shape == (16, 36, 2, 3)
    np.testing.assert_array_equal(
        table.face_vertices[3, 2, 1], table.vertices[3, table.faces[3, 2, 1]]
    )


@pytest.mark.parametrize(("name", "label"), list(zip(HULLS, LABELS, strict=True)), ids=list(HULLS))
def test_hull_is_convex_and_as_large_as_the_spec_says(name: str, label: int) -> None:
    table = hull_table()
    counts, volume = HULLS[name]
    sizes = (table.num_vertices, table.num_faces, table.num_edges)
    assert tuple(size[label] for size in sizes) == counts
    vertices = table.vertices[label, : counts[0]]
    hull = ConvexHull(vertices)
    assert len(hull.vertices) == counts[0]
    assert hull.volume == pytest.approx(volume, rel=1e-12)
    for face, normal in zip(table.faces[label], table.face_normals[label], strict=True):
        depths = (vertices - vertices[face[0]]) @ normal
        # No vertex is outside a face, exactly its corners are on it, the origin is inside.
        assert depths.max() < 1e-12
        assert set(np.flatnonzero(depths > -1e-12)) == set(face)
        assert -vertices[face[0]] @ normal < -0.05


@pytest.mark.parametrize("name", [name for name in HULLS if name not in ROUND])
def test_flat_hulls_are_the_solids_of_the_spec(name: str) -> None:
    """Every corner is on the solid's surface; as the volume is right, it is the same solid."""
    table, label = hull_table(), CLASS_NAMES.index(name)
    corners = table.vertices[label, : table.num_vertices[label]] + table.centers[label]
    np.testing.assert_allclose(SOLIDS[name][1](*corners.T), 0.0, atol=1e-12)


@pytest.mark.parametrize("label", LABELS, ids=list(HULLS))
def test_faces_turn_counter_clockwise_around_their_normals(label: int) -> None:
    table = hull_table()
    for corners, normal in zip(table.face_vertices[label], table.face_normals[label], strict=True):
        sides = np.roll(corners, -1, axis=0) - corners
        sides = sides[np.linalg.norm(sides, axis=1) > 0]
        turns = np.cross(sides, np.roll(sides, -1, axis=0))
        assert (turns @ normal > 0.01).all()
        assert np.linalg.norm(normal) == pytest.approx(1.0)


@pytest.mark.parametrize("label", LABELS, ids=list(HULLS))
def test_edges_join_two_faces(label: int) -> None:
    table = hull_table()
    num_faces, num_edges = table.num_faces[label], table.num_edges[label]
    edges = [tuple(edge) for edge in table.edges[label, :num_edges]]
    assert len(set(edges)) == num_edges
    assert all(start < end for start, end in edges)
    for edge, normals in zip(edges, table.edge_normals[label], strict=False):
        meeting = [f for f in range(num_faces) if set(edge) <= set(table.faces[label, f])]
        expected = table.face_normals[label, meeting]
        np.testing.assert_array_equal(np.sort(normals, axis=0), np.sort(expected, axis=0))


@pytest.mark.parametrize("label", range(16), ids=CLASS_NAMES)
def test_padding(label: int) -> None:
    table = hull_table()
    assert not table.vertices[label, table.num_vertices[label] :].any()
    for rows, count in (
        (table.faces[label], table.num_faces[label]),
        (table.face_normals[label], table.num_faces[label]),
        (table.edges[label], table.num_edges[label]),
        (table.edge_normals[label], table.num_edges[label]),
    ):
        assert (rows[count:] == rows[0]).all()
    for face in table.faces[label]:
        corners = len(set(face))
        assert (face[corners:] == face[corners - 1]).all()
        assert (face < table.num_vertices[label]).all()


def test_hulls_stand_on_their_centers_of_mass() -> None:
    library = shape_library()
    for i in range(0, 810, 30):
        label, s = library.class_labels[i], library.s[i]
        if not library.hulls.has_hull[label]:
            continue
        placed = s * (library.hulls.vertices[label] + library.hulls.centers[label])
        placed = placed[: library.hulls.num_vertices[label]]
        assert placed[:, 2].min() == pytest.approx(library.base[i])
        assert placed[:, 2].max() == pytest.approx(library.top[i])
        np.testing.assert_allclose(s * library.hulls.centers[label], library.center_of_mass[i])


def test_radius_of_round_hulls_is_that_of_equal_area() -> None:
    """Factor 1.023 for the 12-gons of cylinder and cone; the dome's arc stays."""
    table = hull_table()
    for name in ("cylinder", "cone", "cone-hires"):
        widths = np.hypot(*table.vertices[CLASS_NAMES.index(name), :12, :2].T)
        np.testing.assert_allclose(widths, 1.023, atol=5e-4)
    dome = CLASS_NAMES.index("dome")
    arc = table.vertices[dome, :18] + table.centers[dome] - (0, 0, -0.5)
    np.testing.assert_allclose(np.hypot(arc[:, 0], arc[:, 2]), 1.0)
