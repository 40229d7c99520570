"""What comes with jaxnew: encoders that encode new actions right after installation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxnew
from jaxnew.embedding import Encoder, find_table
from jaxnew.representation.table import RepresentationTable
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError, place_of
from tests.experiments.commands import run

NAMES = ["grid_world", "create"]
IDS = np.array([0, 5, 1023], np.int32)


@pytest.mark.golden
@pytest.mark.parametrize("name", NAMES)
def test_its_table_is_what_it_makes_of_the_recordings_of_its_budget(
    name: str, tmp_path: Path
) -> None:
    encoder = Encoder.load(f"pretrained:{name}")
    found = encoder.encode(jaxnew.record(encoder.task, IDS, output=tmp_path / "some.npz"))
    # Other machines round otherwise.
    np.testing.assert_allclose(found.vectors, encoder.table.rows(IDS), atol=1e-3)
    assert found.made_by == encoder.table.hash
    sizes = {file.name: file.stat().st_size for file in encoder.path.iterdir()}
    assert max(sizes.values()) < 2e6, sizes


@pytest.mark.unit
def test_it_is_named_wherever_an_encoder_or_a_table_is(tmp_path: Path) -> None:
    domain = Domain.of(load_task("grid_world"))
    table = find_table(domain, tmp_path, "pretrained:grid_world", "laptop")
    assert table.hash == Encoder.load("pretrained:grid_world").table.hash
    assert place_of("runs/pretrained:grid_world") == Path("runs/pretrained:grid_world")
    with pytest.raises(UsageError, match=r"no pretrained:chess; there is .*grid_world"):
        Encoder.load("pretrained:chess")


@pytest.mark.integration
def test_commands_take_it(tmp_path: Path) -> None:
    new, table = tmp_path / "new.npz", tmp_path / "table.npz"
    jaxnew.record("grid_world", IDS, num_recordings=4, output=new)
    files = (f"--observations={new}", f"--output={table}")
    run("embed", "--checkpoint=pretrained:grid_world", *files)
    assert RepresentationTable.load(table).vectors.shape == (3, 16)
    flags = ("--representation=pretrained:grid_world", "--budget=smoke", "--set=num_updates=1")
    run("train", *flags, f"--runs={tmp_path}")
    assert (tmp_path / "grid_world" / "ours-pretrained-grid_world-default-smoke-31").is_dir()
