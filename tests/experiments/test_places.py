"""Tasks and policies of the user's own, given by place: `package.module:NAME`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.reports.jobs import embed_job, sweep_job
from experiments.reports.production import Cell, Source
from jaxnew.policy import UtilityMethod
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.methods import adapted, file_name, method_of, variant_of
from jaxnew.task.places import UsageError, trusting
from jaxnew.task.settings import recorded_task

pytestmark = pytest.mark.unit

MODULE = """
import dataclasses
from experiments.tasks.grid_world import TASK
from jaxnew.policy import UtilityMethod
from jaxnew.policy.method import MethodContext

TASK = dataclasses.replace(TASK, name="mine")
NUMBER = 3

class Policy(UtilityMethod):
    name = "mine"

    def __init__(self, context):
        super().__init__()
        self.context = context

def no_argument():
    return UtilityMethod()

def too_many(context, other):
    return UtilityMethod()

class NoPolicy:
    name = "nothing"

    def __init__(self, context):
        self.init = self.value = self.decode = None
"""


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's modules lie somewhere on Python's path."""
    (tmp_path / "someones_module.py").write_text(MODULE)
    (tmp_path / "someones_broken_module.py").write_text("import some_library_that_is_not_here\n")
    monkeypatch.syspath_prepend(tmp_path)


def domain() -> Domain:
    return Domain.of(load_task("grid_world"), None)


def test_a_task_knows_where_it_was_found() -> None:
    assert load_task("grid_world").reference == "grid_world"
    task = load_task("someones_module:TASK")
    assert (task.name, task.reference) == ("mine", "someones_module:TASK")
    assert Domain.of(task, None).folder(Path("runs")) == Path("runs/mine")


def test_a_policy_is_made_with_what_it_must_know() -> None:
    method = method_of("someones_module:Policy", domain().task, domain().split)
    assert isinstance(method, UtilityMethod)
    assert method.name == "mine"
    np.testing.assert_array_equal(method.context.train_ids, domain().split.train)
    assert method.context.sums_gaussian_entropy


def test_its_budget_is_that_of_ours() -> None:
    paper = domain().task.stage_two["paper"]
    assert adapted(paper, "someones_module:Policy", domain().task, domain().split) == paper


def test_file_names() -> None:
    assert file_name("package.module:Policy") == "package-module-Policy"
    assert file_name("nearest-neighbour") == "nearest-neighbour"


def test_commands_for_other_processes_name_the_places() -> None:
    domain = Domain.of(load_task("someones_module:TASK"), None)
    source = Source(domain, Path("runs"), "smoke", "smoke", 0, (1,), (), {})
    jobs = [
        embed_job(source, "hvae"),
        sweep_job(source, Cell("someones_module:Policy", "gt12"), (1, 2)),
    ]
    for job in jobs:
        assert "--task=someones_module:TASK" in job.command
    assert "--method=someones_module:Policy" in job.command
    (folder,) = [word for word in job.command if word.startswith("--workdir=")]
    assert folder.startswith("--workdir=runs/mine/sweep-someones_module-Policy-gt12-")


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("no_such_module:X", ["no module no_such_module"]),
        ("someones_module.deeper:X", ["no module someones_module.deeper"]),
        ("someones_module:Polcy", ["has no Polcy", "someones_module:Policy?"]),
        ("someones_module:", ["'someones_module:' is not a package.module:NAME"]),
        (":Policy", ["is not a package.module:NAME"]),
        ("someones module:Policy", ["is not a package.module:NAME"]),
        (".someones_module:Policy", ["is not a package.module:NAME"]),
    ],
)
def test_wrong_places(place: str, says: list[str]) -> None:
    for load, legal in ((load_task, "grid_world, recommender"), (variant_of, "ours, modulated")):
        with pytest.raises(UsageError) as error:
            load(place)
        for words in [*says, repr(place), legal, "give package.module:"]:
            assert words in str(error.value), error.value


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("NUMBER", "someones_module:NUMBER is 3, which cannot be called"),
        ("no_argument", "cannot be called with one argument: too many positional"),
        ("too_many", "cannot be called with one argument: missing a required argument: 'other'"),
    ],
)
def test_what_makes_no_policy(name: str, says: str) -> None:
    with pytest.raises(UsageError) as error:
        variant_of(f"someones_module:{name}")
    assert says in str(error.value)
    assert "takes a jaxnew.policy.method.MethodContext" in str(error.value)


def test_what_is_no_policy() -> None:
    says = "lacks project, distribution. A policy needs name, init, project, distribution, value, d"
    with pytest.raises(UsageError, match=says):
        method_of("someones_module:NoPolicy", domain().task, domain().split)


def test_what_is_no_task() -> None:
    with pytest.raises(UsageError, match=r"someones_module:NUMBER is 3, not a jaxnew.Task"):
        load_task("someones_module:NUMBER")


def test_a_module_that_lacks_a_library_says_so() -> None:
    """It is there: to call it missing would send the user searching in the wrong place."""
    for load in (load_task, variant_of):
        with pytest.raises(ModuleNotFoundError, match="some_library_that_is_not_here"):
            load("someones_broken_module:X")


@pytest.mark.parametrize("place", ["task", "method"])
def test_what_a_run_names_is_imported_when_it_is_trusted(
    place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """To import is to run: a module in the folder where one is may be somebody else's."""
    name = {"task": "someones_module:TASK", "method": "someones_module:Policy"}[place]
    plain = {"task": "grid_world", "method": "ours", place: name}
    monkeypatch.delitem(sys.modules, "someones_module", raising=False)
    with pytest.raises(UsageError, match=f"names {name}, which is not installed.*--trust"):
        recorded_task(plain)
    assert "someones_module" not in sys.modules
    assert capsys.readouterr().out == ""
    with trusting():
        assert recorded_task(plain).name in ("mine", "grid_world")
    assert "Importing someones_module, which the run names, from " in capsys.readouterr().out
    assert "someones_module" in sys.modules
    recorded_task(plain)  # It has run already.
    assert capsys.readouterr().out == ""


def test_installed_modules_and_those_that_the_user_names_are_trusted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "experiments.tasks.grid_world")
    assert load_task("experiments.tasks.grid_world:TASK", is_recorded=True).name == "grid_world"
    assert "Importing experiments.tasks.grid_world, which" in capsys.readouterr().out
    monkeypatch.delitem(sys.modules, "someones_module", raising=False)
    assert load_task("someones_module:TASK").name == "mine"
    assert load_task("someones_module:TASK", is_recorded=True).name == "mine"
    with pytest.raises(UsageError, match="no module no_such_module"):
        load_task("no_such_module:X", is_recorded=True)
