"""Action universes and their splits. NumPy only, so that host workers can import it.

An *action universe* numbers every action of a domain `0..A-1` and says what is known about each
of them; an *action split* says which of them an agent trains with and which it has never seen.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sized
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from jaxnew.storage.files import read_json, write_bytes_atomically

SPLIT_NAMES = ("train", "validation", "test")


class SplitMismatch(ValueError):
    """Two artefacts belong to different universes or splits."""


def check_same(what: str, found: str, recorded: str, where: object) -> None:
    """Raises SplitMismatch unless the hash of what was read is the one on record."""
    if found != recorded:
        raise SplitMismatch(
            f"The {what} in {where} is not the run's own: its hash is {found}, on record is "
            f"{recorded}. Put the run's own back; tables of new actions are for evaluate --table."
        )


def content_hash(*parts: np.ndarray | str | int) -> str:
    """Short SHA-256 over arrays (dtype, shape, bytes) and scalars; equal on every machine."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            little_endian = np.ascontiguousarray(part, dtype=part.dtype.newbyteorder("<"))
            digest.update(f"{little_endian.dtype.str}{little_endian.shape}".encode())
            digest.update(little_endian.tobytes())
        else:
            digest.update(repr(part).encode())
        digest.update(b"|")
    return digest.hexdigest()[:16]


@dataclass(frozen=True)
class ActionUniverse:
    """All actions of a domain.

    Attributes:
      name: domain and version, e.g. `GridWorld-v0`.
      class_labels: int32[A] class of each action, an index into `class_names`.
      class_names: name of each class, in label order.
      primary_parameter: f64[A] the number by which actions of one class differ (angle, scale, ...).
      action_names: A printable names.
      engineered: named ground-truth vectors, each f32[A, e].
      content: array [A, ...] that fixes what each action does; two actions with equal rows are the
        same action under two ids.
    """

    name: str
    class_labels: np.ndarray
    class_names: tuple[str, ...]
    primary_parameter: np.ndarray
    action_names: tuple[str, ...]
    content: np.ndarray
    engineered: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        per_action: dict[str, Sized] = {
            "class_labels": self.class_labels,
            "primary_parameter": self.primary_parameter,
            "action_names": self.action_names,
            **{f"engineered[{key!r}]": value for key, value in self.engineered.items()},
        }
        for attribute, value in per_action.items():
            if len(value) != self.num_actions:
                raise ValueError(
                    f"{self.name}: {attribute} has {len(value)} rows, but content has "
                    f"{self.num_actions}; every attribute needs one row per action."
                )
        if self.num_actions and not 0 <= self.class_labels.min() <= self.class_labels.max() < len(
            self.class_names
        ):
            raise ValueError(
                f"{self.name}: class_labels span {self.class_labels.min()}.."
                f"{self.class_labels.max()}, but there are {len(self.class_names)} class names."
            )

    @property
    def num_actions(self) -> int:
        return len(self.content)

    @property
    def hash(self) -> str:
        """Identifies the universe by name and by what each action does."""
        return content_hash(self.name, np.asarray(self.content))

    @cached_property
    def action_hashes(self) -> tuple[str, ...]:
        """A hashes of what each action does; equal ones mean equal actions (-0.0 is 0.0)."""
        without_minus_zero = self.content + np.zeros((), self.content.dtype)
        return tuple(content_hash(np.asarray(row)) for row in without_minus_zero)

    def first(self, num_actions: int) -> ActionUniverse:
        """The universe of the first actions alone: what it was before it has grown."""
        n = num_actions
        return replace(
            self,
            class_labels=self.class_labels[:n],
            primary_parameter=self.primary_parameter[:n],
            action_names=self.action_names[:n],
            content=self.content[:n],
            engineered={name: vectors[:n] for name, vectors in self.engineered.items()},
        )


