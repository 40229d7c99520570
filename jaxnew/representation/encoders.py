"""Networks that read recordings: dense blocks, scalar batch norm and the trajectory encoder.

Inside the networks of stage 1 the features lead, `[w, B, S]` or `[w, N]` with `N = B * S`: gates
and directions are then contiguous blocks, and on a CPU a training step is a fifth cheaper.

A recording encoder maps `[B, S, T, D]` to `[E, B, S]`; everything behind it works on that and does
not know what was recorded, so an image encoder only has to give `[E, B, S]` as well.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

Initializer = Callable[..., jax.Array]

# Xavier-normal with gain sqrt(2), that is std = 2 / sqrt(fan_in + fan_out).
xavier_normal: Initializer = nn.initializers.variance_scaling(
    2.0, "fan_avg", "normal", dtype=jnp.float32
)

# Bounds of the likelihood's learned log-variance.
LOG_VARIANCE_MIN, LOG_VARIANCE_MAX = -4.0, 3.0

# Free log-variance vectors start from N(0, 1).
free_log_variance: Initializer = nn.initializers.normal(1.0, jnp.float32)


def uniform_within(bound: float) -> Initializer:
    """An initializer: f32 draws, uniform in [-bound, bound]."""

    def init(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class Dense(nn.Module):
    """Affine map of the leading axis: `Lin(i, o)` in `docs/method.md`, "HVAE".

    Attributes:
      features: o.
      pytorch_init: False for the Xavier-normal weights and zero bias of the HVAE;
        True for PyTorch's defaults, weights and bias uniform in +-1/sqrt(i), which the flat
        VAE keeps.
    """

    features: int
    pytorch_init: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[i, ...] -> f32[o, ...]."""
        num_inputs = x.shape[0]
        kernel_init, bias_init = xavier_normal, nn.initializers.zeros_init()
        if self.pytorch_init:
            kernel_init = bias_init = uniform_within(1.0 / math.sqrt(num_inputs))
        kernel = self.param("kernel", kernel_init, (num_inputs, self.features))
        bias = self.param("bias", bias_init, (self.features,), jnp.float32)
        y = kernel.T @ x.reshape(num_inputs, -1) + bias[:, None]
        return y.reshape(self.features, *x.shape[1:])


