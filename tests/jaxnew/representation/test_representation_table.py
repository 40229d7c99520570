"""The table on disk, and what it refuses."""

import numpy as np
import pytest

from jaxnew.actions import ActionSplit, ActionUniverse, SplitMismatch
from jaxnew.representation.table import RepresentationTable, engineered_table


def make_universe(name="Toy-v0", num_actions=6):
    return ActionUniverse(
        name=name,
        class_labels=np.zeros(num_actions, np.int32),
        class_names=("only",),
        primary_parameter=np.arange(num_actions, dtype=np.float64),
        action_names=tuple(str(i) for i in range(num_actions)),
        content=np.arange(num_actions)[:, None],
        engineered={"truth": np.arange(2.0 * num_actions).reshape(num_actions, 2)},
    )


def make_split(universe, train=(0, 1, 2)):
    rest = [i for i in range(universe.num_actions) if i not in train]
    return ActionSplit(
        train=np.array(train),
        validation=np.array(rest[:1]),
        test=np.array(rest[1:]),
        universe_hash=universe.hash,
    )


UNIVERSE = make_universe()
SPLIT = make_split(UNIVERSE)


def make_table(**changes):
    rng = np.random.default_rng(0)
    fields = {
        "vectors": rng.normal(size=(6, 3)),
        "ids": np.arange(6),
        "universe_hash": UNIVERSE.hash,
        "split_hash": SPLIT.hash,
        "source": "hvae:xy",
    }
    return RepresentationTable(**{**fields, **changes})


@pytest.mark.unit
def test_save_and_load_round_trip(tmp_path):
    table = make_table()
    table.save(tmp_path / "table.npz")
    loaded = RepresentationTable.load(tmp_path / "table.npz")
    np.testing.assert_array_equal(loaded.vectors, table.vectors)
    np.testing.assert_array_equal(loaded.ids, table.ids)
    assert loaded.vectors.dtype == np.float32
    assert loaded.ids.dtype == np.int32
    assert (loaded.universe_hash, loaded.split_hash) == (UNIVERSE.hash, SPLIT.hash)
    assert loaded.source == "hvae:xy"
    assert loaded.hash == table.hash
    assert list(tmp_path.iterdir()) == [tmp_path / "table.npz"]  # No temporary file is left.
    loaded.check(UNIVERSE, SPLIT)


@pytest.mark.unit
def test_saving_replaces_an_older_file_under_any_name(tmp_path):
    path = tmp_path / "table"  # numpy would add a suffix.
    make_table().save(path)
    make_table(vectors=np.ones((6, 3))).save(path)
    np.testing.assert_array_equal(RepresentationTable.load(path).vectors, np.ones((6, 3)))


@pytest.mark.unit
def test_rows_follow_ids_in_any_order():
    table = make_table(vectors=np.arange(6.0)[:, None], ids=np.array([5, 4, 3, 2, 1, 0]))
    np.testing.assert_array_equal(table.rows(np.array([0, 5, 0]))[:, 0], [5.0, 0.0, 5.0])
    same = make_table(vectors=np.arange(6.0)[::-1, None], ids=np.arange(6))
    assert table.hash == same.hash
    with pytest.raises(ValueError, match="lacks 1 of the 2 actions asked for, the first is 9"):
        table.rows(np.array([0, 9]))


@pytest.mark.unit
def test_hash_depends_on_every_vector_and_id():
    hashes = {
        make_table().hash,
        make_table(vectors=np.zeros((6, 3))).hash,
        make_table(ids=np.arange(1, 7)).hash,
    }
    assert len(hashes) == 3


@pytest.mark.unit
def test_engineered_table_is_the_universes_vectors():
    table = engineered_table(UNIVERSE, "truth")
    np.testing.assert_array_equal(table.vectors, UNIVERSE.engineered["truth"])
    assert table.split_hash is None
    table.check(UNIVERSE, SPLIT)
    table.check(UNIVERSE, make_split(UNIVERSE, train=(3, 4)))  # Nothing was learned on a split.
    with pytest.raises(ValueError, match=r"no engineered vectors 'lies'; it has \['truth'\]"):
        engineered_table(UNIVERSE, "lies")


@pytest.mark.unit
def test_a_table_of_another_universe_or_split_is_refused():
    table = make_table()
    with pytest.raises(SplitMismatch, match="universe"):
        table.check(make_universe("Other-v0"), SPLIT)
    with pytest.raises(SplitMismatch, match="split"):
        table.check(UNIVERSE, make_split(UNIVERSE, train=(0, 1, 3)))


