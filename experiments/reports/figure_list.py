"""The figures of the paper: which settings each of them shows, by task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from experiments.reports.production import Cell
from jaxnew.task.places import UsageError

_BASELINES = ("ours", "continuous", "nearest-neighbour")
_ABLATIONS = ("ours", "no-entropy", "no-subsampling")
_ALL = ("ours", "continuous", "nearest-neighbour", "no-entropy", "no-subsampling")

# Tasks of the paper's main text, and the nine further ones of its appendix.
_CREATE = ("create-push", "create-obstacle", "create-seesaw")
_FURTHER = "navigate belt buckets cannon collide moving ladder basket funnel"
_FURTHER_CREATE = tuple(f"create-{level}" for level in _FURTHER.split())


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper.

    Attributes:
      kind: bars, curves, finetune, representations, study or films.
      title: what it shows.
      cells: its settings, by task. Of a picture of representations, only these count.
      budget: suffix of the preset of its runs.
      study: name of the task's study that it shows.
      note: below the table of its bars.
      notes: instead of it, by task.
    """

    kind: str
    title: str
    cells: Mapping[str, tuple[Cell, ...]]
    budget: str = ""
    study: str = ""
    note: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)


def _cells(methods: Sequence[str], representation: str, *more: str) -> tuple[Cell, ...]:
    """Methods on one representation, then ours on further ones."""
    return (*(Cell(method, representation) for method in methods), *_encoders(*more))


def _encoders(*names: str) -> tuple[Cell, ...]:
    """Ours on representations."""
    return tuple(Cell("ours", name) for name in names)


def _each(tasks: Sequence[str], cells: tuple[Cell, ...]) -> dict[str, tuple[Cell, ...]]:
    return dict.fromkeys(tasks, cells)


def _everywhere(methods: Sequence[str], *more: str) -> dict[str, tuple[Cell, ...]]:
    """The same on all tasks of the main text; the Recommender has one representation."""
    return {
        "grid_world": _cells(methods, "hvae", *more),
        "recommender": _cells(methods, "product"),
        _STACKING: _cells(methods, "hvae", *more),
        **_each(_CREATE, _cells(methods, "hvae", *more)),
    }


_OURS = Cell("ours", "hvae")
_FULL = Cell("ours", "hvae", split="full")
_STACKING = "shape_stacking"
_STACKING_NOTE = (
    "The paper's bars of Shape Stacking merge the results of several machines, which agree within "
    "a machine rather than within a seed, and some values were typed by hand "
    "(`source_note` in `experiments/paper/results.csv`)."
)
_FIXED_SET_NOTE = (
    f"{_STACKING_NOTE} Its train bars of methods with one fixed set come from another simulator, "
    "which rebuilds the scene at each drop, and are not comparable with any other."
)
_TUNED = _cells(("ours", "nearest-neighbour"), "hvae")
# The encoder of the analysis has seen its whole universe (docs/create.md, "Analysis").
_ANALYSED = _each(_CREATE, (Cell("ours", "hvae-oracle", variant="-analysis"),))

