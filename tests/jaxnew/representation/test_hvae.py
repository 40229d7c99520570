"""The networks against plain NumPy, their initial distributions, and their sizes."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage1_reference as reference

from jaxnew.representation import decoders, encoders, objective
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.hvae import ActionInference
from jaxnew.representation.modality import one_hot_modality, vector_modality
from jaxnew.representation.vae import build_model

# float32 against float64 through some ten layers of width < 130.
RTOL, ATOL = 2e-4, 2e-5


def random_variables(module, *args):
    """Variables of `module` full of noise, so that no bias or shift is zero; costs no compile.

    Running averages are 0 and 1, as at the start of training.
    """
    shapes = jax.eval_shape(lambda key: module.init(key, *args), jax.random.key(0))
    rng = np.random.default_rng(0)

    def fill(path, shape):
        names = [entry.key for entry in path]
        if names[0] == "batch_stats":
            return np.full(shape.shape, float(names[-1] == "var"), np.float32)
        mean = float(names[-1] == "scale")
        std = 1.5 / np.sqrt(shape.shape[0]) if len(shape.shape) == 2 else 0.3
        return rng.normal(mean, std, shape.shape).astype(np.float32)

    return jax.tree_util.tree_map_with_path(fill, shapes)


@functools.partial(jax.jit, static_argnums=0)
def apply(module, variables, *args):
    return module.apply(variables, *args)


@functools.partial(jax.jit, static_argnums=0)
def apply_in_training(module, variables, *args):
    return module.apply(variables, *args, True, mutable=["batch_stats"])


@pytest.mark.oracle
def test_trajectory_encoder_equals_a_numpy_loop():
    x = np.random.default_rng(0).normal(size=(2, 3, 5, 4)).astype(np.float32)
    module = encoders.TrajectoryEncoder(6)
    variables = random_variables(module, x)
    plain = reference.as_float64(variables["params"])
    ours = np.moveaxis(apply(module, variables, x), 0, -1)
    expected = [[reference.encode_recording(plain, one) for one in rows] for rows in x]
    np.testing.assert_allclose(ours, expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
def test_each_lstm_bias_counts():
    x = np.ones((1, 1, 2, 2), np.float32)
    module = encoders.TrajectoryEncoder(4)
    variables = random_variables(module, x)
    before = apply(module, variables, x)[:, 0, 0]
    for name in ("bias_input", "bias_hidden"):
        layer = variables["params"]["BiLSTMLayer_1"]["backward"]
        layer[name] = layer[name] + 0.5  # Not in place: the last call may still be reading it.
        after = apply(module, variables, x)[:, 0, 0]
        expected = reference.encode_recording(reference.as_float64(variables["params"]), x[0, 0])
        np.testing.assert_allclose(after, expected, rtol=RTOL)
        assert np.abs(after - before).max() > 0.01
        before = after


@pytest.mark.oracle
def test_still_images_are_sequences_of_length_one():
    """The LSTM reads encoded still images as T = 1."""
    x = np.random.default_rng(1).normal(size=(1, 3, 1, 4)).astype(np.float32)
    module = encoders.TrajectoryEncoder(5)
    variables = random_variables(module, x)
    plain = reference.as_float64(variables["params"])
    expected = [reference.encode_recording(plain, one) for one in x[0]]
    ours = apply(module, variables, x)[:, 0].T
    np.testing.assert_allclose(ours, expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
@pytest.mark.parametrize("num_categories", [0, 2])
def test_decoder_feeds_back_its_own_predictions(num_categories):
    rng = np.random.default_rng(2)
    g = rng.normal(size=(16, 2, 3)).astype(np.float32)
    first = rng.normal(size=(2, 3, 4)).astype(np.float32)
    # Wide enough that not all ReLUs are off.
    module = decoders.TrajectoryDecoder(16, num_categories=num_categories)
    variables = random_variables(module, g, first, 5)
    plain = reference.as_float64(variables["params"])
    ours = jax.jit(lambda v: module.apply(v, g, first, 5))(variables)
    assert ours.shape == (2, 3, 4, 4)
    for b, s in np.ndindex(2, 3):
        expected = reference.decode(
            plain, g[:, b, s], first[b, s], 5, num_categories=num_categories
        )
        np.testing.assert_allclose(ours[b, s], expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
def test_scalar_batch_norm_has_one_mean_and_variance():
    x = np.random.default_rng(3).normal(2.0, 3.0, size=(7, 5)).astype(np.float32)
    module = encoders.ScalarBatchNorm()
    variables = random_variables(module, x, False)
    assert sum(leaf.size for leaf in jax.tree.leaves(variables)) == 4
    plain = reference.as_float64(variables["params"])
    ours, updated = apply_in_training(module, variables, x)
    np.testing.assert_allclose(ours, reference.scalar_batch_norm(plain, x), rtol=1e-5, atol=1e-6)
    running = updated["batch_stats"]["BatchNorm_0"]
    np.testing.assert_allclose(running["mean"], 0.01 * x.mean(), rtol=1e-5)
    np.testing.assert_allclose(running["var"], 0.99 + 0.01 * x.var(), rtol=1e-5)
    inference = module.apply({**variables, **updated}, x, False)
    expected = reference.scalar_batch_norm_running(
        plain, reference.as_float64(updated["batch_stats"]), x
    )
    np.testing.assert_allclose(inference, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.oracle
def test_action_inference_averages_after_its_last_layer_as_in_the_release():
    h = np.random.default_rng(4).normal(size=(5, 3, 4)).astype(np.float32)
    module = ActionInference(width=6, latent=2)
    variables = random_variables(module, h, False)
    (mean, log_variance), _ = apply_in_training(module, variables, h)
    plain = reference.as_float64(variables["params"])
    statistics = reference.scalar_batch_norm(
        plain["ScalarBatchNorm_0"], reference.action_statistics(plain, np.moveaxis(h, 0, -1))
    )
    np.testing.assert_allclose(mean.T, statistics[:, :2], rtol=RTOL, atol=ATOL)
    np.testing.assert_allclose(log_variance.T, statistics[:, 2:], rtol=RTOL, atol=ATOL)


SMALL = RepresentationConfig(
    encoder_width=5, inference_width=14, hidden_width=12, action_latent=3, observation_latent=2
)
XY = vector_modality("xy", 2)


def noise(seed, num_actions, num_recordings, action_latent=3, observation_latent=2):
    rng = np.random.default_rng(seed)
    return objective.LatentNoise(
        action=rng.normal(size=(num_actions, action_latent)).astype(np.float32),
        observation=rng.normal(size=(num_actions, num_recordings, observation_latent)).astype(
            np.float32
        ),
    )


@pytest.mark.oracle
@pytest.mark.parametrize("num_categories", [0, 4])
def test_the_whole_hvae_equals_numpy(num_categories):
    rng = np.random.default_rng(5)
    if num_categories:
        features = np.eye(4)[rng.integers(0, 4, (3, 4, 3, 2))].reshape(3, 4, 3, 8)
    else:
        features = rng.uniform(0, 9, (3, 4, 3, 2))
    features = features.astype(np.float32)
    model = build_model(SMALL, one_hot_modality("cells", 2, 4) if num_categories else XY)
    draws = noise(6, 3, 4)
    variables = random_variables(model, features, draws, False)
    output, _ = apply_in_training(model, variables, features, draws)
    terms = objective.elbo_terms(output, features, num_categories)
    expected = reference.hvae(
        variables["params"], features, draws.action, draws.observation, num_categories
    )
    ours = (terms.reconstruction, terms.kl_action, terms.kl_observation)
    np.testing.assert_allclose(ours, expected, rtol=2e-3)  # A chain of ~40 float32 layers.


@pytest.mark.oracle
def test_the_whole_hvae_of_changes_equals_numpy():
    """All that is not the paper's at once: units, changes, variances, the weight of the KL."""
    features = np.random.default_rng(15).uniform(0, 9, (3, 4, 4, 2)).astype(np.float32)
    features[..., 1] *= 0.01  # In another unit.
    model = build_model(SMALL.in_minutes(), XY)
    draws = noise(16, 3, 4)
    variables = random_variables(model, features, draws, False)
    output, updated = apply_in_training(model, variables, features, draws)
    terms = objective.elbo_terms(output, features, 0, kl_recordings=672)
    reconstruction, kl_action, kl_observation = reference.hvae(
        variables["params"], features, draws.action, draws.observation, is_changed=True
    )
    ours = (terms.reconstruction, terms.kl_action, terms.kl_observation)
    expected = (reconstruction, kl_action * 4 / 672, kl_observation)
    np.testing.assert_allclose(ours, expected, rtol=2e-3)
    mean, deviation, change = reference.scales_of(features.astype(np.float64))
    found = (mean, deviation**2 - 1e-6, change**2 - 1e-6)
    for name, value in zip(("mean", "variance", "squared_change"), found, strict=True):
        before, after = (v["batch_stats"]["scales"][name] for v in (variables, updated))
        np.testing.assert_allclose(after, 0.99 * before + 0.01 * value, rtol=1e-4)


