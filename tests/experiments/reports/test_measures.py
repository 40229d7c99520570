"""How well the numbers of a table's report order what policies make of it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.reports.measures import MeasuredTable, rank_correlation, study_measures
from jaxnew.representation.table import engineered_table
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import plain_config, skill_universe, write_evaluation, write_run


def runs_on_noisy_tables(folder: Path) -> list[Path]:
    """The more noise there is on a table of engineered vectors, the less its policy reaches."""
    table = engineered_table(skill_universe(), "gt12")
    noise = np.random.default_rng(0).normal(size=table.vectors.shape)
    paths = []
    for number, (deviation, success) in enumerate([(0.1, 0.9), (1.0, 0.6), (3.0, 0.3), (9.0, 0.2)]):
        noisy = replace(table, vectors=np.float32(table.vectors + deviation * noise))
        config = {**plain_config(representation=f"table{number}.npz"), "table_hash": noisy.hash}
        paths.append(write_run(folder / f"noise-{deviation:g}", config, table=noisy))
        write_evaluation(paths[-1], "test", success)
    return paths


@pytest.mark.unit
def test_tables_are_ordered_by_what_their_policies_reach(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = runs_on_noisy_tables(tmp_path)
    written = study_measures(paths[::-1], 1000, tmp_path / "out")
    assert [path.name for path in written] == ["measures.png", "measures.md", "measures.csv"]
    text = written[1].read_text()
    assert text in capsys.readouterr().out
    places = [text.index(f"| {path.name} | 0 |") for path in paths]
    assert places == sorted(places)
    assert "| noise-0.1 | 0 | 90.0 |" in text
    (ranks,) = [line for line in text.splitlines() if line.startswith("| Spearman, 4 tables | 0 |")]
    assert ranks.split(" | ")[3] == "+1.00"  # 5-NN R2, the first measure.
    with written[2].open() as opened:
        rows = list(csv.DictReader(opened))
    assert [float(row["test"]) for row in rows] == [0.9, 0.6, 0.3, 0.2]
    told = [float(row["5-NN R2 to net displacement"]) for row in rows]
    assert told == sorted(told, reverse=True)
    config = {**plain_config(), "method": "modulated"}
    other = write_run(tmp_path / "other", config)
    with pytest.raises(UsageError, match=r"other has method=modulated and .*noise-0.1 ours; give"):
        study_measures([*paths, other], 1000, tmp_path / "refused")


@pytest.mark.oracle
def test_the_correlation_is_of_ranks_and_leaves_out_what_is_not_defined() -> None:
    def tables(*pairs: tuple[float, float]) -> list[MeasuredTable]:
        return [MeasuredTable("", 0, {"a": value}, success) for value, success in pairs]

    # Ranks 1, 2, 3, 4 and 1, 3, 2, 4: 1 - 6 (0 + 1 + 1 + 0) / (4 (16 - 1)).
    four = tables((1.0, 0.1), (2.0, 0.3), (30.0, 0.2), (400.0, 0.9))
    assert rank_correlation(four, "a") == pytest.approx(0.8)
    assert rank_correlation([*four, *tables((float("nan"), 0.5))], "a") == pytest.approx(0.8)
    assert np.isnan(rank_correlation(tables((1.0, 0.1), (1.0, 0.2), (1.0, 0.3)), "a"))
    assert np.isnan(rank_correlation(four[:2], "a"))
