"""The paper's numbers: bars and learning curves, read from the released results (`paper/*.csv`)."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

FOLDER = Path(__file__).parents[1] / "paper"

# Environment steps of a training run.
_BUDGETS = {
    "Grid World": 40e6,
    "Recommender": 40e6,
    "Recommender (fully observable)": 80e6,
    "Shape Stacking": 3e6,
}
_CREATE_BUDGET = 60e6

# (our method, our representation) -> the paper's method. Both names of a default modality count.
_METHODS = {
    ("ours", "hvae"): "ours",
    ("ours", "hvae-xy"): "ours",
    ("ours", "hvae-onehot"): "ours_onehot",
    ("ours", "hvae-state"): "ours",
    ("ours", "hvae-video"): "ours_video",
    ("ours", "hvae-image"): "ours",
    ("ours", "gt12"): "ours_engineered",
    ("ours", "gt21"): "ours_engineered",
    ("ours", "gt32"): "ours_engineered",
    ("ours", "vae"): "vae",
    ("ours", "vae-xy"): "vae",
    ("ours", "vae-state"): "vae",
    ("ours", "vae-image"): "vae",
    ("ours", "product"): "ours",
    ("ours", "product-mu"): "ours",
    ("ours", "hvae-oracle"): "ours_oracle_hvae",
}
# Baselines and ablations of the policy, on the default representation of a domain.
_BASELINES = {
    "no-entropy": "ours_no_entropy",
    "no-subsampling": "ours_no_subsampling",
    "continuous": "continuous_output",
    "nearest-neighbour": "nearest_neighbor",
}
_DEFAULT_REPRESENTATIONS = ("hvae", "hvae-xy", "hvae-state", "hvae-image", "product", "product-mu")

# Where a representation makes the paper's results those of an environment of its own.
_ENVIRONMENTS = {("Recommender", "product-mu"): "Recommender (fully observable)"}
# Figure of a split that is not the domain's default, and what it appends to the names of methods.
_SPLIT_FIGURES = {"full": ("fig7a_create_full_split", "")}
_SPLIT_FIGURES_OF = {("Shape Stacking", "full"): ("fig23_stacking_variants", "full_split")}
# Methods whose train curves come from another simulator (docs/shape_stacking.md, "Against the paper
# and its release").
_OTHER_SIMULATOR = {"Shape Stacking": ("nearest_neighbor", "ours_no_subsampling")}
# Actions in the sets of a bar, where they are not as many as in training.
_SET_SIZES = {("Recommender (fully observable)", "test"): 25}


class PaperError(ValueError):
    """The paper has no such environment, method, split or figure."""


@dataclass(frozen=True)
class PaperResult:
    """One bar of the paper, or one point of an analysis.

    Attributes:
      figure: e.g. `fig4_baselines`.
      environment: e.g. `Grid World`.
      method: e.g. `ours`, `vae`.
      split: `train` or `test` actions.
      metric: success_rate (a share in [0, 1]), ctr or final_height.
      mean, std: over seeds; std is the population's.
      num_seeds: seeds behind it.
      source: the released file, or a remark.
    """

    figure: str
    environment: str
    method: str
    split: str
    metric: str
    mean: float
    std: float
    num_seeds: int
    source: str


class PaperValue(NamedTuple):
    """Mean and population standard deviation over the paper's seeds."""

    mean: float
    std: float
    num_seeds: int


class PaperCurve(NamedTuple):
    """A learning curve: true environment steps f64[n], mean f64[n] and half-band f64[n]."""

    steps: np.ndarray
    mean: np.ndarray
    std: np.ndarray


def paper_method(method: str, representation: str, variant: str = "") -> str | None:
    """What the paper calls our method on our representation; None if it did not run it.

    Args:
      method: ours, such as `no-entropy`.
      representation: ours, such as `hvae`.
      variant: of the domain or of the policy, see `Presentation.paper_variant`.
    """
    if method in _BASELINES and representation in _DEFAULT_REPRESENTATIONS:
        name: str | None = _BASELINES[method]
    else:
        name = _METHODS.get((method, representation))
    if name is None or not variant:
        return name
    name = f"{name}_{variant}"
    return name if any(row.method == name for row in _results()) else None


def paper_figure_of_split(environment: str | None, split: str) -> tuple[str, str] | None:
    """Where the paper reports on a split which is not the default; None if it does not.

    Args:
      environment: the paper's name of the domain, or None.
      split: ours, such as `full`.

    Returns:
      The figure, and what it appends to the names of methods.
    """
    return _SPLIT_FIGURES_OF.get((str(environment), split), _SPLIT_FIGURES.get(split))


