"""The paper's numbers: bars and learning curves, read from the released results (`paper/*.csv`)."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
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

# Our representation, without the name of a default modality -> the paper's method.
_OURS = {
    "hvae": "ours",
    "product": "ours",
    "product-mu": "ours",
    "hvae-onehot": "ours_onehot",
    "hvae-video": "ours_video",
    "gt12": "ours_engineered",
    "gt21": "ours_engineered",
    "gt32": "ours_engineered",
    "vae": "vae",
    "hvae-oracle": "ours_oracle_hvae",
}
_DEFAULT_MODALITY = re.compile("(?<=vae)-(xy|state|image)$")
# Baselines and ablations of the policy, on the default representation of a domain.
_BASELINES = {
    "no-entropy": "ours_no_entropy",
    "no-subsampling": "ours_no_subsampling",
    "continuous": "continuous_output",
    "nearest-neighbour": "nearest_neighbor",
}

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


class PaperValue(NamedTuple):
    """Mean and population standard deviation over the paper's seeds."""

    mean: float
    std: float
    num_seeds: int


@dataclass(frozen=True)
class PaperResult:
    """One bar of the paper, or one point of an analysis.

    Attributes:
      figure: e.g. `fig4_baselines`.
      environment: e.g. `Grid World`.
      method: e.g. `ours`, `vae`.
      split: `train` or `test` actions.
      metric: success_rate (a share in [0, 1]), ctr or final_height.
      value: its mean and deviation.
    """

    figure: str
    environment: str
    method: str
    split: str
    metric: str
    value: PaperValue


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
    name = _OURS.get(_DEFAULT_MODALITY.sub("", representation))
    if method != "ours":
        name = _BASELINES.get(method) if name == "ours" else None
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
    _check("method", method, (row.method for row in _results()))
    _check_split(split)
    if figure is not None:
        _check("figure", figure, (row.figure for row in _results()))
    for row in rows:
        if (row.method, row.split) == (method, split) and figure in (None, row.figure):
            return row.value
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
    its end is the mean of the seeds' best evaluations. What the released figures draw past the
    budget is padding and left out.

    Args:
      environment: as in `paper_environments`.
      method: the paper's name, see `paper_method`.
      split: sets of `train` or `validation` actions.

    Raises:
      PaperError: a name that stands nowhere in the paper.
    """
    end = paper_steps(environment)
    _check("method", method, [row.method for row in _results()] + [key[1] for key in _curves()])
    _check_split(split)
    curve = _curves().get((environment, method, split))
    if curve is None:
        return None
    return PaperCurve(*(values[curve.steps <= end] for values in curve))


def is_comparable(environment: str | None, method: str | None, split: str) -> bool:
    """Whether what the paper shows on a part of the split was made by the environment itself."""
    return split != "train" or method not in _OTHER_SIMULATOR.get(environment or "", ())


def _check(kind: str, name: str, known: Iterable[str]) -> None:
    names = list(dict.fromkeys(known))
    if name not in names:
        raise PaperError(f"The paper has no {kind} {name!r}; there are: {', '.join(names)}.")


def _check_split(split: str) -> None:
    _check("split", split, [row.split for row in _results()] + [key[2] for key in _curves()])


@lru_cache(maxsize=1)
def _results() -> list[PaperResult]:
    return [
        PaperResult(
            *(row["figure"], row["environment"], row["method"], row["split"], row["metric"]),
            PaperValue(float(row["mean"]), float(row["std"]), int(row["n_seeds"])),
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
