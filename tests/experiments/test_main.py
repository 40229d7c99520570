"""The command `jaxnew`, and the flags of each command."""

from __future__ import annotations

import importlib
import re
import signal
from typing import Any

import pytest
from absl import flags

from experiments import main
from experiments.main import COMMANDS

pytestmark = pytest.mark.unit


def command(name: str) -> Any:
    return importlib.import_module(f"experiments.{name}")


def listed(text: str) -> set[str]:
    """Names of the flags in a help text, absl's in its own form."""
    return set(re.findall(r"^  (?:-\w,)?--(?:\[no\])?(\w+)", text, re.MULTILINE))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr("sys.argv", ["jaxnew", *arguments])
    monkeypatch.setattr("sys.path", [*main.sys.path])  # A command appends to it.
    main.main()


def test_one_process_imports_every_command() -> None:
    """So none defines a flag that another has, or one for all."""
    for name in COMMANDS:
        assert callable(command(name).main)
        assert "debug_nans" in command(name).ARGUMENTS._values
    of_all = flags.FLAGS.flags_by_module_dict()
    ours = ("experiments", "jaxnew", "envs_host", "envs_mjx", "__main__")
    assert [module for module in of_all if module.startswith(ours)] == []


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_the_flags_of_the_project(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = set(command(name).ARGUMENTS._values)
    run(monkeypatch, name, "--help")
    text = capsys.readouterr().out
    assert text.startswith(main.summary(name))
    assert listed(text) == ours
    run(monkeypatch, name, "--helpfull")
    assert listed(capsys.readouterr().out) >= ours | {"verbosity", "logtostderr", "pdb"}


def test_a_child_ends_with_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[signal.Signals] = []
    monkeypatch.setattr(main, "signal_at_parents_end", sent.append)
    monkeypatch.setattr("os.environ", main.child("train")[1])
    with pytest.raises(SystemExit, match="which started this one, is gone"):
        run(monkeypatch)  # This process did not start itself.
    assert sent == [signal.SIGTERM]
    run(monkeypatch)  # Its own children are not told.
    assert sent == [signal.SIGTERM]


@pytest.mark.parametrize("words", [(), ("--help",), ("-h",), ("help",)])
def test_jaxnew_lists_its_commands(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, *words)
    lines = capsys.readouterr().out.splitlines()
    for name in COMMANDS:
        (line,) = [line for line in lines if line.startswith(f"  {name} ")]
        assert line.removeprefix(f"  {name}").strip() == main.summary(name)
        assert len(main.summary(name)) > 20


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("trian",), "Unknown command 'trian'; there are collect, embed, train"),
        (("evaluate", "--seed=1"), "UsageError: Unknown command line flag 'seed'"),
        (("train", "seed=1"), "UsageError: Unknown argument 'seed=1'"),
        (("train", "--workers=-1"), "UsageError: flag --workers=-1"),
        (("evaluate", "--run=x", "--checkpoint=last"), "UsageError: flag --checkpoint=last"),
    ],
)
def test_what_is_not_there_is_refused(
    words: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit) as end:
        run(monkeypatch, *words)
    assert str(end.value).startswith(message)


def test_help_says_what_may_be_given() -> None:
    evaluate, sweep = (command(name).ARGUMENTS.help_text() for name in ("evaluate", "sweep"))
    assert "  --checkpoint\n      best, latest. Which checkpoint;" in evaluate
    assert "  --episodes\n      Episodes per set. Default: 5000.\n" in evaluate
    assert (
        "  --sets\n      Parts of the split: train, validation, test, all. Default: test."
        in evaluate
    )
    assert "  --vary\n      hyperparameter=value,value,... Repeatable.\n" in sweep


def test_a_second_command_line_starts_from_the_defaults() -> None:
    arguments = command("train").ARGUMENTS
    arguments.parse(["--seed=7", "--set=num_updates=1", "--set=seed=2"])
    assert (arguments.seed, len(arguments.set), arguments.is_given("seed")) == (7, 2, True)
    arguments.parse(["--stderrthreshold=fatal"])  # One of absl's, which are legal as well.
    assert (arguments.seed, arguments.set, arguments.is_given("seed")) == (31, [], False)
