"""Checkpoints: bit-exact, committed in one step, and honest about damage."""

from __future__ import annotations

import itertools
import json
import logging
import os
import resource
import shutil
import sys
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import optax
import pytest
from flax import struct

from jaxnew.storage.checkpoint import Checkpointer, CheckpointError, record_hash
from jaxnew.storage.files import StorageError
from tests.kills import Killed, is_killed


@struct.dataclass
class State:
    step: Any
    key: jax.Array
    params: Any
    opt_state: Any
    extras: Any


def make_state(step: int = 0) -> State:
    params = {"w": jnp.arange(6.0).reshape(2, 3) + step, "b": jnp.zeros(3)}
    return State(
        step=jnp.int32(step),
        key=jax.random.key(7),
        params=params,
        opt_state=optax.adam(1e-3).init(params),
        extras={},
    )


def bits(leaf: Any) -> bytes:
    is_key = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf).tobytes()


def assert_same(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for one, other in pairs:
        assert type(one) is type(other)
        if hasattr(other, "dtype"):
            assert one.dtype == other.dtype
            assert one.shape == other.shape
            assert getattr(one, "weak_type", None) == getattr(other, "weak_type", None)
        assert bits(one) == bits(other)


@pytest.mark.unit
def test_every_kind_of_leaf_comes_back_bit_for_bit(tmp_path: Path) -> None:
    odd = np.array([0x7FC12345, 0xFFC00001, 0x80000000, 0x00000001, 0x7F800000], np.uint32)
    extras = {
        "keys": jax.random.split(jax.random.key(1), 3),
        "rbg": jax.random.key(2, impl="rbg"),
        "bfloat16": jnp.array([1.5, -0.0], jnp.bfloat16),
        "numpy_bfloat16": np.array([0.1], ml_dtypes.bfloat16),
        "odd_floats": odd.view(np.float32),
        "f64": np.array([0.1, -0.0]),
        "i64": np.int64(2**60),
        "np_float": np.float64(0.1),
        "bools": jnp.array([True, False]),
        "empty": jnp.zeros((0, 4)),
        "empty_numpy": np.zeros((3, 0), np.int8),
        "uint8": jnp.arange(5, dtype=jnp.uint8),
        "weak": jnp.asarray(3.0),
        "weak_vector": jnp.full((2,), 1.5),
        "python": (3, True, 0.1, None),
        "key_list": [jax.random.key(5)],
    }
    state = make_state(3).replace(extras=extras)
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save("latest", 3, state, {"best": None, "rate": 0.1})
    blank = {
        name: value if name == "python" else jax.tree.map(lambda x: x, value)
        for name, value in extras.items()
    }
    example = make_state(0).replace(extras=blank)
    restored, metadata = Checkpointer(tmp_path).restore("latest", example)
    assert_same(restored, state)
    assert metadata == {"best": None, "rate": 0.1}


@pytest.mark.unit
def test_values_come_from_the_checkpoint_not_from_the_example(tmp_path: Path) -> None:
    Checkpointer(tmp_path).save("best", 5, make_state(5))
    restored, _ = Checkpointer(tmp_path).restore("best", make_state(0))
    assert_same(restored, make_state(5))


@pytest.mark.unit
def test_an_abstract_example_will_do(tmp_path: Path) -> None:
    Checkpointer(tmp_path).save("best", 5, make_state(5))
    abstract = jax.eval_shape(make_state, 0)
    restored, _ = Checkpointer(tmp_path).restore("best", abstract)
    assert_same(restored, make_state(5))


@pytest.mark.unit
def test_arrays_go_where_the_example_was_put(tmp_path: Path) -> None:
    device = jax.devices()[0]
    Checkpointer(tmp_path).save("best", 1, {"a": jnp.ones(2)})
    put = {"a": jax.device_put(jnp.zeros(2), device)}
    assert Checkpointer(tmp_path).restore("best", put)[0]["a"].committed
    assert not Checkpointer(tmp_path).restore("best", {"a": jnp.zeros(2)})[0]["a"].committed


@pytest.mark.unit
def test_a_python_counter_may_become_an_array(tmp_path: Path) -> None:
    # The first state holds a Python int; jit turns it into an int32 scalar.
    Checkpointer(tmp_path).save("latest", 4, {"step": jnp.int32(4)})
    restored, _ = Checkpointer(tmp_path).restore("latest", {"step": 0})
    assert restored == {"step": 4}
    assert type(restored["step"]) is int
    with pytest.raises(CheckpointError, match="Python float"):
        Checkpointer(tmp_path).restore("latest", {"step": 0.0})


@pytest.mark.unit
def test_the_newest_are_kept(tmp_path: Path) -> None:
    checkpointer = Checkpointer(tmp_path)
    for step in range(5):
        checkpointer.save("latest", step, {"a": jnp.float32(step)})
        checkpointer.save("best", step, {"a": jnp.float32(step)})
    assert checkpointer.steps("latest") == [3, 4]
    assert checkpointer.steps("best") == [2, 3, 4]
    assert float(checkpointer.restore("latest", {"a": jnp.float32(0)})[0]["a"]) == 4.0
    assert float(checkpointer.restore("best", {"a": jnp.float32(0)}, step=3)[0]["a"]) == 3.0
    assert sorted(os.listdir(tmp_path / "latest")) == ["000000000003", "000000000004"]
    checkpointer.discard_after(3)
    assert checkpointer.steps("latest") == [3]
    assert checkpointer.steps("best") == [2, 3]


@pytest.mark.unit
def test_a_full_disk_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No file may be as large as the checkpoint's, and what is there stays."""
    printed: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda told: printed.append(str(told.exc_value)))
    handler = logging.Handler(logging.ERROR)
    monkeypatch.setattr(handler, "emit", lambda record: printed.append(record.getMessage()))
    logging.getLogger("absl").addHandler(handler)
    checkpointer, rng = Checkpointer(tmp_path), np.random.default_rng(0)
    checkpointer.save("latest", 1, {"a": np.zeros(3)})
    state = {f"a{i}": rng.normal(size=5000) for i in range(30)}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(StorageError, match=r"0002 cannot be written: File too .*run the same"):
            checkpointer.save("latest", 2, state)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        logging.getLogger("absl").removeHandler(handler)
    # Threads of Orbax go on for a while, and whether they say so is a matter of chance.
    sys.unraisablehook(SimpleNamespace(exc_value=RuntimeError("Event loop is closed")))  # type: ignore[arg-type]
    assert printed == []
    sys.unraisablehook(SimpleNamespace(exc_value=RuntimeError("Another")))  # type: ignore[arg-type]
    assert printed == ["Another"]
    # So is what they leave after the cleaning, under the name of an unfinished one.
    found = [name for name in os.listdir(tmp_path / "latest") if not name.startswith("new-")]
    assert found == ["000000000001"]
    checkpointer.save("latest", 2, state)
    assert sorted(os.listdir(tmp_path / "latest")) == ["000000000001", "000000000002"]
    assert Checkpointer(tmp_path).steps("latest") == [1, 2]


