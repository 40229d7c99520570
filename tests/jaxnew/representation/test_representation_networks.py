"""The networks against plain NumPy, their initial distributions, and their sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage1_reference as reference

from jaxnew.representation import decoders, encoders, objective
from jaxnew.representation.hvae import HVAE, ActionInference
from jaxnew.representation.vae import FlatVAE

# float32 against float64 through some ten layers of width < 130.
RTOL, ATOL = 2e-4, 2e-5


def perturbed(params, seed=0):
    """Adds noise to every parameter: biases and batch-norm shifts would otherwise be zero."""
    leaves, treedef = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    noisy = [np.asarray(leaf) + 0.1 * rng.normal(size=leaf.shape) for leaf in leaves]
    return jax.tree.unflatten(treedef, [jnp.asarray(leaf, jnp.float32) for leaf in noisy])


def init_params(module, *args):
    return jax.jit(lambda key: module.init(key, *args))(jax.random.key(0))["params"]


@pytest.mark.oracle
def test_trajectory_encoder_equals_a_numpy_loop():
    x = np.random.default_rng(0).normal(size=(2, 3, 5, 4)).astype(np.float32)
    module = encoders.TrajectoryEncoder(6)
    params = init_params(module, x)
    ours = jax.jit(module.apply)({"params": params}, x)
    plain = reference.as_float64(params)
    expected = [[reference.encode_recording(plain, one) for one in rows] for rows in x]
    np.testing.assert_allclose(ours, expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["bias_input", "bias_hidden"])
def test_each_lstm_bias_counts(name):
    x = jnp.ones((1, 2, 2))
    module = encoders.TrajectoryEncoder(4)
    params = init_params(module, x)
    params["BiLSTMLayer_1"]["backward"][name] += 0.5
    expected = reference.encode_recording(reference.as_float64(params), np.ones((2, 2)))
    np.testing.assert_allclose(module.apply({"params": params}, x)[0], expected, rtol=RTOL)


@pytest.mark.oracle
def test_still_images_are_sequences_of_length_one():
    """Spec method 3.2: the LSTM reads encoded images with T = 1."""
    x = np.random.default_rng(1).normal(size=(3, 1, 4)).astype(np.float32)
    module = encoders.TrajectoryEncoder(5)
    params = init_params(module, x)
    plain = reference.as_float64(params)
    expected = [reference.encode_recording(plain, one) for one in x]
    np.testing.assert_allclose(module.apply({"params": params}, x), expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
def test_decoder_feeds_back_its_own_predictions():
    rng = np.random.default_rng(2)
    g = rng.normal(size=(2, 3, 6)).astype(np.float32)
    first = rng.normal(size=(2, 3, 4)).astype(np.float32)
    module = decoders.TrajectoryDecoder(6)
    params = perturbed(jax.jit(lambda key: module.init(key, g, first, 5))(jax.random.key(0)))
    params = params["params"]
    ours = module.apply({"params": params}, g, first, 5)
    plain = reference.as_float64(params)
    assert ours.shape == (2, 3, 4, 4)
    for b, s in np.ndindex(2, 3):
        expected = reference.decode(plain, g[b, s], first[b, s], 5)
        np.testing.assert_allclose(ours[b, s], expected, rtol=RTOL, atol=ATOL)


@pytest.mark.oracle
def test_scalar_batch_norm_has_one_mean_and_variance():
    x = np.random.default_rng(3).normal(2.0, 3.0, size=(7, 5)).astype(np.float32)
    module = encoders.ScalarBatchNorm()
    variables = module.init(jax.random.key(0), x, False)
    assert sum(leaf.size for leaf in jax.tree.leaves(variables)) == 4
    params = perturbed(variables["params"])
    stats = variables["batch_stats"]
    ours, updated = module.apply(
        {"params": params, "batch_stats": stats}, x, True, mutable=["batch_stats"]
    )
    plain = reference.as_float64(params)
    np.testing.assert_allclose(ours, reference.scalar_batch_norm(plain, x), rtol=1e-5, atol=1e-6)
    running = updated["batch_stats"]["BatchNorm_0"]
    np.testing.assert_allclose(running["mean"], 0.01 * x.mean(), rtol=1e-5)
    np.testing.assert_allclose(running["var"], 0.99 + 0.01 * x.var(), rtol=1e-5)
    inference = module.apply({"params": params, **updated}, x, False)
    expected = reference.scalar_batch_norm_running(
        plain, reference.as_float64(updated["batch_stats"]), x
    )
    np.testing.assert_allclose(inference, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.oracle
def test_action_inference_averages_after_its_last_layer_as_in_the_spec():
    h = np.random.default_rng(4).normal(size=(3, 4, 5)).astype(np.float32)
    module = ActionInference(width=6, latent=2)
    variables = module.init(jax.random.key(0), h, False)
    params = perturbed(variables["params"])
    variables = {"params": params, "batch_stats": variables["batch_stats"]}
    (mean, log_variance), _ = module.apply(variables, h, True, mutable=["batch_stats"])
    plain = reference.as_float64(params)
    statistics = reference.scalar_batch_norm(
        plain["ScalarBatchNorm_0"], reference.action_statistics(plain, h)
    )
    np.testing.assert_allclose(mean, statistics[:, :2], rtol=RTOL, atol=ATOL)
    np.testing.assert_allclose(log_variance, statistics[:, 2:], rtol=RTOL, atol=ATOL)


def small_hvae(gaussian_dim):
    return HVAE(
        encoder_width=5,
        inference_width=7,
        hidden_width=6,
        action_latent=3,
        observation_latent=2,
        gaussian_dim=gaussian_dim,
    )


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
def test_the_whole_hvae_equals_the_spec_in_numpy(num_categories):
    rng = np.random.default_rng(5)
    if num_categories:
        features = np.eye(4)[rng.integers(0, 4, (3, 4, 3, 2))].reshape(3, 4, 3, 8)
    else:
        features = rng.uniform(0, 9, (3, 4, 3, 2))
    features = features.astype(np.float32)
    model = small_hvae(0 if num_categories else 2)
    draws = noise(6, 3, 4)
    variables = jax.jit(lambda key: model.init(key, features, draws, False))(jax.random.key(0))
    params = perturbed(variables["params"])

    @jax.jit
    def terms_of(params):
        variables_now = {"params": params, "batch_stats": variables["batch_stats"]}
        output, _ = model.apply(variables_now, features, draws, True, mutable=["batch_stats"])
        return objective.elbo_terms(output, features, num_categories)

    terms = terms_of(params)
    expected = reference.hvae(params, features, draws.action, draws.observation, num_categories)
    ours = (terms.reconstruction, terms.kl_action, terms.kl_observation)
    np.testing.assert_allclose(ours, expected, rtol=2e-3)  # A chain of ~40 float32 layers.


@pytest.mark.oracle
def test_the_whole_flat_vae_equals_the_spec_in_numpy():
    features = np.random.default_rng(7).uniform(0, 9, (1, 6, 3, 2)).astype(np.float32)
    model = FlatVAE(encoder_width=5, hidden_width=6, observation_latent=2, gaussian_dim=2)
    draws = noise(8, 1, 6)
    variables = jax.jit(lambda key: model.init(key, features, draws, False))(jax.random.key(0))
    params = perturbed(variables["params"])
    variables = {"params": params, "batch_stats": variables["batch_stats"]}

    @jax.jit
    def terms_of(variables):
        output, _ = model.apply(variables, features, draws, True, mutable=["batch_stats"])
        return objective.elbo_terms(output, features, 0)

    terms = terms_of(variables)
    reconstruction, kl = reference.flat_vae(params, features, draws.observation)
    np.testing.assert_allclose(terms.reconstruction, reconstruction, rtol=2e-3)
    np.testing.assert_allclose(terms.kl_observation, kl, rtol=2e-3)
    assert float(terms.kl_action) == 0.0


def count(model, dim, num_steps=3):
    features = jax.ShapeDtypeStruct((2, 2, num_steps, dim), jnp.float32)
    latents = objective.draw_noise(
        jax.random.key(0), (2, 2), model.action_latent, model.observation_latent
    )
    shapes = jax.eval_shape(lambda x: model.init(jax.random.key(0), x, latents, False), features)
    return sum(leaf.size for leaf in jax.tree.leaves(shapes["params"]))


@pytest.mark.golden
def test_parameter_counts_are_the_specs_without_its_unused_layers():
    # Spec method 3 counts 341,994 (xy) and 443,430 (one-hot) "including unused layers". Unused are,
    # in both, a Lin(dz, H) for a second stochastic layer in q(z|o,c) and in p(z|c) (spec 3.5),
    # 16 * 64 + 64 = 1,088 each; in one-hot also the free log-variance of 160 features, which a
    # categorical likelihood does not read (spec 3.7).
    unused = 2 * (16 * 64 + 64)
    sizes = {
        "encoder_width": 64,
        "inference_width": 128,
        "hidden_width": 64,
        "action_latent": 16,
        "observation_latent": 16,
    }
    assert count(HVAE(**sizes, gaussian_dim=2), 2) == 341_994 - unused
    assert count(HVAE(**sizes, gaussian_dim=0), 160) == 443_430 - unused - 160
    # CREATE's state modality: D = 6, T = 7, latents of 128 (spec method 3), same two layers unused.
    sizes |= {"action_latent": 128, "observation_latent": 128}
    assert count(HVAE(**sizes, gaussian_dim=6), 6) == 431_250 - 2 * (128 * 64 + 64)


@pytest.mark.unit
def test_hvae_dense_layers_start_xavier_normal_and_lstms_uniform():
    model = HVAE(64, 128, 64, 16, 16, gaussian_dim=2)
    features = jnp.zeros((1, 1, 3, 2))
    latents = objective.draw_noise(jax.random.key(0), (1, 1), 16, 16)
    params = init_params(model, features, latents, False)
    kernel = params["action_inference"]["Dense_1"]["kernel"]  # 128 x 128
    # std = 2 / sqrt(i + o) = 0.125; of 16,384 draws its standard error is 0.0007.
    np.testing.assert_allclose(kernel.std(), 0.125, atol=0.003)
    assert np.abs(kernel).max() > 3 * 0.125  # Normal, not uniform (whose bound is 1.73 std).
    assert not np.any(params["action_inference"]["Dense_1"]["bias"])
    bound = 1 / np.sqrt(64)
    for name in ("kernel_input", "kernel_hidden", "bias_input", "bias_hidden"):
        values = np.abs(params["decoder"]["lstm"][name])
        assert values.max() <= bound
        assert values.max() > 0.95 * bound
        np.testing.assert_allclose(values.mean(), bound / 2, rtol=0.15)
    prior = params["latent_prior"]["LatentHead_0"]["log_variance"]
    assert 0.5 < prior.std() < 1.6  # 16 draws of N(0, 1).
    assert params["likelihood_log_variance"].shape == (2,)


@pytest.mark.unit
def test_flat_vae_dense_layers_start_as_pytorchs():
    model = FlatVAE(64, 64, 16, gaussian_dim=2)
    latents = objective.draw_noise(jax.random.key(0), (1, 1), 16, 16)
    params = init_params(model, jnp.zeros((1, 1, 3, 2)), latents, False)
    layers = [
        params["inference"]["Dense_0"],
        params["inference"]["LatentHead_0"]["ResBlock_1"]["Dense_1"],
        params["decoder_start"]["from_observation"],
        params["decoder"]["read"],
        params["decoder"]["after_lstm"]["Dense_0"],
    ]
    for layer in layers:
        bound = 1 / np.sqrt(layer["kernel"].shape[0])
        for values in (layer["kernel"], layer["bias"]):
            assert np.abs(values).max() <= bound
            assert np.abs(values).max() > 0.85 * bound


@pytest.mark.property
@pytest.mark.parametrize("start", [0, 79])
@pytest.mark.parametrize("num_categories", [0, 80])
def test_gradients_are_finite_at_extreme_inputs(start, num_categories):
    cells = jnp.full((2, 2, 3, 2), start)
    features = jax.nn.one_hot(cells, 80).reshape(2, 2, 3, 160) if num_categories else 1.0 * cells
    model = small_hvae(0 if num_categories else 2)
    draws = noise(9, 2, 2)
    variables = jax.jit(lambda key: model.init(key, features, draws, False))(jax.random.key(0))
    stats = variables["batch_stats"]

    @jax.jit
    def gradient(params):
        def loss(params):
            variables_now = {"params": params, "batch_stats": stats}
            output, _ = model.apply(variables_now, features, draws, True, mutable=["batch_stats"])
            return objective.weighted_loss(
                objective.elbo_terms(output, features, num_categories), 2.0
            )

        return jax.value_and_grad(loss)(params)

    for value in (-50.0, 50.0):
        params = jax.tree_util.tree_map_with_path(
            lambda path, leaf, v=value: (
                jnp.full_like(leaf, v) if _is_likelihood_or_posterior(path) else leaf
            ),
            variables["params"],
        )
        loss, grads = gradient(params)
        assert np.isfinite(loss)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def _is_likelihood_or_posterior(path):
    names = [entry.key for entry in path]
    return names[-1] == "likelihood_log_variance" or (
        names[0] == "observation_inference" and names[-1] == "log_variance"
    )
