"""The published splits of shapes (docs/shape_stacking.md, "Splits")."""

from __future__ import annotations

import numpy as np
import pytest

from envs_mjx.shape_stacking import shape_library, shape_universe
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from envs_mjx.shape_stacking.splits import published_split

pytestmark = pytest.mark.golden

TRAIN_SCALES = """
middle_triangle 2 4 5; hat 3 4 5; triangle 0 3 5; tall_triangle 0 1 5;
horizontal_rectangle 0 1 4; dome 0 3 4; cone-hires 2 4 8 9 11 12 15 16 17 20 22 23 25 26 28;
cone 0 3 4 5 7 8 15 17 18 19 21 24 26 27 28; tetrahedron 0 3 6 7 8; arch 1 4 5;
rectangle 1 4 5 8 9; half_rectangle 0 1 3 4 8; cube 0 2 3 6 9;
sphere 0 1 2 3 6 8 11 12 15 16 20 22 24 27 29; capsule 0 1 4 5 6 7 8 9 10 12 14 16 20 27 28;
cylinder 1 2 5 7 8 11 14 15 19 20 22 23 25 27 28
"""
HELD_OUT_CLASSES = {
    "hat",
    "cylinder",
    "tetrahedron",
    "horizontal_rectangle",
    "middle_triangle",
    "cube",
    "cone",
    "cone-hires",
}


@pytest.mark.parametrize(
    ("name", "sizes"), [("default", (405, 202, 203)), ("full", (420, 195, 195))]
)
def test_sizes_and_disjointness(name: str, sizes: tuple[int, int, int]) -> None:
    split = published_split(name)
    assert (len(split.train), len(split.validation), len(split.test)) == sizes
    split.check(shape_universe())
    assert np.array_equal(split.ids("all"), np.arange(810))
    assert split.always_available.size == 0


def test_default_trains_the_published_scales_at_every_angle() -> None:
    library, split = shape_library(), published_split()
    rows = [row.split() for row in TRAIN_SCALES.split(";")]
    assert len(rows) == 16
    for name, *indices in rows:
        of_class = library.class_labels == CLASS_NAMES.index(name)
        is_trained = np.isin(library.scale_index, [int(index) for index in indices])
        expected = np.flatnonzero(of_class & is_trained)
        assert np.array_equal(split.train[of_class[split.train]], expected)


def test_full_parts_by_class() -> None:
    labels, split = shape_library().class_labels, published_split("full")
    held_out = np.concatenate([split.validation, split.test])
    assert {CLASS_NAMES[label] for label in labels[held_out]} == HELD_OUT_CLASSES
    assert {CLASS_NAMES[label] for label in labels[split.train]} == set(
        CLASS_NAMES
    ) - HELD_OUT_CLASSES


@pytest.mark.parametrize("name", ["default", "full"])
def test_validation_is_the_first_half_of_the_shuffled_rest(name: str) -> None:
    """`RandomState(41)`, the first floor(n / 2) are for validation."""
    split = published_split(name)
    held_out = sorted({*range(810)} - {*split.train.tolist()})
    order = np.random.RandomState(41).permutation(len(held_out))
    expected = sorted(held_out[k] for k in order[: len(held_out) // 2])
    assert split.validation.tolist() == expected


def test_twins_among_the_cones() -> None:
    """`cone` and `cone-hires` are one solid: 18 of 30 scales train one and hold out the other."""
    is_train = np.isin(np.arange(810), published_split().train)
    assert (is_train[360:390] != is_train[390:420]).sum() == 18


def test_unknown_split() -> None:
    with pytest.raises(ValueError, match=r"split='half' is not published.*'default', 'full'"):
        published_split("half")
