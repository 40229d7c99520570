"""Networks that predict recordings from latents (`docs/method.md`, "HVAE")."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnew.representation.encoders import (
    AS_GIVEN,
    Dense,
    LSTMWeights,
    ResBlock,
    Scales,
    lstm_cell,
)


class DecoderStart(nn.Module):
    """Latents -> the features `g` that every decoder starts from.

    `g = ReLU(Lin(z) + Lin(c))`; the flat VAE has no action latent: `g = ReLU(Lin(z))`.

    Attributes:
      width: H.
      pytorch_init: see `Dense`.
    """

    width: int
    pytorch_init: bool = False

    @nn.compact
    def __call__(self, z: jax.Array, c: jax.Array | None) -> jax.Array:
        """(z f32[dz, B, S], c f32[dc, B] or None) -> g f32[H, B, S]."""
        g = Dense(self.width, self.pytorch_init, name="from_observation")(z)
        if c is not None:
            g = g + Dense(self.width, self.pytorch_init, name="from_action")(c)[:, :, None]
        return nn.relu(g)


class TrajectoryDecoder(nn.Module):
    """Predicts steps 1..T-1 of a recording from its step 0, feeding back its own predictions.

    Of one-hot features the predictions are logits.

    Attributes:
      width: H.
      pytorch_init: see `Dense`.
      predicts_changes: see `RepresentationConfig`.
      num_categories: K, where features are one-hot blocks of K numbers and the probabilities of
        what was predicted are fed back; 0: what was predicted, of one-hot features their logits.
    """

    width: int
    pytorch_init: bool = False
    predicts_changes: bool = False
    num_categories: int = 0

    @nn.compact
    def __call__(
        self, g: jax.Array, first_step: jax.Array, num_steps: int, scales: Scales = AS_GIVEN
    ) -> jax.Array:
        """Decodes.

        Args:
          g: f32[H, B, S] from `DecoderStart`.
          first_step: f32[B, S, D] the recordings' true step 0.
          num_steps: T, at least 2.
          scales: of the D numbers.
        Returns:
          f32[B, S, T-1, D] predicted means (or logits) of steps 1..T-1.
        """
        *batch, dim = first_step.shape
        read = Dense(self.width, self.pytorch_init, name="read")
        before = ResBlock(2, self.pytorch_init, name="before_lstm")
        after = ResBlock(2, self.pytorch_init, name="after_lstm")
        write = Dense(dim, self.pytorch_init, name="write")
        kernel_input, kernel_hidden, bias = LSTMWeights(self.width, name="lstm")(self.width)
        kernel = jnp.concatenate([kernel_input, kernel_hidden]).T
        scales = Scales(*(jnp.reshape(numbers, (-1, 1)) for numbers in scales))

        def predicted(hidden: jax.Array, last: jax.Array) -> jax.Array:
            written = write(after(hidden))
            if self.predicts_changes:
                return last + scales.change * written
            return scales.mean + scales.deviation * written

        def seen(prediction: jax.Array) -> jax.Array:
            if not self.num_categories:
                return scales.standardized(prediction)
            blocks = prediction.reshape(-1, self.num_categories, prediction.shape[-1])
            return nn.softmax(blocks, axis=1).reshape(prediction.shape)

        g = g.reshape(self.width, -1)
        step = first_step.reshape(-1, dim).T
        gates = kernel_input.T @ (g * before(read(scales.standardized(step))))
        hidden, cell = lstm_cell(gates + bias[:, None], None)
        predictions = [predicted(hidden, step)]
        for _ in range(num_steps - 2):
            u = g * before(read(seen(predictions[-1])))
            gates = kernel @ jnp.concatenate([u, hidden]) + bias[:, None]
            hidden, cell = lstm_cell(gates, cell)
            predictions.append(predicted(hidden, predictions[-1]))
        return jnp.stack(predictions).transpose(2, 0, 1).reshape(*batch, num_steps - 1, dim)
