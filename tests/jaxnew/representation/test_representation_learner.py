"""Batches, the optimiser, resuming, encoding, and a tiny learning run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import stage1_reference as reference

from jaxnew.finiteness import cause_of
from jaxnew.representation import batches, learner, report
from jaxnew.representation.modality import one_hot_modality, vector_modality

XY = vector_modality("xy", 2)
TINY = learner.RepresentationConfig(
    encoder_width=16,
    inference_width=32,
    hidden_width=24,
    action_latent=4,
    observation_latent=3,
    actions_per_batch=16,
    recordings_per_action=8,
    num_steps=8,
)
# 16 kinds of actions (two moves, four directions each), four actions of each kind.
KINDS = np.arange(16).repeat(4)
IS_HELD_OUT = np.arange(64) % 4 == 0


def recordings_of_all(low=2, high=6):
    """uint8[64, 12, 3, 2], one start per recording; near the origin, where learning is quick."""
    moves = np.stack([reference.MOVES[KINDS % 4], reference.MOVES[KINDS // 4]], axis=1)
    path = np.concatenate([np.zeros((64, 1, 2), int), np.cumsum(moves, axis=1)], axis=1)
    start = np.random.default_rng(0).integers(low, high, (64, 12, 1, 2))
    return (start + path[:, None]).astype(np.uint8)


@pytest.fixture(scope="module")
def tiny():
    """(learner, recordings uint8[48, 12, 3, 2], initial state), compiled once for all tests."""
    recordings = jnp.asarray(recordings_of_all()[~IS_HELD_OUT])
    stage1 = learner.RepresentationLearner(TINY, XY)
    return stage1, recordings, stage1.init(jax.random.key(0), recordings.shape)


@pytest.fixture(scope="module")
def flat():
    """(learner of a flat VAE on one-hot features, recordings uint8[3, 4, 3, 2], state)."""
    modality = one_hot_modality("onehot", 2, 80)
    stage1 = learner.RepresentationLearner(dataclasses.replace(TINY, kind="vae"), modality)
    recordings = jnp.asarray(recordings_of_all()[:3, :4])
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
        return recordings[batches.hvae_choice(key_epochs, key_step, step, (11, 9), 3, 6)]

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
        key_step = jax.random.fold_in(key, step)
        return recordings[batches.hvae_choice(key, key_step, step, (2, 8), 2, 3)]

    drawn = np.asarray(jax.vmap(draw)(jnp.arange(2000)))[..., 0, 1]
    counts = np.bincount(drawn.ravel(), minlength=8)
    # 12,000 draws over 8: 1,500 each, standard deviation sqrt(4000 * 3/8 * 5/8) = 31; 5 sigma.
    np.testing.assert_allclose(counts, 1500, atol=155)


@pytest.mark.property
def test_flat_vae_batches_pool_all_actions_with_replacement():
    recordings = labelled(4, 5)
    drawn = np.asarray(recordings[batches.flat_vae_choice(jax.random.key(0), (4, 5), 400)])
    assert drawn.shape == (1, 400, 1, 2)
    flat = drawn[0, :, 0, 0] * 5 + drawn[0, :, 0, 1]
    counts = np.bincount(flat, minlength=20)
    # 400 draws over 20: 20 each, standard deviation 4.4; five of them.
    np.testing.assert_allclose(counts, 20, atol=22)
    assert len(np.unique(counts)) > 3  # Not a permutation: with replacement.


@pytest.mark.unit
def test_flat_vae_draws_as_many_recordings_as_divide_evenly():
    config = learner.RepresentationConfig(kind="vae")
    assert batches.Batches.of(config, XY).pooled_size(512) == 86_016  # Grid World.
    create = dataclasses.replace(config, recordings_per_action=464)
    assert batches.Batches.of(create, XY).pooled_size(1098) == 59_292  # CREATE.
    few = dataclasses.replace(config, actions_per_batch=64, recordings_per_action=8)
    assert batches.Batches.of(few, XY).pooled_size(513) == 513  # One of each at least.


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
    return [np.asarray(leaf) for leaf in jax.tree.leaves(_without_key_types(state))]


def _without_key_types(state):
    return jax.tree.map(
        lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x,
        state,
    )


@pytest.mark.unit
def test_every_step_draws_a_batch_and_noise_of_its_own(tiny, flat):
    """Also within an epoch: of one action, whose batches differ only in what the step draws."""
    stage1, recordings, state = flat
    metrics = [
        stage1.train_steps(state.replace(step=jnp.int32(step)), recordings, 1)[1]
        for step in (0, 1, 2)
    ]
    assert len({float(of_step["reconstruction"]) for of_step in metrics}) == 3
    stage1 = learner.RepresentationLearner(dataclasses.replace(TINY, actions_per_batch=1), XY)
    states = [tiny[2].replace(step=jnp.int32(step)) for step in (0, 1, 2)]
    recordings = tiny[1][:1]
    drawn = [recordings[stage1._choice(state, recordings.shape)] for state in states]
    assert len({np.asarray(x).tobytes() for x in drawn}) == 3
    noise = [jax.random.key_data(stage1._step_keys(state)[1]) for state in states]
    assert len({key.tobytes() for key in noise}) == 3


@pytest.mark.unit
def test_training_changes_every_parameter_and_leaves_the_keys(tiny):
    stage1, recordings, state = tiny
    trained, metrics = stage1.train_steps(state, recordings, 6)
    for ours, theirs in (
        (trained.key_epochs, state.key_epochs),
        (trained.key_steps, state.key_steps),
    ):
        assert jax.random.key_data(ours).tolist() == jax.random.key_data(theirs).tolist()
    changed = jax.tree.map(lambda a, b: bool(np.any(a != b)), state.params, trained.params)
    assert all(jax.tree.leaves(changed)), changed
    assert all(value.shape == () for value in metrics.values())
    assert cause_of(metrics) is None
    assert set(metrics) == {
        "loss",
        "reconstruction",
        "kl_action",
        "kl_observation",
        "grad_norm",
        "nonfinite/recording",
        "nonfinite/loss",
        "nonfinite/gradient",
    }


@pytest.mark.property
def test_gradients_are_finite_at_extreme_inputs_and_log_variances(tiny, flat):
    for stage1, recordings, state in (tiny, flat):
        corners = jnp.zeros_like(recordings).at[::2].set(79)
        for value in (-50.0, 50.0):
            params = jax.tree_util.tree_map_with_path(
                lambda path, leaf, v=value: (
                    jnp.full_like(leaf, v) if _is_free_log_variance(path) else leaf
                ),
                state.params,
            )
            _, metrics = stage1.train_steps(state.replace(params=params), corners, 1)
            assert cause_of(metrics) is None, (value, metrics)


def _is_free_log_variance(path):
    """Of the likelihood and of z's posterior; e^50 / e^-50 of posterior and prior overflows."""
    names = [entry.key for entry in path]
    return "log_variance" in names[-1] and names[0] != "latent_prior"