class ResBlock(nn.Module):
    """`ReLU(e + x)`, where `e` is `num_layers` dense layers with ReLU between them, not after.

    `Res(n, w)` in `docs/method.md`, "HVAE".

    Attributes:
      num_layers: n.
      pytorch_init: see `Dense`.
    """

    num_layers: int
    pytorch_init: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[w, ...] -> f32[w, ...]."""
        e = x
        for layer in range(self.num_layers):
            e = Dense(x.shape[0], self.pytorch_init)(nn.relu(e) if layer else e)
        return nn.relu(e + x)


class ScalarBatchNorm(nn.Module):
    """Batch norm with one feature: all numbers share one mean, variance, scale and shift.

    `BN1` in `docs/method.md`, "HVAE": eps 1e-3, running averages keep 0.99. PyTorch feeds
    its running variance with the unbiased batch variance, this one (as Flax does) with the biased
    one; with the n >= 2,000 numbers of a batch here they differ by less than 0.05 %.
    """

    @nn.compact
    def __call__(self, x: jax.Array, training: bool) -> jax.Array:
        """f32[...] -> f32[...]; batch statistics if `training`, else the running averages."""
        norm = nn.BatchNorm(
            use_running_average=not training,
            momentum=0.99,
            epsilon=1e-3,
            use_fast_variance=False,  # E[x^2] - E[x]^2 cancels in float32.
        )
        return norm(x.reshape(-1, 1)).reshape(x.shape)


class Scales(NamedTuple):
    """In which units a recording's numbers are read and written.

    Attributes:
      mean, deviation: f32[D] over all steps.
      change: f32[D] root of the mean square of the change from step to step.
    """

    mean: Any
    deviation: Any
    change: Any

    def standardized(self, x: jax.Array) -> jax.Array:
        """`(x - mean) / deviation`, the D numbers on the axis of the scales."""
        return (x - self.mean) / self.deviation


# The identity.
AS_GIVEN = Scales(0.0, 1.0, 1.0)


class Standardization(nn.Module):
    """The scales of recordings: those of the batch in training, else their running averages.

    Averages keep 0.99 a step, as in `ScalarBatchNorm`; nothing is learned.

    Attributes:
      is_active: False gives `AS_GIVEN`.
      num_channels: C, where the D numbers are pixels of as many channels: the mean is then of the
        channels, f32[C], and all that there is.
    """

    is_active: bool
    num_channels: int | None = None

    @nn.compact
    def __call__(self, features: jax.Array, training: bool) -> Scales:
        """f32[B, S, T, D] -> scales; T at least 2, but for images."""
        if not self.is_active:
            return AS_GIVEN
        if self.num_channels is not None:
            pixels = features.reshape(-1, self.num_channels)
            return AS_GIVEN._replace(mean=self._kept("mean", 0.0, pixels, training))
        mean = self._kept("mean", 0.0, features, training)
        variance = self._kept("variance", 1.0, jnp.square(features - mean), training)
        changes = jnp.square(jnp.diff(features, axis=-2))
        squared_change = self._kept("squared_change", 1.0, changes, training)
        # Numbers that never change are read as zero, and their changes written as nearly zero.
        return Scales(mean, jnp.sqrt(variance + 1e-6), jnp.sqrt(squared_change + 1e-6))

    def _kept(self, name: str, start: float, numbers: jax.Array, training: bool) -> jax.Array:
        """f32[D] the mean of numbers f32[..., D] in training, which moves the average kept."""
        shape = numbers.shape[-1:]
        average = self.variable("batch_stats", name, jnp.full, shape, start, jnp.float32)
        if not training:
            return average.value
        mean = jnp.mean(numbers, axis=tuple(range(numbers.ndim - 1)))
        average.value = 0.99 * average.value + 0.01 * mean
        return mean


def lstm_cell(gates: jax.Array, cell: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """One LSTM step from pre-activations; PyTorch's gate order (input, forget, candidate, output).

    Args:
      gates: f32[4E, N] sum of the input's, the hidden state's and both bias contributions.
      cell: f32[E, N] cell state, None for zeros.
    Returns:
      (hidden f32[E, N], cell f32[E, N]).
    """
    write, forget, candidate, output = jnp.split(gates, 4)
    new_cell = nn.sigmoid(write) * jnp.tanh(candidate)
    if cell is not None:
        new_cell = new_cell + nn.sigmoid(forget) * cell
    return nn.sigmoid(output) * jnp.tanh(new_cell), new_cell


class LSTMWeights(nn.Module):
    """The four parameters of one LSTM direction, laid out and initialised as in PyTorch.

    All uniform in +-1/sqrt(hidden). There are two bias vectors, which only ever act as a sum, but
    each receives the whole gradient: the pair learns twice as fast as one vector would.

    Attributes:
      hidden: E.
    """

    hidden: int

    @nn.compact
    def __call__(self, input_dim: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns (input kernel f32[i, 4E], hidden kernel f32[E, 4E], summed bias f32[4E])."""
        init = uniform_within(1.0 / math.sqrt(self.hidden))
        width = 4 * self.hidden
        kernel_input = self.param("kernel_input", init, (input_dim, width))
        kernel_hidden = self.param("kernel_hidden", init, (self.hidden, width))
        bias_input = self.param("bias_input", init, (width,))
        bias_hidden = self.param("bias_hidden", init, (width,))
        return kernel_input, kernel_hidden, bias_input + bias_hidden


