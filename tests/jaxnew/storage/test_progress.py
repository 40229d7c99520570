"""What is shown of a long job."""

from __future__ import annotations

import time

import pytest

from jaxnew.storage import progress
from jaxnew.storage.progress import ProgressDisplay


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
