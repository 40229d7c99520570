"""Recordings that are images: videos, and still images (`docs/method.md`, "HVAE").

Frames become 288 numbers by convolutions, and predicted numbers become frames by convolutions; what
lies between them is that of trajectories. Where the networks flatten 3x3 pixels of 32 channels, the
order is rows, columns, channels (the original's PyTorch: channels, rows, columns): a permutation of
the neighbouring layers' weights and nothing else.

The decoder also gives a mask `M` in (0, 1). For videos it mixes the predicted image `y` with the
recording's first frame, `M y + (1 - M) x_0`, so that what does not move need not be drawn; for
still images it is not used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.convolution import WINDOW, convolution_by_xla
from jaxnew.representation.decoders import TrajectoryDecoder
from jaxnew.representation.encoders import (
    Dense,
    ResBlock,
    Scales,
    TrajectoryEncoder,
    uniform_within,
)

CODE_SHAPE = (3, 3, 32)  # Height, width and channels of the 288 numbers.
CODE_SIZE = math.prod(CODE_SHAPE)
# Channels and strides of the encoder, by the images' side.
ENCODERS = {
    48: ((8, 8, 16, 16, 16, 16, 32), (2, 1, 2, 1, 2, 1, 2)),
    84: ((8, 8, 16, 16, 16, 16, 32, 32, 32), (2, 1, 2, 1, 2, 1, 2, 1, 2)),
}


# Logit of the mask of a video that is drawn as its changes: at first all of it stands still.
MASK_START = -4.0


class _Upsampling(NamedTuple):
    """A transposed convolution with stride 2: from n to `2 n + size - 2 - 2 padding` pixels."""

    features: int
    size: int
    padding: int


# Layers of the decoder, by the images' side: an int is a 3x3 convolution with so many channels.
DECODERS: dict[int, tuple[int | _Upsampling, ...]] = {
    48: (
        *(32, _Upsampling(32, 2, 0), 32, _Upsampling(32, 2, 0)),
        *(32, _Upsampling(16, 2, 0), 16, _Upsampling(16, 2, 0)),
    ),
    84: (
        *(32, _Upsampling(32, 2, 0), 32, _Upsampling(32, 3, 1), 32, _Upsampling(16, 3, 1)),
        *(16, _Upsampling(16, 2, 0), 16, _Upsampling(16, 2, 0)),
    ),
}


def check_image_shape(shape: tuple[int, int, int]) -> None:
    """Raises ValueError unless there are networks for images `(height, width, channels)`."""
    if len(shape) != 3 or shape[0] != shape[1] or shape[0] not in ENCODERS or shape[2] < 1:
        raise ValueError(
            f"image_shape={shape} must be (side, side, channels) with a side of "
            f"{' or '.join(map(str, ENCODERS))}."
        )


def transposed_convolution(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    """Transposed convolution with stride 2, as in PyTorch: f32[B, H, W, C] -> f32[B, H', W', O].

    Every pixel adds its product with the kernel to a patch; patches begin 2 pixels apart. Then
    `padding` pixels are cut off on all sides: `H' = 2 H + k - 2 - 2 padding`.

    Args:
      x: images.
      kernel: f32[k, k, C, O].
      padding: 0 or more.
    """
    size = kernel.shape[0]
    if size == 2:  # Patches touch and do not overlap: nothing is to be added.
        batch, height, width, channels = x.shape
        # One product: as an einsum into the final order, XLA takes a quarter longer on a CPU.
        columns = jnp.moveaxis(kernel, 2, 0).reshape(channels, -1)
        patches = (x.reshape(-1, channels) @ columns).reshape(batch, height, width, 2, 2, -1)
        image = jnp.swapaxes(patches, 2, 3).reshape(batch, 2 * height, 2 * width, -1)
        return _without_border(image, padding)
    products = jnp.einsum("bhwc,ijco->ijbhwo", x, kernel)
    total = None
    for i in range(size):
        for j in range(size):
            spread = ((0, 0, 0), (i, size - 1 - i, 1), (j, size - 1 - j, 1), (0, 0, 0))
            placed = jax.lax.pad(products[i, j], jnp.zeros((), x.dtype), spread)
            total = placed if total is None else total + placed
    assert total is not None
    return _without_border(total, padding)


def _without_border(images: jax.Array, border: int) -> jax.Array:
    """Images [B, H, W, C] less `border` pixels on all sides."""
    return images[:, border : images.shape[1] - border, border : images.shape[2] - border]


class Convolution(nn.Module):
    """A 3x3 convolution with padding 1; PyTorch's default initialisation.

    Attributes:
      features: O.
      stride: 1 or 2.
    """

    features: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[B, H, W, C] -> f32[B, H', W', O]."""
        init = uniform_within(1.0 / math.sqrt(WINDOW**2 * x.shape[-1]))
        kernel = self.param("kernel", init, (WINDOW, WINDOW, x.shape[-1], self.features))
        y = convolution_by_xla(
            x, kernel, self.stride
        )  # On CPUs no part of a loop, see the learner.
        return y + self.param("bias", init, (self.features,))


