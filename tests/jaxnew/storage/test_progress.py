"""What is shown of a long job."""

from __future__ import annotations

import io
import os
import sys
import time

import pytest
from rich.console import Console

from jaxnew.storage import progress
from jaxnew.storage.progress import LastingStream, ProgressDisplay, bar_on, lasting, say


@pytest.mark.unit
def test_it_moves_within_a_chunk(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_PLAIN_EVERY_S", 0.0)
    monkeypatch.setattr(progress, "_MOVES_EVERY_S", 0.02)
    with ProgressDisplay("job", 30, "updates") as display:
        display.update(0, "compiling")
        time.sleep(0.1)
        display.update(10, "fast")
        time.sleep(0.3)  # At that rate it would be past 20.
        display.update(20)
        display.update(30)
        time.sleep(0.1)  # Such as a last evaluation.
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "job: 0/30 updates  compiling"
    assert "job: 0/30 updates  compiling for 0:00" in lines
    about = [line for line in lines if "about" in line]
    places = [int(line.split("about ")[1].split("/")[0]) for line in about]
    assert places == sorted(places)
    assert places[0] < places[-1] == 19  # No further than the last chunk went.
    assert all(line.endswith(" left  fast") for line in about)
    assert lines[-1].startswith("job: 30/30 updates")
    assert lines[-2].startswith("job: 20/30 updates")


@pytest.mark.unit
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_the_bar_its_unit_and_the_time_left_fit_80_columns(encoding: str) -> None:
    shown = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    console = Console(file=lasting(shown), width=80, force_terminal=True, color_system=None)
    bar = bar_on(console)
    title, note = "ours-hvae-relative-default-[laptop]", "1:02:03  123,456 env steps/s  " * 4
    bar.add_task(title, total=156250, completed=151234, unit="updates", note=note)
    console.print(bar.get_renderable())
    shown.seek(0)
    first, second = shown.read().splitlines()
    assert first.startswith("ours-hvae-relative-")
    assert " 151234/156250 updates " in first
    assert first.rstrip().endswith("-:--:--")  # Nothing is known of the speed.
    assert first.count("\N{BOX DRAWINGS HEAVY HORIZONTAL}" if encoding == "utf-8" else "-") >= 8
    assert second.startswith("  1:02:03  123,456 env steps/s")
    assert max(len(first), len(second)) == 80


@pytest.mark.unit
def test_a_terminal_of_few_letters_shows_others_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", shown)
    say("läuft")
    shown.seek(0)
    assert shown.read() == "l?uft\n"


@pytest.mark.unit
def test_nobody_needs_to_read_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closed by its reader, or by the program itself."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        with ProgressDisplay("job", 2, "updates") as display:
            display.update(1)
            display.say("half of it")
            display.update(2)
        assert LastingStream(closed).write("lost") == 4
    say("lost as well")


@pytest.mark.unit
def test_a_signal_within_a_print_may_print(capsys: pytest.CaptureFixture[str]) -> None:
    class Busy(io.StringIO):
        def write(self, text: str) -> int:
            raise RuntimeError("reentrant call inside <_io.BufferedWriter name='<stdout>'>")

    print("once more to stop at once", file=lasting(Busy()), flush=True)
    assert capsys.readouterr().out == ""
