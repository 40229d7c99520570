"""The 10,000 published products, bit for bit. NumPy only."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from jaxnew.actions import ActionUniverse

NUM_PRODUCTS = 10_000
VECTOR_SIZE = 16
_SEED = 123
_CONSTANT_DEVIATION = 3.0


def product_vectors() -> np.ndarray:
    """f32[10000, 16] unit-length product vectors (beta; the paper's `c`)."""
    return _draw()[0].copy()


def product_constants() -> np.ndarray:
    """f32[10000] product constants (mu), hidden from the agent unless its table shows them."""
    return _draw()[1].copy()


@lru_cache(maxsize=1)
def product_universe() -> ActionUniverse:
    """All products as an action universe.

    There is one class; the primary parameter is the product constant. The content is the vector and
    the constant, f32[10000, 17]. Engineered vectors:

    * `product` f32[10000, 16]: the product vector, which the paper's agents see;
    * `product-mu` f32[10000, 17]: the product constant appended, unscaled (fully observable).
    """
    vectors, constants = _draw()
    with_constants = np.concatenate([vectors, constants[:, None]], axis=1)
    return ActionUniverse(
        name="Recommender-v0",
        class_labels=np.zeros(NUM_PRODUCTS, np.int32),
        class_names=("product",),
        primary_parameter=constants.astype(np.float64),
        action_names=tuple(f"product {i}" for i in range(NUM_PRODUCTS)),
        content=with_constants,
        engineered={"product": vectors.copy(), "product-mu": with_constants.copy()},
    )


@lru_cache(maxsize=1)
def _draw() -> tuple[np.ndarray, np.ndarray]:
    """Vectors and constants, in the published order of draws."""
    rng = np.random.RandomState(_SEED)
    raw = rng.normal(size=(NUM_PRODUCTS, VECTOR_SIZE))
    constants = rng.normal(0.0, _CONSTANT_DEVIATION, size=NUM_PRODUCTS)
    vectors = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    return vectors.astype(np.float32), constants.astype(np.float32)
