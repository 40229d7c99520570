"""MuJoCo's C engine: reference figures, and what every engine promises."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs_mjx.shape_stacking import rules, scene, shape_library
from envs_mjx.shape_stacking.engines import contract, mujoco_c
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.engines.mujoco_pool import world_model
from experiments.untrained import towers as stacking

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def engine() -> MujocoC:
    return MujocoC()


@pytest.fixture(scope="module")
def short() -> MujocoC:
    return MujocoC(settle_steps=60)


def heap(seed: int, count: int) -> Arrays:
    """Worlds of 0 to 12 shapes, not far above the table and each other, turned and moving."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 810, (count, 12)).astype(np.int32)
    ids[rng.random((count, 12)) < 0.4] = -1
    quaternion = rng.normal(size=(count, 12, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    xy = rng.uniform(-0.5, 0.5, (count, 12, 2))
    z = np.broadcast_to(0.2 + 0.9 * np.arange(12), (count, 12))[..., None]
    qpos = np.concatenate([xy, z, quaternion], axis=-1).astype(np.float32)
    return ids, qpos, rng.uniform(-1.0, 1.0, (count, 12, 6)).astype(np.float32)


def assert_same(found: Any, expected: Any) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


@pytest.mark.property
def test_copies_simulate_the_same_apart(short: MujocoC) -> None:
    """A shallow copy shares the worlds; others have theirs, in other processes too."""
    state = heap(0, 3)
    expected = short.settle_host(*state)
    for copied in (copy.deepcopy(short), pickle.loads(pickle.dumps(short))):
        assert copied._worlds is not short._worlds
        assert_same(copied.settle_host(*state), expected)
    assert copy.copy(short)._worlds is short._worlds


@pytest.mark.golden
def test_reference_figures(engine: MujocoC) -> None:
    """3, 4 and 6 to 15 of docs/shape_stacking.md, "Reference figures", with its tolerances."""
    rows = stacking.measured(engine)
    asserted = [row for row in rows if row.tolerance is not None]
    assert len(asserted) > 70
    assert {row.check for row in asserted} == {3, 4, *range(6, 16)}
    wrong = [r for r in asserted if not abs(r.value - float(r.spec)) <= float(r.tolerance or 0)]
    assert wrong == []
    # Figure 9: off its centre by 0.03, the upper sphere falls off the lower one.
    fallen = next(row for row in rows if row.spec == "falls off")
    assert fallen.value < 0.5


@pytest.mark.golden
def test_04_the_start_scene_stays(engine: MujocoC) -> None:
    bodies = stacking.start_scenes([798, 799, 800], [0.1, 0.0, -0.2], [1.0, 1.3, 1.6])
    after = stacking.settled(engine, bodies)
    np.testing.assert_allclose(after.qpos[:, :2, 0], bodies.qpos[:, :2, 0], atol=1e-3)
    np.testing.assert_array_equal(after.qpos[:, 2:], bodies.qpos[:, 2:])


@pytest.mark.golden
def test_several_contacts_hold_a_tower_straighter(engine: MujocoC) -> None:
    """With one contact per pair, towers of hulls creep; with several they stand."""
    drops = [((690, -0.65), (684, -0.65), (678, -0.65))]
    drift = {}
    for name, one in (("one", engine), ("several", MujocoC(has_multiple_contacts=True))):
        start = stacking.start_scenes([799], [0.0], [1.3])
        tower = np.asarray(stacking.stack(one, start, drops).qpos)[0, 2:5]
        assert np.abs(tower[:, 2] - [0.478, 1.027, 1.492]).max() < 0.03
        drift[name] = np.abs(tower[:, 0] + 0.65).max()
    assert drift["several"] < 1e-3 < drift["one"]


@pytest.mark.oracle
@pytest.mark.parametrize("several", [False, True])
def test_worlds_equal_models_of_their_own(several: bool) -> None:
    """Against models that hold each world's shapes and no others, stepped one by one.

    Impacts magnify rounding, so single steps are compared, from forty moments of a fall.
    """
    engine = MujocoC(settle_steps=1, has_multiple_contacts=several)
    ids, qpos, _ = heap(0, 5)
    for k in range(len(ids)):
        model, used = world_model(ids[k], several), ids[k] >= 0
        data, one = mujoco.MjData(model), mujoco.MjData(model)
        data.qpos[:] = np.where(used[:, None], qpos[k], scene.parked_qpos()).ravel()
        befores, afters, num_contacts = [], [], 0
        for _ in range(40):
            mujoco.mj_step(model, data, 3)
            mujoco.mj_resetData(model, one)
            one.qpos[:], one.qvel[:] = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
            befores.append((one.qpos.reshape(12, 7).copy(), one.qvel.reshape(12, 6).copy()))
            mujoco.mj_step(model, one)
            afters.append((one.qpos.reshape(12, 7).copy(), one.qvel.reshape(12, 6).copy()))
            num_contacts += one.ncon
        assert num_contacts > 40
        state = [np.array(x, np.float32) for x in zip(*befores, strict=True)]
        found = engine.settle_host(np.repeat(ids[k : k + 1], 40, axis=0), *state)
        assert found[2].all()
        # Float32 of at most 15 m or m/s, and where Newton's method stops.
        for result, expected in zip(found, zip(*afters, strict=True), strict=False):
            np.testing.assert_allclose(result[:, used], np.array(expected)[:, used], atol=1e-5)


@pytest.mark.oracle
def test_free_fall() -> None:
    """Euler with 0.01 s: after n steps v = -g n dt and z = z0 - g dt^2 n (n + 1) / 2."""
    ids = np.full((1, 12), -1, np.int32)
    ids[0, 7] = 735
    qpos, qvel = scene.parked_qpos()[None].copy(), np.zeros((1, 12, 6), np.float32)
    qpos[0, 7, :3] = 0.0, 0.0, 2.0
    for steps in (1, 30):
        new_qpos, new_qvel, ok = MujocoC(settle_steps=steps).settle_host(ids, qpos, qvel)
        assert ok.all()
        assert new_qvel[0, 7, 2] == pytest.approx(-9.81 * 0.01 * steps, abs=1e-6)
        fallen = 9.81 * 0.01**2 * steps * (steps + 1) / 2
        assert new_qpos[0, 7, 2] == pytest.approx(2.0 - fallen, abs=1e-6)


@pytest.mark.contract
def test_22_same_bits_for_every_batch_order_and_thread_count(short: MujocoC) -> None:
    ids, qpos, qvel = heap(1, 7)
    whole = short.settle_host(ids, qpos, qvel)
    assert whole[2].all()
    assert np.abs(whole[0] - qpos).max() > 0.1
    order = np.random.default_rng(2).permutation(7)
    shuffled = short.settle_host(ids[order], qpos[order], qvel[order])
    assert_same(shuffled, [x[order] for x in whole])
    for k in range(7):
        alone = short.settle_host(ids[k], qpos[k], qvel[k])
        assert_same(alone, [x[k] for x in whole])
    # Bodies that touch from the first step on show what solvers remember.
    again = short.settle_host(ids, *whole[:2])
    shuffled = short.settle_host(ids[order], whole[0][order], whole[1][order])
    assert_same(shuffled, [x[order] for x in again])
    for threads in (1, 3):
        assert_same(MujocoC(60, num_threads=threads).settle_host(ids, qpos, qvel), whole)


@pytest.mark.contract
def test_more_worlds_than_fit_at_once(monkeypatch: pytest.MonkeyPatch, short: MujocoC) -> None:
    ids, qpos, qvel = heap(1, 7)
    whole = short.settle_host(ids, qpos, qvel)
    monkeypatch.setattr(mujoco_c, "_CAPACITY", 3)
    assert_same(MujocoC(60).settle_host(ids, qpos, qvel), whole)


@pytest.mark.contract
def test_jit_vmap_and_scan_equal_direct_calls(short: MujocoC) -> None:
    ids, qpos, qvel = heap(3, 6)
    direct = short.settle_host(ids, qpos, qvel)
    again = short.settle_host(ids, *direct[:2])
    assert_same(short.settle(ids, qpos, qvel), direct)
    assert_same(jax.jit(short.settle)(ids, qpos, qvel), direct)
    assert_same(jax.jit(jax.vmap(short.settle))(ids, qpos, qvel), direct)
    # Vmapped over ids alone, and over two axes.
    one_state = jax.jit(jax.vmap(short.settle, in_axes=(0, None, None)))(ids, qpos[0], qvel[0])
    expected = short.settle_host(ids, *(np.repeat(x[:1], 6, axis=0) for x in (qpos, qvel)))
    assert_same(one_state, expected)
    nested = [x.reshape(2, 3, *x.shape[1:]) for x in (ids, qpos, qvel)]
    found = jax.jit(jax.vmap(jax.vmap(short.settle)))(*nested)
    assert_same(found, [x.reshape(2, 3, *x.shape[1:]) for x in direct])

    def body(state: Any, _: Any) -> tuple[Any, Any]:
        settled = jax.vmap(short.settle)(ids, *state)
        return (settled.qpos, settled.qvel), settled

    _, both = jax.jit(lambda *state: jax.lax.scan(body, state, length=2))(qpos, qvel)
    assert_same([x[0] for x in both], direct)
    assert_same([x[1] for x in both], again)


@pytest.mark.contract
def test_unused_bodies_come_back_parked_whatever_they_were(short: MujocoC) -> None:
    ids, qpos, qvel = heap(4, 3)
    unused = ids < 0
    expected = short.settle_host(ids, qpos, qvel)
    parked = np.broadcast_to(scene.parked_qpos(), qpos.shape)
    np.testing.assert_array_equal(expected[0][unused], parked[unused])
    assert not expected[1][unused].any()
    qpos[unused], qvel[unused] = np.nan, 1e30
    ids[unused] = -7
    assert_same(short.settle_host(ids, qpos, qvel), expected)
    none = short.settle_host(np.full((1, 12), -1, np.int32), qpos[:1], qvel[:1])
    assert_same(none, [scene.parked_qpos()[None], np.zeros((1, 12, 6)), [True]])


@pytest.mark.contract
@pytest.mark.parametrize(
    ("where", "value"),
    [("qpos", np.nan), ("qpos", 201.0), ("qvel", np.inf), ("qvel", -51.0), ("spin", 1001.0)],
)
def test_unsound_worlds_are_given_back(short: MujocoC, where: str, value: float) -> None:
    """The others are as without them."""
    ids, qpos, qvel = heap(5, 3)
    expected = short.settle_host(ids, qpos, qvel)
    slot = int(np.flatnonzero(ids[1] >= 0)[0])
    {"qpos": qpos[..., 0], "qvel": qvel[..., 1], "spin": qvel[..., 4]}[where][1, slot] = value
    found = short.settle_host(ids, qpos, qvel)
    assert found[2].tolist() == [True, False, True]
    assert_same([x[1] for x in found[:2]], [qpos[1], qvel[1]])
    assert_same([x[::2] for x in found], [x[::2] for x in expected])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("array", "column", "limit"),
    [("qpos", 0, 200.0), ("qpos", 2, 200.0), ("qvel", 1, 50.0), ("qvel", 3, 1000.0)],
)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_limits_of_plausible_worlds(array: str, column: int, limit: float, sign: float) -> None:
    state = {"qpos": np.zeros((4, 12, 7)), "qvel": np.zeros((4, 12, 6))}
    state[array][:, 11, column] = sign * np.array([0.99 * limit, 1.01 * limit, np.inf, np.nan])
    assert contract.is_plausible(**state).tolist() == [True, False, False, False]


@pytest.mark.contract
def test_worlds_that_explode_are_given_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A fall that ends above the limit, and one that the engine itself gives up."""
    monkeypatch.chdir(tmp_path)
    engine = MujocoC(settle_steps=30)
    ids, qpos, qvel = heap(6, 2)
    ids[:] = -1
    ids[:, 0] = 735
    qpos[:, 0, 2] = 5.0
    qvel[:] = 0.0
    assert engine.settle_host(ids, qpos, qvel)[2].all()
    monkeypatch.setattr(contract, "MAX_SPEED", 2.0)  # 2.94 m/s after 0.3 s.
    found = engine.settle_host(ids, qpos, qvel)
    assert_same(found, [qpos, qvel, [False, False]])

    for name in ("MAX_SPEED", "MAX_SPIN", "MAX_DISTANCE_M"):
        monkeypatch.setattr(contract, name, np.inf)
    qvel[1, 0, 2] = 1e12  # MuJoCo stops at 1e10 and starts anew from its own first state.
    found = engine.settle_host(ids, qpos, qvel)
    assert found[2].tolist() == [True, False]
    assert_same([x[1] for x in found[:2]], [qpos[1], qvel[1]])
    assert list(tmp_path.iterdir()) == []  # Where MuJoCo would leave a log.
    qvel[1, 0, 2] = 0.0
    assert engine.settle_host(ids, qpos, qvel)[2].all()


@pytest.mark.contract
def test_no_worlds(short: MujocoC) -> None:
    found = short.settle_host(*(x[:0] for x in heap(0, 1)))
    assert [x.shape for x in found] == [(0, 12, 7), (0, 12, 6), (0,)]


@pytest.mark.unit
def test_bad_input_is_refused(short: MujocoC) -> None:
    ids, qpos, qvel = heap(0, 2)
    for call in (short.settle, short.settle_host):
        with pytest.raises(ValueError, match=r"the shapes \(2, 12\), \(2, 12, 7\), \(2, 12, 7\);"):
            call(ids, qpos, qpos)
        with pytest.raises(ValueError, match="the same leading axes"):
            call(ids[0], qpos, qvel)
        with pytest.raises(TypeError, match="float64; give int32, float32 and float32"):
            call(ids, qpos, qvel.astype(np.float64))
        with pytest.raises(TypeError, match="are int64, float32, float32; give int32"):
            call(ids.astype(np.int64), qpos, qvel)
    ids[1, 3] = 810
    with pytest.raises(ValueError, match=r"shape_ids has 810; ids are 0\.\.809"):
        short.settle_host(ids, qpos, qvel)
    with pytest.raises(ValueError, match="settle_steps=0 must be 1 to 100,000"):
        MujocoC(settle_steps=0)
    with pytest.raises(ValueError, match="num_threads=-1 must be 0"):
        MujocoC(num_threads=-1)
    with pytest.raises(ValueError, match="num_threads=1000000 must be 0"):
        MujocoC(num_threads=10**6)
    with pytest.raises(ValueError, match="settle_steps=1000000000 must be 1 to"):
        MujocoC(settle_steps=10**9)


@pytest.mark.unit
def test_input_is_left_as_it_was(short: MujocoC) -> None:
    state = heap(8, 2)
    before = [x.copy() for x in state]
    short.settle_host(*state)
    assert_same(state, before)


@pytest.mark.contract
def test_engine_and_rules_in_one_program(engine: MujocoC) -> None:
    """Figure 6 as an environment would play it: place, settle, reward in one jitted function."""

    @jax.jit
    def play(position: jax.Array) -> tuple[jax.Array, jax.Array]:
        bodies = rules.place(rules.start(799, 0.0, 1.3), 2, 690, position)
        qpos, qvel, ok = engine.settle(bodies.shape_ids, bodies.qpos, bodies.qvel)
        return rules.tower_reward(rules.Bodies(bodies.shape_ids, qpos, qvel)), ok

    reward, ok = play(jnp.array([-0.65, 0.0]))
    assert bool(ok)
    assert float(reward) == pytest.approx(0.732, abs=0.005)
    s = shape_library().s[690]
    assert float(reward) < 0.5 * (2 * 0.34207 + s) + 0.5 * (2 * 0.34207 + s - 0.5)
