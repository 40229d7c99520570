"""How good a table is before any policy is trained.

`docs/method.md`, "Representation table and its report", has the numbers of the released tables.
scikit-learn takes seconds to import, so it is imported where it is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

NUM_NEIGHBOURS = 5
ACTIVE_STD = 0.1


def nearest_neighbours(vectors: np.ndarray, num_neighbours: int = NUM_NEIGHBOURS) -> np.ndarray:
    """Rows of the nearest other rows, Euclidean, by scikit-learn.

    Args:
      vectors: f[A, d], A > `num_neighbours`.
      num_neighbours: k.
    Returns:
      int[A, k], nearest first.

    Raises:
      ValueError: there are too few rows.
    """
    if len(vectors) <= num_neighbours:
        raise ValueError(
            f"{num_neighbours} nearest neighbours need more than {num_neighbours} actions; got "
            f"{len(vectors)}."
        )
    from sklearn.neighbors import NearestNeighbors

    # A tree chooses otherwise among equal distances, which tables of whole numbers have.
    model = NearestNeighbors(n_neighbors=num_neighbours, algorithm="brute")
    found: np.ndarray = model.fit(vectors.astype(np.float64)).kneighbors(return_distance=False)
    return found


def neighbour_purity(
    vectors: np.ndarray,
    labels: np.ndarray,
    subset: Sequence[int] | np.ndarray | None = None,
    num_neighbours: int = NUM_NEIGHBOURS,
) -> float:
    """Share of the nearest neighbours that have the label of their query.

    Args:
      vectors: f[A, d].
      labels: int[A].
      subset: rows that serve as queries and as candidates; None for all.
      num_neighbours: k; a query is not its own neighbour.

    Raises:
      ValueError: there are too few rows.
    """
    if subset is not None:
        vectors, labels = vectors[np.asarray(subset)], labels[np.asarray(subset)]
    neighbours = nearest_neighbours(vectors, num_neighbours)
    return float(np.mean(labels[neighbours] == labels[:, None]))


def neighbour_r2(
    vectors: np.ndarray,
    targets: np.ndarray,
    held_out: Sequence[int] | np.ndarray,
    num_neighbours: int = NUM_NEIGHBOURS,
) -> float:
    """How much of the facts about held-out actions their nearest train actions tell.

    A held-out action's facts are predicted as the mean of those of its nearest neighbours among the
    other actions: `1 - squared error / squared deviation from the held-out mean`, of all facts.

    Args:
      vectors: f[A, d].
      targets: f[A, ...] facts, all in one unit.
      held_out: rows that are predicted, from the rest.
      num_neighbours: k.
    Returns:
      At most 1; about -1/k where neighbours tell nothing, NaN where all held-out facts are equal.

    Raises:
      ValueError: fewer than k rows are not held out.
    """
    from sklearn.neighbors import KNeighborsRegressor

    held_out = np.unique(np.asarray(held_out, int))
    others = np.setdiff1d(np.arange(len(vectors)), held_out)
    if len(others) < num_neighbours:
        raise ValueError(
            f"{num_neighbours} nearest neighbours need as many actions that are not held out; got "
            f"{len(others)}."
        )
    facts = np.asarray(targets, np.float64).reshape(len(vectors), -1)
    model = KNeighborsRegressor(num_neighbours, algorithm="brute")
    model.fit(np.asarray(vectors[others], np.float64), facts[others])
    error = facts[held_out] - model.predict(np.asarray(vectors[held_out], np.float64))
    deviation = facts[held_out] - facts[held_out].mean(axis=0)
    total = float(np.sum(deviation**2))
    return 1.0 - float(np.sum(error**2)) / total if total > 0.0 else float("nan")


def linear_r2(vectors: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """In-sample R2 of ordinary least squares with intercept, per target column.

    Args:
      vectors: f[A, d].
      targets: f[A, ...], at least one column; flattened to [A, k].
    Returns:
      f64[k]; NaN for a constant column, which has no variance to explain.
    """
    from sklearn.linear_model import LinearRegression
    from sklearn.metrics import r2_score

    vectors = np.asarray(vectors, np.float64)
    targets = np.asarray(targets, np.float64).reshape(len(vectors), -1)
    predicted = LinearRegression().fit(vectors, targets).predict(vectors)
    r2 = r2_score(targets, predicted, multioutput="raw_values")
    return np.where(np.ptp(targets, axis=0) > 0, r2, np.nan)


def entry_statistics(vectors: np.ndarray) -> dict[str, float]:
    """Mean, std, min and max of all entries, and the number of dimensions with std > 0.1."""
    return {
        "mean": float(vectors.mean()),
        "std": float(vectors.std()),
        "min": float(vectors.min()),
        "max": float(vectors.max()),
        "active_dimensions": int(np.sum(vectors.std(axis=0) > ACTIVE_STD)),
        "dimensions": int(vectors.shape[1]),
    }


def describe(
    vectors: np.ndarray,
    labels: np.ndarray,
    held_out: Sequence[int] | np.ndarray,
    targets: Mapping[str, np.ndarray] | None = None,
) -> dict[str, Any]:
    """All numbers of one table, as plain JSON.

    Args:
      vectors: f32[A, d].
      labels: int[A].
      held_out: rows outside the train split, for the second purity: validation and test together.
      targets: by name f[A, ...], what a linear map of the representation should explain.
    """
    targets = targets or {}
    explained = {name: linear_r2(vectors, values) for name, values in targets.items()}
    told = {name: neighbour_r2(vectors, values, held_out) for name, values in targets.items()}
    return {
        "purity_all": neighbour_purity(vectors, labels),
        "purity_held_out": neighbour_purity(vectors, labels, held_out),
        "neighbour_r2": {name: _plain(value) for name, value in told.items()},
        "linear_r2": {name: _plain(values) for name, values in explained.items()},
        "linear_r2_mean": {name: _plain(values.mean()) for name, values in explained.items()},
        "entries": entry_statistics(vectors),
    }


def measures(numbers: Mapping[str, Any]) -> dict[str, float | None]:
    """What `describe` gave, by name: first what ordered policies best in pilots.

    None where a number is not defined.
    """
    found = {f"5-NN R2 to {fact}": r2 for fact, r2 in numbers["neighbour_r2"].items()}
    found |= {"5-NN purity": numbers["purity_all"], "of held-out": numbers["purity_held_out"]}
    return found | {f"linear R2 to {fact}": r2 for fact, r2 in numbers["linear_r2_mean"].items()}


def tsne(vectors: np.ndarray, seed: int) -> np.ndarray:
    """Two dimensions for a scatter plot: scikit-learn's t-SNE, perplexity 10.

    Args:
      vectors: f[A, d], A > 10. The released figures draw at most 400 actions.
      seed: of scikit-learn's generator.
    Returns:
      f32[A, 2].
    """
    from sklearn.manifold import TSNE

    return TSNE(n_components=2, perplexity=10, random_state=seed).fit_transform(vectors)


def _plain(values: np.ndarray | float) -> Any:
    """Floats for JSON, which has no NaN: None instead."""
    if np.ndim(values):
        return [_plain(value) for value in np.asarray(values)]
    return float(values) if np.isfinite(values) else None
