"""Configuration trees: round trip, typed edits, and errors that name the field."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnew.storage.config import ConfigError, differences, from_dict, set_paths, to_dict, vary


@dataclass(frozen=True)
class Optimizer:
    learning_rate: float = 1e-3
    decay: float | None = None
    kind: Literal["adam", "sgd"] = "adam"


@dataclass(frozen=True)
class Ppo:
    num_envs: int = 64
    num_minibatches: int = 8
    is_clipped: bool = True
    layers: tuple[int, ...] = (64, 64)
    window: tuple[int, float] = (1, 0.5)
    optimizer: Optimizer = field(default_factory=Optimizer)

    def __post_init__(self) -> None:
        if self.num_envs % self.num_minibatches:
            raise ValueError(f"num_envs={self.num_envs} is not divisible.")


@dataclass(frozen=True)
class Run:
    name: str = "run"
    note: str | None = None
    seed: int = 0
    ppo: Ppo = field(default_factory=Ppo)
    probe: Optimizer | None = None


def optimizers() -> st.SearchStrategy[Optimizer]:
    numbers = st.floats(allow_nan=False, allow_infinity=False)
    return st.builds(Optimizer, numbers, st.none() | numbers, st.sampled_from(["adam", "sgd"]))


def runs() -> st.SearchStrategy[Run]:
    numbers = st.floats(allow_nan=False, allow_infinity=False)
    ppo = st.builds(
        Ppo,
        num_envs=st.integers(-5, 5).map(lambda n: 8 * n),
        num_minibatches=st.sampled_from([1, 2, 4, 8]),
        is_clipped=st.booleans(),
        layers=st.lists(st.integers(), max_size=3).map(tuple),
        window=st.tuples(st.integers(), numbers),
        optimizer=optimizers(),
    )
    return st.builds(
        Run,
        name=st.text(),
        note=st.none() | st.text(),
        seed=st.integers(),
        ppo=ppo,
        probe=st.none() | optimizers(),
    )


@pytest.mark.property
@settings(max_examples=100, deadline=None)
@given(runs())
def test_round_trip_through_json(run: Run) -> None:
    restored = from_dict(Run, json.loads(json.dumps(to_dict(run))))
    assert restored == run
    assert differences(run, restored) == []


@pytest.mark.property
@settings(max_examples=100, deadline=None)
@given(runs(), st.integers(), st.floats(allow_nan=False, allow_infinity=False))
def test_an_edit_changes_one_field_only(run: Run, seed: int, rate: float) -> None:
    edited = set_paths(run, [f"seed={seed}", f"ppo.optimizer.learning_rate={rate!r}"])
    assert edited.seed == seed
    assert edited.ppo.optimizer.learning_rate == rate
    changed = {path for path, _, _ in differences(run, edited)}
    assert changed <= {"seed", "ppo.optimizer.learning_rate"}


@pytest.mark.unit
@pytest.mark.parametrize(
    ("assignment", "path", "value"),
    [
        ("seed=-3", "seed", -3),
        ("name=a=b c", "name", "a=b c"),
        ("note=none", "note", None),
        ("note=text", "note", "text"),
        ("ppo.is_clipped=False", "ppo.is_clipped", False),
        ("ppo.is_clipped=1", "ppo.is_clipped", True),
        ("ppo.layers=1,2,3", "ppo.layers", (1, 2, 3)),
        ("ppo.layers=(5,)", "ppo.layers", (5,)),
        ("ppo.layers=", "ppo.layers", ()),
        ("ppo.window=2,3", "ppo.window", (2, 3.0)),
        ("ppo.optimizer.learning_rate=3", "ppo.optimizer.learning_rate", 3.0),
        ("ppo.optimizer.decay=1e-2", "ppo.optimizer.decay", 0.01),
        ("ppo.optimizer.decay=None", "ppo.optimizer.decay", None),
        ("ppo.optimizer.kind=sgd", "ppo.optimizer.kind", "sgd"),
        ("probe=none", "probe", None),
    ],
)
def test_text_is_read_by_type(assignment: str, path: str, value: Any) -> None:
    found: Any = set_paths(Run(), [assignment])
    for name in path.split("."):
        found = getattr(found, name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.property
@settings(max_examples=100, deadline=None)
@given(runs(), runs())
def test_values_and_their_texts_are_set_alike(run: Run, other: Run) -> None:
    """Every field of a group at once; texts are stripped, as on a command line."""
    values = {
        f"ppo.optimizer.{field.name}": getattr(other.ppo.optimizer, field.name)
        for field in dataclasses.fields(Optimizer)
    }
    values |= {"seed": other.seed, "ppo.layers": other.ppo.layers, "ppo.window": other.ppo.window}
    texts = [f" {path} = {str(value).strip('()')}" for path, value in values.items()]
    edited = set_paths(run, values)
    assert edited == set_paths(run, texts)
    assert edited.ppo.optimizer == other.ppo.optimizer
    by_name = {path.replace(".", "__"): value for path, value in values.items()}
    assert vary(run, by_name) == edited
    assert edited.name == run.name


@pytest.mark.unit
@pytest.mark.parametrize(
    ("assignment", "parts"),
    [
        ("ppo.num_env=64", ["ppo.num_env does not exist", "Did you mean ppo.num_envs?"]),
        ("ppo.num_env=64", ["ppo.num_envs, ppo.num_minibatches"]),
        ("learning_rate=1", ["Did you mean ppo.optimizer.learning_rate?", "name, note, seed"]),
        ("optimizer.kind=sgd", ["Did you mean ppo.optimizer.kind?"]),
        ("zzz=1", ["zzz does not exist"]),
        ("seed.x=1", ["seed is not a group"]),
        ("ppo=1", ["ppo is a group of fields", "ppo.num_envs"]),
        ("probe.kind=sgd", ["probe is None"]),
        ("seed=1.5", ["seed must be int", "'1.5'"]),
        ("seed=true", ["seed must be int"]),
        ("ppo.is_clipped=2", ["ppo.is_clipped must be bool"]),
        ("ppo.layers=1,a", ["ppo.layers must be int", "'a'"]),
        ("ppo.window=1", ["ppo.window must have 2 elements, got 1"]),
        ("ppo.optimizer.learning_rate=fast", ["ppo.optimizer.learning_rate must be float"]),
        ("ppo.optimizer.learning_rate=inf", ["must be a finite float"]),
        ("ppo.optimizer.kind=lion", ["'adam', 'sgd'", "'lion'"]),
        ("ppo.num_envs=100", ["ppo.num_envs=100", "ppo: num_envs=100 is not divisible."]),
        ("seed", ["must look like path.to.field=value"]),
    ],
)
def test_wrong_edits_say_what_is_legal(assignment: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        set_paths(Run(), [assignment])
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"seed": 1.5}, "seed must be int, got 1.5 (float)"),
        ({"seed": True}, "seed must be int, got True (bool)"),
        ({"ppo.layers": 3}, "ppo.layers must be tuple[int, ...], got 3"),
        ({"ppo.is_clipped": 1}, "ppo.is_clipped must be bool, got 1"),
        ({"ppo": {"num_envs": 8}}, "ppo is a group of fields"),
        ({"ppo.num_env": 8}, "Did you mean ppo.num_envs?"),
    ],
)
def test_values_of_another_type_are_refused(changes: dict[str, Any], text: str) -> None:
    for edit in (lambda: set_paths(Run(), changes), lambda: vary(Run(), changes)):
        with pytest.raises(ConfigError) as caught:
            edit()
        assert text in str(caught.value)


@pytest.mark.unit
def test_fields_that_are_legal_only_together_are_set_together() -> None:
    edited = set_paths(Run(), ["ppo.num_envs=100", "ppo.num_minibatches=10"])
    assert (edited.ppo.num_envs, edited.ppo.num_minibatches) == (100, 10)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda d: d["ppo"].pop("layers"), ["ppo.layers is missing"]),
        (lambda d: d["ppo"].update(num_env=1), ["ppo.num_env does not exist", "num_envs?"]),
        (lambda d: d.update(seed=1.0), ["seed must be int, got 1.0 (float)"]),
        (lambda d: d.update(seed=True), ["seed must be int, got True (bool)"]),
        (lambda d: d["ppo"]["optimizer"].update(learning_rate=True), ["must be float"]),
        (lambda d: d["ppo"].update(layers=[1, "2"]), ["ppo.layers[1] must be int, got '2'"]),
        (lambda d: d.update(ppo=3), ["ppo must be Ppo, got 3"]),
        (lambda d: d.update(probe={"kind": "sgd"}), ["probe.learning_rate, probe.decay"]),
        (lambda d: d["ppo"].update(num_envs=9), ["ppo: num_envs=9 is not divisible."]),
    ],
)
def test_damaged_dictionaries_are_refused_with_the_path(change: Any, parts: list[str]) -> None:
    plain = to_dict(Run())
    change(plain)
    with pytest.raises(ConfigError) as caught:
        from_dict(Run, plain)
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.unit
def test_ints_become_floats_where_a_float_is_asked_for() -> None:
    plain = to_dict(dataclasses.replace(Run(), probe=Optimizer(learning_rate=1)))
    assert type(plain["probe"]["learning_rate"]) is float


@pytest.mark.unit
def test_a_wrongly_typed_or_infinite_value_has_no_plain_form() -> None:
    with pytest.raises(ConfigError, match="seed must be int"):
        to_dict(Run(seed="3"))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="must be a finite float"):
        to_dict(Run(probe=Optimizer(learning_rate=float("inf"))))


@pytest.mark.unit
def test_unsupported_annotations_are_the_programmers_mistake() -> None:
    bad = dataclasses.make_dataclass("Bad", [("names", list)], frozen=True)
    with pytest.raises(TypeError, match="names is annotated list"):
        from_dict(bad, {"names": [1]})


@pytest.mark.unit
def test_differences_list_path_and_both_values() -> None:
    old, new = Run(), set_paths(Run(), ["seed=1", "ppo.layers=3"])
    assert differences(old, new) == [("seed", 0, 1), ("ppo.layers", [64, 64], [3])]
    assert differences(to_dict(old), new) == differences(old, new)
    (only,) = differences({"a": 1}, {"a": 1, "b": 2})
    assert (only[0], repr(only[1]), only[2]) == ("b", "(absent)", 2)
    assert differences({"a": 1}, {"a": True}) == [("a", 1, True)]


@pytest.mark.unit
def test_of_lists_of_configurations_the_values_that_differ_are_told() -> None:
    def members(seeds: list[int], rates: list[float], layers: int) -> dict[str, Any]:
        group = {"size": layers, "none": None}
        listed = [{"seed": s, "ppo": {"rate": r, "net": group}} for r in rates for s in seeds]
        return {"members": listed}

    old = members([1, 2], [0.5, 0.1], 3)
    assert differences(old, members([1, 2], [0.5, 0.1], 3)) == []
    assert differences(old, members([1, 2, 4], [0.5, 0.1], 5)) == [
        ("members.seed", [1, 2], [1, 2, 4]),
        ("members.ppo.net.size", 3, 5),
    ]
    one, two, three, four = old["members"]
    ((path, *_),) = differences(old, {"members": [one, three, two, four]})
    assert path == "members"
