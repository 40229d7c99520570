"""A few drills of each kind, of another seed each time; `python -m tests.drills` runs more."""

from __future__ import annotations

import time

import pytest

from tests.drills.drills import Drills

pytestmark = [pytest.mark.slow, pytest.mark.integration]


@pytest.fixture(scope="module")
def drills(tmp_path_factory: pytest.TempPathFactory) -> Drills:
    return Drills(tmp_path_factory.mktemp("drills"), seed=int(time.time()))


def test_a_killed_command_ends_with_the_same_bits(drills: Drills) -> None:
    drills.kills(4)
    assert drills.totals["kills"].total() == 4


def test_a_full_disk_is_one_line_and_the_command_goes_on(drills: Drills) -> None:
    try:
        drills.full_disks(2)
    except PermissionError as err:
        pytest.skip(str(err))
    assert drills.totals["full disks"].total() == 2


def test_lost_workers_are_replaced_exactly(drills: Drills) -> None:
    drills.worker_faults(10)
    assert drills.totals["worker faults"].total() == 10


def test_damage_is_named_or_harmless(drills: Drills) -> None:
    drills.damages(10)
    assert drills.totals["damages"].total() == 10