@dataclass(frozen=True)
class ActionIdentity:
    """What some actions are, whatever their numbers; it travels with what is made from them.

    Attributes:
      universe: `ActionUniverse.name` of the universe that they were taken from.
      place: what `Task.with_universe` takes to find it again; empty for a task's own.
      names: n printable names.
      hashes: n of `ActionUniverse.action_hashes`.
    """

    universe: str
    place: str
    names: tuple[str, ...]
    hashes: tuple[str, ...]

    @classmethod
    def of(cls, universe: ActionUniverse, ids: np.ndarray, place: str = "") -> Self:
        """Of the actions `ids` int[n] of a universe."""
        chosen = np.asarray(ids).tolist()
        names, hashes = universe.action_names, universe.action_hashes
        return cls(
            universe.name, place, tuple(names[i] for i in chosen), tuple(hashes[i] for i in chosen)
        )

    def rows(self, rows: np.ndarray) -> Self:
        """Of some of the actions, by place in this list."""
        chosen = np.asarray(rows).tolist()
        return replace(
            self,
            names=tuple(self.names[row] for row in chosen),
            hashes=tuple(self.hashes[row] for row in chosen),
        )

    def find(self, ids: np.ndarray, universe: ActionUniverse) -> np.ndarray:
        """int32[n] the same actions in another universe, -1 where it lacks one.

        Args:
          ids: int[n] their numbers, which they keep where they may.
        """
        known = universe.action_hashes
        places: dict[str, list[int]] = {}
        for number, key in enumerate(known):
            places.setdefault(key, []).append(number)
        found = np.full(len(self.hashes), -1, np.int32)
        for row, number in enumerate(np.asarray(ids).tolist()):
            same = places.get(self.hashes[row], [])
            if same:
                found[row] = same.pop(same.index(number) if number in same else 0)
        return found

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays of a file; see `from_arrays`."""
        return {f"action_{name}": np.array(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """What `arrays` gave, or None for a file that does not say what its actions are."""
        if "action_hashes" not in arrays:
            return None
        universe, place = (str(arrays[f"action_{name}"]) for name in ("universe", "place"))
        names, hashes = (tuple(arrays[f"action_{name}"].tolist()) for name in ("names", "hashes"))
        return cls(universe, place, names, hashes)


@dataclass(frozen=True)
class ActionSplit:
    """Which actions are trained with, selected by, and tested on.

    Attributes:
      train, validation, test: int32[...] ascending ids, disjoint.
      universe_hash: `ActionUniverse.hash` of the universe that the ids belong to.
      seed: the seed that drew the split, or None for a split given by hand.
      always_available: ids in every available set (CREATE's no-op), part of no pool below.
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    universe_hash: str
    seed: int | None = None
    always_available: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        owner: dict[int, str] = {}
        for name in (*SPLIT_NAMES, "always_available"):
            ids = np.asarray(getattr(self, name))
            if ids.size or name in SPLIT_NAMES:
                ids = checked_ids(ids, what=name)
            object.__setattr__(self, name, np.sort(ids.astype(np.int32)))
            for action_id in ids.tolist():
                if action_id in owner:
                    raise ValueError(
                        f"Action {action_id} is in both {owner[action_id]} and {name}; "
                        "each id may be listed once."
                    )
                owner[action_id] = name

    @property
    def hash(self) -> str:
        """Identifies the split: universe and membership."""
        return content_hash(
            self.universe_hash, self.train, self.validation, self.test, self.always_available
        )

    def ids(self, name: str) -> np.ndarray:
        """int32[n] ids of one part of the split, or of the union `all`."""
        if name == "all":
            return np.sort(np.concatenate([self.train, self.validation, self.test]))
        if name not in SPLIT_NAMES:
            raise ValueError(f"Unknown split {name!r}; choose one of {(*SPLIT_NAMES, 'all')}.")
        return getattr(self, name)

    def check(self, universe: ActionUniverse) -> None:
        """Raises unless the split belongs to `universe` and is disjoint by content.

        Raises:
          SplitMismatch: the split was made for another universe.
          ValueError: an id does not exist, or the same action stands in two parts under two ids.
        """
        if self.universe_hash != universe.hash:
            raise SplitMismatch(
                f"The split was made for universe {self.universe_hash}, but {universe.name} is "
                f"{universe.hash}. Make the split again from this universe."
            )
        keys = universe.action_hashes
        owner: dict[str, str] = {}
        for name in (*SPLIT_NAMES, "always_available"):
            ids = getattr(self, name)
            outside = ids[(ids < 0) | (ids >= universe.num_actions)]
            if outside.size:
                raise ValueError(
                    f"{name} holds action {outside[0]}; {universe.name} has 0.."
                    f"{universe.num_actions - 1}."
                )
            for action_id in ids.tolist():
                if owner.setdefault(keys[action_id], name) != name:
                    raise ValueError(
                        f"Action {action_id} ({universe.action_names[action_id]}) of {name} does "
                        f"the same as an action of {owner[keys[action_id]]}."
                    )

    def save(self, path: Path) -> None:
        """Writes `path` (.json), whole or not at all."""
        record = {
            "universe_hash": self.universe_hash,
            "seed": self.seed,
            "hash": self.hash,
            **{name: getattr(self, name).tolist() for name in (*SPLIT_NAMES, "always_available")},
        }
        write_bytes_atomically(path, json.dumps(record).encode())

    @classmethod
    def load(cls, path: Path) -> ActionSplit:
        """Reads what `save` wrote.

        Raises:
          SplitMismatch: the ids do not have the hash recorded beside them.
          ValueError: the file is missing or damaged.
        """
        try:
            record = read_json(path, ValueError)
        except FileNotFoundError as err:
            raise ValueError(
                f"{path} is missing: it says which actions are seen in training. Restore it from a "
                "copy."
            ) from err
        try:
            recorded_hash = record["hash"]
            id_lists = {
                name: np.array(record[name], np.int32)
                for name in (*SPLIT_NAMES, "always_available")
            }
            split = cls(universe_hash=record["universe_hash"], seed=record["seed"], **id_lists)
        except (KeyError, TypeError, ValueError, OverflowError) as err:
            what = f"it lacks {err}" if isinstance(err, KeyError) else str(err)
            raise ValueError(f"{path} is damaged ({what}). Restore it from a copy.") from err
        if split.hash != recorded_hash:
            raise SplitMismatch(
                f"{path} was edited or damaged: its ids hash to {split.hash}, it says "
                f"{recorded_hash}. Restore the file or make the split again."
            )
        return split


def random_halves_split(universe: ActionUniverse, seed: int) -> ActionSplit:
    """Random halves, the second cut in two: the paper's 2:1:1.

    Actions with equal content are kept on one side, so the parts are disjoint by content.
    """
    rng = np.random.default_rng(seed)
    keys = np.array(_group_by_content(universe))
    groups = rng.permutation(len(np.unique(keys)))
    half, three_quarters = len(groups) // 2, len(groups) // 2 + len(groups) // 4

    def members(chosen: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.isin(keys, chosen)).astype(np.int32)

    split = ActionSplit(
        train=members(groups[:half]),
        validation=members(groups[half:three_quarters]),
        test=members(groups[three_quarters:]),
        universe_hash=universe.hash,
        seed=seed,
    )
    split.check(universe)
    return split


def _group_by_content(universe: ActionUniverse) -> list[int]:
    """The group number of each action; actions with equal content share one."""
    first_seen: dict[str, int] = {}
    return [first_seen.setdefault(key, len(first_seen)) for key in universe.action_hashes]


def mixture_ids(seen: np.ndarray, unseen: np.ndarray, unseen_ratio: float) -> np.ndarray:
    """A pool with about the given share of unseen actions (paper figure 9c).

    The first `floor(x * |unseen|)` unseen and the first `floor((1 - x) * |seen|)` seen ids; sets
    drawn from it hold the share only on average, as in the released analysis.
    """
    if not 0.0 <= unseen_ratio <= 1.0:
        raise ValueError(f"unseen_ratio={unseen_ratio} is not in [0, 1].")
    num_unseen = int(unseen_ratio * len(unseen))
    num_seen = int((1.0 - unseen_ratio) * len(seen))
    return np.concatenate([unseen[:num_unseen], seen[:num_seen]]).astype(np.int32)


def checked_ids(ids: ArrayLike, num_actions: int = 2**31, what: str = "ids") -> np.ndarray:
    """int32[n] distinct ids of `num_actions` actions; numbers that are no integers stay none.

    Args:
      ids: int[n].
      what: they are, for the message.

    Raises:
      ValueError: they are something else, or none.
    """
    given = np.asarray(ids)
    if given.ndim != 1 or given.size == 0 or given.dtype.kind not in "iu":
        raise ValueError(
            f"{what}: must be a non-empty list of integers, got {given.dtype} of shape "
            f"{given.shape}."
        )
    outside = given[(given < 0) | (given >= num_actions)]
    if outside.size:
        raise ValueError(f"{what}: action {outside[0]} is not in 0..{num_actions - 1}.")
    values, counts = np.unique(given, return_counts=True)
    if len(values) < len(given):
        raise ValueError(
            f"{what}: action {values[counts.argmax()]} stands there twice; list each id once."
        )
    return given.astype(np.int32)


def read_text(path: Path | str) -> str:
    """A user's text file, with or without the mark of byte order that some editors write.

    Raises:
      ValueError: it is no UTF-8.
      OSError: it cannot be read.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as err:
        raise ValueError(f"{path} is no UTF-8 text ({err.reason}); save it as UTF-8.") from err


def load_ids(path: Path, universe: ActionUniverse) -> np.ndarray:
    """int32[n] action ids from a text file: one id per line or separated by commas or spaces.

    Raises:
      ValueError: the file holds something else than ids of `universe`, or an id twice.
      OSError: it cannot be read.
    """
    words = read_text(path).replace(",", " ").split()
    if not words:
        raise ValueError(f"{path} holds no action id.")
    try:
        ids = np.array([int(word) for word in words], np.int64)
    except (ValueError, OverflowError) as err:
        raise ValueError(f"{path} must hold integer action ids only: {err}.") from err
    return checked_ids(ids, universe.num_actions, f"{path}, ids of {universe.name}")
