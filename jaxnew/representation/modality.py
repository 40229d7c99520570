"""What was recorded, and how a stored recording becomes the networks' input."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxnew.representation.images import check_image_shape

GAUSSIAN = "gaussian"
CATEGORICAL = "categorical"


@dataclass(frozen=True)
class Modality:
    """How stored recordings become network inputs.

    Attributes:
      name: for messages and file names, e.g. "xy" or "onehot".
      feature_dim: D, numbers per time step after `featurize`.
      likelihood: "gaussian" or "categorical".
      num_categories: categories per coordinate for a categorical likelihood, whose D numbers are
        one-hot blocks of that size, one after the other; 0 for a Gaussian one.
      featurize: stored recordings [..., T, D0], uint8 or float -> f32[..., T, D]; pure JAX. Images
        are stored [..., T, height, width, channels], stills without T, which is 1.
      image_shape: (side, side, channels) where a step is an image, whose D numbers are then in that
        order; else None.
      is_still: whether a recording is one image.

    Raises:
      ValueError: the fields contradict each other.
    """

    name: str
    feature_dim: int
    likelihood: str
    num_categories: int
    featurize: Callable[[jax.Array], jax.Array]
    image_shape: tuple[int, int, int] | None = None
    is_still: bool = False

    def __post_init__(self) -> None:
        if self.likelihood not in (GAUSSIAN, CATEGORICAL):
            raise ValueError(
                f"Modality {self.name!r}: unknown likelihood {self.likelihood!r}; choose "
                f"{GAUSSIAN!r} or {CATEGORICAL!r}."
            )
        if self.feature_dim < 1:
            raise ValueError(
                f"Modality {self.name!r}: feature_dim={self.feature_dim} must be >= 1."
            )
        is_categorical = self.likelihood == CATEGORICAL
        if is_categorical != (self.num_categories > 0):
            raise ValueError(
                f"Modality {self.name!r}: num_categories={self.num_categories} does not fit "
                f"likelihood={self.likelihood!r}; it is positive for {CATEGORICAL!r}, 0 otherwise."
            )
        if is_categorical and self.feature_dim % self.num_categories:
            raise ValueError(
                f"Modality {self.name!r}: feature_dim={self.feature_dim} is not a multiple of "
                f"num_categories={self.num_categories}."
            )

        self._check_images()

    def _check_images(self) -> None:
        if self.image_shape is None:
            if self.is_still:
                raise ValueError(f"Modality {self.name!r}: is_still needs an image_shape.")
            return
        check_image_shape(self.image_shape)
        if self.feature_dim != math.prod(self.image_shape) or self.likelihood != GAUSSIAN:
            raise ValueError(
                f"Modality {self.name!r}: images of {self.image_shape} have feature_dim="
                f"{math.prod(self.image_shape)} and a {GAUSSIAN!r} likelihood; got feature_dim="
                f"{self.feature_dim} and {self.likelihood!r}."
            )

    @property
    def recording_rank(self) -> int:
        """Axes of one stored recording."""
        return 2 if self.image_shape is None else 4 - self.is_still

    def num_steps(self, recordings_shape: tuple[int, ...]) -> int:
        """T of recordings [A, S, ...]."""
        return 1 if self.is_still else recordings_shape[2]

    @property
    def is_gaussian_vector(self) -> bool:
        """Whether a step is a vector of numbers that have units."""
        return self.image_shape is None and not self.num_categories

    @property
    def gaussian_dim(self) -> int:
        """D if the likelihood is Gaussian, else 0."""
        return 0 if self.num_categories else self.feature_dim


def vector_modality(name: str, feature_dim: int) -> Modality:
    """Stored vectors as they are, converted to float32, with a Gaussian likelihood."""
    return Modality(name, feature_dim, GAUSSIAN, 0, _as_float)


def one_hot_modality(name: str, num_coordinates: int, num_categories: int) -> Modality:
    """Stored integer coordinates [..., T, num_coordinates] as one-hot blocks."""

    def featurize(recordings: jax.Array) -> jax.Array:
        blocks = jax.nn.one_hot(recordings, num_categories, dtype=jnp.float32)
        return blocks.reshape(*recordings.shape[:-1], num_coordinates * num_categories)

    return Modality(name, num_coordinates * num_categories, CATEGORICAL, num_categories, featurize)


def image_modality(
    name: str, image_shape: tuple[int, int, int], is_still: bool = False
) -> Modality:
    """Stored uint8 images, scaled to +-0.5, with a Gaussian likelihood of pixels.

    Args:
      name: see `Modality`.
      image_shape: (side, side, channels) with a side of 48 or 84.
      is_still: recordings are single images [..., side, side, channels] instead of videos
        [..., T, side, side, channels].
    """
    size = math.prod(image_shape)

    def featurize(recordings: jax.Array) -> jax.Array:
        leading = recordings.shape[:-3]
        steps = (*leading, 1) if is_still else leading
        return (recordings.astype(jnp.float32) / 255.0 - 0.5).reshape(*steps, size)

    return Modality(name, size, GAUSSIAN, 0, featurize, image_shape, is_still)


def _as_float(recordings: jax.Array) -> jax.Array:
    return recordings.astype(jnp.float32)