@pytest.mark.oracle
def test_the_whole_hvae_of_one_hot_changes_equals_numpy():
    """Categories have no units: probabilities are fed back, and logits are added to."""
    rng = np.random.default_rng(5)
    features = np.eye(4)[rng.integers(0, 4, (3, 4, 3, 2))].reshape(3, 4, 3, 8).astype(np.float32)
    model = build_model(SMALL.in_minutes(), one_hot_modality("cells", 2, 4))
    draws = noise(6, 3, 4)
    variables = random_variables(model, features, draws, False)
    assert "scales" not in variables["batch_stats"]
    output, _ = apply_in_training(model, variables, features, draws)
    terms = objective.elbo_terms(output, features, 4)
    expected = reference.hvae(
        variables["params"], features, draws.action, draws.observation, 4, is_changed=True
    )
    ours = (terms.reconstruction, terms.kl_action, terms.kl_observation)
    np.testing.assert_allclose(ours, expected, rtol=2e-3)


@pytest.mark.unit
def test_learned_log_variances_beyond_their_bounds_get_no_gradient():
    features = np.random.default_rng(17).uniform(0, 9, (2, 3, 3, 2)).astype(np.float32)
    model, draws = build_model(SMALL, XY), noise(18, 2, 3)
    variables = random_variables(model, features, draws, False)

    def loss(log_variance):
        params = {**variables["params"], "likelihood_log_variance": log_variance}
        output, _ = apply_in_training(model, {**variables, "params": params}, features, draws)
        return objective.elbo_terms(output, features, 0).reconstruction

    for value, has_gradient in ((-4.5, False), (1.0, True), (3.5, False)):
        gradient = jax.grad(loss)(jnp.full(2, value))
        assert np.all((gradient != 0.0) == has_gradient)
    np.testing.assert_array_equal(loss(jnp.full(2, -9.0)), loss(jnp.full(2, -4.0)))