@pytest.mark.unit
def test_nonfinite_numbers_are_counted(tiny):
    stage1, recordings, state = tiny
    params = jax.tree.map(lambda leaf: leaf, state.params)
    params["decoder"]["write"]["bias"] = jnp.full_like(params["decoder"]["write"]["bias"], np.nan)
    _, metrics = stage1.train_steps(state.replace(params=params), recordings, 1)
    assert cause_of(metrics) == "loss"
    assert float(metrics["nonfinite/recording"]) == 0.0
    # In the last of three steps, by then the parameters are finite no more.
    spoiled = jnp.asarray(recordings, jnp.float32).at[:, :, 1, 0].set(jnp.nan)
    _, metrics = stage1.train_steps(state, spoiled, 3)
    assert cause_of(metrics) == "recording"


@pytest.mark.unit
def test_first_epoch_weighs_reconstruction_twice_and_the_third_by_a_quarter_more(tiny):
    stage1, recordings, state = tiny  # 48 // 16 = 3 steps an epoch.
    for step, weight in [(0, 2.0), (2, 2.0), (3, 1.5), (6, 1.25), (90, 1.0)]:
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
    expected = np.array(reference.radam(np.clip(gradients, -0.5, 0.5)))
    assert abs(expected[0]) == pytest.approx(1e-3 * 0.3)  # No adaptation: lr times momentum.
    for t, (gradient, update) in enumerate(zip(gradients, expected, strict=True), start=1):
        updates, opt_state = update_of(jnp.array([gradient, 0.0]), opt_state, params)
        # optax takes rho_t in float32, where 1 - b2^t cancels: its error is 0.12 / t, which counts
        # in the rectifier just after rho_t = 5.
        rtol = 1e-5 if t < 6 else 2e-2 if t < 20 else 2e-3
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
    recordings = np.asarray(recordings)
    mean, log_variance = stage1.encode_posterior(state, recordings[:10], batch=4)
    assert mean.shape == log_variance.shape == (10, 4)
    assert mean.dtype == np.float32
    shuffled = recordings[:10, np.random.default_rng(0).permutation(12)]
    # A mean of 12 numbers in another order, through four layers.
    np.testing.assert_allclose(stage1.encode(state, shuffled, batch=4), mean, atol=1e-5)
    last_three = stage1.encode(state, recordings[7:10], batch=4)  # In other batches than above.
    np.testing.assert_allclose(last_three, mean[7:], atol=1e-5)


