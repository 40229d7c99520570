"""Metric files survive crashes and cuts."""

from __future__ import annotations

import builtins
import json
import re
import resource
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensorboardX.proto.event_pb2 import Event

from jaxnew.storage.files import StorageError
from jaxnew.storage.metrics import FILE_NAME, MetricsError, MetricsLog, _Events, read


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
    with pytest.raises(MetricsError, match="line 2 is not what was written"):
        read(tmp_path)


@pytest.mark.unit
@pytest.mark.parametrize("name", ["step", "chain"])
def test_a_metric_may_not_hide_what_a_report_has(tmp_path: Path, name: str) -> None:
    with MetricsLog(tmp_path) as log, pytest.raises(ValueError, match=f"called `{name}`"):
        log.write(1, {name: 3.0})


def written(path: Path, steps: Sequence[int] = range(1, 6)) -> dict[str, Any]:
    """A file with a report for each step; its mark."""
    with MetricsLog(path) as log:
        for step in steps:
            log.write(step, {"loss": 0.5 * step, "worst": float("inf"), "none": float("nan")})
        return log.mark


@pytest.mark.unit
@pytest.mark.parametrize(
    ("alter", "number"),
    [
        (lambda lines: [*lines[:2], lines[2].replace("1.5", "1.4"), *lines[3:]], 3),
        (lambda lines: [*lines[:2], re.sub(', "chain.*"', "", lines[2]), *lines[3:]], None),
        (lambda lines: [*lines[:2], *lines[3:]], 3),
        (lambda lines: [lines[1], lines[0], *lines[2:]], 1),
        (lambda lines: [*lines, lines[4]], 6),
        (lambda lines: lines[1:], 1),
    ],
)
def test_a_line_that_was_altered_lost_or_moved_is_noticed(
    tmp_path: Path, alter: Any, number: int | None
) -> None:
    written(tmp_path)
    file = tmp_path / FILE_NAME
    file.write_text("".join(alter(file.read_text().splitlines(keepends=True))))
    if number is None:  # A line of 0.2.0 and before: what it says is the same.
        assert steps(tmp_path) == [1, 2, 3, 4, 5]
        return
    for use in (read, MetricsLog, lambda path: MetricsLog(path).cut_back(9)):
        with pytest.raises(MetricsError, match=rf"line {number} is not what was written .*altered"):
            use(tmp_path)


@pytest.mark.unit
def test_every_flipped_bit_of_a_line_is_noticed(tmp_path: Path) -> None:
    mark, file = written(tmp_path, (1, 2)), tmp_path / FILE_NAME
    whole, expected = file.read_bytes(), read(tmp_path)
    for position in range(len(whole)):
        content = bytearray(whole)
        content[position] ^= 1 << position % 8
        file.write_bytes(content)
        try:
            found = read(tmp_path, mark)
        except MetricsError:
            continue
        assert found == expected  # A blank of another kind.


@pytest.mark.unit
def test_reports_that_a_checkpoint_relies_on_have_to_be_there(tmp_path: Path) -> None:
    early, late = written(tmp_path, (1, 2)), written(tmp_path, (3, 4))
    file = tmp_path / FILE_NAME
    assert len(read(tmp_path, early)) == len(read(tmp_path, late)) == 4
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:2]))
    assert len(read(tmp_path, early)) == 2
    with pytest.raises(MetricsError, match=r"holds 2; the run had written 4 reports .* copy, or"):
        read(tmp_path, late)
    file.unlink()
    with pytest.raises(MetricsError, match=r"metrics\.jsonl is missing; .* 2 reports"):
        read(tmp_path, early)
    assert written(tmp_path, (1, 2, 5)) != early
    with pytest.raises(MetricsError, match="holds others; the run had written 2"):
        read(tmp_path, {**early, "chain": "0" * 12})
    file.write_bytes(b"")
    with pytest.warns(UserWarning, match="its first 2 reports were given up"):
        assert read(tmp_path, early) == []


