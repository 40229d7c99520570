"""Two pages quote the examples word for word, and their scripts and commands run; links lead on."""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path

import pytest

from examples.kicks import PLAY
from jaxnew.embedding import Encoder
from tests.experiments.commands import ROOT, evaluation, read_json, run

DOCS = sorted(ROOT.glob("docs/**/*.md"))
PAGES = sorted(ROOT.glob("docs/your_own_*.md"))
TASK_PLACE, METHOD_PLACE = "examples.kicks:TASK", "examples.attention_policy:AttentionMethod"


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.+?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def is_quoted(block: str, source: str) -> bool:
    """Whether whole lines of the source are those of the block, all further to the right or not."""
    lines = textwrap.dedent(block)
    return any(f"\n{textwrap.indent(lines, ' ' * depth)}" in source for depth in (0, 4, 8))


def scripts(page: Path) -> list[str]:
    """Blocks that are whole scripts; all others are quoted."""
    return [block for block in blocks(page, "python") if block.startswith("import jaxnew\n")]


def commands(page: Path) -> list[list[str]]:
    """The words of every command of the page."""
    lines = "".join(blocks(page, "shell")).replace("\\\n", " ").splitlines()
    return [shlex.split(line) for line in lines]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page") / "runs"


def run_page(page: Path, runs: Path) -> str:
    """Runs the page's commands in order, at smoke budget and below `runs`; their output."""
    outputs = []
    for jaxnew, name, *flags in commands(page):
        assert jaxnew == "jaxnew"
        words = [f.replace("laptop", "smoke").replace("=runs/", f"={runs}/") for f in flags]
        words.append("--episodes=64" if name == "evaluate" else f"--runs={runs}")
        outputs.append(run(name, *words))
    return "".join(outputs)


def run_script(page: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs the page's scripts likewise."""
    text = "\n".join(scripts(page))
    text = text.replace('"laptop"', '"smoke"').replace('"test"])', '"test"], episodes=32)')
    assert text.count("episodes=32") == 1
    monkeypatch.chdir(runs.parent)
    exec(compile(text, page.name, "exec"), {})


@pytest.mark.unit
def test_every_page_is_found_from_the_front() -> None:
    """README, or the list of pages that it points to, points to each."""
    assert [page.name for page in PAGES] == ["your_own_domain.md", "your_own_policy.md"]
    front = (ROOT / "README.md").read_text()
    listed = ROOT / "docs" / "README.md"
    contents = ""
    if listed.exists():
        assert "](docs/README.md)" in front
        contents = listed.read_text()
    for page in ROOT.glob("docs/*.md"):
        if page != listed:
            is_linked = f"](docs/{page.name}" in front or f"]({page.name}" in contents
            assert is_linked, f"Neither README.md nor docs/README.md has a link to {page.name}."
    for page in PAGES:
        assert not re.findall(r"^```(?!python|shell|\n)", page.read_text(), re.MULTILINE)


@pytest.mark.unit
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_blocks_stand_in_the_examples(page: Path) -> None:
    sources = [path.read_text() for path in sorted((ROOT / "examples").glob("*.py"))]
    quoted = [block for block in blocks(page, "python") if block not in scripts(page)]
    assert len(quoted) >= 3
    for block in quoted:
        assert any(is_quoted(block, source) for source in sources), f"{page.name} quotes:\n{block}"


@pytest.mark.unit
@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_what_the_pages_name_exists(page: Path) -> None:
    for file in re.findall(r"`((?:\w+/)+[\w.]+\.(?:py|md))`", page.read_text()):
        assert (ROOT / file).is_file(), file
    for file in re.findall(r"\]\(((?!http)[^)#]+)[^)]*\)", page.read_text()):
        assert (page.parent / file).exists(), file


@pytest.mark.integration
def test_the_domain_from_recordings_to_unseen_actions(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs" / "your_own_domain.md"
    assert [words[1] for words in commands(page)] == ["collect", "embed", "train", "evaluate"]
    output = run_page(page, runs)
    assert "300 actions x 8 recordings" in output
    path = runs / "kicks" / "ours-hvae-default-smoke-31"
    assert read_json(path / "config.json")["task"] == TASK_PLACE
    result = evaluation(path, "test-best-sampled-m20")
    assert (result["num_actions"], result["num_episodes"]) == (75, 64)
    assert {"is_success", "is_off_table", "episode_length"} <= set(result["metrics"])
    # The encoder of new actions is found again as well.
    encoder = Encoder.load(runs / "kicks" / "embed-hvae-default-smoke-31")
    assert (encoder.config.task, encoder.frozen()[2].format) == (TASK_PLACE, PLAY.format)
    # And the script is the same, in this process.
    run_script(page, runs, monkeypatch)
    said = capsys.readouterr().out
    assert said.count("already complete") == 2
    assert re.search(r"32 sampled episodes each; .*\n +is_success .*\n(.+\n)*test ", said)


@pytest.mark.integration
def test_the_policy_is_found_again(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs" / "your_own_policy.md"
    assert [words[1] for words in commands(page)] == ["train", "evaluate"]
    run_page(page, runs)
    path = runs / "kicks" / "examples-attention_policy-AttentionMethod-hvae-default-smoke-31"
    config = read_json(path / "config.json")
    assert (config["task"], config["method"]) == (TASK_PLACE, METHOD_PLACE)
    result = evaluation(path, "test-best-sampled-m20")
    assert (result["num_actions"], result["num_episodes"]) == (75, 64)
    run_script(page, runs, monkeypatch)
    said = capsys.readouterr().out
    assert re.search(r"32 sampled episodes each; .*\n +is_success .*\n(.+\n)*test ", said)
