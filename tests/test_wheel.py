"""What users install works outside the checkout, also beside folders named like ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.experiments.commands import ENVIRONMENT, ROOT

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the project as its wheel installs it, and nothing else."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", folder, ROOT], check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", folder / "site", wheel], check=True)
    return folder / "site"


def run(installed: Path, folder: Path, *command: str) -> str:
    """Output of a command in `folder`, with the installed project before any other."""
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **ENVIRONMENT, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_commands_run_in_a_folder_with_experiments_of_the_users_own(
    installed: Path, tmp_path: Path
) -> None:
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "__init__.py").write_text("raise RuntimeError('not this one')")
    (tmp_path / "mine.py").write_text(
        "from dataclasses import replace\n"
        "from jaxnew import load_task\n"
        "TASK = replace(load_task('grid_world'), name='mine')\n"
    )
    console = str(installed / "bin" / "jaxnew")
    flags = ("--task=mine:TASK", "--representation=gt5", "--budget=smoke")
    assert "update 4 of 4" in run(installed, tmp_path, console, "train", *flags)
    path = tmp_path / "runs" / "mine" / "ours-gt5-default-smoke-31"
    flags = (f"--run={path}", "--episodes=16", "--trust")
    assert "16 sampled episodes" in run(installed, tmp_path, console, "evaluate", *flags)
    # `figures` trains what is missing in processes of their own.
    dry = run(installed, tmp_path, console, "figures", "--figure=6", "--budget=smoke", "--dry_run")
    assert "sweep" in dry


def test_its_data_is_there(installed: Path, tmp_path: Path) -> None:
    code = (
        "import jaxnew, experiments.reports.paper as paper\n"
        "print(jaxnew.__file__, jaxnew.__version__)\n"
        "for name in ('create-push', 'recommender', 'shape_stacking'):\n"
        "    task = jaxnew.load_task(name)\n"
        "    print(name, jaxnew.Domain.of(task).split.hash)\n"
        "print(len(paper.paper_results('Grid World')) > 5)\n"
    )
    output = run(installed, tmp_path, sys.executable, "-P", "-c", code).splitlines()
    assert output[0].startswith(str(installed))
    assert [line.split()[0] for line in output[1:4]] == [
        "create-push",
        "recommender",
        "shape_stacking",
    ]
    assert output[4] == "True"
    assert (installed / "jaxnew" / "py.typed").is_file()
    assert (installed / "jaxnew" / "pretrained" / "grid_world" / "weights.npz").is_file()
