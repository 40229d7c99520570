"""What the README shows runs as it stands there (its commands: `tests/experiments`)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


@pytest.mark.integration
def test_the_environments_examples(capsys: pytest.CaptureFixture[str]) -> None:
    grid_world, stacking = re.findall(r"```python\n(.+?)```", README, re.DOTALL)
    exec(compile(grid_world, "README.md", "exec"), {})
    assert capsys.readouterr().out == "50 (81,)\n"
    exec(compile(stacking, "README.md", "exec"), {})
    # Shape 290 bridges the cylinders (spec shape_stacking 13, check 7), or lies on one of them.
    assert 0.9 < float(capsys.readouterr().out) < 1.2


@pytest.mark.unit
def test_what_the_readme_names_exists() -> None:
    modules = set(re.findall(r"python -m experiments\.(\w+)", README)) - {"NAME"}
    assert modules >= {"collect", "embed", "train", "evaluate"}
    for module in modules:
        assert (ROOT / "experiments" / f"{module}.py").is_file(), module
    for file in re.findall(r"`((?:jaxnew|experiments|envs_mjx)/[\w/]+\.py)`", README):
        assert (ROOT / file).is_file(), file
    for file in re.findall(r"\]\((results/[^)]+)\)", README):
        assert (ROOT / file).is_file(), file