class BiLSTMLayer(nn.Module):
    """One bidirectional LSTM layer, zero initial states.

    Attributes:
      hidden: E per direction.
    """

    hidden: int

    @nn.compact
    def __call__(self, steps: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Reads a sequence in both directions.

        Args:
          steps: T arrays f32[i, N].
        Returns:
          (forward, backward), each T arrays f32[E, N], both in the order of time.
        """
        forward = LSTMWeights(self.hidden, name="forward")(steps[0].shape[0])
        backward = LSTMWeights(self.hidden, name="backward")(steps[0].shape[0])
        return _run_direction(steps, forward), _run_direction(steps[::-1], backward)[::-1]


def _run_direction(
    steps: list[jax.Array], weights: tuple[jax.Array, jax.Array, jax.Array]
) -> list[jax.Array]:
    """Hidden states, T arrays f32[E, N], of an LSTM that reads `steps`, T arrays f32[i, N].

    Unrolled (T is small), with one product per step. Hoisting the input products of all steps into
    one is slower on a CPU: its output does not fit the caches.
    """
    kernel_input, kernel_hidden, bias = weights
    kernel = jnp.concatenate([kernel_input, kernel_hidden]).T
    hidden, cell = lstm_cell(kernel_input.T @ steps[0] + bias[:, None], None)
    outputs = [hidden]
    for step in steps[1:]:
        gates = kernel @ jnp.concatenate([step, hidden]) + bias[:, None]
        hidden, cell = lstm_cell(gates, cell)
        outputs.append(hidden)
    return outputs


class TrajectoryEncoder(nn.Module):
    """Recordings of vectors over time -> one vector each.

    Two bidirectional LSTM layers; the top layer's outputs are averaged over time and directions.

    Attributes:
      width: E.
      reads_changes: see `RepresentationConfig`.
    """

    width: int
    reads_changes: bool = False

    @nn.compact
    def __call__(self, features: jax.Array, scales: Scales = AS_GIVEN) -> jax.Array:
        """f32[B, S, T, D] -> f32[E, B, S]."""
        changes = jnp.diff(features, axis=2, prepend=features[:, :, :1]) / scales.change
        features = scales.standardized(features)
        if self.reads_changes:
            features = jnp.concatenate([features, changes], axis=-1)
        *batch, num_steps, dim = features.shape
        flat = features.reshape(-1, num_steps, dim)
        steps = [flat[:, t].T for t in range(num_steps)]
        forward, backward = BiLSTMLayer(self.width)(steps)
        steps = [jnp.concatenate(pair) for pair in zip(forward, backward, strict=True)]
        forward, backward = BiLSTMLayer(self.width)(steps)
        mean = functools.reduce(jnp.add, forward + backward) / (2 * num_steps)
        return mean.reshape(self.width, *batch)


class LatentHead(nn.Module):
    """Hidden features -> a diagonal Gaussian whose log-variance is one free vector.

    `Res(2, H)`, `Res(2, H)`, `Lin(H, dz)`, `BN1` gives the mean; the log-variance is learned and
    shared by all inputs, as in the release; the paper says that the network outputs it.

    Attributes:
      latent: dz.
      pytorch_init: see `Dense`.
    """

    latent: int
    pytorch_init: bool = False

    @nn.compact
    def __call__(self, e: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[H, ...] -> (mean f32[dz, ...], log-variance f32[dz])."""
        for _ in range(2):
            e = ResBlock(2, self.pytorch_init)(e)
        mean = ScalarBatchNorm()(Dense(self.latent, self.pytorch_init)(e), training)
        return mean, self.param("log_variance", free_log_variance, (self.latent,))


def likelihood_log_variance(module: nn.Module, gaussian_dim: int) -> jax.Array | None:
    """Registers the likelihood's free log-variance f32[D] in `module`; None where D is 0.

    It is clamped to [-4, 3]; outside, its gradient is zero.
    """
    if not gaussian_dim:
        return None
    free = module.param("likelihood_log_variance", free_log_variance, (gaussian_dim,))
    return jnp.clip(free, LOG_VARIANCE_MIN, LOG_VARIANCE_MAX)
