"""Images as recordings against NumPy and SciPy, and their sizes."""

import functools
from dataclasses import replace

import image_reference
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage1_reference as reference
from test_hvae import count, random_variables

from jaxnew.finiteness import cause_of
from jaxnew.representation import images, objective
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.encoders import AS_GIVEN
from jaxnew.representation.learner import RepresentationLearner
from jaxnew.representation.modality import Modality, image_modality
from jaxnew.representation.vae import build_model

# float32 against float64 through some twenty layers, each normalised by the batch.
TOLERANCE = {"rtol": 2e-3, "atol": 2e-3}
VIDEO, STILL = (48, 48, 1), (84, 84, 3)
RNG = np.random.default_rng(0)


def variables_of(module, *args, method=None):
    """Noise of a size that keeps activations of order one through convolutions."""
    variables = random_variables(module, *args)

    def scaled(path, leaf):
        if leaf.ndim == 4:
            return leaf * np.float32(3 / np.sqrt(leaf.shape[0] * leaf.shape[1] * leaf.shape[2]))
        return leaf

    return jax.tree_util.tree_map_with_path(scaled, variables)


@functools.partial(jax.jit, static_argnums=0)
def in_training(module, variables, *args):
    return module.apply(variables, *args, True, mutable=["batch_stats"])


@pytest.mark.oracle
@pytest.mark.parametrize(("size", "padding"), [(2, 0), (3, 1), (3, 0)])
def test_transposed_convolutions_stamp_their_kernel(size, padding):
    x = RNG.normal(size=(2, 4, 5, 3)).astype(np.float32)
    kernel = RNG.normal(size=(size, size, 3, 2)).astype(np.float32)
    plain = {"kernel": kernel.astype(np.float64), "bias": np.zeros(2)}
    expected = [image_reference.transposed_convolution(plain, one, padding) for one in x]
    got = images.transposed_convolution(x, kernel, padding)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.oracle
