"""The trunk for images and the policies on top of it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxnew.convolution import convolution_by_columns, convolution_by_xla
from jaxnew.environment import ActionSpec
from jaxnew.policy import distribution_and_value, make_method
from jaxnew.policy.method import MethodContext
from jaxnew.policy.state_encoder import ImageEncoder
from tests.jaxnew.policy import numpy_policy

D, A, M = 128, 12, 5
CREATE = ActionSpec(A, position_dim=2)
RNG = np.random.default_rng(0)
SMALL = jnp.asarray(RNG.integers(0, 256, (3, 13, 18, 3)), jnp.uint8)
TABLE = jnp.asarray(RNG.normal(size=(A, D)), jnp.float32)


def count(params: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def method_of(name: str = "ours", is_conditioned: bool = False) -> Any:
    ids = np.arange(A, dtype=np.int32)
    return make_method(
        name, MethodContext(ids, action_spec=CREATE, conditions_position=is_conditioned)
    )


def shapes_of(method: Any) -> Any:
    """The method's parameters for small images, as shapes: initialising takes long on a CPU."""
    return jax.eval_shape(lambda key: method.init(key, SMALL[0], D), jax.random.key(0))


@pytest.mark.golden
def test_parameter_counts() -> None:
    """CREATE 61,302; Shape Stacking (4 frames, one coordinate, a stop) 61,446."""
    shapes = [((84, 84, 3), CREATE), ((84, 84, 4), ActionSpec(A, 1, has_stop=True))]
    found = []
    for shape, spec in shapes:
        method = make_method("ours", MethodContext(action_spec=spec))
        image = jax.ShapeDtypeStruct(shape, jnp.uint8)
        found.append(
            count(jax.eval_shape(lambda k, x, f=method: f.init(k, x, D), jax.random.key(0), image))
        )
    assert found == [61_302, 61_446]


@pytest.mark.golden
def test_the_trunk_ends_with_288_numbers() -> None:
    image = jnp.zeros((84, 84, 3), jnp.uint8)
    params = jax.eval_shape(ImageEncoder().init, jax.random.key(0), image)["params"]
    kernels = [params[f"convolution_{i}"]["kernel"].shape for i in range(5)]
    channels = [(3, 16), (16, 16), (16, 32), (32, 32), (32, 32)]
    assert kernels == [(3, 3, *pair) for pair in channels]
    assert params["dense"]["kernel"].shape == (288, 64)


@pytest.mark.unit
def test_initial_parameters() -> None:
    """Convolutions fill +-1/sqrt(9 C), bias included; the dense layer has gain sqrt 2."""
    image = jnp.zeros((84, 84, 3), jnp.uint8)
    params = jax.jit(ImageEncoder().init)(jax.random.key(0), image)["params"]
    for index, inputs in enumerate((3, 16, 16, 32, 32)):
        layer = params[f"convolution_{index}"]
        bound = 1 / np.sqrt(9 * inputs)
        kernel = np.asarray(layer["kernel"]).ravel()
        assert 0.98 * bound < np.abs(kernel).max() <= bound
        np.testing.assert_allclose(kernel.std(), bound / np.sqrt(3), rtol=0.1)
        assert 0.5 * bound < np.abs(layer["bias"]).max() <= bound
    dense = np.asarray(params["dense"]["kernel"])
    np.testing.assert_allclose(dense.T @ dense, 2 * np.eye(64), atol=1e-5)
    np.testing.assert_array_equal(params["dense"]["bias"], 0.0)


def features_by_scipy(params: Any, image: np.ndarray) -> np.ndarray:
    """The trunk of one image by SciPy's correlation of whole images, in float64."""
    x = image.astype(np.float64) / 255.0
    for index in range(5):
        layer = params[f"convolution_{index}"]
        kernel = np.asarray(layer["kernel"], np.float64)
        padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
        planes = [
            sum(
                signal.correlate2d(padded[..., c], kernel[..., c, o], "valid")
                for c in range(kernel.shape[2])
            )[::2, ::2]
            for o in range(kernel.shape[3])
        ]
        x = np.maximum(np.stack(planes, axis=-1) + np.asarray(layer["bias"], np.float64), 0.0)
    return np.maximum(numpy_policy.dense(params["dense"], x.reshape(-1)), 0.0)


