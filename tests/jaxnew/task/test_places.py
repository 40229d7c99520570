"""What is given as `package.module:NAME`, and presets by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from jaxnew.task.places import UsageError, budget_of, load_place

pytestmark = pytest.mark.unit


def test_an_object_is_found_where_it_is() -> None:
    assert load_place("jaxnew.task.places:budget_of", "thing", "") is budget_of


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("jaxnew.task.places", "is not a package.module:NAME"),
        ("jaxnew.task.places:", "is not a package.module:NAME"),
        ("../evil:NAME", "is not a package.module:NAME"),
        ("jaxnew.task.place:budget_of", "there is no module jaxnew.task.place"),
        ("jaxnwe:Task", r"there is no module jaxnwe \(it has to be importable from"),
        ("jaxnew.task.places:budgets_of", r"did you mean jaxnew\.task\.places:budget_of\?"),
    ],
)
def test_what_is_not_there_is_said(place: str, says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        load_place(place, "thing 'x'", "Things: a, b.")
    assert str(caught.value).startswith("Unknown thing 'x': ")
    assert str(caught.value).endswith("Things: a, b.")


def test_a_module_that_lacks_another_is_not_called_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_more.py").write_text("import not_installed_anywhere\nTASK = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match="not_installed_anywhere"):
        load_place("needs_more:TASK", "task", "")


def test_a_preset_is_found_by_name() -> None:
    assert budget_of({"smoke": 1, "paper": 2}, "paper", "Stage one") == 2
    with pytest.raises(UsageError, match="Stage one has no budget 'papr'; choose one of smoke, p"):
        budget_of({"smoke": 1, "paper": 2}, "papr", "Stage one")
