"""Universes, splits and lists of actions (docs/method.md, "Splits and action sets")."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs_mjx.grid_world import GridWorld, skill_universe
from jaxnew import observations
from jaxnew.actions import (
    SPLIT_NAMES,
    ActionSplit,
    ActionUniverse,
    SplitMismatch,
    checked_ids,
    content_hash,
    load_ids,
    mixture_ids,
    random_halves_split,
)
from jaxnew.environment import FixedActionSet
from jaxnew.representation.table import RepresentationTable
from jaxnew.sampling import ActionPool, Actions

PARTS = (*SPLIT_NAMES, "always_available")


def universe_of(content: np.ndarray, name: str = "toy") -> ActionUniverse:
    n = len(content)
    return ActionUniverse(
        name=name,
        class_labels=np.arange(n, dtype=np.int32) % 2,
        class_names=("even", "odd"),
        primary_parameter=np.arange(n, dtype=np.float64),
        action_names=tuple(f"action {i}" for i in range(n)),
        content=np.asarray(content),
        engineered={"id": np.arange(n, dtype=np.float32)[:, None]},
    )


UNIVERSE = universe_of(np.arange(20))


def split_of(universe: ActionUniverse = UNIVERSE, **changes) -> ActionSplit:
    parts = {"train": [0, 1, 2], "validation": [3, 4], "test": [5, 6], **changes}
    arrays = {
        name: value if name in ("seed", "universe_hash") else np.array(value, np.int32)
        for name, value in parts.items()
    }
    return ActionSplit(**{"universe_hash": universe.hash, **arrays})


# Universes.


@pytest.mark.unit
@pytest.mark.parametrize("attribute", ["class_labels", "primary_parameter", "action_names"])
def test_universe_needs_one_row_per_action(attribute: str) -> None:
    with pytest.raises(ValueError, match=rf"{attribute} has 19 rows, but content has 20"):
        replace(UNIVERSE, **{attribute: getattr(UNIVERSE, attribute)[:-1]})


@pytest.mark.unit
def test_universe_needs_one_engineered_row_per_action() -> None:
    with pytest.raises(ValueError, match=r"engineered\['gt'\] has 21 rows.* 20"):
        replace(UNIVERSE, engineered={"gt": np.zeros((21, 3))})


@pytest.mark.unit
@pytest.mark.parametrize("label", [-1, 2])
def test_universe_needs_a_name_for_every_class(label: int) -> None:
    labels = UNIVERSE.class_labels.copy()
    labels[7] = label
    with pytest.raises(ValueError, match=rf"{label}.*2 class names"):
        replace(UNIVERSE, class_labels=labels)


@pytest.mark.unit
def test_universe_hash_is_name_and_content_only() -> None:
    content = np.arange(20)
    assert universe_of(content).hash == UNIVERSE.hash
    assert universe_of(content, name="toy-v1").hash != UNIVERSE.hash
    changed = content.copy()
    changed[19] = 99
    assert universe_of(changed).hash != UNIVERSE.hash
    assert universe_of(content[::-1]).hash != UNIVERSE.hash
    assert universe_of(content[:, None]).hash != UNIVERSE.hash
    # A better name for an action does not make it another action.
    renamed = replace(UNIVERSE, action_names=tuple("abcdefghijklmnopqrst"))
    assert renamed.hash == UNIVERSE.hash


@pytest.mark.unit
def test_content_hash_depends_on_type_and_shape_but_not_on_memory_order() -> None:
    array = np.arange(6, dtype=np.int32).reshape(2, 3)
    assert content_hash(array) == content_hash(np.asfortranarray(array))
    assert content_hash(array) == content_hash(array.astype(">i4"))
    others = [array.reshape(3, 2), array.astype(np.int64), array.T, array + 1]
    assert len({content_hash(x) for x in (array, *others)}) == 5
    # The boundary between parts matters.
    assert content_hash("ab", "c") != content_hash("a", "bc")
    assert content_hash(array[0], array[1]) != content_hash(array.reshape(-1))


@pytest.mark.unit
def test_action_hashes_are_equal_where_rows_are_equal() -> None:
    keys = universe_of(np.array([[1, 2], [2, 1], [1, 2]])).action_hashes
    assert keys[0] == keys[2]
    assert keys[0] != keys[1]


@pytest.mark.unit
def test_zero_and_minus_zero_are_the_same_content() -> None:
    """`content` rows that compare equal are one action; -0.0 appears wherever 0 is negated."""
    keys = universe_of(np.array([[0.0, 1.0], [-0.0, 1.0]])).action_hashes
    assert keys[0] == keys[1]


# The random split.


@pytest.mark.unit
@pytest.mark.parametrize(
    ("num_actions", "sizes"),
    # Grid World, Recommender, Shape Stacking.
    [(1024, (512, 256, 256)), (10_000, (5000, 2500, 2500)), (810, (405, 202, 203))],
)
def test_split_sizes_are_those_of_the_paper(num_actions: int, sizes: tuple[int, ...]) -> None:
    split = random_halves_split(universe_of(np.arange(num_actions)), seed=0)
    assert tuple(len(split.ids(name)) for name in SPLIT_NAMES) == sizes
    assert split.ids("all").tolist() == list(range(num_actions))


@pytest.mark.unit
def test_grid_world_split_is_random_and_reproducible() -> None:
    universe = skill_universe()
    first, again, other = (random_halves_split(universe, seed) for seed in (0, 0, 1))
    assert first.hash == again.hash
    assert all(np.array_equal(first.ids(name), again.ids(name)) for name in SPLIT_NAMES)
    assert first.seed == 0
    # Two random halves of 1024 share 256 members, standard deviation
    # sqrt(512 * 1/2 * 1/2 * 512/1023) = 8; five of them on either side.
    assert abs(len(np.intersect1d(first.train, other.train)) - 256) < 40
    # Not a block of ids: the mean id of a random half is 511.5 +- 9.2.
    assert abs(first.train.mean() - 511.5) < 46
    assert first.hash != other.hash


@pytest.mark.property
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    content=st.lists(st.integers(0, 30), min_size=8, max_size=80).filter(
        lambda values: len(set(values)) >= 4
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_split_is_a_partition_disjoint_by_content(content: list[int], seed: int) -> None:
    universe = universe_of(np.array(content, np.uint8)[:, None])
    split = random_halves_split(universe, seed)
    ids = [split.ids(name) for name in SPLIT_NAMES]
    assert np.array_equal(np.sort(np.concatenate(ids)), np.arange(len(content)))
    contents = [{content[i] for i in part} for part in ids]
    assert not contents[0] & contents[1]
    assert not contents[0] & contents[2]
    assert not contents[1] & contents[2]
    # 2:1:1 in distinct actions: floor(k/2), floor(k/4) and the rest.
    k = len(set(content))
    assert [len(c) for c in contents] == [k // 2, k // 4, k - k // 2 - k // 4]


@pytest.mark.unit
def test_every_pair_of_actions_is_separated_about_equally_often() -> None:
    """Over many seeds each action is in train half of the time and in test a quarter."""
    universe = universe_of(np.arange(16))
    in_train, in_test = np.zeros(16), np.zeros(16)
    for seed in range(400):
        split = random_halves_split(universe, seed)
        in_train[split.train] += 1
        in_test[split.test] += 1
    # Binomial(400, 1/2) has deviation 10, Binomial(400, 1/4) 8.7; bounds at 4.5 deviations.
    assert np.abs(in_train - 200).max() < 45
    assert np.abs(in_test - 100).max() < 39


# Splits.


@pytest.mark.unit
def test_split_sorts_its_ids_and_hashes_membership() -> None:
    split = split_of(train=[2, 0, 1], test=[6, 5])
    assert split.train.tolist() == [0, 1, 2]
    assert split.train.dtype == np.int32
    assert split.hash == split_of().hash
    changes = [
        {"train": [0, 1]},
        {"train": [0, 1, 7]},
        {"validation": [3]},
        {"test": [5]},
        {"train": [0, 1], "validation": [2, 3, 4]},
        {"validation": [5, 6], "test": [3, 4]},
        {"always_available": [9]},
        {"universe_hash": "other"},
    ]
    assert len({split.hash, *(split_of(**change).hash for change in changes)}) == 1 + len(changes)
    # The seed says where a split came from, not what it is.
    assert split_of(seed=3).hash == split.hash


@pytest.mark.unit
@pytest.mark.parametrize(
    "changes",
    [
        {"test": [2, 6]},
        {"validation": [3, 3]},
        {"always_available": [0]},
        {"always_available": [8, 8]},
    ],
)
def test_split_refuses_an_id_in_two_places(changes: dict) -> None:
    with pytest.raises(ValueError, match=r"Action \d is in both \w+ and|stands there twice"):
        split_of(**changes)


@pytest.mark.unit
@pytest.mark.parametrize("changes", [{"train": []}, {"validation": []}, {"test": [[5, 6]]}])
def test_split_refuses_empty_and_nested_parts(changes: dict) -> None:
    with pytest.raises(ValueError, match=rf"{next(iter(changes))}: must be .* of shape \("):
        split_of(**changes)


@pytest.mark.unit
def test_ids_by_name() -> None:
    split = split_of(always_available=[9])
    assert [split.ids(name).tolist() for name in SPLIT_NAMES] == [[0, 1, 2], [3, 4], [5, 6]]
    assert split.ids("all").tolist() == [0, 1, 2, 3, 4, 5, 6]
    with pytest.raises(ValueError, match=r"'tset'.*train.*validation.*test.*all"):
        split.ids("tset")


@pytest.mark.unit
def test_check_accepts_a_sound_split() -> None:
    split = split_of(always_available=[9])
    assert split.check(UNIVERSE) is None


@pytest.mark.unit
def test_check_names_both_universes() -> None:
    other = universe_of(np.arange(20) + 1, name="toy-v1")
    with pytest.raises(SplitMismatch, match=rf"{UNIVERSE.hash}.*toy-v1 is {other.hash}"):
        split_of().check(other)
    assert issubclass(SplitMismatch, ValueError)


@pytest.mark.unit
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("action_id", [-1, 20])
def test_check_refuses_ids_that_do_not_exist(part: str, action_id: int) -> None:
    """JAX clamps out-of-range reads silently, so this is the only place that notices."""
    with pytest.raises(ValueError, match=rf"{part}.*{action_id}.*0\.\.(19|2147483647)"):
        split_of(**{part: [10, action_id]}).check(UNIVERSE)


@pytest.mark.unit
def test_check_refuses_the_same_action_under_two_ids() -> None:
    content = np.arange(20)
    content[6] = content[1]
    universe = universe_of(content)
    with pytest.raises(ValueError, match=r"Action 6 \(action 6\) of test .* of train"):
        split_of(universe).check(universe)
    # Twice on the same side is harmless.
    content = np.arange(20)
    content[2] = content[1]
    twins = universe_of(content)
    assert split_of(twins).check(twins) is None


# Files.


@pytest.mark.unit
def test_split_survives_its_file(tmp_path: Path) -> None:
    split = random_halves_split(skill_universe(), seed=11)
    split.save(tmp_path / "split.json")
    loaded = ActionSplit.load(tmp_path / "split.json")
    assert loaded.hash == split.hash
    assert loaded.seed == 11
    assert loaded.universe_hash == split.universe_hash
    for name in PARTS:
        assert np.array_equal(getattr(loaded, name), getattr(split, name))
        assert getattr(loaded, name).dtype == np.int32


@pytest.mark.unit
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("train", [0, 1]),
        ("train", [0, 1, 7]),
        ("test", [5, 8]),
        ("always_available", [9]),
        ("universe_hash", "0" * 16),
        ("hash", "0" * 16),
    ],
)
def test_an_edited_file_is_refused(tmp_path: Path, field: str, value: object) -> None:
    path = tmp_path / "split.json"
    split_of().save(path)
    record = json.loads(path.read_text())
    assert record[field] != value
    path.write_text(json.dumps({**record, field: value}))
    with pytest.raises(SplitMismatch, match=r"split\.json was edited .*[0-9a-f]{16}"):
        ActionSplit.load(path)


@pytest.mark.property
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    ids=st.lists(st.integers(0, 500), min_size=5, max_size=60, unique=True),
    seed=st.none() | st.integers(0, 2**63),
    data=st.data(),
)
def test_any_split_survives_its_file(
    tmp_path_factory: pytest.TempPathFactory, ids: list[int], seed: int | None, data: st.DataObject
) -> None:
    last = len(ids)
    cuts = data.draw(
        st.lists(st.integers(1, last), min_size=3, max_size=3, unique=True).map(sorted)
    )
    parts = [ids[start:end] for start, end in zip([0, *cuts], [*cuts, last], strict=True)]
    train, validation, test, always_available = map(np.array, parts)
    split = ActionSplit(train, validation, test, "u" * 16, seed, always_available)
    path = tmp_path_factory.mktemp("split") / "split.json"
    split.save(path)
    loaded = ActionSplit.load(path)
    assert loaded.hash == split.hash
    assert loaded.seed == seed
    assert [getattr(loaded, name).tolist() for name in PARTS] == [sorted(part) for part in parts]


# Mixtures of seen and unseen actions (docs/method.md, "Difficulty analyses").


@pytest.mark.unit
@pytest.mark.parametrize(
    ("ratio", "num_unseen", "num_seen"),
    # |U| = 813 (squared distance > 3.0) and 762 train tools: floor(x |U|) and floor((1 - x) 762).
    [
        (0.0, 0, 762),
        (0.2, 162, 609),
        (0.4, 325, 457),
        (0.6, 487, 304),
        (0.8, 650, 152),
        (1.0, 813, 0),
    ],
)
def test_mixture_takes_the_first_of_both(ratio: float, num_unseen: int, num_seen: int) -> None:
    seen, unseen = np.arange(762) * 2, np.arange(813) * 2 + 1
    pool = mixture_ids(seen, unseen, ratio)
    expected = np.concatenate([unseen[:num_unseen], seen[:num_seen]])
    assert np.array_equal(pool, expected)
    assert pool.dtype == np.int32


@pytest.mark.unit
@pytest.mark.parametrize("ratio", [-0.1, 1.1, float("nan")])
def test_mixture_refuses_other_ratios(ratio: float) -> None:
    with pytest.raises(ValueError, match=rf"unseen_ratio={ratio} is not in \[0, 1\]"):
        mixture_ids(np.arange(4), np.arange(4), ratio)


# Lists of ids in files.


@pytest.mark.unit
@pytest.mark.parametrize("text", ["3\n1\n19\n", "3, 1,19", " 3 1\t19 ", "3,\n1,\n\n19"])
def test_ids_are_read_in_order_from_any_list(tmp_path: Path, text: str) -> None:
    path = tmp_path / "ids.txt"
    path.write_text(text)
    ids = load_ids(path, UNIVERSE)
    assert ids.tolist() == [3, 1, 19]
    assert ids.dtype == np.int32


@pytest.mark.unit
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"ids\.txt holds no action id"),
        (" ,\n", r"ids\.txt holds no action id"),
        ("1 two 3", r"ids\.txt .*integer.*'two'"),
        ("1 2.0", r"ids\.txt .*integer.*'2\.0'"),
        ("1 20", r"ids\.txt, ids of toy: action 20 is not in 0\.\.19"),
        ("-1", r"ids\.txt, ids of toy: action -1 is not in 0\.\.19"),
        # Larger than an int32.
        ("99999999999", r"ids\.txt, ids of toy: action 99999999999 is not in 0\.\.19"),
        ("4 7 4", r"ids\.txt, .* action 4 stands there twice; list each id once"),
    ],
)
def test_bad_lists_are_refused_with_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "ids.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_ids(path, UNIVERSE)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([1.0, 2.0], "must be a non-empty list of integers, got float64"),
        ([True, False], "must be a non-empty list of integers, got bool"),
        (["1"], "must be a non-empty list of integers, got <U1"),
        ([[1, 2]], r"must be a non-empty list of integers, got int64 of shape \(1, 2\)"),
        ([-1], r"action -1 is not in 0\.\."),
        ([2**33], r"action 8589934592 is not in 0\.\."),
        ([4, 7, 4], "action 4 stands there twice"),
    ],
)
def test_what_is_no_list_of_ids_is_refused_wherever_python_takes_one(
    ids: list[object], message: str
) -> None:
    """Float ids were cut to integers, and true and false were actions 1 and 0."""
    takes: list[Callable[[np.ndarray], object]] = [
        checked_ids,
        lambda ids: ActionSplit(ids, np.array([18]), np.array([19]), UNIVERSE.hash),
        lambda ids: Actions.of(np.zeros((20, 2), np.float32), ids, 1),
        lambda ids: ActionPool.of(ids, capacity=20),
        lambda ids: FixedActionSet(GridWorld(), ids),
        lambda ids: RepresentationTable(np.zeros((len(ids), 2), np.float32), ids),
        lambda ids: observations.checked_ids(ids, None, "mine.npz"),
    ]
    for take in takes:
        is_matrix = np.ndim(ids) == 2 and take == takes[5]  # Of another length than the vectors.
        with pytest.raises(ValueError, match="one per row" if is_matrix else message):
            take(np.array(ids))


@pytest.mark.unit
def test_text_files_have_one_encoding(tmp_path: Path) -> None:
    """Some editors write a mark before it, or another one; that one is refused by its name."""
    path = tmp_path / "ids.txt"
    path.write_bytes(b"\xef\xbb\xbf1 2")
    assert load_ids(path, UNIVERSE).tolist() == [1, 2]
    for encoding in ("utf-16", "utf-16-be", "latin-1"):
        path.write_bytes("1 2 ü".encode(encoding))
        with pytest.raises(
            ValueError, match=r"ids\.txt (is no UTF-8 text .* save it as UTF-8|must)"
        ):
            load_ids(path, UNIVERSE)
