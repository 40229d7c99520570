"""Batches, the optimiser, resuming, encoding, and a tiny learning run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import stage1_reference as reference

from jaxnew.representation import batches, learner, report
from jaxnew.representation.modality import Modality, one_hot_modality, vector_modality

XY = vector_modality("xy", 2)
TINY = learner.RepresentationConfig(
    encoder_width=6,
    inference_width=8,
    hidden_width=6,
    action_latent=3,
    observation_latent=2,
    actions_per_batch=4,
    recordings_per_action=5,
    num_steps=8,
)


@pytest.fixture(scope="module")
def tiny():
    """(learner, recordings uint8[10, 7, 3, 2], initial state), compiled once."""
    recordings = jnp.asarray(reference.grid_recordings(10, 7, seed=0, num_moves=2))
    stage1 = learner.RepresentationLearner(TINY, XY)
    return stage1, recordings, stage1.init(jax.random.key(0), recordings.shape)


def labelled(num_actions, num_recordings):
    """int32[A, S, 1, 2] recordings that say which action and which recording they are."""
    action, recording = np.indices((num_actions, num_recordings))
    return jnp.asarray(np.stack([action, recording], -1)[:, :, None], jnp.int32)


@pytest.mark.property
def test_hvae_batches_hold_distinct_recordings_and_epochs_distinct_actions():
    recordings = labelled(11, 9)
    key_epochs, key_steps = jax.random.split(jax.random.key(1))

    def draw(step):
        key_step = jax.random.fold_in(key_steps, step)
        return batches.hvae_batch(key_epochs, key_step, step, recordings, 3, 6)

    drawn = np.asarray(jax.vmap(draw)(jnp.arange(12)))[:, :, :, 0]
    assert drawn.shape == (12, 3, 6, 2)
    assert np.all(drawn[..., 0] == drawn[:, :, :1, 0])  # One action per row.
    assert all(len(set(row)) == 6 for row in drawn[..., 1].reshape(-1, 6).tolist())
    actions = drawn[:, :, 0, 0].reshape(4, 9)  # floor(11 / 3) = 3 steps an epoch.
    assert all(len(set(epoch)) == 9 for epoch in actions.tolist())
    assert len({tuple(epoch) for epoch in actions.tolist()}) == 4  # Shuffled anew.
    assert len({tuple(row) for row in drawn[..., 1].reshape(-1, 6).tolist()}) > 30


@pytest.mark.property
def test_every_recording_is_drawn_equally_often():
    recordings = labelled(2, 8)

    def draw(step):
        key = jax.random.key(3)
        return batches.hvae_batch(key, jax.random.fold_in(key, step), step, recordings, 2, 3)

    drawn = np.asarray(jax.vmap(draw)(jnp.arange(2000)))[..., 0, 1]
    counts = np.bincount(drawn.ravel(), minlength=8)
    # 12,000 draws over 8: 1,500 each, standard deviation sqrt(4000 * 3/8 * 5/8) = 31; 5 sigma.
    np.testing.assert_allclose(counts, 1500, atol=155)


@pytest.mark.property
def test_flat_vae_batches_pool_all_actions_with_replacement():
    recordings = labelled(4, 5)
    drawn = np.asarray(batches.flat_vae_batch(jax.random.key(0), recordings, 400))
    assert drawn.shape == (1, 400, 1, 2)
    flat = drawn[0, :, 0, 0] * 5 + drawn[0, :, 0, 1]
    counts = np.bincount(flat, minlength=20)
    # 400 draws over 20: 20 each, standard deviation 4.4; five of them.
    np.testing.assert_allclose(counts, 20, atol=22)
    assert len(np.unique(counts)) > 3  # Not a permutation: with replacement.


@pytest.mark.unit
def test_flat_vae_draws_as_many_recordings_as_divide_evenly():
    config = learner.RepresentationConfig(kind="vae")
    stage1 = learner.RepresentationLearner(config, XY)
    assert stage1._flat_batch_size(512) == 86_016  # Spec method 4, Grid World.
    create = dataclasses.replace(config, recordings_per_action=464)
    assert learner.RepresentationLearner(create, XY)._flat_batch_size(1098) == 59_292  # CREATE.


@pytest.mark.property
def test_two_times_k_steps_are_2k_steps_bit_for_bit(tiny):
    stage1, recordings, state = tiny
    at_once, _ = stage1.train_steps(state, recordings, 6)
    for pieces in ([3, 3], [1, 5]):
        resumed = state
        for num_steps in pieces:
            # Through the host, as a checkpoint does.
            resumed = jax.tree.map(
                lambda leaf: (
                    leaf
                    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
                    else jnp.asarray(np.asarray(leaf))
                ),
                resumed,
            )
            resumed, _ = stage1.train_steps(resumed, recordings, num_steps)
        assert int(resumed.step) == 6
        for ours, theirs in zip(_numbers(resumed), _numbers(at_once), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def _numbers(state):
    plain = state.replace(key=jax.random.key_data(state.key))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(plain)]


@pytest.mark.unit
def test_training_changes_every_parameter_and_leaves_the_key(tiny):
    stage1, recordings, state = tiny
    trained, metrics = stage1.train_steps(state, recordings, 6)
    assert jax.random.key_data(trained.key).tolist() == jax.random.key_data(state.key).tolist()
    changed = jax.tree.map(lambda a, b: bool(np.any(a != b)), state.params, trained.params)
    assert all(jax.tree.leaves(changed)), changed
    assert all(value.shape == () for value in metrics.values())
    assert float(metrics["nonfinite"]) == 0.0
    assert set(metrics) == {
        "loss",
        "reconstruction",
        "kl_action",
        "kl_observation",
        "grad_norm",
        "nonfinite",
    }


@pytest.mark.unit
def test_nonfinite_numbers_are_counted(tiny):
    stage1, recordings, state = tiny
    params = jax.tree.map(lambda leaf: leaf, state.params)
    params["decoder"]["write"]["bias"] = jnp.full_like(params["decoder"]["write"]["bias"], np.nan)
    _, metrics = stage1.train_steps(state.replace(params=params), recordings, 1)
    assert float(metrics["nonfinite"]) >= 1.0


@pytest.mark.unit
def test_first_epoch_weighs_reconstruction_twice_and_the_third_by_a_quarter_more(tiny):
    stage1, recordings, state = tiny  # 10 // 4 = 2 steps an epoch.
    for step, weight in [(0, 2.0), (1, 2.0), (2, 1.5), (4, 1.25), (40, 1.0)]:
        _, metrics = stage1.train_steps(state.replace(step=jnp.int32(step)), recordings, 1)
        kl = metrics["kl_action"] + metrics["kl_observation"]
        expected = -(weight * metrics["reconstruction"] - kl / weight)
        np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-5)


@pytest.mark.oracle
def test_optimiser_is_elementwise_clamp_then_radam_with_its_unrectified_phase():
    # rho_t exceeds 5 from t = 6 on, so both phases are run; gradients beyond 0.5 are clamped.
    gradients = [0.3, -0.9, 4.0, 0.1, -0.2, 0.45, -7.0, 0.05, 0.5, 0.2] * 4
    optimizer = learner.RepresentationLearner(TINY, XY)._optimizer
    params = jnp.zeros(2)
    opt_state = optimizer.init(params)
    update_of = jax.jit(optimizer.update)
    expected = reference.radam(np.clip(gradients, -0.5, 0.5))
    assert abs(expected[0]) == pytest.approx(1e-3 * 0.3)  # No adaptation: lr times momentum.
    for t, (gradient, update) in enumerate(zip(gradients, expected, strict=True), start=1):
        updates, opt_state = update_of(jnp.array([gradient, 0.0]), opt_state, params)
        # optax takes rho_t in float32, where 1 - b2^t cancels: its error is 0.12 / t, which counts
        # in the rectifier just after rho_t = 5.
        rtol = 1e-5 if t < 6 else 2e-2 if t < 15 else 1e-3
        np.testing.assert_allclose(updates, [update, 0.0], rtol=rtol)


@pytest.mark.unit
def test_huge_gradients_are_clamped_entry_by_entry():
    optimizer = learner.RepresentationLearner(TINY, XY)._optimizer
    params = jnp.zeros(3)
    updates, _ = optimizer.update(jnp.array([1e6, -3.0, 0.25]), optimizer.init(params), params)
    np.testing.assert_allclose(updates, [-5e-4, 5e-4, -2.5e-4], rtol=1e-5)


@pytest.mark.property
def test_encode_ignores_the_order_of_recordings_and_the_batch(tiny):
    stage1, recordings, state = tiny
    mean, log_variance = stage1.encode_posterior(state, recordings, batch=10)
    assert mean.shape == log_variance.shape == (10, 3)
    assert mean.dtype == np.float32
    shuffled = np.asarray(recordings)[:, np.random.default_rng(0).permutation(7)]
    np.testing.assert_allclose(stage1.encode(state, shuffled, batch=10), mean, atol=1e-5)
    np.testing.assert_allclose(stage1.encode(state, recordings, batch=4), mean, atol=1e-5)


@pytest.mark.property
def test_encode_takes_new_actions_with_other_numbers_of_recordings(tiny):
    """Paper algorithm 2: a frozen encoder reads actions that training never saw."""
    stage1, _, state = tiny
    new = reference.grid_recordings(3, 20, seed=9, num_moves=2)
    vectors = stage1.encode(state, new)
    assert vectors.shape == (3, 3)
    # Doubling every recording leaves their mean, and so the representation.
    np.testing.assert_allclose(
        stage1.encode(state, np.concatenate([new, new], axis=1)), vectors, atol=1e-5
    )


@pytest.mark.unit
def test_encode_uses_running_averages_not_the_batch(tiny):
    stage1, recordings, state = tiny
    alone = stage1.encode(state, recordings[:1])
    together = stage1.encode(state, recordings)
    np.testing.assert_allclose(alone[0], together[0], atol=1e-5)
    stats = jax.tree.map(lambda leaf: leaf + 1.0, state.batch_stats)
    moved = stage1.encode(state.replace(batch_stats=stats), recordings)
    assert np.abs(moved - together).max() > 0.01


@pytest.mark.unit
def test_flat_vae_representation_is_the_mean_of_recordings_means():
    config = dataclasses.replace(TINY, kind="vae", actions_per_batch=2)
    stage1 = learner.RepresentationLearner(config, XY)
    recordings = reference.grid_recordings(3, 4, seed=1, num_moves=2)
    state = stage1.init(jax.random.key(0), recordings.shape)
    whole, log_variance = stage1.encode_posterior(state, recordings)
    assert whole.shape == (3, 2)
    single = [stage1.encode(state, recordings[:, s : s + 1]) for s in range(4)]
    np.testing.assert_allclose(whole, np.mean(single, axis=0), atol=1e-5)
    np.testing.assert_array_equal(log_variance[0], log_variance[2])
    _, metrics = stage1.train_steps(state, jnp.asarray(recordings), 2)
    assert float(metrics["kl_action"]) == 0.0
    assert np.isfinite(float(metrics["loss"]))


@pytest.mark.unit
def test_one_hot_features_are_blocks_per_coordinate():
    modality = one_hot_modality("onehot", 2, 5)
    features = modality.featurize(jnp.array([[1, 4], [0, 2]], jnp.uint8))
    assert features.dtype == jnp.float32
    expected = np.concatenate([np.eye(5)[[1, 0]], np.eye(5)[[4, 2]]], axis=1)
    np.testing.assert_array_equal(features, expected)
    assert modality.feature_dim == 10
    assert modality.gaussian_dim == 0
    assert XY.gaussian_dim == 2


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"likelihood": "poisson"}, "unknown likelihood"),
        ({"feature_dim": 0}, "feature_dim=0"),
        ({"num_categories": 2}, "does not fit"),
        ({"likelihood": "categorical"}, "does not fit"),
        ({"likelihood": "categorical", "num_categories": 3}, "not a multiple"),
    ],
)
def test_bad_modalities_are_refused(changes, message):
    good = {
        "name": "xy",
        "feature_dim": 2,
        "likelihood": "gaussian",
        "num_categories": 0,
        "featurize": lambda x: x,
    }
    with pytest.raises(ValueError, match=message):
        Modality(**{**good, **changes})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"kind": "gan"}, ValueError, "kind='gan'"),
        ({"hidden_width": 0}, ValueError, "hidden_width=0"),
        ({"num_steps": 2.5}, TypeError, "num_steps=2.5"),
        ({"learning_rate": float("nan")}, ValueError, "learning_rate=nan"),
        ({"gradient_clip": -1.0}, ValueError, "gradient_clip=-1.0"),
    ],
)
def test_bad_configs_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        learner.RepresentationConfig(**changes)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "shape", "message"),
    [
        ({}, (3, 7, 3, 2), "set it to at most 3"),
        ({}, (10, 4, 3, 2), "set it to at most 4"),
        ({}, (10, 7, 1, 2), "T >= 2"),
        ({}, (10, 7, 2), "T >= 2"),
        ({"kind": "vae"}, (21, 7, 3, 2), "less than the 21 train actions"),
    ],
)
def test_recordings_that_cannot_fill_a_batch_are_refused(changes, shape, message):
    stage1 = learner.RepresentationLearner(dataclasses.replace(TINY, **changes), XY)
    with pytest.raises(ValueError, match=message):
        stage1.init(jax.random.key(0), shape)


@pytest.mark.unit
def test_bad_calls_are_refused(tiny):
    stage1, recordings, state = tiny
    with pytest.raises(ValueError, match="num_steps=0"):
        stage1.train_steps(state, recordings, 0)
    with pytest.raises(ValueError, match="set it to at most 3"):
        stage1.train_steps(state, recordings[:3], 1)
    with pytest.raises(ValueError, match="non-empty"):
        stage1.encode(state, recordings[0])
    with pytest.raises(ValueError, match="batch=0"):
        stage1.encode(state, recordings, batch=0)


@pytest.mark.learning
def test_held_out_actions_lie_beside_actions_that_do_the_same():
    """Trained on some actions, the encoder puts unseen ones where they belong.

    16 kinds (two moves of four directions each), 4 actions of each; one of each kind is held out.
    Its nearest train action must be of its kind: 1/16 by chance.
    """
    rng = np.random.default_rng(0)
    kinds = np.arange(16).repeat(4)
    moves = np.stack([reference.MOVES[kinds % 4], reference.MOVES[kinds // 4]], axis=1)
    path = np.concatenate([np.zeros((64, 1, 2), int), np.cumsum(moves, axis=1)], axis=1)
    start = rng.integers(2, 6, (64, 32, 1, 2))
    recordings = (start + path[:, None]).astype(np.uint8)
    held_out = np.arange(64) % 4 == 0
    config = dataclasses.replace(
        TINY,
        encoder_width=16,
        inference_width=32,
        hidden_width=24,
        action_latent=4,
        observation_latent=4,
        actions_per_batch=16,
        recordings_per_action=8,
    )
    stage1 = learner.RepresentationLearner(config, XY)
    train = jnp.asarray(recordings[~held_out])
    state = stage1.init(jax.random.key(0), train.shape)
    state, first = stage1.train_steps(state, train, 50)
    state, last = stage1.train_steps(state, train, 950)
    vectors = stage1.encode(state, recordings)
    distances = np.square(vectors[held_out][:, None] - vectors[~held_out]).sum(-1)
    nearest = kinds[~held_out][distances.argmin(axis=1)]
    accuracy = np.mean(nearest == kinds[held_out])
    assert float(last["loss"]) < float(first["loss"])
    # Chance 1/16. Half of 16 by luck has probability below 1e-5.
    assert accuracy >= 0.5, accuracy
    assert report.neighbour_purity(vectors, kinds, num_neighbours=3) > 0.4


@pytest.mark.unit
def test_the_optimiser_state_is_optax_radams(tiny):
    stage1, _, state = tiny
    counts = [
        leaf
        for leaf in jax.tree.leaves(state.opt_state, is_leaf=lambda x: hasattr(x, "mu"))
        if isinstance(leaf, optax.ScaleByAdamState)
    ]
    assert len(counts) == 1
    assert jax.tree.structure(counts[0].mu) == jax.tree.structure(state.params)
    assert stage1.config.learning_rate == 1e-3
