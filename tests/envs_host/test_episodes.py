"""What a pool remembers of running episodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs_host.episodes import ActionLog


@pytest.mark.property
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 7)), max_size=60), st.integers(0, 3))
def test_the_log_is_a_list_per_environment(steps: list[tuple[bool, int]], k: int) -> None:
    """Two halves of two environments; each entry is a half and which of its episodes end."""
    log, lists = ActionLog(4, k), [[] for _ in range(4)]
    for t, (half, ends) in enumerate(steps):
        rows = slice(2 * half, 2 * half + 2)
        ids, positions = np.array([t, t + 100]), np.full((2, k), t, np.float32)
        log.append(rows, ids, positions)
        for j in range(2):
            lists[rows.start + j].append(t + 100 * j)
        ended = [rows.start + j for j in range(2) if ends & (1 << j)]
        log.clear(np.array(ended, int))
        for i in ended:
            lists[i].clear()
    other = ActionLog(4, k)
    other.load(**log.state())
    for i, expected in enumerate(lists):
        for each in (log, other):
            ids, positions = each.of(i)
            assert ids.tolist() == expected
            assert positions.shape == (len(expected), k)
            assert positions.dtype == np.float32
            np.testing.assert_array_equal(positions, (ids % 100)[:, None].repeat(k, 1))
