"""Recommender: 10,000 products for users whose taste drifts (docs/recommender.md)."""

from envs_mjx.recommender.environment import (
    Recommender,
    RecommenderParams,
    RecommenderSettings,
    RecommenderState,
)
from envs_mjx.recommender.products import product_constants, product_universe, product_vectors

__all__ = [
    "Recommender",
    "RecommenderParams",
    "RecommenderSettings",
    "RecommenderState",
    "product_constants",
    "product_universe",
    "product_vectors",
]
