"""Acceptance numbers of a table, on tables with known answers."""

import json

import numpy as np
import pytest

from jaxnew.representation import report


def clusters(num_clusters, size, seed=0):
    """Points around far corners, and the corner of each."""
    labels = np.arange(num_clusters).repeat(size)
    noise = np.random.default_rng(seed).normal(size=(num_clusters * size, 3))
    return noise + 100.0 * labels[:, None], labels


@pytest.mark.unit
def test_purity_is_one_for_clusters_and_excludes_the_query():
    vectors, labels = clusters(3, 6)
    assert report.neighbour_purity(vectors, labels) == 1.0
    # Each point alone with its label: only the query itself could match.
    assert report.neighbour_purity(vectors, np.arange(18)) == 0.0


@pytest.mark.unit
def test_purity_of_a_line_by_hand():
    # 0 1 2 | 3 at 10: with 1 neighbour 0->1, 1->0 (tie with 2), 2->1, 3->2.
    vectors = np.array([[0.0], [1.0], [2.0], [10.0]])
    np.testing.assert_array_equal(report.nearest_neighbours(vectors, 1)[:, 0], [1, 0, 1, 2])
    assert report.neighbour_purity(vectors, np.array([0, 0, 1, 1]), num_neighbours=1) == 0.75


@pytest.mark.oracle
def test_neighbours_equal_a_loop():
    vectors = np.random.default_rng(1).normal(size=(30, 4))
    for row, neighbours in enumerate(report.nearest_neighbours(vectors)):
        distances = [np.linalg.norm(vectors[row] - other) for other in vectors]
        distances[row] = np.inf
        np.testing.assert_array_equal(neighbours, np.argsort(distances)[:5])


@pytest.mark.unit
def test_a_subset_serves_as_queries_and_as_candidates():
    vectors, labels = clusters(2, 12)
    labels = labels.copy()
    labels[::2] = 7  # The even rows carry another label, so they spoil the purity of all rows.
    assert report.neighbour_purity(vectors, labels) < 0.8
    assert report.neighbour_purity(vectors, labels, np.arange(1, 24, 2)) == 1.0
    with pytest.raises(ValueError, match="more than 5 actions; got 4"):
        report.neighbour_purity(vectors, labels, [0, 1, 2, 3])


@pytest.mark.unit
def test_linear_r2_is_one_for_affine_maps_and_low_for_noise():
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(400, 3)).astype(np.float32)
    affine = vectors @ rng.normal(size=(3, 2)) + 5.0
    targets = np.concatenate([affine, rng.normal(size=(400, 1)), np.ones((400, 1))], axis=1)
    r2 = report.linear_r2(vectors, targets)
    np.testing.assert_allclose(r2[:2], 1.0, atol=1e-5)
    assert 0.0 <= r2[2] < 0.05  # 3 of 400 degrees of freedom explain 0.75 % of noise on average.
    assert np.isnan(r2[3])
    assert report.linear_r2(vectors, affine.reshape(400, 1, 2)).shape == (2,)


@pytest.mark.oracle
def test_what_neighbours_tell_equals_a_loop():
    rng = np.random.default_rng(3)
    vectors, facts = rng.normal(size=(40, 3)), rng.normal(size=(40, 2)) * [1.0, 5.0]
    facts[:, 0] += 4 * vectors[:, 0]
    held_out = np.arange(0, 40, 3)
    others = np.setdiff1d(np.arange(40), held_out)
    error = 0.0
    for row in held_out:
        order = np.argsort([np.linalg.norm(vectors[row] - vectors[other]) for other in others])
        error += np.sum((facts[row] - facts[others[order[:5]]].mean(axis=0)) ** 2)
    total = len(held_out) * facts[held_out].var(axis=0).sum()
    found = report.neighbour_r2(vectors, facts[:, None], held_out)
    assert found == pytest.approx(1.0 - error / total)
    assert report.neighbour_r2(facts, facts, held_out) > 0.5 > found
    assert np.isnan(report.neighbour_r2(vectors, np.ones(40), held_out))
    with pytest.raises(ValueError, match="as many actions that are not held out; got 4"):
        report.neighbour_r2(vectors, facts, np.arange(36))


@pytest.mark.unit
def test_entry_statistics_count_active_dimensions():
    vectors = np.array([[0.0, 1.0, -1.0], [0.19, 1.0, 1.0]])
    statistics = report.entry_statistics(vectors)
    # Standard deviations 0.095, 0 and 1.
    assert statistics["active_dimensions"] == 1
    assert statistics["dimensions"] == 3
    assert statistics["min"] == -1.0
    assert statistics["max"] == 1.0
    assert statistics["mean"] == pytest.approx(2.19 / 6)


@pytest.mark.unit
def test_describe_is_plain_json():
    vectors, labels = clusters(2, 8)
    numbers = report.describe(
        vectors.astype(np.float32), labels, held_out=range(8, 16), targets={"x": labels[:, None]}
    )
    again = json.loads(json.dumps(numbers, allow_nan=False))
    assert again == numbers
    assert numbers["purity_all"] == numbers["purity_held_out"] == 1.0
    assert numbers["linear_r2"]["x"][0] == pytest.approx(1.0, abs=0.01)
    assert numbers["neighbour_r2"]["x"] is None  # All held-out labels are alike.
    constant = report.describe(vectors, labels, range(8), {"c": np.ones((16, 1))})
    assert constant["linear_r2"]["c"] == [None]


@pytest.mark.unit
def test_tsne_separates_clusters_and_repeats_with_its_seed():
    vectors, labels = clusters(2, 12)
    points = report.tsne(vectors, seed=3)
    assert points.shape == (24, 2)
    assert report.neighbour_purity(points, labels) == 1.0
    np.testing.assert_array_equal(points, report.tsne(vectors, seed=3))