@pytest.mark.parametrize("side", [48, 84])
def test_frames_become_codes_and_codes_become_frames(side):
    frames = RNG.uniform(-0.5, 0.5, (2, side, side, 2)).astype(np.float32)
    encoder = images.FrameEncoder()
    variables = variables_of(encoder, frames, True)
    codes, updated = in_training(encoder, variables, frames)
    assert codes.shape == (2, 288)
    plain = reference.as_float64(variables["params"])
    expected = image_reference.encode_frames(plain, frames.astype(np.float64))
    assert (expected > 0).mean() > 0.2
    np.testing.assert_allclose(codes, expected, **TOLERANCE)
    first = image_reference.convolution(plain["Convolution_0"], frames[0].astype(np.float64), 2)
    second = image_reference.convolution(plain["Convolution_0"], frames[1].astype(np.float64), 2)
    both = np.stack([first, second])
    running = updated["batch_stats"]["ChannelBatchNorm_0"]["BatchNorm_0"]
    np.testing.assert_allclose(running["mean"], 0.1 * both.mean((0, 1, 2)), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(running["var"], 0.9 + 0.1 * both.var((0, 1, 2)), rtol=1e-3)

    decoder = images.FrameDecoder((side, side, 2))
    variables = variables_of(decoder, codes, 0.0, True)
    (image, mask), _ = in_training(decoder, variables, codes, 0.0)
    assert (image.shape, mask.shape) == ((2, side, side, 2), (2, side, side, 1))
    plain = reference.as_float64(variables["params"])
    expected_image, expected_mask = image_reference.decode_frames(
        plain, np.asarray(codes, np.float64), side
    )
    assert np.ptp(expected_image) > 0.2
    np.testing.assert_allclose(image, expected_image, **TOLERANCE)
    np.testing.assert_allclose(mask, expected_mask, **TOLERANCE)


@pytest.mark.unit
def test_convolutions_start_as_pytorchs():
    """Uniform in +-1/sqrt(fan_in); a transposed one counts its outputs."""
    x = np.zeros((1, 4, 4, 16), np.float32)
    plain = images.Convolution(32)
    up = images.TransposedConvolution(images._Upsampling(8, 3, 1))
    for module, fan_in in ((plain, 9 * 16), (up, 9 * 8)):
        params = jax.jit(module.init)(jax.random.key(0), x)["params"]
        bound = 1 / np.sqrt(fan_in)
        kernel = np.asarray(params["kernel"]).ravel()
        assert 0.97 * bound < np.abs(kernel).max() <= bound
        np.testing.assert_allclose(kernel.std(), bound / np.sqrt(3), rtol=0.1)
        assert 0.4 * bound < np.abs(params["bias"]).max() <= bound


@pytest.mark.oracle
def test_a_video_is_drawn_over_its_first_frame():
    """Codes of the first frame start the LSTM; each prediction is mixed with the frame itself."""
    decoder = images.ImageRecordingDecoder(12, VIDEO, is_still=False)
    features = RNG.uniform(-0.5, 0.5, (1, 2, 3, 48 * 48)).astype(np.float32)
    g = np.abs(RNG.normal(size=(12, 1, 2))).astype(np.float32)
    codes = RNG.normal(size=(1, 2, 288)).astype(np.float32)
    variables = variables_of(decoder, g, codes, features, AS_GIVEN, True)
    got, _ = in_training(decoder, variables, g, codes, features, AS_GIVEN)
    plain = reference.as_float64(variables["params"])
    all_codes = np.repeat(codes[0].astype(np.float64)[:, None], 3, axis=1)
    first = features[0, :, 0].reshape(2, *VIDEO).astype(np.float64)
    expected = image_reference.video_means(plain, g[:, 0].T.astype(np.float64), all_codes, first)
    assert got.shape == (1, 2, 2, 48 * 48)
    np.testing.assert_allclose(got[0], expected, **TOLERANCE)


@pytest.mark.oracle
def test_a_still_image_is_drawn_and_scored_as_a_whole():
    decoder = images.ImageRecordingDecoder(12, STILL, is_still=True)
    size = 84 * 84 * 3
    features = RNG.uniform(-0.5, 0.5, (1, 2, 1, size)).astype(np.float32)
    g = np.abs(RNG.normal(size=(12, 1, 2))).astype(np.float32)
    codes = np.zeros((1, 2, 288), np.float32)
    scales = AS_GIVEN._replace(mean=np.array([-0.45, 0.0, 0.2], np.float32))
    variables = variables_of(decoder, g, codes, features, scales, True)
    got, _ = in_training(decoder, variables, g, codes, features, scales)
    plain = reference.as_float64(variables["params"])
    from_decoder = g[:, 0].T.astype(np.float64)
    expected = image_reference.still_means(plain, from_decoder, 84, scales.mean)
    np.testing.assert_allclose(got[0, :, 0], expected, **TOLERANCE)

    zeros = np.zeros((1, 2, 3), np.float32)
    log_variance = RNG.normal(size=size).astype(np.float32)
    output = objective.VAEOutput(
        action_mean=None,
        action_log_variance=None,
        observation_mean=zeros,
        observation_log_variance=zeros[0, 0],
        prior_mean=zeros[:, :1],
        prior_log_variance=zeros[0, 0],
        prediction=got,
        likelihood_log_variance=log_variance,
    )
    terms = objective.elbo_terms(output, jnp.asarray(features), 0)
    total = sum(
        reference.gaussian_log_density(features[0, s, 0], np.asarray(got)[0, s, 0], log_variance)
        for s in range(2)
    )
    np.testing.assert_allclose(terms.reconstruction, total / 2, rtol=1e-4)


@pytest.mark.unit
def test_the_encoder_reads_every_frame_and_hands_on_the_first():
    features = RNG.uniform(-0.5, 0.5, (1, 2, 3, 48 * 48)).astype(np.float32)
    encoder = images.ImageRecordingEncoder(5, VIDEO)
    variables = variables_of(encoder, features, False)
    run = jax.jit(lambda x: encoder.apply(variables, x, False))
    h, start = run(features)
    assert (h.shape, start.shape) == ((5, 1, 2), (1, 2, 288))
    later = features.copy()
    later[0, 0, 2] = 0.0
    changed, same = run(later)
    np.testing.assert_array_equal(same, start)
    assert np.abs(changed - h)[:, 0, 0].max() > 1e-4
    np.testing.assert_allclose(changed[:, 0, 1], h[:, 0, 1], atol=1e-6)


@pytest.mark.oracle
def test_changes_of_pixels_are_read_as_channels():
    features = RNG.uniform(-0.5, 0.5, (1, 2, 3, 48 * 48)).astype(np.float32)
    frames = features.reshape(1, 2, 3, *VIDEO)
    changes = frames - np.concatenate([frames[:, :, :1], frames[:, :, :-1]], axis=2)
    both = np.concatenate([frames, changes], axis=-1).reshape(1, 2, 3, -1)
    plain, reading = (
        images.ImageRecordingEncoder(5, (48, 48, 2)),
        images.ImageRecordingEncoder(5, VIDEO, reads_changes=True),
    )
    variables = variables_of(reading, features, False)
    expected = jax.jit(lambda: plain.apply(variables, both, False))()
    found = jax.jit(lambda: reading.apply(variables, features, False))()
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.unit
def test_a_video_of_changes_starts_as_its_first_frame():
    features = RNG.uniform(-0.5, 0.5, (1, 2, 3, 48 * 48)).astype(np.float32)
    g, codes = np.ones((12, 1, 2), np.float32), np.ones((1, 2, 288), np.float32)
    distances = []
    for predicts_changes in (False, True):
        decoder = images.ImageRecordingDecoder(12, VIDEO, False, predicts_changes)
        args = (g, codes, features, AS_GIVEN)
        variables = jax.jit(lambda key, m=decoder, a=args: m.init(key, *a, True))(jax.random.key(0))
        means, _ = in_training(decoder, variables, *args)
        distances.append(np.abs(means - features[:, :, :1]).mean())
    assert distances[0] > 0.05
    assert distances[1] < 0.01


@pytest.mark.golden
def test_parameter_counts_are_the_specs_without_its_unused_layers():
    # The release has 1,583,280 (video) and 1,429,938 (still images), unused layers included. These
    # are Lin(dz, H) for a second stochastic layer in q(z|o,c) and in p(z|c),
    # 128 * 128 + 128 each, and the log-variance of the 288 numbers that the LSTM or MLP decoder
    # predicts, which is discarded.
    unused = 2 * (128 * 128 + 128) + 288
    config = RepresentationConfig(
        encoder_width=128,
        inference_width=128,
        hidden_width=128,
        action_latent=128,
        observation_latent=128,
    )
    video, still = image_modality("video", VIDEO), image_modality("still", STILL, is_still=True)
    assert count(config, video, 7) == 1_583_280 - unused == 1_549_968
    assert count(config, still, 1) == 1_429_938 - unused == 1_396_626
    # Without the pixels' log-variances; changes of pixels are a channel more for 8 windows.
    config = config.in_minutes()
    assert count(config, video, 7) == 1_549_968 - 48 * 48 + 9 * 8
    assert count(config, still, 1) == 1_396_626 - 84 * 84 * 3


@pytest.mark.unit
@pytest.mark.parametrize("is_flat", [False, True])
def test_both_vaes_take_both_kinds_of_images(is_flat):
    """Shapes of a whole pass, traced; pixels have a log-variance each."""
    for shape, num_steps, is_still in ((VIDEO, 4, False), (STILL, 1, True)):
        size = int(np.prod(shape))
        config = RepresentationConfig(
            kind="vae" if is_flat else "hvae",
            encoder_width=6,
            inference_width=4,
            hidden_width=5,
            action_latent=2,
            observation_latent=3,
        )
        model = build_model(config, image_modality("any", shape, is_still))
        draws = objective.LatentNoise(jnp.zeros((2, 2)), jnp.zeros((2, 3, 3)))
        features = jnp.zeros((2, 3, num_steps, size))

        def whole(key, model=model, draws=draws, features=features):
            variables = model.init(key, features, draws, False)
            output, _ = model.apply(variables, features, draws, True, mutable=["batch_stats"])
            posterior = model.apply(variables, features, method="posterior")
            return output, objective.elbo_terms(output, features, 0), posterior

        output, terms, (mean, _) = jax.eval_shape(whole, jax.random.key(0))
        assert output.prediction.shape == (2, 3, max(1, num_steps - 1), size)
        assert output.likelihood_log_variance.shape == (size,)
        assert terms.reconstruction.shape == ()
        assert mean.shape == (2, 3 if is_flat else 2)


@pytest.mark.slow
def test_a_learner_trains_on_stored_videos():
    """Two steps from uint8 recordings, and the encoding of new ones. Half a minute of compiling."""
    config = RepresentationConfig(
        encoder_width=4,
        inference_width=4,
        hidden_width=4,
        action_latent=2,
        observation_latent=2,
        actions_per_batch=2,
        recordings_per_action=1,
        num_steps=2,
    )
    recordings = RNG.integers(0, 256, (2, 2, 2, *VIDEO)).astype(np.uint8)
    learner = RepresentationLearner(config, image_modality("video", VIDEO))
    state = learner.init(jax.random.key(0), recordings.shape)
    learner._run = None  # On a CPU steps on images are no part of a loop.
    trained, metrics = learner.train_steps(state, recordings, 2)
    assert np.isfinite(float(metrics["loss"]))
    assert cause_of(metrics) is None
    moved = [
        float(np.abs(a - b).max())
        for a, b in zip(*map(jax.tree.leaves, (state.params, trained.params)), strict=True)
    ]
    assert np.mean(np.array(moved) > 0) > 0.9
    assert learner.encode(trained, recordings).shape == (2, 2)


@pytest.mark.unit
def test_the_flat_vae_of_images_draws_the_batches_of_the_hvae():
    """In the paper's setting 32 actions with 52 images each, epochs as there."""
    config = RepresentationConfig(
        kind="vae", observation_latent=2, actions_per_batch=2, recordings_per_action=3
    )
    recordings = np.arange(4 * 5, dtype=np.uint8).reshape(4, 5, 1, 1, 1)
    recordings = jnp.asarray(np.broadcast_to(recordings, (4, 5, *STILL)))
    modality = image_modality("images", STILL, is_still=True)
    learner = RepresentationLearner(config, modality)
    pooled = RepresentationLearner(replace(config, kind="hvae"), modality)
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="actions_per_batch=9 exceeds the 4 train"):
        RepresentationLearner(replace(config, actions_per_batch=9), modality).init(
            key, recordings.shape
        )

    class State:
        key_epochs, key_steps, step = key, jax.random.key(1), jnp.int32(5)

    features, expected = (
        each._features(recordings[each._choice(State, recordings.shape)])
        for each in (learner, pooled)
    )
    assert features.shape == (2, 3, 1, 84 * 84 * 3)
    np.testing.assert_array_equal(features, expected)
    assert [int(each._batches.epoch(State.step, 4)) for each in (learner, pooled)] == [2, 2]


