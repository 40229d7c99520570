"""Recordings that stay on the host: the batches, the training and the encoding of an array."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.finiteness import cause_of
from jaxnew.representation import learner
from jaxnew.representation.modality import vector_modality
from jaxnew.representation.sources import (
    DrawnRecordings,
    RecordingSource,
    StoredRecordings,
    padded_chunks,
)

XY = vector_modality("xy", 2)
TINY = learner.RepresentationConfig(
    encoder_width=4,
    inference_width=8,
    hidden_width=8,
    action_latent=3,
    observation_latent=3,
    actions_per_batch=3,
    recordings_per_action=4,
)
RNG = np.random.default_rng(0)
SMALL = RNG.integers(0, 20, (10, 6, 3)).astype(np.uint8)  # The small form of 10 x 6 recordings.
IDS = np.arange(10, dtype=np.int32) * 7


def draw(ids, small):
    """Each number of the small form becomes a point; its y says whose recording it is."""
    return np.stack([small, np.broadcast_to(ids[:, None] % 5, small.shape)], axis=-1)


FULL = draw(np.repeat(IDS, 6), SMALL.reshape(60, 3)).reshape(10, 6, 3, 2).astype(np.uint8)


def sources(rows=None):
    return {
        "stored": StoredRecordings(FULL, rows),
        "drawn": DrawnRecordings(
            SMALL, IDS, lambda ids, small: draw(ids, small).astype(np.uint8), (3, 2), rows
        ),
    }


@pytest.fixture(scope="module")
def tiny():
    stage1 = learner.RepresentationLearner(TINY, XY)
    return stage1, stage1.init(jax.random.key(1), FULL.shape)


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["stored", "drawn"])
@pytest.mark.parametrize("rows", [None, np.array([4, 9, 0, 2])])
def test_gathered_recordings_are_those_of_the_array(name, rows):
    source = sources(rows)[name]
    assert isinstance(source, RecordingSource)
    whole = FULL if rows is None else FULL[rows]
    assert source.shape == whole.shape
    chosen, numbers = np.array([[3], [0], [3]]), np.array([[5, 0], [1, 2], [0, 4]])
    found = source.gather(chosen, numbers)
    np.testing.assert_array_equal(found, whole[chosen, numbers])
    assert found.dtype == np.uint8


@pytest.mark.oracle
@pytest.mark.parametrize("kind", ["hvae", "vae"])
def test_every_step_sees_the_batch_of_the_array(kind):
    config = dataclasses.replace(TINY, kind=kind)
    stage1 = learner.RepresentationLearner(config, XY)
    state = stage1.init(jax.random.key(1), FULL.shape)
    state = state.replace(step=jnp.int32(5))
    rows, numbers = jax.device_get(stage1._choices(state, shape=FULL.shape, num_steps=4))
    for i in range(4):
        of_step = state.replace(step=jnp.int32(5 + i))
        expected = jnp.asarray(FULL)[stage1._choice(of_step, FULL.shape)]
        batch = sources()["drawn"].gather(rows[i], numbers[i])
        np.testing.assert_array_equal(batch, expected)
        epoch = stage1._batches.epoch(of_step.step, FULL.shape[0])
        assert int(epoch) == ((5 + i) // 3 if kind == "hvae" else 5 + i)
    assert not np.array_equal(numbers[0], numbers[1])


@pytest.mark.contract
def test_drawn_and_stored_recordings_train_alike_to_the_bit_and_nearly_as_an_array(tiny):
    stage1, start = tiny
    trained = {name: stage1.train_steps(start, source, 7) for name, source in sources().items()}
    by_array = stage1.train_steps(start, jnp.asarray(FULL), 7)
    assert_same(trained["drawn"], trained["stored"])
    state, metrics = trained["drawn"]
    assert int(state.step) == 7
    assert set(metrics) == set(by_array[1])
    for name, value in metrics.items():
        np.testing.assert_allclose(value, by_array[1][name], rtol=1e-4, err_msg=name)
    # Another program, so rounding differs; the last two steps divide by small deviations.
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), state.params, by_array[0].params
    )
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), state.params, start.params)
    assert max(jax.tree.leaves(moved)) > 2e-3


@pytest.mark.contract
@pytest.mark.parametrize("name", ["stored", "drawn"])
def test_two_times_k_steps_from_a_source_are_2k_steps_bit_for_bit(tiny, name):
    stage1, start = tiny
    source = sources()[name]
    at_once, _ = stage1.train_steps(start, source, 6)
    half, _ = stage1.train_steps(start, source, 3)
    again, _ = stage1.train_steps(jax.tree.map(jnp.array, half), source, 3)
    assert_same(at_once, again)
    assert_differ(at_once.params, half.params)


@pytest.mark.unit
def test_metrics_are_means_and_non_finite_numbers_are_counted(tiny):
    stage1, start = tiny
    source = sources()["stored"]
    singles, state = [], start
    for _ in range(3):
        state, metrics = stage1.train_steps(state, source, 1)
        singles.append(float(metrics["loss"]))
    _, metrics = stage1.train_steps(start, source, 3)
    np.testing.assert_allclose(metrics["loss"], np.mean(singles), rtol=1e-6)
    assert cause_of(metrics) is None
    params = jax.tree.map(lambda leaf: leaf, start.params)
    params["decoder"]["write"]["bias"] = jnp.full_like(params["decoder"]["write"]["bias"], np.nan)
    _, metrics = stage1.train_steps(start.replace(params=params), source, 3)
    # Those of the first step, counted, not averaged.
    assert float(metrics["nonfinite/loss"]) == 1.0
    assert cause_of(metrics) == "loss"


@pytest.mark.unit
def test_the_next_batch_is_gathered_between_steps_and_none_in_vain(tiny):
    stage1, start = tiny
    asked = []

    class Watched(StoredRecordings):
        def gather(self, rows, numbers):
            asked.append(numbers.shape)
            return super().gather(rows, numbers)

    stage1.train_steps(start, Watched(FULL), 4)
    assert asked == [(3, 4)] * 4


@pytest.mark.contract
@pytest.mark.parametrize("name", ["stored", "drawn"])
def test_encoding_reads_a_source_in_blocks(tiny, name):
    stage1, state = tiny
    expected = stage1.encode(state, FULL, batch=4)
    np.testing.assert_array_equal(stage1.encode(state, sources()[name], batch=4), expected)
    assert np.abs(np.diff(expected, axis=0)).max() > 0
    chunks = list(padded_chunks(sources()[name], 4))
    assert [chunk.shape for chunk in chunks] == [(4, 6, 3, 2)] * 3
    np.testing.assert_array_equal(np.concatenate(chunks)[:10], FULL)
    np.testing.assert_array_equal(chunks[2][2], FULL[9])


@pytest.mark.unit
def test_large_recordings_are_encoded_few_actions_at_a_time(tiny, monkeypatch):
    """Of videos of 7 x 48 x 48 one action with 1,024 recordings at a time: 2^24 numbers."""
    stage1, state = tiny
    asked = []

    class Watched(StoredRecordings):
        def gather(self, rows, numbers):
            asked.append(len(rows))
            return super().gather(rows, numbers)

    stage1.encode(state, Watched(FULL))
    assert asked == [8, 8]
    for limit, batch in ((3 * 36, 3), (36, 1), (1, 1)):  # An action is 6 x 3 x 2 numbers.
        asked.clear()
        monkeypatch.setattr(learner, "_ENCODED_FEATURES", limit)
        stage1.encode(state, Watched(FULL))
        assert set(asked) == {batch}
        assert len(asked) == -(-10 // batch)


@pytest.mark.unit
def test_bad_sources_are_refused(tiny):
    stage1, state = tiny
    with pytest.raises(ValueError, match="10 rows of recordings need as many ids, got 9"):
        DrawnRecordings(SMALL, IDS[:9], draw, (3, 2))
    wrong = DrawnRecordings(SMALL, IDS, draw, (4, 2))
    with pytest.raises(ValueError, match=r"drawn as \(12, 3, 2\); expected \(12, 4, 2\)"):
        stage1.train_steps(state, wrong, 1)
    with pytest.raises(ValueError, match="set it to at most 2"):
        stage1.train_steps(state, sources(np.array([0, 1]))["drawn"], 1)


def assert_same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(as_numpy(x), as_numpy(y)), a, b)


def assert_differ(a, b):
    assert any(
        not np.array_equal(x, y)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def as_numpy(leaf):
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)
