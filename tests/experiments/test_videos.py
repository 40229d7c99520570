"""Films as files, and the contact sheets of CREATE."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments import contact_sheets
from experiments.reports.video import write_video


def frames(count: int, height: int = 15, width: int = 20) -> list[np.ndarray]:
    """A dark column that moves to the right, on white."""
    made = np.full((count, height, width, 3), 255, np.uint8)
    for number, frame in enumerate(made):
        frame[:, number] = 0
    return list(made)


@pytest.mark.unit
def test_gif_has_every_frame(tmp_path: Path) -> None:
    path = write_video(iter(frames(6)), tmp_path / "new" / "film.gif", frame_ms=70)
    with Image.open(path) as film:
        assert film.n_frames == 6
        assert film.size == (20, 15)
        for number in range(6):
            film.seek(number)
            shown = np.asarray(film.convert("L"))
            assert np.argwhere(shown[7] < 64).ravel().tolist() == [number]
            assert film.info["duration"] == (70 if number < 5 else 1500)


@pytest.mark.unit
def test_mp4_is_written_by_imageio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list = []

    class Writer(SimpleNamespace):
        def __enter__(self) -> Writer:
            return self

        def __exit__(self, *error: object) -> None:
            written.append("closed")

        def append_data(self, frame: np.ndarray) -> None:
            written.append(frame.shape)

    imageio = ModuleType("imageio.v2")
    imageio.get_writer = lambda path, **settings: written.append((path, settings)) or Writer()
    monkeypatch.setitem(sys.modules, "imageio", ModuleType("imageio"))
    monkeypatch.setitem(sys.modules, "imageio.v2", imageio)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", ModuleType("imageio_ffmpeg"))
    write_video(frames(2), tmp_path / "film.mp4", frame_ms=50)
    settings = {"fps": 20.0, "macro_block_size": 2}
    assert written == [(tmp_path / "film.mp4", settings), (14, 20, 3), (14, 20, 3), "closed"]


@pytest.mark.unit
def test_bad_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"\.gif, \.mp4"):
        write_video(frames(1), tmp_path / "film.avi")
    with pytest.raises(ValueError, match="0 frames"):
        write_video([], tmp_path / "film.gif")
    with pytest.raises(ValueError, match="one size"):
        write_video([*frames(1), *frames(1, 16)], tmp_path / "film.gif")
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(ImportError, match=r"jaxnew\[video\]"):
        write_video(frames(1), tmp_path / "film.mp4")


@pytest.mark.integration
def test_sheet_of_the_levels() -> None:
    sheet = contact_sheets.levels_sheet()
    again = contact_sheets.levels_sheet()
    assert np.array_equal(np.asarray(sheet), np.asarray(again))
    # Twelve cells of 300 + 196 x 300, three in a row, with gaps and titles.
    assert sheet.size == (3 * (496 + 14) + 14, 4 * (300 + 30 + 14) + 14)
    cells = [
        np.asarray(sheet)[14 + 344 * row + 30 :, 14 + 510 * column :][:300, :496]
        for row in range(4)
        for column in range(3)
    ]
    assert len({cell.tobytes() for cell in cells}) == 12
    # All have a red target for people, and gray pixels for the agent.
    for cell in cells[:9]:
        assert (cell[:, :300] == (0xF4, 0x5B, 0x69)).all(axis=-1).sum() > 100
        assert (cell[:, 300:] == 129).all(axis=-1).sum() > 50


@pytest.mark.integration
def test_sheet_of_the_tools() -> None:
    sheet = np.asarray(contact_sheets.tools_sheet())
    # 22 cells of 420 x 280, four in a row: the last row has two.
    assert sheet.shape == (6 * (280 + 30 + 14) + 14, 4 * (420 + 14) + 14, 3)
    inked = []
    for place in range(24):
        top, left = 14 + 324 * (place // 4) + 30, 14 + 434 * (place % 4)
        cell = sheet[top : top + 280, left : left + 420]
        thirds = (cell != 255).any(axis=-1).reshape(2, 140, 3, 140)
        inked.append(thirds.any(axis=(1, 3)).sum())
        assert np.ptp(cell[140:], axis=-1).max() == 0  # Gray.
        assert (np.ptp(cell[:140], axis=-1).max() > 0) == (place < 22)
    # Three tools in each, above for people and below for the agent.
    assert inked == [6] * 22 + [0, 0]