@pytest.mark.unit
def test_stored_images_become_numbers_around_zero():
    video, still = image_modality("video", VIDEO), image_modality("images", STILL, True)
    assert (video.recording_rank, still.recording_rank) == (4, 3)
    stored = RNG.integers(0, 256, (2, 3, *VIDEO)).astype(np.uint8)
    features = np.asarray(video.featurize(jnp.asarray(stored)))
    assert features.shape == (2, 3, 48 * 48)
    np.testing.assert_allclose(features[1, 2], stored[1, 2].ravel() / 255 - 0.5, atol=1e-6)
    one = RNG.integers(0, 256, (2, *STILL)).astype(np.uint8)
    assert still.featurize(jnp.asarray(one)).shape == (2, 1, 84 * 84 * 3)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_shape": (50, 50, 1), "feature_dim": 2500}, "side of 48 or 84"),
        ({"feature_dim": 7}, "have feature_dim=2304"),
        ({"likelihood": "categorical", "num_categories": 48}, "'gaussian' likelihood"),
        ({"image_shape": None, "is_still": True}, "is_still needs an image_shape"),
    ],
)
def test_bad_image_modalities_are_refused(changes, message):
    good = {
        "name": "video",
        "feature_dim": 2304,
        "likelihood": "gaussian",
        "num_categories": 0,
        "featurize": lambda x: x,
        "image_shape": VIDEO,
        "is_still": False,
    }
    Modality(**good)
    with pytest.raises(ValueError, match=message):
        Modality(**{**good, **changes})


@pytest.mark.unit
def test_recordings_of_another_kind_are_refused():
    learner = RepresentationLearner(RepresentationConfig(), image_modality("video", VIDEO))
    with pytest.raises(ValueError, match=r"\[A, S, T, height, width, channels\] with T >= 2"):
        learner.init(jax.random.key(0), (128, 700, 7, 6))
