"""The representation table: what a policy knows about each action. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxnew.actions import (
    ActionIdentity,
    ActionSplit,
    ActionUniverse,
    SplitMismatch,
    checked_ids,
    content_hash,
)
from jaxnew.storage.arrays import read_arrays, write_arrays

_TEXTS = ("universe_hash", "split_hash", "source", "play", "encoder_hash", "hash")


@dataclass(frozen=True, eq=False)
class RepresentationTable:
    """One vector per action.

    Attributes:
      vectors: f32[A, d] finite; row i describes action `ids[i]`.
      ids: int32[A] ascending, each once. Rows given in another order are sorted.
      universe_hash: `ActionUniverse.hash` of the actions, None if unknown.
      split_hash: `ActionSplit.hash` of the split whose train actions the encoder learned from;
        None if unknown, or if nothing was learned (engineered vectors).
      source: where the vectors come from, e.g. "hvae-xy, laptop, seed 31".
      play: modality of the recordings that were encoded, None if there were none, or unknown.
      encoder_hash: `hash` of the first table that the encoder made, of the actions of its domain;
        None: this is it.
      identity: what the actions are, None if unknown.

    Raises:
      ValueError: a shape, an id or a value is wrong.
    """

    vectors: np.ndarray
    ids: np.ndarray
    universe_hash: str | None = None
    split_hash: str | None = None
    source: str = "unknown"
    play: str | None = None
    encoder_hash: str | None = None
    identity: ActionIdentity | None = None

    def __post_init__(self) -> None:
        vectors = _checked_vectors(np.asarray(self.vectors))
        ids = _checked_ids(np.asarray(self.ids), len(vectors))
        order = np.argsort(ids)
        if self.identity is not None:
            if len(self.identity.hashes) != len(ids):
                raise ValueError(
                    f"{len(ids)} actions cannot be identified by {len(self.identity.hashes)} "
                    "hashes; there must be one for each."
                )
            object.__setattr__(self, "identity", self.identity.rows(order))
        object.__setattr__(self, "vectors", np.ascontiguousarray(vectors[order]))
        object.__setattr__(self, "ids", ids[order])

    @property
    def hash(self) -> str:
        """Identifies what a policy reads: ids and vectors, not where they come from."""
        return content_hash(self.vectors, self.ids)

    @property
    def made_by(self) -> str:
        """Identifies the encoder: equal for tables whose vectors mean the same to a policy."""
        return self.encoder_hash or self.hash

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """f32[n, d] vectors of the actions `ids` int[n].

        Raises:
          ValueError: the table lacks one of them.
        """
        ids = np.asarray(ids)
        missing = np.setdiff1d(ids, self.ids)
        if missing.size:
            raise ValueError(
                f"The table ({self.source}) lacks {missing.size} of the {len(np.unique(ids))} "
                f"actions asked for, the first is {missing[0]}. Encode these actions too."
            )
        return self.vectors[np.searchsorted(self.ids, ids)]

    def check(self, universe: ActionUniverse, split: ActionSplit) -> None:
        """Raises unless the table describes every action of `universe` and fits `split`.

        Unknown hashes (None) fit everything: a user's own vectors carry none.

        Raises:
          SplitMismatch: the table was made for another universe or split.
          ValueError: it lacks an action, or has one that does not exist.
        """
        if self.universe_hash not in (None, universe.hash):
            raise SplitMismatch(
                f"The table ({self.source}) describes universe {self.universe_hash}, but "
                f"{universe.name} is {universe.hash}. Make the table again for this universe."
            )
        if self.split_hash not in (None, split.hash):
            raise SplitMismatch(
                f"The table ({self.source}) was learned on split {self.split_hash}, but the split "
                f"in use is {split.hash}; its test actions may have been seen in training. Train "
                "the encoder on this split, or use the split that the table was learned on."
            )
        self.rows(np.arange(universe.num_actions))
        if len(self.ids) > universe.num_actions:
            unknown = self.ids[(self.ids < 0) | (self.ids >= universe.num_actions)]
            raise ValueError(
                f"The table ({self.source}) describes action {unknown[0]}; {universe.name} has "
                f"0..{universe.num_actions - 1}."
            )

    def save(self, path: Path | str) -> None:
        """Writes `path` (.npz), whole or not at all."""
        texts = {name: getattr(self, name) for name in _TEXTS}
        arrays: dict[str, Any] = {"vectors": self.vectors, "ids": self.ids}
        arrays |= {name: np.array(text) for name, text in texts.items() if text is not None}
        arrays |= self.identity.arrays() if self.identity else {}
        write_arrays(Path(path), arrays)

    @classmethod
    def load(cls, path: Path | str) -> RepresentationTable:
        """Reads what `save` wrote, or a user's own `.npz` with the arrays `ids` and `vectors`.

        The hashes of a user's own file are unknown (None); `source` is then its path.

        Raises:
          ValueError: the file is missing or damaged, or its arrays are wrong.
        """
        arrays = read_arrays(Path(path), ("ids", "vectors"), ValueError)
        texts = {name: str(arrays[name]) for name in _TEXTS if name in arrays}
        try:
            table = cls(
                vectors=arrays["vectors"],
                ids=arrays["ids"],
                universe_hash=texts.get("universe_hash"),
                split_hash=texts.get("split_hash"),
                source=texts.get("source", str(path)),
                play=texts.get("play"),
                encoder_hash=texts.get("encoder_hash"),
                identity=ActionIdentity.from_arrays(arrays),
            )
        except ValueError as err:
            raise ValueError(f"{path}: {err}") from err
        if texts.get("hash", table.hash) != table.hash:
            raise ValueError(
                f"{path} was edited or damaged: its rows hash to {table.hash}, it says "
                f"{texts['hash']}. Restore the file or make the table again."
            )
        return table


def engineered_table(universe: ActionUniverse, name: str) -> RepresentationTable:
    """The table of the universe's ground-truth vectors called `name`.

    Raises:
      ValueError: the universe has no such vectors.
    """
    if name not in universe.engineered:
        raise ValueError(
            f"{universe.name} has no engineered vectors {name!r}; it has "
            f"{sorted(universe.engineered)}."
        )
    ids = np.arange(universe.num_actions, dtype=np.int32)
    return RepresentationTable(
        vectors=universe.engineered[name],
        ids=ids,
        universe_hash=universe.hash,
        source=f"engineered:{name}",
        identity=ActionIdentity.of(universe, ids),
    )


def random_table(universe: ActionUniverse, size: int, seed: int) -> RepresentationTable:
    """Vectors from N(0, I) that say nothing of what actions do, f32[A, size]; for reference.

    Raises:
      ValueError: `size` < 1.
    """
    if size < 1:
        raise ValueError(f"Random vectors need a size of at least 1, got {size}.")
    vectors = np.random.default_rng(seed).normal(size=(universe.num_actions, size))
    ids = np.arange(universe.num_actions, dtype=np.int32)
    return RepresentationTable(
        vectors=vectors.astype(np.float32),
        ids=ids,
        universe_hash=universe.hash,
        source=f"random:{size}, seed {seed}",
        identity=ActionIdentity.of(universe, ids),
    )


def _checked_vectors(vectors: np.ndarray) -> np.ndarray:
    """`vectors` as f32[A, d]."""
    if vectors.ndim != 2 or 0 in vectors.shape or vectors.dtype.kind not in "fiu":
        raise ValueError(
            f"vectors must be numbers [A, d], one row per action; got {vectors.dtype} of shape "
            f"{vectors.shape}."
        )
    with np.errstate(over="ignore"):
        vectors = vectors.astype(np.float32)
    bad_rows = np.flatnonzero(~np.isfinite(vectors).all(axis=1))
    if bad_rows.size:
        raise ValueError(
            f"vectors holds NaN or infinite numbers in {bad_rows.size} of {len(vectors)} rows, the "
            f"first is row {bad_rows[0]}. A diverged encoder gives such rows."
        )
    return vectors


def _checked_ids(ids: np.ndarray, num_rows: int) -> np.ndarray:
    """`ids` as int32[num_rows], each once and not negative."""
    if ids.shape != (num_rows,):
        raise ValueError(
            f"ids must be {num_rows} integers, one per row of vectors; got {ids.dtype} of shape "
            f"{ids.shape}."
        )
    return checked_ids(ids)
