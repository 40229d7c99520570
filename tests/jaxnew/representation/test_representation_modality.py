"""How the encoder reads recordings, and what it refuses to read."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.representation.modality import Modality, one_hot_modality, vector_modality


@pytest.mark.unit
def test_one_hot_features_are_blocks_per_coordinate():
    modality = one_hot_modality("onehot", 2, 5)
    features = modality.featurize(jnp.array([[1, 4], [0, 2]], jnp.uint8))
    assert features.dtype == jnp.float32
    expected = np.concatenate([np.eye(5)[[1, 0]], np.eye(5)[[4, 2]]], axis=1)
    np.testing.assert_array_equal(features, expected)
    assert modality.feature_dim == 10
    assert modality.gaussian_dim == 0
    assert vector_modality("xy", 2).gaussian_dim == 2


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"likelihood": "poisson"}, "unknown likelihood"),
        ({"feature_dim": 0}, "feature_dim=0"),
        ({"num_categories": 2}, "does not fit"),
        ({"likelihood": "categorical"}, "does not fit"),
        ({"likelihood": "categorical", "num_categories": 3}, "not a multiple"),
    ],
)
def test_bad_modalities_are_refused(changes, message):
    good = {
        "name": "xy",
        "feature_dim": 2,
        "likelihood": "gaussian",
        "num_categories": 0,
        "featurize": lambda x: x,
    }
    with pytest.raises(ValueError, match=message):
        Modality(**{**good, **changes})
