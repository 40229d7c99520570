"""The notebook runs as it stands, and shows a run of its default budget."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"


def printed(notebook: nbformat.NotebookNode) -> str:
    """All that its cells print."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.get("text", "") for output in outputs)


def pictures(notebook: nbformat.NotebookNode) -> list[int]:
    """Numbers of the cells that show a picture."""
    return [
        number
        for number, cell in enumerate(notebook.cells)
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]


@pytest.mark.unit
def test_the_notebook_is_kept_with_what_it_shows() -> None:
    assert NOTEBOOK.stat().st_size < 400_000
    text = re.sub(r'"image/png": ".*"', "", NOTEBOOK.read_text())
    for folder in ("/home", "/root", "/tmp", "/work", "/Users", "site-packages"):
        assert folder not in text
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error"]
    assert len(pictures(notebook)) == 3
    assert "500 updates" in printed(notebook)
    assert "(5000 episodes)" in printed(notebook)


@pytest.mark.integration
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder of its own, at smoke budget; a cell that raises ends the test."""
    monkeypatch.setenv("JAXNEW_QUICKSTART_BUDGET", "smoke")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "kernel"))
    shown = nbformat.read(NOTEBOOK, as_version=4)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client = NotebookClient(
        notebook,
        timeout=400,
        coalesce_streams=True,
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.execute()
    assert pictures(notebook) == pictures(shown)
    assert "update 4 of 4" in printed(notebook)
    assert printed(notebook).count("(128 episodes)") == 3
    assert "4 members" in printed(notebook)
