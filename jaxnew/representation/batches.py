"""Which recordings a training step sees. Pure functions of a key and a step number.

Batches can be recomputed for any step, so a resumed run sees what an uninterrupted one sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import Modality


class Choice(NamedTuple):
    """Recordings of a batch: `recordings[rows, numbers]`.

    Attributes:
      rows: int32[B, 1] or int32[1, n] actions.
      numbers: int32[B, S] or int32[1, n] which recordings of theirs.
    """

    rows: jax.Array
    numbers: jax.Array


def hvae_choice(
    key_epochs: jax.Array,
    key_step: jax.Array,
    step: jax.Array,
    shape: tuple[int, ...],
    actions_per_batch: int,
    recordings_per_action: int,
) -> Choice:
    """One HVAE batch: B of A actions, S recordings of each, both without replacement.

    An epoch is one shuffled pass over the actions, its last incomplete batch dropped.

    Args:
      key_epochs: typed key; epoch e is shuffled with `fold_in(key_epochs, e)`.
      key_step: typed key of this step, consumed.
      step: int32[] gradient step, counted from 0.
      shape: (A, S_total, ...) of the recordings.
      actions_per_batch: B, at most A.
      recordings_per_action: S, at most S_total.
    """
    num_actions, num_recordings = shape[:2]
    epoch, batch = jnp.divmod(step, num_actions // actions_per_batch)
    all_actions = jnp.arange(num_actions, dtype=jnp.int32)
    order = jax.random.permutation(jax.random.fold_in(key_epochs, epoch), all_actions)
    actions = jax.lax.dynamic_slice_in_dim(order, batch * actions_per_batch, actions_per_batch)
    # The S largest of independent draws are a uniform subset.
    noise = jax.random.uniform(key_step, (actions_per_batch, num_recordings), jnp.float32)
    _, chosen = jax.lax.top_k(noise, recordings_per_action)
    return Choice(actions[:, None], chosen)


def flat_vae_choice(key_step: jax.Array, shape: tuple[int, ...], num_recordings: int) -> Choice:
    """One flat-VAE batch: recordings of all actions alike, drawn with replacement.

    Args:
      key_step: typed key of this step, consumed.
      shape: (A, S_total, ...) of the recordings.
      num_recordings: n.
    """
    chosen = jax.random.randint(key_step, (1, num_recordings), 0, shape[0] * shape[1], jnp.int32)
    return Choice(*jnp.divmod(chosen, shape[1]))


@dataclass(frozen=True)
class Batches:
    """How the batches of a training are drawn.

    Attributes:
      are_pooled: from the recordings of all actions alike. So the flat VAE learns from
        trajectories; of images it has the batches of the HVAE.
      actions_per_batch: B.
      recordings_per_action: S.
    """

    are_pooled: bool
    actions_per_batch: int
    recordings_per_action: int

    @classmethod
    def of(cls, config: RepresentationConfig, modality: Modality) -> Batches:
        """Those that a config asks for."""
        are_pooled = config.kind == "vae" and modality.image_shape is None
        return cls(are_pooled, config.actions_per_batch, config.recordings_per_action)

    def pooled_size(self, num_actions: int) -> int:
        """Recordings of a batch from all of A actions: `A * floor(B * S / A)`, and A at least."""
        asked_for = self.actions_per_batch * self.recordings_per_action
        return max(1, asked_for // num_actions) * num_actions

    def check(self, num_actions: int, num_recordings: int) -> None:
        """Raises unless batches can be drawn from `num_recordings` of each of `num_actions`.

        Raises:
          ValueError: there are too few actions or recordings.
        """
        if self.are_pooled:
            return
        if num_actions < self.actions_per_batch:
            raise ValueError(
                f"actions_per_batch={self.actions_per_batch} exceeds the {num_actions} train "
                f"actions; set it to at most {num_actions}."
            )
        if num_recordings < self.recordings_per_action:
            raise ValueError(
                f"recordings_per_action={self.recordings_per_action} exceeds the "
                f"{num_recordings} recordings per action; set it to at most {num_recordings} or "
                "collect more recordings."
            )

    def epoch(self, step: jax.Array, num_actions: int | jax.Array) -> jax.Array:
        """int32[] the epoch of a step int32[]; every pooled batch is an epoch of its own."""
        return step if self.are_pooled else step // (num_actions // self.actions_per_batch)

    def choice(
        self, key_epochs: jax.Array, key_step: jax.Array, step: jax.Array, shape: tuple[int, ...]
    ) -> Choice:
        """What a step sees; arguments as of `hvae_choice`."""
        if self.are_pooled:
            return flat_vae_choice(key_step, shape, self.pooled_size(shape[0]))
        return hvae_choice(
            key_epochs, key_step, step, shape, self.actions_per_batch, self.recordings_per_action
        )