@pytest.mark.oracle
@pytest.mark.parametrize("size", [(13, 18), (16, 7)])
def test_features_equal_scipy(size: tuple[int, int]) -> None:
    images = RNG.integers(0, 256, (2, *size, 3)).astype(np.uint8)
    shapes = jax.eval_shape(ImageEncoder().init, jax.random.key(1), images[0])["params"]
    params = numpy_policy.randomized(shapes, seed=2, scale=0.2)
    got = jax.jit(ImageEncoder().apply)({"params": params}, images)
    expected = np.stack([features_by_scipy(params, image) for image in images])
    assert (expected > 0).mean() > 0.2
    # Sums of a few hundred products of order one in float32.
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("size", "stride"), [((42, 42), 2), ((21, 11), 2), ((6, 1), 2), ((5, 4), 1)]
)
def test_both_forms_of_the_convolution_are_one_function(size: tuple[int, int], stride: int) -> None:
    """With their gradients, with respect to images and kernel."""
    x = jnp.asarray(RNG.normal(size=(2, *size, 5)), jnp.float32)
    kernel = jnp.asarray(RNG.normal(size=(3, 3, 5, 7)), jnp.float32)

    def result(form: Any) -> Any:
        value, pull_back = jax.vjp(lambda x, kernel: form(x, kernel, stride), x, kernel)
        up = jnp.cos(jnp.arange(value.size, dtype=jnp.float32)).reshape(value.shape)
        return value, *pull_back(up)

    columns, xla = jax.jit(lambda: (result(convolution_by_columns), result(convolution_by_xla)))()
    for mine, theirs in zip(columns, xla, strict=True):
        assert mine.shape == theirs.shape
        # Up to 1,764 products of order one per entry, added in another order.
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-3)


@pytest.mark.unit
def test_leading_axes_do_not_matter() -> None:
    encoder = ImageEncoder()
    shapes = jax.eval_shape(encoder.init, jax.random.key(0), SMALL[0])
    params = numpy_policy.randomized(shapes, 1, 0.2)
    several = encoder.apply(params, jnp.stack([SMALL, SMALL[::-1]]))
    assert several.shape == (2, 3, 64)
    np.testing.assert_allclose(several[1, 0], encoder.apply(params, SMALL[2]), atol=1e-6)


@pytest.mark.unit
def test_other_uint8_is_refused() -> None:
    with pytest.raises(ValueError, match=r"images \[..., height, width, channels\], got \(81,\)"):
        method_of().init(jax.random.key(0), jnp.zeros(81, jnp.uint8), D)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "is_conditioned"),
    [
        ("ours", False),
        ("ours", True),
        ("continuous", False),
        ("discrete", False),
        ("random", False),
    ],
)
def test_every_method_acts_on_images_with_one_trunk(name: str, is_conditioned: bool) -> None:
    """Distribution and value at once are what they are apart, and the critic has no trunk."""
    method = method_of(name, is_conditioned)
    params = numpy_policy.randomized(shapes_of(method), 1, 0.1)
    assert set(params["critic"]) == {"value"}
    rows = method.project(params, TABLE)[:M]
    mask = jnp.ones(M, bool)
    distribution, value = distribution_and_value(method, params, SMALL, rows, mask)
    np.testing.assert_allclose(value, method.value(params, SMALL), rtol=1e-6)
    assert value.shape == (3,)
    apart = method.distribution(params, SMALL, rows, mask)
    sample = apart.sample(jax.random.key(3))
    assert sample.position.shape == (3, 2)
    np.testing.assert_allclose(
        distribution.log_prob(sample), apart.log_prob(sample), rtol=1e-5, atol=1e-5
    )


@pytest.mark.unit
def test_value_and_position_reach_the_trunk() -> None:
    """Value gradients do, and the position's head reads f(s)."""
    method = method_of()
    params = numpy_policy.randomized(shapes_of(method), 1, 0.1)
    rows = method.project(params, TABLE)[:M]

    def of_value(p: Any) -> jax.Array:
        return jnp.sum(method.value(p, SMALL))

    def of_position(p: Any) -> jax.Array:
        found = method.distribution(p, SMALL, rows, jnp.ones(M, bool)).position
        return jnp.sum(found.alpha * found.beta)

    for function in (of_value, of_position):
        grads = jax.grad(function)(params)["encoder"]
        assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(grads))


@pytest.mark.unit
def test_the_trunk_runs_once_per_gradient() -> None:
    """The gradient's program holds the columns of one pass, for policy and critic together."""
    method = method_of()
    params = numpy_policy.randomized(shapes_of(method), 1, 0.1)
    rows = method.project(params, TABLE)[:M]

    def loss(p: Any) -> jax.Array:
        distribution, value = distribution_and_value(method, p, SMALL, rows, jnp.ones(M, bool))
        return jnp.sum(value) + jnp.sum(distribution.choice.logits)

    text = str(jax.make_jaxpr(jax.grad(loss))(params))
    # The columns of each of the five convolutions.
    assert text.count("concatenate[") == 5
