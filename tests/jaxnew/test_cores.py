"""Cores that a process may use, on systems that say which and on those that do not."""

from __future__ import annotations

import os

import pytest

from jaxnew.cores import available_cores


@pytest.mark.unit
def test_available_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 9}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    assert available_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores() == 16
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_cores() == 1