@pytest.mark.unit
def test_a_file_of_an_earlier_version_goes_on(tmp_path: Path) -> None:
    file = tmp_path / FILE_NAME
    file.write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "loss": 0.25}\n')
    mark = written(tmp_path, (3, 4))
    assert mark["lines"] == 4
    assert steps(tmp_path) == [1, 2, 3, 4]
    file.write_text(file.read_text().replace("0.25", "0.26"))
    with pytest.raises(MetricsError, match="line 3 is not what was written"):
        read(tmp_path)
    file.write_text(file.read_text().replace("0.26", "0.25"))
    with MetricsLog(tmp_path) as log:
        assert log.cut_back(3) == 1  # Writes the file anew, and all lines have a chain.
        before = log.mark
    assert "chain" in file.read_text().splitlines()[0]
    assert MetricsLog(tmp_path).mark == before
    assert written(tmp_path, (4,)) == mark


@pytest.mark.unit
def test_a_full_disk_leaves_whole_lines(tmp_path: Path) -> None:
    """The system takes a part of the line and then no more; without events the run goes on."""
    mark = written(tmp_path, (1, 2))
    size = (tmp_path / FILE_NAME).stat().st_size
    shutil.rmtree(tmp_path / "tensorboard")
    (tmp_path / "tensorboard").write_text("")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, limits[1]))
    log = MetricsLog(tmp_path)
    try:
        with (
            pytest.raises(StorageError, match=r"metrics\.jsonl cannot be written: File too large"),
            pytest.warns(UserWarning, match="tensorboard cannot be written .*nothing more goes"),
        ):
            log.write(3, {"loss": 1.0})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / FILE_NAME).stat().st_size == size
    assert log.mark == mark
    log.write(3, {"loss": 1.0})
    log.close()
    assert steps(tmp_path) == [1, 2, 3]


@pytest.mark.unit
@pytest.mark.parametrize("call", ["write", "close"])
def test_events_that_cannot_be_written_end_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with MetricsLog(tmp_path) as log:
        log.write(1, {"loss": 1.0})
        monkeypatch.setattr(_Events, call, full)
        with pytest.warns(UserWarning, match="No space left on device.; nothing more"):
            log.write(2, {"loss": 1.0}) if call == "write" else log.close()
        log.write(3, {"loss": 1.0})
    assert steps(tmp_path) == [1, 2, 3][:: 1 if call == "write" else 2]


@pytest.mark.unit
def test_events_are_what_was_reported(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write(3, {"loss": 0.5, "episode/x": float("nan"), "n": 7})
    (file,) = (tmp_path / "tensorboard").iterdir()
    file.rename(file.with_suffix(".first"))  # Names have the second in which a file was begun.
    with MetricsLog(tmp_path) as log:
        log.write(4, {"loss": 0.25})
    found = [
        [
            (e.step, e.session_log.status, *((v.tag, v.simple_value) for v in e.summary.value))
            for e in events(path)
        ]
        for path in sorted((tmp_path / "tensorboard").iterdir())
    ]
    first = [(0, 0), (3, 0, ("loss", 0.5)), (3, 0, ("n", 7.0))]
    second = [(0, 0), (4, 1), (4, 0, ("loss", 0.25))]  # 1: hide what earlier files say of 4 and on.
    assert sorted(found) == sorted([first, second])


def events(path: Path) -> list[Any]:
    """What a file for TensorBoard holds."""
    content, found = path.read_bytes(), []
    while content:  # Length, its check sum, the event, its check sum.
        length = int.from_bytes(content[:8], "little")
        found.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    return found


@pytest.mark.unit
def test_a_link_is_not_written_through(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("")
    (tmp_path / FILE_NAME).symlink_to(tmp_path / "other")
    with MetricsLog(tmp_path) as log, pytest.raises(StorageError, match="It is a link"):
        log.write(1, {"loss": 1.0})
    assert (tmp_path / "other").read_text() == ""


@pytest.mark.unit
def test_events_are_written_and_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with MetricsLog(tmp_path) as log:
        log.write(1, {"a": 1.0})
    assert list((tmp_path / "tensorboard").iterdir())
    real_import = builtins.__import__

    def no_tensorboard(name: str, *rest: Any, **named: Any) -> Any:
        if name.startswith("tensorboardX"):
            raise ImportError(name)
        return real_import(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", no_tensorboard)
    (tmp_path / "other").mkdir()
    with MetricsLog(tmp_path / "other") as log:
        log.write(1, {"a": 1.0})
    assert steps(tmp_path / "other") == [1]
    assert not (tmp_path / "other" / "tensorboard").exists()