def paper_environment(environment: str | None, representation: str) -> str | None:
    """Where the paper reports on a domain with a representation; None if it does not.

    Args:
      environment: the paper's name of the domain, or None.
      representation: ours, such as `product-mu`.
    """
    found = _ENVIRONMENTS.get((str(environment), representation), environment)
    return found if found in paper_environments() else None


def paper_set_size(environment: str | None, split: str, trained: int) -> int:
    """Actions in the sets of a bar of the paper, for a policy trained with sets of `trained`."""
    return _SET_SIZES.get((str(environment), split), trained)


def paper_environments() -> list[str]:
    """Every environment that the paper reports on."""
    return list(dict.fromkeys(row.environment for row in _results()))


def paper_results(environment: str) -> list[PaperResult]:
    """All results in an environment, in the order of the figures.

    Raises:
      PaperError: the paper has no such environment.
    """
    _check("environment", environment, paper_environments())
    return [row for row in _results() if row.environment == environment]


def paper_value(
    environment: str, method: str, split: str, figure: str | None = None
) -> PaperValue | None:
    """One bar of the paper; None if it has none for the method, the split and the figure.

    Args:
      environment: as in `paper_environments`.
      method: the paper's name, see `paper_method`.
      split: `train` or `test` actions; no figure has bars of `validation`.
      figure: where more than one figure has a bar of that name; default: the first of them.

    Raises:
      PaperError: a name that stands nowhere in the paper.
    """
    rows = paper_results(environment)
    _check("method", method, dict.fromkeys(row.method for row in _results()))
    _check("split", split, _splits())
    if figure is not None:
        _check("figure", figure, dict.fromkeys(row.figure for row in _results()))
    for row in rows:
        if (row.method, row.split) == (method, split) and figure in (None, row.figure):
            return PaperValue(row.mean, row.std, row.num_seeds)
    return None


def paper_steps(environment: str) -> float:
    """Environment steps of the paper's training runs.

    Raises:
      PaperError: the paper has no such environment.
    """
    _check("environment", environment, paper_environments())
    return _BUDGETS.get(environment, _CREATE_BUDGET)


def paper_curve(environment: str, method: str, split: str) -> PaperCurve | None:
    """A learning curve up to the training budget; None if the paper shows none.

    Every seed's curve is held at its maximum after it reached it, as the paper drew them, so that
    its end is the mean of the seeds' best evaluations. What the released figures
    draw past the budget is padding and left out.

    Args:
      environment: as in `paper_environments`.
      method: the paper's name, see `paper_method`.
      split: sets of `train` or `validation` actions.

    Raises:
      PaperError: a name that stands nowhere in the paper.
    """
    _check("environment", environment, paper_environments())
    methods = [row.method for row in _results()] + [key[1] for key in _curves()]
    _check("method", method, dict.fromkeys(methods))
    _check("split", split, _splits())
    curve = _curves().get((environment, method, split))
    if curve is None:
        return None
    is_within = curve.steps <= paper_steps(environment)
    return PaperCurve(*(values[is_within] for values in curve))


def is_comparable(environment: str | None, method: str | None, split: str) -> bool:
    """Whether what the paper shows on a part of the split was made by the environment itself."""
    return split != "train" or method not in _OTHER_SIMULATOR.get(environment or "", ())


def _splits() -> list[str]:
    names = [row.split for row in _results()] + [key[2] for key in _curves()]
    return list(dict.fromkeys(names))


def _check(what: str, name: str, known: list[str] | dict[str, None]) -> None:
    if name not in known:
        raise PaperError(f"The paper has no {what} {name!r}; there are: {', '.join(known)}.")


@lru_cache(maxsize=1)
def _results() -> list[PaperResult]:
    return [
        PaperResult(
            figure=row["figure"],
            environment=row["environment"],
            method=row["method"],
            split=row["split"],
            metric=row["metric"],
            mean=float(row["mean"]),
            std=float(row["std"]),
            num_seeds=int(row["n_seeds"]),
            source=row["source_note"],
        )
        for row in _rows("results.csv")
    ]


@lru_cache(maxsize=1)
def _curves() -> dict[tuple[str, str, str], PaperCurve]:
    points: dict[tuple[str, str, str], list[tuple[float, float, float]]] = {}
    for row in _rows("learning_curves.csv"):
        key = row["environment"], row["method"], row["split"]
        steps = 1e6 * float(row["true_steps_million"])
        points.setdefault(key, []).append((steps, float(row["mean"]), float(row["std"])))
    return {key: PaperCurve(*np.array(sorted(rows)).T) for key, rows in points.items()}


def _rows(name: str) -> list[dict[str, str]]:
    with (FOLDER / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
