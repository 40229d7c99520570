"""What evaluations found, as people read it."""

from __future__ import annotations

import pytest

from jaxnew.results import Evaluation

pytestmark = pytest.mark.unit


def test_it_prints_as_a_table_of_80_columns() -> None:
    numbers = {
        "is_success": {"mean": 0.4321, "low": 0.39, "high": 0.47},
        "episode_return": {"mean": -123.456, "low": -130.0, "high": -100.0},
        "episode_length": {"mean": 25.93751, "low": 17.95710, "high": 33.9179},
        "num_steps": {"mean": 1.0, "low": 12345.6, "high": float("inf")},
    }
    row = {"num_episodes": 5000, "policy": "sampled", "metrics": numbers}
    told = {"num_actions": 3, "num_seen": 1, "universe": "toys", "examples": ["a", "b"]}
    rows = {"train": row, "table-a": {**row, **told}}
    text = str(Evaluation("run", rows, ("x is not on record: why",)))
    assert text.splitlines() == [
        "run",
        "5,000 sampled episodes each; mean [95 % interval over episodes]",
        "                      is_success           episode_return        episode_length",
        "train    0.4321 [0.3900, 0.4700]  -123.5 [-130.0, -100.0]  25.94 [17.96, 33.92]",
        "table-a  0.4321 [0.3900, 0.4700]  -123.5 [-130.0, -100.0]  25.94 [17.96, 33.92]",
        "                    num_steps",
        "train    1.000 [12345.6, inf]",
        "table-a  1.000 [12345.6, inf]",
        "table-a: 3 actions of toys, 1 seen in training, e.g. a; b",
        "x is not on record: why",
    ]
    assert max(map(len, text.splitlines())) <= 80
