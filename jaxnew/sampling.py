"""Available sets: the actions that an agent may choose from in one episode, drawn inside jit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.actions import checked_ids


@struct.dataclass
class AvailableSet:
    """What an agent may choose from.

    Attributes:
      ids: int32[..., m] action ids; padding repeats a valid id.
      mask: bool[..., m] true for a real entry.
    """

    ids: jax.Array
    mask: jax.Array

    def id_of(self, choice: jax.Array) -> jax.Array:
        """int32[...] the ids behind choices int32[...] from these sets, or from this one set."""
        ids = jnp.broadcast_to(self.ids, (*choice.shape, self.ids.shape[-1]))
        return jnp.take_along_axis(ids, choice[..., None], axis=-1)[..., 0]


@struct.dataclass
class ActionPool:
    """The actions that sets are drawn from, padded so that every pool runs the same program.

    Attributes:
      ids: int32[P] pool members first, then padding (repeats of the first member).
      size: int32[] number of members.
      always_available: int32[q] ids that stand in the first q slots of every set.
      group_starts: int32[G + 1] where each group of members begins and the last one ends, or None.
        With groups, a set is drawn from half of them (rounded down, at least one), which are drawn
        first (docs/method.md, "Validation groups and cluster sampling").
    """

    ids: jax.Array
    size: jax.Array
    always_available: jax.Array
    group_starts: jax.Array | None = None

    @classmethod
    def of(
        cls,
        ids: np.ndarray,
        *,
        capacity: int,
        always_available: np.ndarray | None = None,
        groups: np.ndarray | None = None,
    ) -> ActionPool:
        """Builds a pool of `ids`, padded to `capacity` (usually the size of the universe).

        Args:
          groups: int[len(ids)] label of the group of each id, or None for no groups.

        Raises:
          ValueError: no id, an id twice, more ids than `capacity`, a capacity above 65,536, or not
            one label per id.
        """
        if capacity > _MAX_POOL:
            raise ValueError(f"A pool holds at most {_MAX_POOL} actions, not {capacity}.")
        always = np.zeros(0, np.int32) if always_available is None else always_available
        ids = checked_ids(ids)
        members = np.setdiff1d(ids, always)
        if members.size == 0:
            raise ValueError(f"A pool needs more than the always available ids {always}.")
        if len(members) > capacity:
            raise ValueError(f"{len(members)} ids do not fit a pool of capacity {capacity}.")
        starts = None
        if groups is not None:
            members, starts = _by_group(ids, np.asarray(groups), members)
        padded = np.full(capacity, members[0], np.int32)
        padded[: len(members)] = members
        return cls(
            jnp.asarray(padded), jnp.int32(len(members)), jnp.asarray(always, jnp.int32), starts
        )


def _by_group(
    ids: np.ndarray, groups: np.ndarray, members: np.ndarray
) -> tuple[np.ndarray, jax.Array]:
    """The members ordered by group, and where each group starts."""
    if groups.shape != ids.shape:
        raise ValueError(f"{len(ids)} ids need as many group labels, got shape {groups.shape}.")
    labels = groups[np.argsort(ids)][np.isin(np.sort(ids), members)]  # `members` is ascending.
    order = np.argsort(labels, kind="stable")
    _, sizes = np.unique(labels, return_counts=True)
    return members[order], jnp.asarray(np.concatenate([[0], np.cumsum(sizes)]), jnp.int32)


def check_set_size(pool: ActionPool, set_size: int, name: str = "pool") -> None:
    """Raises ValueError when `set_size` distinct actions cannot be drawn from `pool`."""
    num_always = pool.always_available.shape[0]
    available = int(pool.size) + num_always
    if not num_always < set_size <= available:
        raise ValueError(
            f"Sets of {set_size} actions cannot be drawn from {name}, which has {available} "
            f"({num_always} of them always available); "
            f"choose a set size in {num_always + 1}..{available}."
        )
    if pool.group_starts is not None:
        sizes = np.sort(np.diff(np.asarray(pool.group_starts)))
        smallest = int(sizes[: _num_drawn_groups(len(sizes))].sum()) + num_always
        if set_size > smallest:
            raise ValueError(
                f"Sets of {set_size} actions cannot be drawn from every half of the {len(sizes)} "
                f"groups of {name}: the smallest groups hold {smallest} with those always "
                "available. Use smaller sets, or fewer groups."
            )


@dataclass(frozen=True)
class SetConfig:
    """Which sets a policy is trained with; all static.

    Attributes:
      size: m, actions available in an episode.
      padded_size: width of the sets; entries past their size are masked. 0 means no padding.
      is_fixed: all actions of training are available in every episode; the sizes are not used.
      training_size: actions available in episodes that are learned from, at most `size`, which
        evaluations have; 0 means `size`.
    """

    size: int = 50
    padded_size: int = 0
    is_fixed: bool = False
    training_size: int = 0

    def __post_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"size={self.size} must be at least 1.")
        if not 0 <= self.training_size <= self.size:
            raise ValueError(
                f"training_size={self.training_size} must be in 1..{self.size}, the size of the "
                "sets, or 0 for that size; set both."
            )
        if self.padded_size and self.padded_size < self.size:
            raise ValueError(
                f"padded_size={self.padded_size} is below size={self.size}; use 0 for no padding."
            )


@struct.dataclass
class Actions:
    """What a policy is offered: the representation of every action, and the sets of an episode.

    Everything that plays episodes takes one. The arrays are traced and the rest is static: one
    program serves the train, validation and test actions of a run.

    Attributes:
      table: f32[A, d] representations; row i describes action i.
      pool: actions that sets are drawn from.
      set_size: m, actions available in an episode.
      padded_size: width of the sets; entries past `set_size` are masked.
      is_fixed: every member of the pool is available in every episode, in the pool's order; the set
        is stored once, not per environment.
      first_size: actions of a set that are available at the first step, 0 for all of them; then
        `growth` more become available at every step.
      growth: see `first_size`.
    """

    table: jax.Array
    pool: ActionPool
    set_size: int = struct.field(pytree_node=False)
    padded_size: int = struct.field(pytree_node=False)
    is_fixed: bool = struct.field(pytree_node=False, default=False)
    first_size: int = struct.field(pytree_node=False, default=0)
    growth: int = struct.field(pytree_node=False, default=1)

    @classmethod
    def of(
        cls,
        table: jax.Array | np.ndarray,
        ids: np.ndarray,
        set_size: int | None = None,
        *,
        padded_size: int = 0,
        always_available: np.ndarray | None = None,
        groups: np.ndarray | None = None,
        name: str = "the actions",
    ) -> Actions:
        """Sets of `set_size` actions that are drawn from `ids`.

        Args:
          table: f32[A, d].
          ids: int[n] actions to draw from, each once.
          set_size: None: all of them are available in every episode.
          padded_size: width of the sets, 0 for `set_size`.
          always_available: int[q] ids that are in every set and count into its size.
          groups: int[n] label of the group of each id; sets are drawn from half of the groups.
          name: of the ids, for messages.

        Raises:
          ValueError: there are no such sets.
        """
        table, ids = jnp.asarray(table, jnp.float32), checked_ids(ids, what=name)
        if np.max(ids) >= len(table):
            raise ValueError(
                f"{name} hold action {np.max(ids)}, and the table describes 0..{len(table) - 1}. "
                "Encode that action, and give its table."
            )
        if set_size is None:
            if padded_size or groups is not None:
                raise ValueError("A fixed set has neither padding nor groups; give a set_size.")
            pool = ActionPool.of(ids, capacity=len(ids), always_available=always_available)
            width = len(ids) + pool.always_available.shape[0]
            return cls(table, pool, int(pool.size) + width - len(ids), width, is_fixed=True)
        pool = ActionPool.of(
            ids, capacity=len(table), always_available=always_available, groups=groups
        )
        check_set_size(pool, set_size, name)
        if padded_size and padded_size < set_size:
            raise ValueError(
                f"padded_size={padded_size} is below set_size={set_size}; use 0 for no padding."
            )
        return cls(table, pool, set_size, padded_size or set_size)

    def growing(self, first_size: int, growth: int = 1) -> Actions:
        """The same sets, of which `first_size` actions are there at first, see `first_size`.

        Raises:
          ValueError: a size is out of range.
        """
        if not 0 <= first_size <= self.set_size or growth < 0:
            raise ValueError(
                f"first_size={first_size} must be in 0..{self.set_size} (the set size) and "
                f"growth={growth} at least 0."
            )
        return replace(self, first_size=first_size, growth=growth)

    def perturbed(self, key: jax.Array, noise: float | jax.Array) -> Actions:
        """The same actions with Gaussian noise on their representations; consumes `key`.

        To learn with such noise is to prefer utilities that change slowly from an action to the
        next (Bishop, *Training with Noise is Equivalent to Tikhonov Regularization*, 1995).

        Args:
          noise: deviation of the noise, f32[], in that of each dimension over the actions that sets
            are drawn from: others may be unknown to the policy.
        """
        members = self.table[self.pool.ids]
        is_member = (jnp.arange(len(members), dtype=jnp.int32) < self.pool.size)[:, None]
        deviation = jnp.std(members, axis=0, where=is_member)

        def with_noise(table: jax.Array) -> jax.Array:
            return table + noise * deviation * jax.random.normal(key, table.shape, jnp.float32)

        return replace(self, table=jax.lax.cond(noise > 0, with_noise, lambda x: x, self.table))

    @property
    def num_actions(self) -> int:
        """How many actions sets are drawn from, those that are always available included."""
        return int(self.pool.size) + int(self.pool.always_available.shape[0])

    def draw(self, keys: jax.Array) -> AvailableSet:
        """One set per key, [..., padded_size], or the fixed set [n]; consumes `keys`."""
        if self.is_fixed:
            ids = jnp.concatenate([self.pool.always_available, self.pool.ids])
            return AvailableSet(ids, jnp.arange(ids.shape[0], dtype=jnp.int32) < self.set_size)
        return draw_sets(keys, self.pool, self.set_size, self.padded_size)

    def offered(self, available: AvailableSet) -> jax.Array:
        """f32[R, d] the rows of the table that may be needed: of a fixed set, or all."""
        return self.table[available.ids] if self.is_fixed else self.table

    def rows(self, offered: jax.Array, available: AvailableSet) -> jax.Array:
        """[..., m, p] of what was computed from `offered` [R, p], the rows of some sets."""
        return offered if self.is_fixed else offered[available.ids]

    def at(self, available: AvailableSet, t: Any) -> AvailableSet:
        """What may be chosen at step t int[] or int[...]: sets are in random order, so a beginning
        is a set, too.
        """
        if not self.first_size:
            return available
        now = (
            np.arange(self.padded_size, dtype=np.int32)
            < self.first_size + self.growth * t[..., None]
        )
        return AvailableSet(available.ids, available.mask & now)


def draw_sets(
    keys: jax.Array, pool: ActionPool, set_size: int, padded_size: int | None = None
) -> AvailableSet:
    """Draws one set per key, exactly uniformly without replacement.

    By sequential rejection where sets are small against what they are drawn from, which costs a
    fraction of sorting noise over the pool (`experiments/benchmarks`), else by the sort. Of a pool
    with groups, half of the groups are drawn first, uniformly; what is drawn from is their members.

    Args:
      keys: PRNG keys [...]; consumed.
      pool: members to draw from; at least `set_size` with the always available ones
        (`check_set_size`).
      set_size: number of actions in a set, static.
      padded_size: width of the result, static; entries past `set_size` are masked.

    Returns:
      AvailableSet with ids int32[..., padded_size] and mask bool[..., padded_size].
    """
    num_always = pool.always_available.shape[0]
    num_drawn = set_size - num_always
    flat_keys = keys.reshape(-1)
    if pool.group_starts is not None:
        drawn = _from_groups(flat_keys, pool, pool.group_starts, num_drawn)
    elif 2 * num_drawn > pool.ids.shape[0]:
        drawn = jax.vmap(lambda key: _by_sorting_noise(key, pool, num_drawn))(flat_keys)
    else:
        drawn = pool.ids[_by_rejection(flat_keys, pool.size, num_drawn)]
    always = jnp.broadcast_to(pool.always_available, (drawn.shape[0], num_always))
    ids = jnp.concatenate([always, drawn], axis=1)
    padding = (padded_size or set_size) - set_size
    ids = jnp.pad(ids, ((0, 0), (0, padding)), mode="edge")
    is_real = jnp.arange(set_size + padding, dtype=jnp.int32) < set_size
    mask = jnp.broadcast_to(is_real, ids.shape)
    shape = (*keys.shape, set_size + padding)
    return AvailableSet(ids.reshape(shape), mask.reshape(shape))


def _num_drawn_groups(num_groups: int) -> int:
    return max(1, num_groups // 2)


def _from_groups(keys: jax.Array, pool: ActionPool, starts: jax.Array, count: int) -> jax.Array:
    """int32[B, count] distinct members of half of the groups."""
    num_groups = starts.shape[0] - 1
    num_drawn = _num_drawn_groups(num_groups)
    key_pairs = jax.vmap(jax.random.split)(keys)
    noise = jax.vmap(lambda key: jax.random.uniform(key, (num_groups,), jnp.float32))(
        key_pairs[:, 0]
    )
    groups = jax.lax.top_k(noise, num_drawn)[1]  # [B, H]
    sizes = (starts[1:] - starts[:-1])[groups]
    ends = jnp.cumsum(sizes, axis=1, dtype=jnp.int32)
    # Places 0.. of the drawn groups' members put in a row, and then where they stand in the pool.
    places = _by_rejection(key_pairs[:, 1], ends[:, -1], count)
    group = jnp.sum(places[:, :, None] >= ends[:, None, :], axis=-1, dtype=jnp.int32)
    first = jnp.take_along_axis(starts[groups] - (ends - sizes), group, axis=1)
    return pool.ids[first + places]


def _by_sorting_noise(key: jax.Array, pool: ActionPool, count: int) -> jax.Array:
    """int32[count] the members with the `count` largest of independent noise."""
    noise = jax.random.uniform(key, pool.ids.shape, jnp.float32)
    is_member = jnp.arange(pool.ids.shape[0], dtype=jnp.int32) < pool.size
    noise = jnp.where(is_member, noise, -1.0)
    return pool.ids[jax.lax.top_k(noise, count)[1]]


_MAX_POOL = 2**16  # The range of `_random_below`.
_REFILL_BLOCK = 8  # Candidates per set drawn at once to replace repeats.


def _by_rejection(keys: jax.Array, bound: jax.Array, count: int) -> jax.Array:
    """int32[B, count] distinct numbers below `bound` int32[] or int32[B], by sequential rejection.

    `count` candidates are drawn at once; the places of those that repeat an earlier one are filled
    by further candidates, in blocks, until no set has an open place. The batch is the minor axis,
    and loops run over candidates: that is what the CPU vectorises.
    """
    key_pairs = jax.vmap(jax.random.split)(keys)
    keys_first, keys_refill = key_pairs[:, 0], key_pairs[:, 1]
    bounds = jnp.broadcast_to(bound, keys.shape)

    def draw(keys: jax.Array, count: int) -> jax.Array:
        return jax.vmap(lambda key, bound: _random_below(key, (count,), bound))(keys, bounds).T

    candidates = draw(keys_first, count)
    place = jnp.arange(count, dtype=jnp.int32)[:, None]

    def mark_repeats(i: jax.Array, is_repeat: jax.Array) -> jax.Array:
        return is_repeat | ((candidates == candidates[i]) & (place > i))

    is_repeat = jax.lax.fori_loop(0, count - 1, mark_repeats, jnp.zeros(candidates.shape, bool))

    def refill(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        chosen, iteration = carry
        keys_now = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys_refill, iteration)
        extra = draw(keys_now, _REFILL_BLOCK)

        def fill_first_open(i: jax.Array, chosen: jax.Array) -> jax.Array:
            is_new = ~jnp.any(chosen == extra[i], axis=0)
            return jnp.where((place == _first_open(chosen)) & is_new, extra[i], chosen)

        chosen = jax.lax.fori_loop(0, _REFILL_BLOCK, fill_first_open, chosen)
        return chosen, iteration + 1

    chosen, _ = jax.lax.while_loop(
        lambda carry: jnp.any(carry[0] < 0),
        refill,
        (jnp.where(is_repeat, -1, candidates), jnp.zeros((), jnp.int32)),
    )
    return chosen.T


def _first_open(chosen: jax.Array) -> jax.Array:
    """int32[B] first row of chosen [count, B] that is -1, or `count`."""
    count = chosen.shape[0]
    place = jnp.arange(count, dtype=jnp.int32)[:, None]
    return jnp.min(jnp.where(chosen < 0, place, count), axis=0)


def _random_below(key: jax.Array, shape: tuple[int, ...], bound: jax.Array) -> jax.Array:
    """int32 in `0..bound-1` for a traced bound of at most 2**16, uniform to within bound / 2**32.

    The high word of `random_bits * bound`: unlike `jax.random.randint`, one draw and no division.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    bound = bound.astype(jnp.uint32)
    low = ((bits & 0xFFFF) * bound) >> 16
    return (((bits >> 16) * bound + low) >> 16).astype(jnp.int32)
