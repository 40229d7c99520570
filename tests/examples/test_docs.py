"""The pages of `docs/` quote the examples word for word, and their commands run."""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path

import pytest

from examples.kicks import PLAY
from experiments.pipeline.artifacts import load_encoder
from tests.experiments.commands import ROOT, read_json, run

PAGES = sorted(ROOT.glob("docs/*.md"))
TASK_PLACE, METHOD_PLACE = "examples.kicks:TASK", "examples.attention_policy:AttentionMethod"


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.+?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def is_quoted(block: str, source: str) -> bool:
    """Whether whole lines of the source are those of the block, all further to the right or not."""
    lines = textwrap.dedent(block)
    return any(f"\n{textwrap.indent(lines, ' ' * depth)}" in source for depth in (0, 4, 8))


def commands(page: Path) -> list[list[str]]:
    """The words of every command of the page."""
    lines = "".join(blocks(page, "shell")).replace("\\\n", " ").splitlines()
    return [shlex.split(line) for line in lines]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def run_page(page: Path, runs: Path) -> str:
    """Runs the page's commands in order, at smoke budget and below `runs`; their output."""
    outputs = []
    for python, flag, module, *flags in commands(page):
        assert (python, flag) == ("python", "-m")
        words = [f.replace("laptop", "smoke").replace("=runs/", f"={runs}/") for f in flags]
        is_evaluation = module == "experiments.evaluate"
        words.append("--episodes=64" if is_evaluation else f"--runs={runs}")
        name = module.removeprefix("experiments.")
        outputs.append(run(name, *words))
    return "".join(outputs)


@pytest.mark.unit
def test_every_page_is_known() -> None:
    """A third page needs tests of its own; README points to each."""
    assert [page.name for page in PAGES] == ["your_own_domain.md", "your_own_policy.md"]
    readme = (ROOT / "README.md").read_text()
    for page in PAGES:
        assert f"](docs/{page.name})" in readme
        assert not re.findall(r"^```(?!python|shell|\n)", page.read_text(), re.MULTILINE)


@pytest.mark.unit
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_blocks_stand_in_the_examples(page: Path) -> None:
    sources = [path.read_text() for path in sorted((ROOT / "examples").glob("*.py"))]
    quoted = blocks(page, "python")
    assert len(quoted) >= 3
    for block in quoted:
        assert any(is_quoted(block, source) for source in sources), f"{page.name} quotes:\n{block}"


@pytest.mark.unit
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_the_pages_name_exists(page: Path) -> None:
    for file in re.findall(r"`((?:\w+/)+[\w.]+\.(?:py|md))`", page.read_text()):
        assert (ROOT / file).is_file(), file
    for file in re.findall(r"\]\(((?!http)[^)#]+)\)", page.read_text()):
        assert (page.parent / file).is_file(), file


@pytest.mark.integration
def test_the_domain_from_recordings_to_unseen_actions(runs: Path) -> None:
    page = ROOT / "docs" / "your_own_domain.md"
    used = [words[2].removeprefix("experiments.") for words in commands(page)]
    assert used == ["collect", "embed", "train", "evaluate"]
    output = run_page(page, runs)
    assert "300 actions x 8 recordings" in output
    path = runs / "kicks" / "ours-hvae-default-smoke-31"
    assert read_json(path / "config.json")["task"] == TASK_PLACE
    result = read_json(path / "evaluation" / "test-best-sampled-m20.json")
    assert (result["num_actions"], result["num_episodes"]) == (75, 64)
    assert {"is_success", "is_off_table", "episode_length"} <= set(result["metrics"])
    # The encoder of new actions is found again as well.
    config, *_, play_format = load_encoder(runs / "kicks" / "embed-hvae-default-smoke-31")
    assert (config.task, play_format) == (TASK_PLACE, PLAY.format)


@pytest.mark.integration
def test_the_policy_is_found_again(runs: Path) -> None:
    page = ROOT / "docs" / "your_own_policy.md"
    used = [words[2].removeprefix("experiments.") for words in commands(page)]
    assert used == ["train", "evaluate"]
    run_page(page, runs)
    path = runs / "kicks" / "examples-attention_policy-AttentionMethod-hvae-default-smoke-31"
    config = read_json(path / "config.json")
    assert (config["task"], config["method"]) == (TASK_PLACE, METHOD_PLACE)
    result = read_json(path / "evaluation" / "test-best-sampled-m20.json")
    assert (result["num_actions"], result["num_episodes"]) == (75, 64)
