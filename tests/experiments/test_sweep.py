"""Members of a sweep are the single runs they stand for."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from experiments.sweep import ARGUMENTS, varied
from jaxnew.representation.table import engineered_table
from jaxnew.sweeping import checked_seeds, member_configs
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from jaxnew.task.settings import TrainConfig
from jaxnew.training import train_config
from tests.experiments.commands import OPTIMIZED, ROOT


@pytest.fixture(scope="module")
def base() -> TrainConfig:
    domain = Domain.of(load_task("grid_world"), None)
    table = engineered_table(domain.universe, "gt12")
    return train_config(domain, "ours", "gt12", table, domain.task.stage_two["paper"], 31)


@pytest.mark.slow
@pytest.mark.integration
def test_on_eight_devices_members_equal_single_runs_after_one_update() -> None:
    # Programs that are not optimized are not as alike.
    flags = f"{OPTIMIZED['XLA_FLAGS']} --xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, "-m", "tests.experiments.sweep_on_devices"],
        cwd=ROOT,
        env={**os.environ, **OPTIMIZED, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["devices"] == found["devices_of_a_leaf"] == 8
    # Relative to how far the weights moved; another entropy coefficient makes 0.1.
    assert found["error_in_turn"] < 1e-5
    # Side by side, products are rounded otherwise, and Adam magnifies that where a gradient is all
    # but zero: in a member or two of the sixteen. The script compares their episodes, too.
    assert found["error_two_at_once"] < 2e-2
    assert found["median_error_two_at_once"] < 1e-3
    assert found["seven_members_on_six_devices_use"] == 1


@pytest.mark.unit
def test_one_member_per_seed_and_combination(base: TrainConfig) -> None:
    vary = {"entropy_coefficient": [0.0, 0.1], "clip": [0.1, 0.2, 0.3]}
    members = member_configs(base, [1, 2], vary)
    found = {
        (m.seed, m.hyperparameters.entropy_coefficient, m.hyperparameters.clip) for m in members
    }
    assert len(members) == len(found) == 2 * 2 * 3
    assert (2, 0.1, 0.3) in found
    assert all(m.hyperparameters.discount == base.hyperparameters.discount for m in members)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("vary", "says"),
    [
        ({"entropy": [0.1]}, "entropy_coefficient"),
        ({"clip": []}, "at least one value"),
        ({"learning_rate": [-1.0]}, "learning_rate"),
    ],
)
def test_bad_axes_are_refused(base: TrainConfig, vary: dict[str, list[float]], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        member_configs(base, [1], vary)


@pytest.mark.unit
@pytest.mark.parametrize("entry", ["clip=a", "clip", "clip=0.1,,0.2"])
def test_axes_that_are_no_numbers_are_refused(entry: str) -> None:
    with pytest.raises(UsageError, match=r"--vary=clip.*name=value"):
        varied(entry)
    assert varied("clip=0.1,2") == ("clip", [0.1, 2.0])


@pytest.mark.unit
@pytest.mark.parametrize("seeds", [[1, 1], []])
def test_bad_seeds_are_refused(seeds: list[int]) -> None:
    with pytest.raises(UsageError, match="seeds"):
        checked_seeds(seeds)
    with pytest.raises(UsageError, match="--seeds"):
        ARGUMENTS.parse(["--seeds=1,x"])
