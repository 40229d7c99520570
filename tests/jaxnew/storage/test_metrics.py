"""Metric files survive crashes and cuts."""

from __future__ import annotations

import builtins
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnew.storage.metrics import FILE_NAME, MetricsError, MetricsLog, read


def steps(path: Path) -> list[int]:
    return [report["step"] for report in read(path)]


@pytest.mark.unit
def test_what_is_written_is_read(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write(3, {"loss": jnp.float32(0.1), "episode/x": float("nan"), "n": np.int64(7)})
        log.write(3, {"success": 0.5, "worst": float("-inf")}, prefix="validation/")
    assert read(tmp_path) == [
        {"step": 3, "loss": float(np.float32(0.1)), "episode/x": None, "n": 7},
        {"step": 3, "validation/success": 0.5, "validation/worst": float("-inf")},
    ]
    assert read(tmp_path / FILE_NAME) == read(tmp_path)
    for line in (tmp_path / FILE_NAME).read_text().splitlines():
        json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


@pytest.mark.unit
def test_each_report_is_on_disk_at_once(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    log.write(1, {"a": 1.0})
    assert steps(tmp_path) == [1]
    log.close()


@pytest.mark.unit
def test_an_absent_file_holds_no_reports(tmp_path: Path) -> None:
    assert read(tmp_path) == []
    assert MetricsLog(tmp_path).cut_back(5) == 0


@pytest.mark.unit
def test_cut_back_keeps_the_step_itself_and_goes_on(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        for step in (1, 2, 2, 3, 4):
            log.write(step, {"a": float(step)})
        assert log.cut_back(2) == 2
        log.write(3, {"a": 30.0})
    assert steps(tmp_path) == [1, 2, 2, 3]
    assert read(tmp_path)[-1]["a"] == 30.0


@pytest.mark.property
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 400))
def test_a_file_cut_anywhere_is_readable_and_repaired(
    tmp_path_factory: pytest.TempPathFactory, length: int
) -> None:
    folder = tmp_path_factory.mktemp("run")
    with MetricsLog(folder) as log:
        for step in range(10):
            log.write(step, {"loss": 0.25 * step})
    whole = (folder / FILE_NAME).read_bytes()
    (folder / FILE_NAME).write_bytes(whole[:length])
    complete = whole[:length].count(b"\n")
    assert steps(folder) == list(range(complete))
    with MetricsLog(folder) as log:
        log.cut_back(100)
        log.write(99, {})
    assert steps(folder) == [*range(complete), 99]


@pytest.mark.unit
@pytest.mark.parametrize("line", ["{broken", "[1]", '{"loss": 1}', '{"step": "x"}', ""])
def test_damage_elsewhere_is_an_error_with_the_line(tmp_path: Path, line: str) -> None:
    (tmp_path / FILE_NAME).write_text(f'{{"step": 1}}\n{line}\n{{"step": 3}}\n')
    with pytest.raises(MetricsError, match="line 2 is not a report"):
        read(tmp_path)


@pytest.mark.unit
def test_a_metric_may_not_hide_the_step(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log, pytest.raises(ValueError, match="called `step`"):
        log.write(1, {"step": 3.0})


@pytest.mark.unit
def test_events_are_written_and_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with MetricsLog(tmp_path) as log:
        log.write(1, {"a": 1.0})
    assert list((tmp_path / "tensorboard").iterdir())
    real_import = builtins.__import__

    def no_tensorboard(name: str, *rest: Any, **named: Any) -> Any:
        if name == "tensorboardX":
            raise ImportError(name)
        return real_import(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", no_tensorboard)
    (tmp_path / "other").mkdir()
    with MetricsLog(tmp_path / "other") as log:
        log.write(1, {"a": 1.0})
    assert steps(tmp_path / "other") == [1]
    assert not (tmp_path / "other" / "tensorboard").exists()