class TransposedConvolution(nn.Module):
    """`transposed_convolution` with a bias; PyTorch's default initialisation.

    PyTorch counts `O k^2` inputs here.

    Attributes:
      layer: its sizes.
    """

    layer: _Upsampling

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[B, H, W, C] -> f32[B, H', W', O]."""
        features, size, padding = self.layer
        init = uniform_within(1.0 / math.sqrt(features * size**2))
        kernel = self.param("kernel", init, (size, size, x.shape[-1], features))
        return transposed_convolution(x, kernel, padding) + self.param("bias", init, (features,))


class ChannelBatchNorm(nn.Module):
    """Batch norm per channel: the method's `BN2d`, eps 1e-5, running averages keep 0.9.

    PyTorch feeds its running variance with the unbiased batch variance, this one with the biased.
    """

    @nn.compact
    def __call__(self, x: jax.Array, training: bool) -> jax.Array:
        """f32[..., C] -> f32[..., C]; batch statistics if `training`, else the running averages."""
        return nn.BatchNorm(
            use_running_average=not training, momentum=0.9, epsilon=1e-5, use_fast_variance=False
        )(x)


class FrameEncoder(nn.Module):
    """Frames f32[n, side, side, C] -> f32[n, 288]: convolutions, each with batch norm and ReLU."""

    @nn.compact
    def __call__(self, frames: jax.Array, training: bool) -> jax.Array:
        x = frames
        for features, stride in zip(*ENCODERS[frames.shape[1]], strict=True):
            x = nn.relu(ChannelBatchNorm()(Convolution(features, stride)(x), training))
        return x.reshape(len(x), CODE_SIZE)


class FrameDecoder(nn.Module):
    """288 numbers -> an image and a mask.

    Attributes:
      image_shape: (side, side, C).
      predicts_changes: see `RepresentationConfig`; masks then start from `MASK_START`.
    """

    image_shape: tuple[int, int, int]
    predicts_changes: bool = False

    @nn.compact
    def __call__(
        self, codes: jax.Array, mean: jax.Array | float, training: bool
    ) -> tuple[jax.Array, jax.Array]:
        """(codes f32[n, 288], mean f32[C]) -> (f32[n, side, side, C], mask f32[n, side, side, 1]).

        Images are in +-0.5. Where the network gives 0, they have the given mean.
        """
        x = codes.reshape(-1, *CODE_SHAPE)
        for layer in DECODERS[self.image_shape[0]]:
            if isinstance(layer, int):
                x = Convolution(layer)(x)
            else:
                x = TransposedConvolution(layer)(x)
            x = nn.relu(ChannelBatchNorm()(x, training))
        init = uniform_within(1.0 / math.sqrt(x.shape[-1]))
        out = nn.Dense(self.image_shape[2] + 1, kernel_init=init, bias_init=init, name="pixels")(x)
        image = nn.sigmoid(out[..., :-1] + _logit(mean))
        return image - 0.5, nn.sigmoid(out[..., -1:] + MASK_START * self.predicts_changes)


def _logit(mean: jax.Array | float) -> jax.Array:
    """What a sigmoid makes `mean + 0.5` of, where that is neither 0 nor 1: at least 0.01 apart."""
    share = jnp.clip(mean + 0.5, 0.01, 0.99)
    return jnp.log(share) - jnp.log1p(-share)


class ImageRecordingEncoder(nn.Module):
    """Recordings of images -> one vector each: `FrameEncoder` per frame, then the BiLSTM.

    Attributes:
      width: E.
      image_shape: (side, side, C).
      reads_changes: see `RepresentationConfig`.
    """

    width: int
    image_shape: tuple[int, int, int]
    reads_changes: bool = False

    @nn.compact
    def __call__(self, features: jax.Array, training: bool) -> tuple[jax.Array, jax.Array]:
        """f32[B, S, T, side * side * C] -> (f32[E, B, S], first frames' codes f32[B, S, 288])."""
        frames = features.reshape(*features.shape[:-1], *self.image_shape)
        if self.reads_changes:
            changes = jnp.diff(frames, axis=2, prepend=frames[:, :, :1])
            frames = jnp.concatenate([frames, changes], axis=-1)
        codes = FrameEncoder()(frames.reshape(-1, *frames.shape[3:]), training)
        codes = codes.reshape(*features.shape[:-1], CODE_SIZE)
        return TrajectoryEncoder(self.width, name="trajectory")(codes), codes[:, :, 0]


class ImageRecordingDecoder(nn.Module):
    """Predicts the frames after the first of a video, or a whole still image.

    Attributes:
      width: H.
      image_shape: (side, side, C).
      is_still: whether a recording is one image.
      predicts_changes: see `RepresentationConfig`.
      pytorch_init: see `Dense`.
    """

    width: int
    image_shape: tuple[int, int, int]
    is_still: bool
    predicts_changes: bool = False
    pytorch_init: bool = False

    @nn.compact
    def __call__(
        self,
        g: jax.Array,
        first_codes: jax.Array,
        features: jax.Array,
        scales: Scales,
        training: bool,
    ) -> jax.Array:
        """Decodes.

        Args:
          g: f32[H, B, S] from `DecoderStart`.
          first_codes: f32[B, S, 288] of the first frames; not read for still images.
          features: f32[B, S, T, side * side * C] recordings; a video's first frame is read.
          scales: of the C channels; their means are read.
          training: see `ChannelBatchNorm`.

        Returns:
          Means f32[B, S, T - 1, side * side * C] of the later frames, or [B, S, 1, ...] of a still.
        """
        decoder = FrameDecoder(self.image_shape, self.predicts_changes)
        batch = features.shape[:2]
        if self.is_still:
            hidden = ResBlock(2, self.pytorch_init)(g)
            codes = Dense(CODE_SIZE, self.pytorch_init)(hidden).reshape(CODE_SIZE, -1).T
            image, _ = decoder(codes, scales.mean, training)
            return image.reshape(*batch, 1, -1)
        trajectory = TrajectoryDecoder(
            self.width, self.pytorch_init, self.predicts_changes, name="trajectory"
        )
        codes = trajectory(g, first_codes, features.shape[2])
        first = features[:, :, 0].reshape(-1, *self.image_shape)
        means = []
        for t in range(features.shape[2] - 1):
            image, mask = decoder(codes[:, :, t].reshape(-1, CODE_SIZE), scales.mean, training)
            means.append((mask * image + (1.0 - mask) * first).reshape(*batch, -1))
        return jnp.stack(means, axis=2)
