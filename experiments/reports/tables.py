"""Tables as text: CSV for programs, Markdown for readers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnew.storage.files import write_bytes_atomically


def csv_text(rows: Sequence[Mapping[str, Any]], titles: Sequence[str] = ()) -> str:
    """One line per row under the names of its fields; what is None stays empty.

    Args:
      rows: with the same fields; at least one where there are no `titles`.
      titles: in place of the fields of the first row.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(titles or rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def line(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    return [line(header), "|" + " --- |" * len(header), *map(line, rows)]


def write(out: Path, stem: str, markdown: str, rows: str) -> list[Path]:
    """`STEM.md` and `STEM.csv` in a folder, which is made if absent."""
    out.mkdir(parents=True, exist_ok=True)
    files = {out / f"{stem}.md": markdown, out / f"{stem}.csv": rows}
    for path, text in files.items():
        write_bytes_atomically(path, text.encode())
    return list(files)
