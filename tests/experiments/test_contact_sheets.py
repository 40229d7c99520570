"""The contact sheets of CREATE."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import contact_sheets


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
