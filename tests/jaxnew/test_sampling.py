"""Available sets: exactly uniform without replacement, and one program for every pool."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from envs_mjx.grid_world import GridWorld, skill_universe
from jaxnew import sampling
from jaxnew.actions import random_halves_split
from jaxnew.policy import make_method
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import ActionPool, Actions, AvailableSet, SetConfig, check_set_size, draw_sets

draw = jax.jit(draw_sets, static_argnames=("set_size", "padded_size"))

# (members, capacity, set size). Both ways of drawing, far below, just below and at the whole pool:
# rejection where 2 m <= capacity, sorting otherwise.
REJECTION = [(6, 6, 3), (6, 16, 6), (40, 200, 39), (512, 1024, 50)]
SORTING = [(6, 6, 4), (5, 7, 5), (40, 44, 30)]
CASES = REJECTION + SORTING
NUM_SETS = 60_000  # One draw per case serves all tests of it.


def pool_of(size: int, capacity: int, always: tuple[int, ...] = ()) -> ActionPool:
    """Members 3, 5, 7, ...: no member is an index into the pool's first rows by accident."""
    return ActionPool.of(
        3 + 2 * np.arange(size), capacity=capacity, always_available=np.array(always, np.int32)
    )


def keys_of(seed: int, count: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


@functools.cache
def draw_numpy(case: tuple[int, int, int]) -> np.ndarray:
    """int[n, m] drawn sets, as member numbers 0..P-1."""
    size, capacity, m = case
    ids = np.asarray(draw(keys_of(1, NUM_SETS), pool_of(size, capacity), set_size=m).ids)
    assert ids.shape == (NUM_SETS, m)
    assert ((ids - 3) % 2 == 0).all()
    members = (ids - 3) // 2
    assert members.min() >= 0
    assert members.max() < size
    return members


def assert_chi_square(statistic: float, degrees: int) -> None:
    """Keys are fixed, so this is no lottery: a uniform sampler has two chances in a million to be
    drawn with a key that fails. The lower bound catches counts that are too even to be random."""
    low, high = stats.chi2.ppf(1e-6, degrees), stats.chi2.isf(1e-6, degrees)
    assert low < statistic < high, f"chi-square {statistic:.1f} with {degrees} degrees"


def multinomial_chi_square(counts: np.ndarray) -> float:
    expected = counts.sum() / counts.size
    assert expected >= 20  # The chi-square approximation holds.
    return float(((counts - expected) ** 2).sum() / expected)


@pytest.mark.property
@pytest.mark.optimized
@pytest.mark.parametrize("case", CASES)
def test_members_are_distinct_and_from_the_pool(case: tuple[int, int, int]) -> None:
    in_order = np.sort(draw_numpy(case), axis=1)
    assert (np.diff(in_order, axis=1) > 0).all()


@pytest.mark.property
@pytest.mark.parametrize("case", [c for c in CASES if c[2] < c[0]])
def test_every_member_is_drawn_equally_often(case: tuple[int, int, int]) -> None:
    """Counts of members over n sets have variance n p (1 - p), p = m / P, and correlation
    -1 / (P - 1), so `(P - 1) / P * sum (count - n p)^2 / (n p (1 - p))` is chi-square, P - 1."""
    size, _, m = case
    counts = np.bincount(draw_numpy(case).reshape(-1), minlength=size)
    p = m / size
    variance = NUM_SETS * p * (1 - p)
    statistic = (size - 1) / size * ((counts - NUM_SETS * p) ** 2).sum() / variance
    assert_chi_square(statistic, size - 1)


@pytest.mark.property
@pytest.mark.parametrize("case", [(6, 6, 3), (6, 6, 4)])
def test_every_subset_is_drawn_equally_often(case: tuple[int, int, int]) -> None:
    """The whole joint law: each of the C(P, m) subsets is one cell of a multinomial."""
    size, _, m = case
    drawn = np.sort(draw_numpy(case), axis=1)
    codes = (drawn * size ** np.arange(m)).sum(axis=1)
    _, counts = np.unique(codes, return_counts=True)
    assert len(counts) == math.comb(size, m)
    assert_chi_square(multinomial_chi_square(counts), len(counts) - 1)


@pytest.mark.property
@pytest.mark.parametrize("case", [(40, 200, 39), (40, 44, 30)])
def test_every_pair_is_drawn_equally_often(case: tuple[int, int, int]) -> None:
    """One pair of slots per set, chosen independently of the draw, so that cells are multinomial
    whatever order a set comes in."""
    size = case[0]
    members = draw_numpy(case)
    slots = np.argsort(np.random.default_rng(0).random(members.shape), axis=1)[:, :2]
    pairs = np.sort(np.take_along_axis(members, slots, axis=1), axis=1)
    counts = np.bincount(pairs[:, 0] * size + pairs[:, 1], minlength=size**2)
    counts = counts[[a * size + b for a, b in itertools.combinations(range(size), 2)]]
    assert counts.sum() == NUM_SETS
    assert_chi_square(multinomial_chi_square(counts), len(counts) - 1)


@pytest.mark.property
@pytest.mark.parametrize("case", [(6, 16, 6), (5, 7, 5)])
def test_the_whole_pool_is_drawn_when_the_set_is_as_large(case: tuple[int, int, int]) -> None:
    assert (np.sort(draw_numpy(case), axis=1) == np.arange(case[0])).all()


@pytest.mark.property
@pytest.mark.parametrize("case", [(40, 100, 30), (40, 44, 30)])
def test_a_set_depends_on_its_key_alone(case: tuple[int, int, int]) -> None:
    size, capacity, m = case
    keys, pool = keys_of(6, 24), pool_of(size, capacity)
    together = np.asarray(draw(keys, pool, set_size=m).ids)
    assert np.array_equal(together, np.asarray(draw(keys, pool, set_size=m).ids))
    assert np.array_equal(together[::-1], np.asarray(draw(keys[::-1], pool, set_size=m).ids))
    few = np.asarray(draw(keys[5:9].reshape(2, 2), pool, set_size=m).ids)
    assert np.array_equal(together[5:9].reshape(2, 2, m), few)
    # Different keys give different sets.
    assert len({frozenset(row) for row in together.tolist()}) == 24


@pytest.mark.unit
def test_padding_repeats_valid_ids_and_is_masked() -> None:
    pool = pool_of(6, 6)
    bare = draw(keys_of(7, 50), pool, set_size=4, padded_size=4)
    assert np.asarray(bare.mask).all()
    padded = draw(keys_of(7, 50), pool, set_size=4, padded_size=7)
    assert padded.ids.shape == padded.mask.shape == (50, 7)
    assert padded.ids.dtype == jnp.int32
    assert padded.mask.dtype == bool
    # The set itself is the one drawn without padding.
    assert np.array_equal(padded.ids[:, :4], bare.ids)
    assert (np.asarray(padded.mask) == [True] * 4 + [False] * 3).all()
    ids = np.asarray(padded.ids)
    assert all(set(row[4:]) <= set(row[:4]) for row in ids.tolist())


@pytest.mark.unit
@pytest.mark.parametrize("capacity", [14, 30])  # Sorting and rejection.
def test_always_available_actions_stand_first_and_are_not_drawn_again(capacity: int) -> None:
    """As CREATE's no-op, which is removed from the pool and put into slot 0."""
    always = (5, 9)  # 9 is offered as a member too; 5 as well.
    pool = pool_of(14, capacity, always)
    assert int(pool.size) == 12
    drawn = draw(keys_of(8, 400), pool, set_size=10, padded_size=12)
    ids = np.asarray(drawn.ids)
    assert (ids[:, :2] == always).all()
    assert not np.isin(ids[:, 2:10], always).any()
    assert (np.diff(np.sort(ids[:, :10], axis=1), axis=1) > 0).all()
    assert np.array_equal(np.unique(ids[:, 2:10]), np.setdiff1d(3 + 2 * np.arange(14), always))
    assert (np.asarray(drawn.mask) == [True] * 10 + [False] * 2).all()
    # 8 of 12 members in each set: the count of each is binomial-like, deviation below
    # sqrt(400 * 2/3 * 1/3) = 9.4; five of them.
    counts = np.bincount(ids[:, 2:10].reshape(-1))
    assert np.abs(counts[counts > 0] - 400 * 8 / 12).max() < 47


@pytest.mark.unit
def test_one_program_serves_pools_of_every_size() -> None:
    split = random_halves_split(skill_universe(), seed=0)
    num_traces = 0

    @jax.jit
    def counted(keys: jax.Array, pool: ActionPool) -> jax.Array:
        nonlocal num_traces
        num_traces += 1
        return draw_sets(keys, pool, 50).ids

    for name in ("train", "validation", "test", "all"):
        ids = np.asarray(
            counted(keys_of(9, 40), ActionPool.of(split.ids(name), capacity=1024)).tolist()
        )
        assert np.isin(ids, split.ids(name)).all()
        assert all(len(set(row)) == 50 for row in ids.tolist())
    assert num_traces == 1


@pytest.mark.unit
def test_a_pool_holds_its_members_and_valid_padding() -> None:
    pool = ActionPool.of(np.array([7, 2, 9]), capacity=5)
    assert int(pool.size) == 3
    assert sorted(pool.ids[:3].tolist()) == [2, 7, 9]
    assert set(pool.ids.tolist()) == {2, 7, 9}
    assert pool.ids.shape == (5,)
    assert pool.always_available.shape == (0,)
    exact = ActionPool.of(np.array([7, 2, 9]), capacity=3)
    assert sorted(exact.ids.tolist()) == [2, 7, 9]


@pytest.mark.unit
@pytest.mark.parametrize(
    ("ids", "always", "message"),
    [
        ([], [], "non-empty"),
        ([4, 4], [], "action 4 stands there twice"),
        ([4], [4], "more than the always available"),
        ([1, 2, 3, 4], [], "4 ids do not fit a pool of capacity 3"),
    ],
)
def test_bad_pools_are_refused(ids: list[int], always: list[int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActionPool.of(np.array(ids, np.int32), capacity=3, always_available=np.array(always))


@pytest.mark.unit
def test_a_pool_beyond_the_range_of_the_draw_is_refused() -> None:
    """`_random_below` is right up to 2**16 members; beyond, the last are never drawn."""
    assert ActionPool.of(np.arange(2**16), capacity=2**16).size == 2**16
    with pytest.raises(ValueError, match="65"):
        ActionPool.of(np.arange(2**16 + 1), capacity=2**16 + 1)


@pytest.mark.unit
def test_check_set_size_says_what_fits() -> None:
    plain, with_always = pool_of(6, 16), pool_of(6, 16, (100, 101))
    for pool, sizes in ((plain, (1, 6)), (with_always, (3, 8))):
        assert all(check_set_size(pool, size) is None for size in sizes)
    with pytest.raises(ValueError, match=r"Sets of 7 .*test actions.* 6 \(0 .*1\.\.6"):
        check_set_size(plain, 7, "the test actions")
    with pytest.raises(ValueError, match=r"Sets of 0 .*1\.\.6"):
        check_set_size(plain, 0)
    with pytest.raises(ValueError, match=r"Sets of 9 .* 8 \(2 .*3\.\.8"):
        check_set_size(with_always, 9)
    # Nothing would be drawn.
    with pytest.raises(ValueError, match=r"Sets of 2 .*3\.\.8"):
        check_set_size(with_always, 2)


@pytest.mark.property
@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    bits=st.lists(
        st.sampled_from([0, 1, 0xFFFF, 0x10000, 0xFFFF0000, 0xFFFFFFFE, 0xFFFFFFFF])
        | st.integers(0, 2**32 - 1),
        min_size=8,
        max_size=8,
    ),
    bound=st.sampled_from([1, 2, 3, 50, 512, 10_000, 2**16 - 1, 2**16]) | st.integers(1, 2**16),
)
def test_random_below_is_the_scaled_word(bits: list[int], bound: int) -> None:
    """floor(bits * bound / 2**32) exactly: in 0..bound-1 and monotone, so every value has
    floor(2**32 / bound) or one more words that lead to it."""
    words = jnp.asarray(np.array(bits, np.uint32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.random, "bits", lambda *_args, **_kwargs: words)
        got = sampling._random_below(jax.random.key(0), (8,), jnp.int32(bound))
    assert got.dtype == jnp.int32
    assert got.tolist() == [word * bound >> 32 for word in bits]


@pytest.mark.property
@pytest.mark.parametrize("split_name", ["train", "validation"])
def test_grid_world_sets_are_new_at_each_reset(split_name: str) -> None:
    """50 distinct ids of the requested split (docs/grid_world.md, "Splits and action sets")."""
    ids, done = collect_grid_world_sets(split_name)
    allowed = random_halves_split(skill_universe(), seed=0).ids(split_name)
    num_steps, num_envs, m = ids.shape
    assert m == 50
    assert np.isin(ids, allowed).all()
    assert (np.diff(np.sort(ids, axis=-1), axis=-1) > 0).all()
    assert done.sum() > 20
    # The set changes at the ends and only there.
    has_changed = (ids[1:] != ids[:-1]).any(axis=-1)
    assert np.array_equal(has_changed, done[:-1])
    # No set is ever met again: 50 of 256 or more, in any order.
    sets = {
        (env, frozenset(ids[t, env].tolist())) for env in range(num_envs) for t in range(num_steps)
    }
    assert len(sets) == num_envs + done[:-1].sum()
    assert len({members for _, members in sets}) == len(sets)


def collect_grid_world_sets(split_name: str) -> tuple[np.ndarray, np.ndarray]:
    """(ids int[T, N, 50], done bool[T, N]) of two rollouts in a row."""
    rollout, collect = grid_world_rollout()
    split = random_halves_split(skill_universe(), seed=0)
    table = jax.random.normal(jax.random.key(12), (1024, 3))
    actions = Actions.of(table, split.ids(split_name), 50)
    state = jax.jit(rollout.init)(jax.random.key(10), actions)
    params = rollout.method.init(jax.random.key(11), state.observation[0], 3)
    batches = []
    for seed in (13, 14):
        state, batch, _ = collect(jax.random.key(seed), state, params, actions, jnp.float32(0.99))
        batches.append((np.asarray(batch.available.ids), np.asarray(batch.done)))
    # One program for all splits.
    assert collect._cache_size() == 1
    return tuple(np.concatenate(parts) for parts in zip(*batches, strict=True))


@functools.cache
def grid_world_rollout() -> tuple[DeviceRollout, Any]:
    env = GridWorld()
    config = RolloutConfig(num_envs=6, num_steps=30)
    rollout = DeviceRollout(env, env.default_params, make_method("ours"), config)
    return rollout, jax.jit(rollout.collect)


# What a policy is offered.

SIZE, TABLE = 30, np.random.default_rng(3).normal(size=(30, 2)).astype(np.float32)
IDS = np.array([21, 3, 5, 8, 13, 2, 1])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"size": 0}, "size=0 must be at least 1"),
        ({"size": 4, "padded_size": 3}, "padded_size=3 is below size=4; use 0 for no padding"),
        ({"size": 4, "training_size": -1}, r"training_size=-1 must be in 1\.\.4, .* or 0"),
        ({"size": 4, "training_size": 5}, r"training_size=5 must be in 1\.\.4, .*; set both"),
    ],
)
def test_bad_sizes_are_refused(sizes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SetConfig(**sizes)


@pytest.mark.unit
def test_actions_draw_what_the_pool_draws() -> None:
    keys = keys_of(4, 30)
    actions = Actions.of(
        TABLE, IDS, 4, padded_size=6, always_available=np.array([0, 21]), name="seven"
    )
    assert (actions.set_size, actions.padded_size, actions.is_fixed) == (4, 6, False)
    assert actions.num_actions == 8
    pool = ActionPool.of(IDS, capacity=SIZE, always_available=np.array([0, 21]))
    found, expected = actions.draw(keys), draw_sets(keys, pool, 4, 6)
    assert np.array_equal(found.ids, expected.ids)
    assert np.array_equal(found.mask, expected.mask)
    assert (np.asarray(found.ids)[:, :2] == [0, 21]).all()
    # All rows may be needed, and a set's are those of its ids.
    rows = actions.rows(actions.offered(found), found)
    np.testing.assert_array_equal(rows, TABLE[np.asarray(found.ids)])
    assert Actions.of(TABLE, IDS, 4).padded_size == 4
    assert not np.asarray(Actions.of(TABLE, IDS, 4, padded_size=5).draw(keys).mask).all()


@pytest.mark.unit
def test_a_fixed_set_has_every_action_once_whatever_the_key() -> None:
    """Those that are always available stand first, and are no members besides."""
    actions = Actions.of(TABLE, IDS, always_available=np.array([0, 21]))
    assert (actions.set_size, actions.num_actions, actions.is_fixed) == (8, 8, True)
    available = actions.draw(keys_of(5, 3))
    assert available.ids.shape == available.mask.shape == (actions.padded_size,) == (9,)
    real = available.ids[available.mask].tolist()
    assert real[:2] == [0, 21]
    assert sorted(real) == sorted([0, *IDS])
    assert set(available.ids.tolist()) == set(real)
    offered = actions.offered(available)
    np.testing.assert_array_equal(offered, TABLE[np.asarray(available.ids)])
    assert actions.rows(offered, available) is offered
    plain = Actions.of(TABLE, IDS)
    assert (plain.set_size, plain.padded_size) == (7, 7)
    assert sorted(plain.draw(keys_of(5, 1)).ids.tolist()) == sorted(IDS)


@pytest.mark.unit
def test_a_growing_set_is_the_beginning_of_the_whole_one() -> None:
    actions = Actions.of(TABLE, IDS, 6, padded_size=7)
    whole = actions.draw(keys_of(6, 4))
    assert actions.at(whole, jnp.int32(0)) is whole
    growing = actions.growing(2, 3)
    assert (growing.first_size, growing.growth) == (2, 3)
    assert np.array_equal(growing.draw(keys_of(6, 4)).ids, whole.ids)
    for t, count in enumerate((2, 5, 6, 6)):
        now = growing.at(whole, jnp.int32(t))
        assert np.array_equal(now.ids, whole.ids)
        assert np.asarray(now.mask).sum(axis=1).tolist() == [count] * 4
    # Environments that are at different steps, on the host.
    now = growing.at(whole, np.array([0, 1, 2, 0]))
    assert np.asarray(now.mask).sum(axis=1).tolist() == [2, 5, 6, 2]
    unchanging = actions.growing(2, 0).at(whole, jnp.int32(9))
    assert np.asarray(unchanging.mask).sum(axis=1).tolist() == [2] * 4


@pytest.mark.property
def test_noise_is_as_wide_as_what_sets_are_drawn_from() -> None:
    """Rows of other actions have noise, but no say in how much: a policy may not know them."""
    rng = np.random.default_rng(0)
    scale = np.array([0.1, 1.0, 30.0], np.float32)
    table = (rng.normal(size=(4000, 3)) * scale + 7.0).astype(np.float32)
    ids = np.arange(0, 2000, 2)
    table[2000:] *= 1e3
    actions = Actions.of(table, ids, 50)
    perturbed = jax.jit(Actions.perturbed)
    moved = np.asarray(perturbed(actions, jax.random.key(0), 0.2).table) - table
    # Means and deviations of 2,000 normal numbers: within 4 of their own deviations.
    wanted = 0.2 * table[ids].std(axis=0)
    np.testing.assert_allclose(moved[:2000].std(axis=0), wanted, rtol=4 / math.sqrt(2 * 2000))
    assert (np.abs(moved[:2000].mean(axis=0)) < 4 * wanted / math.sqrt(2000)).all()
    assert np.abs(moved[2000:]).max() < 6 * wanted.max()
    assert np.abs(np.corrcoef(moved[:2000].T) - np.eye(3)).max() < 4 / math.sqrt(2000)
    other = np.asarray(perturbed(actions, jax.random.key(1), 0.2).table) - table
    assert not np.isclose(other[:2000], moved[:2000]).any(axis=1).all()
    still = perturbed(actions, jax.random.key(0), 0.0)
    np.testing.assert_array_equal(still.table, table)
    many = jax.vmap(lambda noise: actions.perturbed(jax.random.key(0), noise).table)(
        jnp.array([0.0, 0.2])
    )
    np.testing.assert_array_equal(many[0], table)
    np.testing.assert_allclose(many[1] - table, moved, rtol=1e-3, atol=1e-2)


@pytest.mark.unit
def test_actions_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Sets of 8 .* from the test actions, .* 7 \(0 "):
        Actions.of(TABLE, IDS, 8, name="the test actions")
    with pytest.raises(ValueError, match="action 4 stands there twice"):
        Actions.of(TABLE, np.array([4, 4]), 1)
    with pytest.raises(ValueError, match="must be a non-empty list of integers"):
        Actions.of(TABLE, np.zeros(0, np.int32))
    with pytest.raises(ValueError, match=r"hold action 30, .* describes 0\.\.29"):
        Actions.of(TABLE, np.arange(31), 2)
    with pytest.raises(ValueError, match="every half of the 7 groups"):
        Actions.of(TABLE, IDS, 4, groups=np.arange(7))
    with pytest.raises(ValueError, match="padded_size=3 is below set_size=4"):
        Actions.of(TABLE, IDS, 4, padded_size=3)
    actions = Actions.of(TABLE, IDS, 4)
    for sizes in ((5, 1), (-1, 1), (2, -1)):
        with pytest.raises(ValueError, match=rf"first_size={sizes[0]} must be in 0\.\.4"):
            actions.growing(*sizes)


@pytest.mark.unit
def test_one_trace_serves_train_validation_and_test_actions() -> None:
    """Another table, other actions and other numbers of them; only sizes are static."""
    num_traces = 0

    @jax.jit
    def counted(keys: jax.Array, actions: Actions) -> tuple[AvailableSet, jax.Array]:
        nonlocal num_traces
        num_traces += 1
        available = actions.draw(keys)
        return available, actions.rows(actions.offered(available), available)

    split = random_halves_split(skill_universe(), seed=0)
    table = np.random.default_rng(0).normal(size=(1024, 3)).astype(np.float32)
    for number, part in enumerate(("train", "validation", "test")):
        actions = Actions.of(table + number, split.ids(part), 50)
        available, rows = counted(keys_of(9, 40), actions)
        assert np.isin(available.ids, split.ids(part)).all()
        np.testing.assert_array_equal(rows, (table + number)[np.asarray(available.ids)])
    assert num_traces == 1
    counted(keys_of(9, 40), Actions.of(table, split.test, 49))
    assert num_traces == 2
