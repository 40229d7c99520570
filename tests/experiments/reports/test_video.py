"""Films as files."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments.reports.video import write_video


def frames(count: int, height: int = 15, width: int = 20) -> list[np.ndarray]:
    """A dark column that moves to the right, on white."""
    made = np.full((count, height, width, 3), 255, np.uint8)
    for number, frame in enumerate(made):
        frame[:, number] = 0
    return list(made)


@pytest.mark.unit
def test_gif_has_every_frame(tmp_path: Path) -> None:
    path = write_video(frames(6), tmp_path / "new" / "film.gif", frame_ms=70)
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
    with pytest.raises(ValueError, match=r"\.gif or \.mp4"):
        write_video(frames(1), tmp_path / "film.avi")
    with pytest.raises(ValueError, match="0 frames"):
        write_video([], tmp_path / "film.gif")
    with pytest.raises(ValueError, match="one size"):
        write_video([*frames(1), *frames(1, 16)], tmp_path / "film.gif")
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(ImportError, match=r"jaxnew\[video\]"):
        write_video(frames(1), tmp_path / "film.mp4")
