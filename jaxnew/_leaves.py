"""Leaves of a state as NumPy arrays with a description, and back, bit for bit."""

from __future__ import annotations

import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Leaf = dict[str, Any]


def is_key(leaf: Any) -> bool:
    """Whether a leaf is an array of typed PRNG keys, concrete or abstract."""
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def named_leaves(state: Any) -> list[tuple[str, Any]]:
    """(path, leaf) of each leaf, in JAX's order; the path looks like `.params['w'][0]`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return [(jax.tree_util.keystr(path) or "(state)", leaf) for path, leaf in leaves]


def describe(name: str, leaf: Any) -> Leaf:
    """Path, shape and dtype of a leaf; `dtype` is `key<...>` for typed PRNG keys.

    Raises:
      TypeError: the leaf is neither an array nor a number.
    """
    if is_key(leaf):
        return {"path": name, "shape": list(leaf.shape), "dtype": str(leaf.dtype)}
    # NumPy's float64 is a Python float too; it is described as an array.
    if isinstance(leaf, bool | int | float | complex) and not isinstance(leaf, np.generic):
        return {"path": name, "shape": [], "dtype": f"Python {type(leaf).__name__}"}
    if not hasattr(leaf, "dtype") or not hasattr(leaf, "shape"):
        raise TypeError(
            f"Leaf {name} of the state is a {type(leaf).__name__}; checkpoints hold arrays, PRNG "
            "keys and numbers. Keep anything else out of the state or mark it as static."
        )
    return {"path": name, "shape": list(leaf.shape), "dtype": str(np.dtype(leaf.dtype))}


def describe_with_content(name: str, leaf: Any) -> tuple[Leaf, np.ndarray]:
    """`describe` with what restoring needs, and the bits of the leaf as a NumPy array."""
    description = describe(name, leaf)
    value = np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)
    description["stored"] = [str(value.dtype), list(value.shape)]
    description["sha256"] = sha256(value)
    if is_key(leaf):
        description["impl"] = str(jax.random.key_impl(leaf))
    return description, value


def sha256(value: np.ndarray) -> str:
    """Hash of the bytes of an array."""
    return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()


def restore(value: np.ndarray, description: Leaf, example: Any) -> Any:
    """`value` as the kind of leaf that `example` is, and on its device if it was put on one."""
    if isinstance(example, np.generic):
        return value[()]
    if isinstance(example, bool | int | float | complex):
        return type(example)(value.item())
    if isinstance(example, np.ndarray):
        return value
    if is_key(example):
        restored = jax.random.wrap_key_data(jnp.asarray(value), impl=description["impl"])
    else:
        restored = jnp.asarray(value)
        if isinstance(example, jax.Array) and example.weak_type:
            # A strongly typed copy would be another argument type, hence another compilation.
            restored = example.at[...].set(restored)
    sharding = getattr(example, "sharding", None)
    is_placed = getattr(example, "committed", sharding is not None)
    return jax.device_put(restored, sharding) if is_placed else restored


def first_difference(saved: list[Leaf], expected: list[Leaf]) -> str | None:
    """Says which leaf differs first in path, shape or dtype, or None if all agree."""
    saved_by_path = {leaf["path"]: leaf for leaf in saved}
    for leaf in expected:
        twin = saved_by_path.pop(leaf["path"], None)
        if twin is None or not _is_same(twin, leaf):
            found = "absent" if twin is None else _show(twin)
            return f"leaf {leaf['path']} is {found} in the checkpoint, expected {_show(leaf)}"
    for leaf in saved_by_path.values():
        return f"leaf {leaf['path']} ({_show(leaf)}) of the checkpoint is not expected"
    return None


def _show(leaf: Leaf) -> str:
    return f"{leaf['dtype']}{leaf['shape']}"


def _is_same(saved: Leaf, expected: Leaf) -> bool:
    if saved["shape"] != expected["shape"]:
        return False
    is_exact = bool(saved["dtype"] == expected["dtype"])
    if not expected["dtype"].startswith("Python ") or saved["dtype"].startswith(("Python", "key<")):
        return is_exact
    # A counter may start as a Python number and come back from a jitted chunk as a scalar array.
    kinds = {"b": "bool", "i": "int", "u": "int", "f": "float", "c": "complex"}
    return f"Python {kinds.get(np.dtype(saved['dtype']).kind)}" == str(expected["dtype"])
