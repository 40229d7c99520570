"""The pages of `docs/commands` say what the commands say."""

from __future__ import annotations

import pytest

from experiments.command_pages import FOLDER, page
from experiments.main import COMMANDS

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("name", COMMANDS)
def test_the_page_is_what_help_says(name: str) -> None:
    file = FOLDER / f"{name}.md"
    assert file.exists(), f"{name} has no page; run: make docs"
    assert file.read_text() == page(name), f"{file.name} is stale; run: make docs"


def test_every_page_is_of_a_command_and_the_index_names_it() -> None:
    pages = {file.stem for file in FOLDER.glob("*.md")} - {"README"}
    assert pages == set(COMMANDS)
    index = (FOLDER / "README.md").read_text()
    assert [name for name in COMMANDS if f"[{name}]({name}.md)" not in index] == []