FIGURES: dict[str, PaperFigure] = {
    "4": PaperFigure(
        "bars", "baselines", _everywhere(_BASELINES, "vae"), notes={_STACKING: _FIXED_SET_NOTE}
    ),
    "5": PaperFigure(
        "representations",
        "held-out tools",
        _each((*_CREATE, *_FURTHER_CREATE), _encoders("hvae", "vae")),
    ),
    "6": PaperFigure(
        "bars", "ablations", _everywhere(_ABLATIONS), notes={_STACKING: _FIXED_SET_NOTE}
    ),
    "7a": PaperFigure(
        "bars",
        "tools of unseen classes",
        _each(_CREATE, (_FULL,)),
        note="The paper's numbers are those of its last runs. Older runs in its release reached "
        "far more on test tools (`alt_create_full_split_older` in `experiments/paper/results.csv`),"
        " so that the target is uncertain.",
    ),
    "7b": PaperFigure(
        "bars",
        "alternate representations",
        {
            "grid_world": _cells(("ours",), "hvae", "hvae-onehot", "gt12", "hvae-oracle"),
            _STACKING: _cells(("ours",), "hvae", "gt21", "hvae-oracle"),
            **_each(_CREATE, _cells(("ours",), "hvae", "hvae-video", "gt32", "hvae-oracle")),
        },
        notes={
            _STACKING: f"{_STACKING_NOTE} Its engineered vectors had their classes in an order "
            "that changed from process to process; those of jaxnew do not."
        },
    ),
    "8": PaperFigure(
        "films",
        "zero-shot episodes",
        _each((*_CREATE, *_FURTHER_CREATE, _STACKING), (_OURS,)),
    ),
    "9a": PaperFigure("study", "angle to training tools", _ANALYSED, study="angle"),
    "9b": PaperFigure("study", "distance to training tools", _ANALYSED, study="embedding"),
    "9c": PaperFigure("study", "share of unseen tools", _ANALYSED, study="mix"),
    "10": PaperFigure("finetune", "training on new actions", {"create-push": _TUNED}),
    "14": PaperFigure(
        "representations",
        "held-out actions",
        {"grid_world": _encoders("hvae", "vae", "hvae-onehot", "gt12")},
    ),
    "15": PaperFigure(
        "representations",
        "held-out tools",
        _each(
            (*_CREATE, *_FURTHER_CREATE),
            (*_encoders("hvae", "vae", "hvae-video"), _FULL),
        ),
    ),
    "16": PaperFigure(
        "representations",
        "held-out shapes",
        {_STACKING: (*_encoders("hvae", "vae"), _FULL)},
    ),
    "18": PaperFigure("bars", "further tasks", _each(_FURTHER_CREATE, _cells(_ALL, "hvae", "vae"))),
    "19": PaperFigure(
        "finetune",
        "training on new actions",
        {
            "grid_world": _TUNED,
            "recommender": _cells(("ours", "nearest-neighbour"), "product"),
            _STACKING: _TUNED,
            **_each(_CREATE[1:], _TUNED),
        },
    ),
    "20": PaperFigure(
        "bars",
        "no reward for subgoals",
        _each(_CREATE, (_OURS, Cell("ours", "hvae", variant="-no-subgoals"))),
        note="In jaxnew it is paid for the goal only; the release does not record which rewards "
        "the paper's runs lacked.",
    ),
    "21": PaperFigure(
        "bars",
        "position conditioned on the tool",
        _each(_CREATE, (_OURS, Cell("ours", "hvae", conditions_position=True))),
    ),
    "22": PaperFigure(
        "bars",
        "fully observable",
        {"recommender": _cells(_ALL, "product-mu")},
        budget="-mu",
    ),
    "23": PaperFigure(
        "bars",
        "ways of placing, shapes of unseen classes",
        {
            _STACKING: (
                _OURS,
                Cell("ours", "hvae", variant="-no-place"),
                Cell("ours", "hvae", variant="-2d-place"),
                _FULL,
            )
        },
        note=_STACKING_NOTE,
    ),
    "24": PaperFigure(
        "curves",
        "learning curves",
        _everywhere(_ALL, "vae"),
        notes={
            _STACKING: "The paper's train curves of methods with one fixed set come from another "
            "simulator, which rebuilds the scene at each drop; those of jaxnew are not compared "
            "with them."
        },
    ),
}
_SAME = {"10": "19", "19": "10"}  # The same curves: figure 10 has those of CREATE Push.


def number_of(number: str, task: str) -> str:
    """The figure that is meant: of two with the same content, the one that shows the task.

    Raises:
      UsageError: there is none, or it does not show the task.
    """
    if number not in FIGURES:
        raise UsageError(f"No figure {number!r}; choose of {', '.join(FIGURES)}.")
    wanted = [number, *([_SAME[number]] if number in _SAME else [])]
    for candidate in wanted:
        if task in FIGURES[candidate].cells:
            return candidate
    shown = ", ".join(task for candidate in wanted for task in FIGURES[candidate].cells)
    raise UsageError(f"Figure {number} does not show {task}; it shows {shown}.")