@pytest.mark.oracle
def test_the_whole_flat_vae_equals_numpy():
    features = np.random.default_rng(7).uniform(0, 9, (1, 6, 3, 2)).astype(np.float32)
    model = build_model(replace(SMALL, kind="vae"), XY)
    draws = noise(8, 1, 6)
    variables = random_variables(model, features, draws, False)
    output, _ = apply_in_training(model, variables, features, draws)
    terms = objective.elbo_terms(output, features, 0)
    reconstruction, kl = reference.flat_vae(variables["params"], features, draws.observation)
    np.testing.assert_allclose(terms.reconstruction, reconstruction, rtol=2e-3)
    np.testing.assert_allclose(terms.kl_observation, kl, rtol=2e-3)
    assert float(terms.kl_action) == 0.0


def count(config, modality, num_steps=3):
    features = jax.ShapeDtypeStruct((2, 2, num_steps, modality.feature_dim), jnp.float32)
    sizes = config.action_latent, config.observation_latent
    latents = objective.draw_noise(jax.random.key(0), (2, 2), *sizes)
    model = build_model(config, modality)
    shapes = jax.eval_shape(lambda x: model.init(jax.random.key(0), x, latents, False), features)
    return sum(leaf.size for leaf in jax.tree.leaves(shapes["params"]))


@pytest.mark.golden
def test_parameter_counts_are_the_releases_without_its_unused_layers():
    # The release has 341,994 (xy) and 443,430 (one-hot), unused layers included: in both
    # a Lin(dz, H) for a second stochastic layer in q(z|o,c) and in p(z|c),
    # 16 * 64 + 64 = 1,088 each; in one-hot also the free log-variance of 160 features, which a
    # categorical likelihood does not read.
    unused = 2 * (16 * 64 + 64)
    config = RepresentationConfig()
    assert count(config, XY) == 341_994 - unused
    assert count(config, one_hot_modality("cells", 2, 80)) == 443_430 - unused - 160
    # CREATE's state modality: D = 6, T = 7, latents of 128, same two layers unused.
    config = replace(config, action_latent=128, observation_latent=128)
    assert count(config, vector_modality("state", 6)) == 431_250 - 2 * (128 * 64 + 64)
