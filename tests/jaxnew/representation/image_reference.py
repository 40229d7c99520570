"""Networks for images in plain NumPy and SciPy, float64, written from `docs/method.md`, "HVAE"."""

import numpy as np
import stage1_reference as reference
from scipy import signal

ENCODER_STRIDES = {48: (2, 1, 2, 1, 2, 1, 2), 84: (2, 1, 2, 1, 2, 1, 2, 1, 2)}
# Kernel size and padding of each deconvolution; a plain convolution stands before each of them.
DECODER_DECONVOLUTIONS = {
    48: ((2, 0), (2, 0), (2, 0), (2, 0)),
    84: ((2, 0), (3, 1), (3, 1), (2, 0), (2, 0)),
}


def convolution(p, x, stride):
    """x [H, W, C] -> [H', W', O], padding 1."""
    x = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    kernel = p["kernel"]
    planes = [
        sum(
            signal.correlate2d(x[..., c], kernel[..., c, o], "valid")
            for c in range(kernel.shape[2])
        )
        for o in range(kernel.shape[3])
    ]
    return np.stack(planes, axis=-1)[::stride, ::stride] + p["bias"]


def transposed_convolution(p, x, padding):
    """x [H, W, C] -> [H', W', O], stride 2: every pixel stamps its multiple of the kernel."""
    kernel = p["kernel"]
    size = kernel.shape[0]
    height, width = (2 * (n - 1) + size for n in x.shape[:2])
    out = np.zeros((height, width, kernel.shape[3]))
    for row, column in np.ndindex(x.shape[:2]):
        stamp = np.tensordot(kernel, x[row, column], axes=(2, 0))
        out[2 * row : 2 * row + size, 2 * column : 2 * column + size] += stamp
    return out[padding : height - padding, padding : width - padding] + p["bias"]


def channel_batch_norm(p, x):
    """Batch statistics of each channel over images and pixels, x [n, H, W, C]."""
    p, axes = p["BatchNorm_0"], (0, 1, 2)
    return (x - x.mean(axes)) / np.sqrt(x.var(axes) + 1e-5) * p["scale"] + p["bias"]


def encode_frames(p, x):
    """x [n, side, side, C] -> [n, 288]."""
    for layer, stride in enumerate(ENCODER_STRIDES[x.shape[1]]):
        x = np.stack([convolution(p[f"Convolution_{layer}"], one, stride) for one in x])
        x = reference.relu(channel_batch_norm(p[f"ChannelBatchNorm_{layer}"], x))
    return x.reshape(len(x), -1)


def decode_frames(p, codes, side, mean=0.0):
    """codes [n, 288], mean [C] -> (image [n, side, side, C], mask [n, side, side, 1])."""
    x, norm = codes.reshape(-1, 3, 3, 32), 0
    for layer, (size, padding) in enumerate(DECODER_DECONVOLUTIONS[side]):
        x = np.stack([convolution(p[f"Convolution_{layer}"], one, 1) for one in x])
        x = reference.relu(channel_batch_norm(p[f"ChannelBatchNorm_{norm}"], x))
        q = p[f"TransposedConvolution_{layer}"]
        assert q["kernel"].shape[0] == size
        x = np.stack([transposed_convolution(q, one, padding) for one in x])
        x = reference.relu(channel_batch_norm(p[f"ChannelBatchNorm_{norm + 1}"], x))
        norm += 2
    out = x @ p["pixels"]["kernel"] + p["pixels"]["bias"]
    start = np.log((0.5 + np.asarray(mean)) / (0.5 - np.asarray(mean)))
    return reference.sigmoid(out[..., :-1] + start) - 0.5, reference.sigmoid(out[..., -1:])


def video_means(p, g, codes, first_frames):
    """Means [n, T-1, side * side * C] of the later frames.

    Args:
      p: parameters of the decoder.
      g: [n, H] what it starts from.
      codes: [n, T, 288] of the true frames, of which the first is given.
      first_frames: [n, side, side, C].
    """
    num_steps = codes.shape[1]
    predicted = np.stack(
        [
            reference.decode(p["trajectory"], one, code[0], num_steps)
            for one, code in zip(g, codes, strict=True)
        ]
    )
    means = []
    for t in range(num_steps - 1):
        image, mask = decode_frames(p["FrameDecoder_0"], predicted[:, t], first_frames.shape[1])
        means.append(mask * image + (1 - mask) * first_frames)
    return np.stack(means, axis=1).reshape(len(g), num_steps - 1, -1)


def still_means(p, g, side, mean=0.0):
    """Means [n, side * side * C] of whole images; the mask is not used."""
    hidden = np.stack([reference.res_block(p["ResBlock_0"], one) for one in g])
    image, _ = decode_frames(p["FrameDecoder_0"], reference.dense(p["Dense_0"], hidden), side, mean)
    return image.reshape(len(g), -1)
