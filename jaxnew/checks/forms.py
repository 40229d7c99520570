"""What checks ask of one function: whether it works, and the forms of its results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxnew.host_checks import first_line
from jaxnew.task.places import UsageError

_QUICK = {"xla_backend_optimization_level": 0}  # Compiling takes longer than what it compiles.


def attempt(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a user's function gives.

    Raises:
      UsageError: it failed; in one sentence.
    """
    try:
        return function(*arguments)
    except Exception as err:
        raise UsageError(f"{what} fails: {type(err).__name__}: {first_line(err)}") from err


def shapes_of(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Shapes and dtypes of what it gives; see `attempt`."""
    return attempt(what, jax.eval_shape, function, *arguments)


def compiled_quickly(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """It, compiled as quickly as possible; random keys are watched. See `attempt`."""
    jitted = jax.jit(function, compiler_options=_QUICK)

    def run(*arguments: Any) -> Any:
        with jax.debug_key_reuse(True):
            return attempt(what, jitted, *arguments)

    return run


def check_like(what: str, found: Any, shape: Sequence[int], dtype: Any = None) -> None:
    """Refuses, with a UsageError, what is not an array of this shape and dtype (None: any)."""
    is_like = getattr(found, "shape", None) == tuple(shape)
    if not is_like or (dtype is not None and found.dtype != dtype):
        wanted = f"{list(shape)}" if dtype is None else f"{np.dtype(dtype).name}{list(shape)}"
        raise UsageError(f"{what} is {form(found)}; it must be {wanted}.")


def check_same_tree(what: str, found: Any, where: str, wanted: Any) -> None:
    """Refuses a tree that a scan could not carry from `where` to `what`."""
    trees = [str(jax.tree.structure(tree)) for tree in (found, wanted)]
    if trees[0] != trees[1]:
        raise UsageError(f"{what} gives {trees[0]}, and {where} {trees[1]}: not the same tree.")
    pairs = zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(wanted), strict=True)
    for (path, one), other in pairs:
        place = jax.tree_util.keystr(path).lstrip(".") or "it"
        if (one.shape, one.dtype) != (other.shape, other.dtype):
            raise UsageError(
                f"{what}: {place} is {form(one)}, and {where} gives {form(other)}; they must be "
                "the same."
            )


def form(found: Any) -> str:
    """Such as `float32[3, 4]`."""
    if hasattr(found, "shape") and hasattr(found, "dtype"):
        return f"{found.dtype}{list(found.shape)}"
    return f"a {type(found).__name__}"