@pytest.mark.unit
def test_missing_and_unknown_actions_are_refused():
    short = make_table(vectors=np.ones((5, 3)), ids=np.array([0, 1, 2, 4, 5]))
    with pytest.raises(ValueError, match="first is 3"):
        short.check(UNIVERSE, SPLIT)
    long = make_table(vectors=np.ones((7, 3)), ids=np.arange(7))
    with pytest.raises(ValueError, match=r"describes action 6; Toy-v0 has 0\.\.5"):
        long.check(UNIVERSE, SPLIT)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vectors": np.ones(6)}, "one row per action"),
        ({"vectors": np.ones((6, 0))}, "one row per action"),
        ({"vectors": np.full((6, 3), "a")}, "must be numbers"),
        ({"vectors": np.full((6, 3), np.nan)}, "NaN or infinite numbers in 6 of 6 rows"),
        ({"vectors": np.full((6, 3), 1e300)}, "NaN or infinite"),  # Beyond float32.
        ({"ids": np.arange(5)}, "6 integers"),
        ({"ids": np.arange(6.0)}, "list of integers, got float64"),
        ({"ids": np.array([0, 1, 2, 3, 4, 4])}, "action 4 stands there twice"),
        ({"ids": np.array([-1, 1, 2, 3, 4, 5])}, "action -1 is not in"),
        ({"ids": np.array([0, 1, 2, 3, 4, 2**40])}, "action 1099511627776 is not in"),
    ],
)
def test_bad_contents_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_table(**changes)


@pytest.mark.unit
def test_a_users_own_file_loads_with_unknown_hashes(tmp_path):
    path = tmp_path / "mine.npz"
    np.savez(path, ids=np.arange(6)[::-1], vectors=np.arange(12.0).reshape(6, 2))
    table = RepresentationTable.load(path)
    assert (table.universe_hash, table.split_hash) == (None, None)
    assert table.source == str(path)
    np.testing.assert_array_equal(table.rows(np.array([5])), [[0.0, 1.0]])
    table.check(UNIVERSE, SPLIT)


@pytest.mark.unit
def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "table.npz"
    make_table().save(path)
    whole = path.read_bytes()
    damaged = {
        "empty": b"",
        "cut": whole[: len(whole) // 2],
        "text": b"ids and vectors",
        "flipped": whole[:150] + bytes([whole[150] ^ 0xFF]) + whole[151:],
    }
    for content in damaged.values():
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"is (missing|damaged)"):
            RepresentationTable.load(path)
    path.unlink()
    with pytest.raises(ValueError, match=r"is (missing|damaged)"):
        RepresentationTable.load(path)
    np.save(path.with_suffix(".npy"), np.ones(3))
    with pytest.raises(ValueError, match=r"is (missing|damaged)"):
        RepresentationTable.load(path.with_suffix(".npy"))


@pytest.mark.unit
def test_files_with_wrong_arrays_are_refused(tmp_path):
    path = tmp_path / "mine.npz"
    np.savez(path, ids=np.arange(3), rows=np.ones((3, 2)))
    with pytest.raises(ValueError, match=r"lacks the array 'vectors'; it has \['ids', 'rows'\]"):
        RepresentationTable.load(path)
    np.savez(path, ids=np.arange(3), vectors=np.full((3, 2), np.inf))
    with pytest.raises(ValueError, match=r"mine\.npz: vectors holds NaN"):
        RepresentationTable.load(path)
    np.savez(path, ids=np.arange(3), vectors=np.array([{}, {}, {}]))
    with pytest.raises(ValueError, match=r"is (missing|damaged)"):
        RepresentationTable.load(path)


@pytest.mark.unit
def test_an_edited_file_is_refused(tmp_path):
    path = tmp_path / "table.npz"
    make_table().save(path)
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "vectors": arrays["vectors"] + 1})
    with pytest.raises(ValueError, match="edited or damaged"):
        RepresentationTable.load(path)


@pytest.mark.unit
def test_rows_are_found_by_id_where_ids_have_gaps() -> None:
    table = RepresentationTable(vectors=np.array([[2.0], [9.0], [4.0]]), ids=np.array([2, 9, 4]))
    np.testing.assert_array_equal(table.rows(np.array([9, 2, 4])), [[9.0], [2.0], [4.0]])