@pytest.mark.unit
def test_damage_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads of Orbax go on after an error of reading, too."""
    printed: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda told: printed.append(str(told.exc_value)))
    checkpointer, state = Checkpointer(tmp_path), {"a": np.arange(3)}
    for step in (1, 2):
        checkpointer.save("latest", step, state)
    for file in (tmp_path / "latest" / "000000000002" / "state").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    with pytest.warns(UserWarning, match=r"0002 is damaged .*; using step 1"):
        checkpointer.restore("latest", state)
    sys.unraisablehook(SimpleNamespace(exc_value=RuntimeError("Event loop is closed")))  # type: ignore[arg-type]
    assert printed == []


@pytest.mark.unit
def test_damaged_ones_are_set_aside_and_kept(tmp_path: Path) -> None:
    checkpointer, states = Checkpointer(tmp_path), [{"a": np.full(3, i)} for i in range(4)]
    for step in (1, 2, 3):
        checkpointer.save("best", step, states[step])
    checkpointer.set_aside_damaged("best", states[0])
    assert checkpointer.steps("best") == [1, 2, 3]
    damage_record(tmp_path / "best" / "000000000001")  # Older than a whole one: left where it is.
    truncate_data(tmp_path / "best" / "000000000003")
    with pytest.warns(UserWarning, match="000000000003 is damaged .*; it is damaged-0000"):
        checkpointer.set_aside_damaged("best", states[0])
    assert checkpointer.steps("best") == [1, 2]
    checkpointer.save("best", 3, states[3])
    assert_same(Checkpointer(tmp_path).restore("best", states[0])[0], states[3])
    assert [name.startswith("damaged-") for name in sorted(os.listdir(tmp_path / "best"))][-1]


@pytest.mark.unit
def test_links_are_not_written_through(tmp_path: Path) -> None:
    other = tmp_path / "other" / "new-thesis"
    other.mkdir(parents=True)
    (tmp_path / "latest").symlink_to(tmp_path / "other")
    checkpointer = Checkpointer(tmp_path)
    with pytest.raises(StorageError, match="latest is a link to"):
        checkpointer.save("latest", 1, {"a": 1})
    (other.parent / "000000000007").mkdir()
    with pytest.raises(StorageError, match="latest is a link to"):
        checkpointer.discard_after(1)
    assert sorted(os.listdir(other.parent)) == ["000000000007", "new-thesis"]


@pytest.mark.unit
@pytest.mark.parametrize("step", [-1, 2, 3])
def test_steps_must_grow(tmp_path: Path, step: int) -> None:
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save("latest", 3, {"a": jnp.float32(0)})
    with pytest.raises(ValueError, match=rf"Cannot save latest at step {step}"):
        checkpointer.save("latest", step, {"a": jnp.float32(0)})


@pytest.mark.unit
def test_what_cannot_be_stored_is_named(tmp_path: Path) -> None:
    checkpointer = Checkpointer(tmp_path)
    with pytest.raises(TypeError, match=r"Leaf \['name'\] of the state is a str"):
        checkpointer.save("latest", 0, {"name": "x"})
    with pytest.raises(ValueError, match="not JSON compliant"):
        checkpointer.save("latest", 0, {"a": 1}, {"best": float("nan")})
    with pytest.raises(ValueError, match="Unknown kind"):
        checkpointer.steps("worst")  # type: ignore[arg-type]
    assert checkpointer.steps("latest") == []


@pytest.mark.unit
def test_nothing_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=f"no best checkpoint in {tmp_path}"):
        Checkpointer(tmp_path).restore("best", {})
    with pytest.raises(CheckpointError, match="no latest checkpoint"):
        Checkpointer(tmp_path).metadata("latest")


def damage_data(path: Path) -> None:
    """Flips a byte in the largest data file."""
    files = [file for file in (path / "state").rglob("*") if file.is_file()]
    target = max(files, key=lambda file: file.stat().st_size)
    content = bytearray(target.read_bytes())
    content[len(content) // 2] ^= 0x01
    target.write_bytes(content)


def truncate_data(path: Path) -> None:
    for file in (path / "state").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def damage_record(path: Path) -> None:
    (path / "record" / "metadata").write_text('{"format_version": 1')


DAMAGES = {
    "flipped byte": damage_data,
    "truncated": truncate_data,
    "broken record": damage_record,
    "no record": lambda path: shutil.rmtree(path / "record"),
    "no data": lambda path: shutil.rmtree(path / "state"),
    "empty": lambda path: [shutil.rmtree(path), path.mkdir()],
}


@pytest.mark.unit
@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damage_falls_back_or_is_an_error(tmp_path: Path, damage: Any) -> None:
    checkpointer = Checkpointer(tmp_path)
    rng = np.random.default_rng(0)
    states = [{"a": rng.normal(size=(50, 50)), "step": step} for step in (1, 2)]
    for state in states:
        checkpointer.save("latest", state["step"], state, {"step": state["step"]})
    damage(tmp_path / "latest" / "000000000002")
    with pytest.warns(UserWarning, match=r"000000000002 is damaged .*; using step 1"):
        restored, metadata = Checkpointer(tmp_path).restore("latest", states[0])
    assert metadata == {"step": 1}
    assert_same(restored, states[0])
    damage(tmp_path / "latest" / "000000000001")
    with pytest.raises(CheckpointError, match="No readable checkpoint") as caught:
        Checkpointer(tmp_path).restore("latest", states[0])
    assert str(tmp_path) in str(caught.value)
    text = str(caught.value)
    assert -1 < text.index("Restore it from a copy") < text.index("delete")


# Orbax leaves futures behind when TensorStore fails.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.unit
def test_every_flipped_byte_is_noticed(tmp_path: Path) -> None:
    checkpointer = Checkpointer(tmp_path)
    state = {"a": np.random.default_rng(0).normal(size=30), "b": jnp.arange(5)}
    path = checkpointer.save("latest", 1, state, {"x": 1})
    files = [file for file in path.rglob("*") if file.is_file()]
    rng = np.random.default_rng(1)
    for _ in range(60):
        file = files[rng.integers(len(files))]
        whole = file.read_bytes()
        if not whole:
            continue
        content = bytearray(whole)
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
        file.write_bytes(content)
        try:
            restored, metadata = Checkpointer(tmp_path).restore("latest", state)
        except CheckpointError:
            pass
        else:  # A byte that does not matter, such as a time stamp.
            assert metadata == {"x": 1}
            assert_same(restored, state)
        file.write_bytes(whole)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("example", "message"),
    [
        ({"a": jnp.zeros(3), "b": jnp.zeros(2)}, r"leaf \['a'\] is float32\[2\] in the"),
        (
            {"a": jnp.zeros(2), "b": jnp.zeros(2, jnp.int32)},
            r"leaf \['b'\] is float32\[2\] in the checkpoint, expected int32\[2\]",
        ),
        ({"a": jnp.zeros(2), "b": jnp.zeros(2), "c": 1}, r"leaf \['c'\] is absent in the"),
        ({"a": jnp.zeros(2)}, r"leaf \['b'\] \(float32\[2\]\) of the checkpoint is not expected"),
        ({"a": jnp.zeros(2), "b": jax.random.key(0)}, r"leaf \['b'\] is float32\[2\]"),
    ],
)
def test_another_structure_is_an_error_even_with_a_fallback(
    tmp_path: Path, example: Any, message: str
) -> None:
    checkpointer = Checkpointer(tmp_path)
    for step in (1, 2):
        checkpointer.save("best", step, {"a": jnp.zeros(2), "b": jnp.zeros(2)})
    with pytest.raises(CheckpointError, match=message):
        checkpointer.restore("best", example)


@pytest.mark.unit
def test_another_format_is_an_error(tmp_path: Path) -> None:
    path = Checkpointer(tmp_path).save("best", 1, {"a": jnp.zeros(2)})
    record = json.loads((path / "record" / "metadata").read_text())
    record["format_version"] = 99
    del record["hash"]
    record["hash"] = record_hash(record)
    (path / "record" / "metadata").write_text(json.dumps(record))
    with pytest.raises(CheckpointError, match="has format 99; this program reads 1"):
        Checkpointer(tmp_path).restore("best", {"a": jnp.zeros(2)})


@pytest.mark.unit
def test_a_save_killed_at_any_rename_or_deletion_leaves_the_newest_readable(
    tmp_path: Path,
) -> None:
    example = {"a": jnp.float32(0)}
    for call in range(40):
        folder = tmp_path / str(call)
        checkpointer, step = Checkpointer(folder), 0

        def save(checkpointer: Checkpointer = checkpointer) -> None:
            nonlocal step
            for step in range(1, 5):
                checkpointer.save("latest", step, {"a": jnp.float32(step)}, {"step": step})

        renames = ((os, "rename"), (os, "replace"), (shutil, "rmtree"))
        was_killed = is_killed(save, call, renames)
        after = Checkpointer(folder)
        committed = after.steps("latest")
        # The save in flight counts or does not; the one before it is there in either case.
        assert committed[-1:] in ([[], [step]] if step == 1 else [[step - 1], [step]])
        if committed:
            restored, metadata = after.restore("latest", example)
            assert float(restored["a"]) == metadata["step"] == committed[-1]
        after.save("latest", 9, example)
        assert all(name.isdecimal() for name in os.listdir(folder / "latest"))
        if not was_killed:
            assert call > 4  # Every instant was tried.
            return
    pytest.fail("40 calls were not enough")


@pytest.mark.unit
@pytest.mark.parametrize("what", ["discard", "set aside"])
def test_discarding_killed_anywhere_leaves_the_rest_readable(tmp_path: Path, what: str) -> None:
    example = {"a": jnp.float32(0)}
    for step in (1, 2, 3):
        Checkpointer(tmp_path / "whole").save("best", step, {"a": jnp.float32(step)})
    for step in (2, 3) if what == "set aside" else ():
        damage_record(tmp_path / "whole" / "best" / f"{step:012d}")
    for call in itertools.count():
        folder = tmp_path / str(call)
        shutil.copytree(tmp_path / "whole", folder)

        checkpointer = Checkpointer(folder)
        work = (
            partial(checkpointer.discard_after, 1)
            if what == "discard"
            else partial(checkpointer.set_aside_damaged, "best", example)
        )
        with warnings.catch_warnings(action="ignore"):
            was_killed = is_killed(work, call, [(os, n) for n in ("rename", "unlink", "rmdir")])
        after = Checkpointer(folder)
        assert after.steps("best")[0] == 1
        after.clean("best")
        with warnings.catch_warnings(action="ignore"):
            restored, _ = after.restore("best", example)
        assert float(restored["a"]) == (1 if what == "set aside" else after.steps("best")[-1])
        left = [name for name in os.listdir(folder / "best") if not name.isdecimal()]
        assert all(name.startswith("damaged-") for name in left)
        assert len(left) + len(after.steps("best")) == 3 or what == "discard"
        if not was_killed:
            assert after.steps("best") == [1]
            assert call > 1  # Every instant was tried.
            return


@pytest.mark.unit
def test_a_half_deleted_checkpoint_no_longer_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(path: Path, **named: Any) -> None:
        (path / "record" / "metadata").unlink()
        raise Killed

    checkpointer = Checkpointer(tmp_path)
    for step in (1, 2):
        checkpointer.save("latest", step, {"a": jnp.float32(step)})
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", half)
        with pytest.raises(Killed):
            checkpointer.save("latest", 3, {"a": jnp.float32(3)})
    assert checkpointer.steps("latest") == [2, 3]
    checkpointer.save("latest", 4, {"a": jnp.float32(4)})
    assert sorted(os.listdir(tmp_path / "latest")) == ["000000000003", "000000000004"]


@pytest.mark.unit
def test_a_part_of_a_state_can_be_read(tmp_path: Path) -> None:
    """Leaves that the example lacks are left out; those that it has must still fit."""
    state = make_state(3)
    Checkpointer(tmp_path).save("best", 3, state)
    part = state.replace(opt_state=None, extras=None)
    with pytest.raises(CheckpointError, match="of the checkpoint is not expected"):
        Checkpointer(tmp_path).restore("best", part)
    found, _ = Checkpointer(tmp_path).restore("best", part, is_part=True)
    assert_same(found, part)
    wrong = part.replace(params={"w": jnp.zeros(5), "b": jnp.zeros(3)})
    with pytest.raises(CheckpointError, match=r"\.params\['w'\]"):
        Checkpointer(tmp_path).restore("best", wrong, is_part=True)