@pytest.mark.property
def test_encode_takes_new_actions_with_other_numbers_of_recordings(tiny):
    """Paper algorithm 2: a frozen encoder reads actions that training never saw."""
    stage1, recordings, state = tiny
    few = np.asarray(recordings[:4])
    many = np.concatenate([few, few], axis=1)  # 24 recordings, not 12 or 8; the mean is the same.
    expected = stage1.encode(state, few, batch=4)
    np.testing.assert_allclose(stage1.encode(state, many, batch=4), expected, atol=1e-5)


@pytest.mark.unit
def test_encode_uses_running_averages_not_the_batch(tiny):
    stage1, recordings, state = tiny
    together = stage1.encode(state, recordings[:4], batch=4)
    same = stage1.encode(state, np.repeat(recordings[:1], 4, axis=0), batch=4)
    np.testing.assert_allclose(same[3], together[0], atol=1e-5)
    stats = jax.tree.map(lambda leaf: leaf + 1.0, state.batch_stats)
    moved = stage1.encode(state.replace(batch_stats=stats), recordings[:4], batch=4)
    assert np.abs(moved - together).max() > 0.01


@pytest.mark.unit
def test_flat_vae_representation_is_the_mean_of_recordings_means(flat):
    stage1, recordings, state = flat
    whole, log_variance = stage1.encode_posterior(state, recordings)
    assert whole.shape == (3, 3)
    single = stage1.encode(state, recordings.reshape(12, 1, 3, 2), batch=12).reshape(3, 4, 3)
    np.testing.assert_allclose(whole, single.mean(axis=1), atol=1e-5)
    np.testing.assert_array_equal(log_variance[0], log_variance[2])


