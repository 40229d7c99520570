"""What the README and `docs/environments.md` show runs as it stands there.

Commands run in `tests/experiments`, pages of one's own domain and policy in `tests/examples`.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jaxnew.recording import record
from jaxnew.task.domain import Domain, load_task

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
ENVIRONMENTS = ROOT / "docs" / "environments.md"
PAGES = [README, ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES += sorted((ROOT / "results").rglob("*.md"))


def blocks(page: Path, language: str = "python") -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.+?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.integration
def test_the_code_of_the_readme_is_a_script(tmp_path: Path) -> None:
    """In a folder of its own and at smoke budget; no flag is parsed, no command is called."""
    learns, returns = blocks(README)
    assert README.read_text().partition("```")[2].startswith("python\nimport jaxnew\n")
    test = Domain.of(load_task("grid_world")).split.test
    record("grid_world", test[:60], output=tmp_path / "new.npz", budget="smoke")
    smaller = {
        "laptop": "smoke",
        "episodes=5000": "episodes=64",
        'evaluate_every": 50': 'evaluate_every": 2',
        "encoder.encode(new)": "encoder.encode(new), episodes=64",
        "range(8)": "range(1)",
    }
    script = learns + returns
    for shown, run in smaller.items():
        assert shown in script
        script = script.replace(shown, run)
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    line = r"^64 sampled episodes each; .*\n +is_success .*\n(\w+)[-\w]*  0\.\d+ \[0\.\d+, 0\.\d+\]"
    assert re.findall(line, done.stdout, re.MULTILINE) == ["test", "table"]
    rows = ast.literal_eval(done.stdout.splitlines()[-1])
    assert [row["entropy_coefficient"] for row in rows] == [0.01, 0.05]


@pytest.mark.integration
def test_the_environments_examples(capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for block in blocks(ENVIRONMENTS):
        exec(compile(block, ENVIRONMENTS.name, "exec"), {})
        printed.append(capsys.readouterr().out)
    grid_world, stacking, create = printed
    assert (grid_world, create) == ("50 (81,)\n", "(84, 84) 50\n")
    # Shape 290 bridges the cylinders (docs/shape_stacking.md), or lies on one of them.
    assert 0.9 < float(stacking) < 1.2


@pytest.mark.unit
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_the_pages_name_exists(page: Path) -> None:
    text = page.read_text()
    for file in re.findall(r"\]\((?!http)([^)#]+)(?:#[^)]*)?\)", text):
        assert (page.parent / file).exists(), file
    if page.name == "CHANGELOG.md":  # It names what is no longer there.
        return
    for module in re.findall(r"python -m ((?:experiments|envs_host|envs_mjx)[\w.]*)", text):
        if module != "experiments.NAME":
            assert (ROOT / module.replace(".", "/")).with_suffix(".py").is_file(), module
    places = r"`((?:jaxnew|experiments|envs_mjx|envs_host|examples|tests)/[\w/]*(?:\.\w+)?)`"
    for file in re.findall(places, text):
        assert (ROOT / file).exists(), file


@pytest.mark.unit
def test_every_page_is_found_from_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    assert "](docs/README.md)" in README.read_text()
    for page in sorted((ROOT / "docs").glob("*.md")):
        assert page.name == "README.md" or f"]({page.name})" in index, page.name
    results = (ROOT / "docs" / "results.md").read_text()
    for page in sorted((ROOT / "results").rglob("*.md")):
        assert f"](../{page.relative_to(ROOT)})" in results, page


@pytest.mark.unit
def test_the_readme_stays_short() -> None:
    assert len(README.read_text().splitlines()) <= 160
