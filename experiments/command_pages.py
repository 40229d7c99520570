"""Writes the pages of `docs/commands` from what each command says with `--help`.

python -m experiments.command_pages
"""

from __future__ import annotations

import importlib
from pathlib import Path

from experiments.main import COMMANDS

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "commands"


def page(name: str) -> str:
    """The page of a command, in Markdown."""
    text = importlib.import_module(f"experiments.{name}").ARGUMENTS.help_text()
    return f"# {name}\n\nWhat `jaxnew {name} --help` says:\n\n```text\n{text}\n```\n"


def main() -> None:
    for name in COMMANDS:
        (FOLDER / f"{name}.md").write_text(page(name))


if __name__ == "__main__":
    main()