@pytest.mark.unit
def test_flat_vae_counts_every_step_as_an_epoch(flat):
    stage1, recordings, state = flat
    state, metrics = stage1.train_steps(state, recordings, 2)
    assert float(metrics["kl_action"]) == 0.0
    assert cause_of(metrics) is None
    # An epoch is one step: w = 1.25 at step 2.
    _, metrics = stage1.train_steps(state, recordings, 1)
    expected = -(1.25 * metrics["reconstruction"] - metrics["kl_observation"] / 1.25)
    np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-5)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "shape", "message"),
    [
        ({}, (3, 12, 3, 2), "set it to at most 3"),
        ({}, (48, 4, 3, 2), "set it to at most 4"),
        ({}, (48, 12, 1, 2), "T >= 2"),
        ({}, (48, 12, 2), "T >= 2"),
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
    with pytest.raises(ValueError, match=r"made float32\(4, 12, 3, 5\) of .* was expected"):
        stage1.encode(state, np.zeros((4, 12, 3, 5), np.uint8))
    with pytest.raises(ValueError, match="batch=0"):
        stage1.encode(state, recordings, batch=0)


@pytest.mark.unit
def test_hvae_dense_layers_start_xavier_normal_and_lstms_uniform(tiny):
    params = tiny[2].params
    kernels = [leaf for path, leaf in _leaves(params) if path[-1] == "kernel"]
    standardised = [np.ravel(k) * np.sqrt(sum(k.shape)) / 2 for k in map(np.asarray, kernels)]
    scores = np.concatenate(standardised)  # N(0, 1) if std = 2 / sqrt(i + o).
    assert len(scores) > 10_000
    np.testing.assert_allclose(scores.std(), 1.0, atol=0.035)  # 5 / sqrt(2 * 10,000).
    assert np.abs(scores).max() > 3.0  # Normal, not uniform, whose bound is 1.73.
    for path, leaf in _leaves(params):
        if path[-1] == "bias" and "BatchNorm_0" not in path:
            assert not np.any(leaf), path
    _check_lstms(params)
    free = [np.ravel(leaf) for path, leaf in _leaves(params) if "log_variance" in path[-1]]
    assert sorted(len(vector) for vector in free) == [2, 3, 3]  # D, dz, dz.
    assert np.concatenate(free).std() > 0.3
    assert np.abs(np.concatenate(free)).max() < 4.0


@pytest.mark.unit
def test_flat_vae_dense_layers_start_as_pytorchs(flat):
    params = flat[2].params
    tree = dict(_leaves(params))
    kernels = [path for path in tree if path[-1] == "kernel"]
    assert len(kernels) == 13
    for path in kernels:
        bound = 1 / np.sqrt(tree[path].shape[0])
        values = np.abs(np.concatenate([np.ravel(tree[path]), np.ravel(tree[*path[:-1], "bias"])]))
        assert values.max() <= bound, path
        assert values.max() > 0.9 * bound, path
        assert np.any(tree[*path[:-1], "bias"]), path
    _check_lstms(params)


def _leaves(params):
    return [
        (tuple(entry.key for entry in path), leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
    ]


def _check_lstms(params):
    """All LSTM weights and both biases are uniform in +-1 / sqrt(hidden)."""
    tree = dict(_leaves(params))
    hidden_kernels = [path for path in tree if path[-1] == "kernel_hidden"]
    assert len(hidden_kernels) == 5  # Two directions in two layers, and the decoder.
    for path in hidden_kernels:
        bound = 1 / np.sqrt(tree[path].shape[0])
        for name in ("kernel_input", "kernel_hidden", "bias_input", "bias_hidden"):
            values = np.abs(tree[*path[:-1], name])
            assert values.max() <= bound, (path, name)
            assert values.max() > 0.9 * bound, (path, name)


@pytest.mark.learning
def test_held_out_actions_lie_beside_actions_that_do_the_same(tiny):
    """The nearest train action of an unseen one must be of its kind: 1/16 by chance."""
    stage1, recordings, state = tiny
    state, first = stage1.train_steps(state, recordings, 100)
    state, last = stage1.train_steps(state, recordings, 1900)
    vectors = stage1.encode(state, recordings_of_all(), batch=4)
    assert float(last["loss"]) < float(first["loss"])
    assert accuracy_of(vectors) >= 0.5  # Half of 16 by luck has probability below 1e-5.
    assert report.neighbour_purity(vectors, KINDS, num_neighbours=3) > 0.4


def accuracy_of(vectors):
    """Share of held-out actions whose nearest train action is of their kind."""
    distances = np.square(vectors[IS_HELD_OUT][:, None] - vectors[~IS_HELD_OUT]).sum(-1)
    nearest = KINDS[~IS_HELD_OUT][distances.argmin(axis=1)]
    return np.mean(nearest == KINDS[IS_HELD_OUT])


@pytest.mark.learning
def test_in_minutes_the_same_is_learned_all_over_a_large_room():
    """There the paper's form still learns to copy a cell: its purity is 0.03 after 200 steps."""
    recordings = recordings_of_all(8, 72)
    stage1 = learner.RepresentationLearner(TINY.in_minutes(), XY)
    seen = jnp.asarray(recordings[~IS_HELD_OUT])
    state, _ = stage1.train_steps(stage1.init(jax.random.key(0), seen.shape), seen, 500)
    vectors = stage1.encode(state, recordings, batch=4)
    assert accuracy_of(vectors) >= 0.8
    assert report.neighbour_purity(vectors, KINDS, num_neighbours=3) > 0.8


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
