"""Sets drawn from half of the groups of a pool (docs/method.md, cluster sampling)."""

from __future__ import annotations

import itertools
from collections import Counter

import jax
import numpy as np
import pytest
from scipy.stats import chisquare

from jaxnew.sampling import ActionPool, check_set_size, draw_sets

IDS = np.array([30, 10, 20, 50, 40, 60, 70, 80], np.int32)
GROUPS = np.array([0, 0, 1, 1, 1, 2, 2, 3])  # {30, 10}, {20, 50, 40}, {60, 70}, {80}
MEMBERS = [{30, 10}, {20, 50, 40}, {60, 70}, {80}]


def draws(pool: ActionPool, set_size: int, count: int, seed: int = 0) -> np.ndarray:
    """int32[count, set_size]."""
    keys = jax.random.split(jax.random.key(seed), count)
    return np.asarray(jax.jit(lambda k: draw_sets(k, pool, set_size).ids)(keys))


@pytest.mark.oracle
def test_every_set_has_its_probability() -> None:
    """Half of the groups uniformly, then pairs of their members uniformly: by enumeration."""
    pool = ActionPool.of(IDS, capacity=12, groups=GROUPS)
    expected: Counter[tuple[int, int]] = Counter()
    halves = list(itertools.combinations(range(4), 2))
    for half in halves:
        pairs = list(itertools.combinations(sorted(set.union(*(MEMBERS[g] for g in half))), 2))
        for pair in pairs:
            expected[pair] += 1 / (len(halves) * len(pairs))
    count = 20_000
    found = Counter(tuple(sorted(row)) for row in draws(pool, 2, count).tolist())
    assert set(found) <= set(expected)
    observed = [found[pair] for pair in expected]
    # Fixed key; a correct draw fails once in a thousand keys.
    assert chisquare(observed, [count * p for p in expected.values()]).pvalue > 1e-3


@pytest.mark.property
@pytest.mark.parametrize("num_groups", [1, 2, 5, 10])
def test_a_set_stays_within_half_of_the_groups(num_groups: int) -> None:
    ids = np.random.default_rng(num_groups).permutation(200)[:100].astype(np.int32)
    groups = np.arange(100) % num_groups
    group_of = dict(zip(ids.tolist(), groups.tolist(), strict=True))
    pool = ActionPool.of(ids, capacity=200, groups=groups)
    size = max(1, num_groups // 2) * (100 // num_groups)  # All members of the groups drawn.
    for set_size in (3, size):
        sets = draws(pool, set_size, 200)
        assert all(len(set(row)) == set_size for row in sets.tolist())
        seen = [{group_of[i] for i in row} for row in sets.tolist()]
        assert max(map(len, seen)) <= max(1, num_groups // 2)
        assert set.union(*seen) == set(range(num_groups))


@pytest.mark.unit
def test_what_is_always_available_stands_first_and_in_no_group() -> None:
    always = np.array([20, 99], np.int32)
    pool = ActionPool.of(IDS, capacity=12, always_available=always, groups=GROUPS)
    assert int(pool.size) == 7
    assert np.asarray(pool.group_starts).tolist() == [0, 2, 4, 6, 7]
    assert set(np.asarray(pool.ids)[2:4].tolist()) == {40, 50}
    sets = draws(pool, 4, 100)
    assert (sets[:, :2] == always).all()
    assert not np.isin(sets[:, 2:], always).any()


@pytest.mark.unit
def test_sets_too_large_for_some_half_are_refused() -> None:
    pool = ActionPool.of(IDS, capacity=12, groups=GROUPS)
    check_set_size(pool, 3)  # {80} and {30, 10}.
    with pytest.raises(ValueError, match="the smallest groups hold 3 with those always"):
        check_set_size(pool, 4)
    with pytest.raises(ValueError, match=r"8 ids need as many group labels, got shape \(3,\)"):
        ActionPool.of(IDS, capacity=12, groups=np.zeros(3))


@pytest.mark.unit
def test_one_program_serves_pools_of_other_groups() -> None:
    jitted = jax.jit(lambda keys, pool: draw_sets(keys, pool, 2).ids)
    keys = jax.random.split(jax.random.key(0), 4)
    for labels in (GROUPS, GROUPS[::-1].copy()):
        jitted(keys, ActionPool.of(IDS, capacity=12, groups=labels))
    assert jitted._cache_size() == 1


@pytest.mark.golden
def test_sets_without_groups_are_drawn_as_ever() -> None:
    """The numbers of revision 298f35c."""
    pool = ActionPool.of(np.arange(40, dtype=np.int32), capacity=64)
    found = draw_sets(jax.random.split(jax.random.key(7), 2), pool, 6).ids
    assert np.asarray(found).tolist() == GOLDEN


GOLDEN = [[7, 30, 15, 13, 28, 35], [9, 32, 31, 30, 18, 1]]
