"""Training of stage 1: recordings of the train actions -> an encoder of actions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxnew import finiteness
from jaxnew.finiteness import PREFIX
from jaxnew.optimizer import in_32_bits
from jaxnew.representation.batches import Batches, Choice
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import Modality
from jaxnew.representation.objective import (
    ElboTerms,
    LatentNoise,
    draw_noise,
    elbo_terms,
    reconstruction_weight,
    weighted_loss,
)
from jaxnew.representation.sources import RecordingSource, StoredRecordings, padded_chunks
from jaxnew.representation.vae import build_model

__all__ = ["Modality", "RepresentationConfig", "RepresentationLearner", "RepresentationState"]

Metrics = dict[str, jax.Array]

# What is encoded at a time: actions, and numbers of their features. 2^24 are 64 MiB; the layers'
# outputs are several times as much.
_ENCODED_ACTIONS = 8
_ENCODED_FEATURES = 2**24


@struct.dataclass
class EncoderWeights:
    """All that encoding reads.

    Attributes:
      params: network parameters, f32 leaves.
      batch_stats: running averages, f32 leaves.
    """

    params: Any
    batch_stats: Any


@struct.dataclass
class RepresentationState:
    """All that training changes.

    Attributes:
      params: network parameters, f32 leaves.
      batch_stats: running averages of the batch norms, f32 leaves.
      opt_state: optimiser state.
      key_epochs: typed PRNG key, never advanced; epoch e is shuffled with `fold_in` of it and e.
      key_steps: typed PRNG key, never advanced; step i draws with `fold_in` of it and i.
      step: int32[] gradient steps taken.
    """

    params: Any
    batch_stats: Any
    opt_state: Any
    key_epochs: jax.Array
    key_steps: jax.Array
    step: jax.Array

    @property
    def weights(self) -> EncoderWeights:
        """What an encoder keeps of it."""
        return EncoderWeights(self.params, self.batch_stats)


class RepresentationLearner:
    """Trains an HVAE or a flat VAE and encodes actions with it.

    Recordings are given in their stored dtype, `[A, S_total, T, D0]`, and become features only
    after a batch has been drawn. They are an array, which training keeps on the device, or a
    `RecordingSource`, which gives each batch when it is needed.

    Attributes:
      config: hyper-parameters.
      modality: what was recorded.
      appends_changes: `Autoencoder.mean_changes` stand behind the means of the posterior.
    """

    def __init__(
        self, config: RepresentationConfig, modality: Modality, appends_changes: bool = False
    ) -> None:
        self.config = config
        self.modality = modality
        self.appends_changes = appends_changes
        self._model = build_model(config, modality)
        self._batches = Batches.of(config, modality)
        # Betas 0.9 and 0.999, eps 1e-8: `docs/method.md`, "Objective of stage 1".
        self._optimizer = in_32_bits(
            optax.chain(
                optax.clip(config.gradient_clip), optax.radam(config.learning_rate, threshold=5.0)
            )
        )
        self._run = jax.jit(self._run_steps)
        self._step = jax.jit(self._step_on)
        self._choices = jax.jit(self._choices_of, static_argnames=("shape", "num_steps"))
        self._posterior = jax.jit(self._posterior_of)

    def init(self, key: jax.Array, recordings_shape: tuple[int, ...]) -> RepresentationState:
        """A fresh training state.

        Args:
          key: typed key, consumed.
          recordings_shape: (A_train, S_total, T, D0) of the recordings to train on; of images
            (A_train, S_total, T, height, width, channels), of stills without T.
        Raises:
          ValueError: the recordings are too few for the config's batches, or have no step to
            predict.
        """
        self._check_trainable(recordings_shape)
        key_params, key_run = jax.random.split(key)
        key_epochs, key_steps = jax.random.split(key_run)
        num_steps = self.modality.num_steps(recordings_shape)
        features = jnp.zeros((1, 1, num_steps, self.modality.feature_dim), jnp.float32)
        variables = jax.jit(self._init_variables)(key_params, features)
        return RepresentationState(
            params=variables["params"],
            batch_stats=variables["batch_stats"],
            opt_state=self._optimizer.init(variables["params"]),
            key_epochs=key_epochs,
            key_steps=key_steps,
            step=jnp.zeros((), jnp.int32),
        )

    def train_steps(
        self, state: RepresentationState, recordings: jax.Array | RecordingSource, num_steps: int
    ) -> tuple[RepresentationState, Metrics]:
        """Takes `num_steps` gradient steps; `2k` at once equal two calls of `k` bit for bit (CPU).

        Of an array, the number of steps is a traced bound of one compiled loop, so that every value
        runs the same program. Of a source, each step is a call, and the host gathers the next batch
        while it computes; the batches are those of an array with the same recordings.

        Args:
          state: not changed.
          recordings: [A_train, S_total, T, D0], stored dtype; kept on the device between calls if
            it is a `jax.Array`. Or a source of that shape.
          num_steps: at least 1.
        Returns:
          The new state, and f32[] metrics: means over the steps of `loss`, `reconstruction`,
          `kl_action`, `kl_observation` and `grad_norm` (before the clamp); `nonfinite/...` are
          the numbers of entries that are not finite at the first step that has any.
        Raises:
          ValueError: see `init`; or `num_steps` < 1, or the recordings do not suit the modality.
        """
        self._check_trainable(recordings.shape)
        if num_steps < 1:
            raise ValueError(f"num_steps={num_steps} must be at least 1.")
        is_source = isinstance(recordings, RecordingSource)
        if not is_source and self.modality.image_shape and jax.default_backend() == "cpu":
            # Inside of loops XLA's convolutions are ten times slower there.
            recordings = StoredRecordings(np.asarray(recordings))
        if isinstance(recordings, RecordingSource):
            return self._run_on_source(state, recordings, num_steps)
        return self._run(state, jnp.asarray(recordings), jnp.int32(num_steps))

    def encode(
        self,
        weights: EncoderWeights | RepresentationState,
        recordings: jax.Array | np.ndarray | RecordingSource,
        batch: int | None = None,
    ) -> np.ndarray:
        """Action representations f32[A, d], from the arguments of `encode_posterior`: its means,
        and what is appended to them.
        """
        means, _, appended = self._encoded(weights, recordings, batch)
        return np.concatenate([means, appended], axis=1)

    def encode_posterior(
        self,
        weights: EncoderWeights | RepresentationState,
        recordings: jax.Array | np.ndarray | RecordingSource,
        batch: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Posterior of each action given all its recordings, batch norm in inference mode.

        Works on any actions, seen in training or not (paper algorithm 2), and on any number of
        recordings per action, which need not be that of training.

        Args:
          weights: of an encoder, or the state of its training.
          recordings: [A, S, T, D0], stored dtype; may stay on the host, or be a source.
          batch: actions encoded at a time; bounds memory, does not change the result beyond
            rounding. Default: 8, or as many as have 2^24 features, but at least one.
        Returns:
          (mean, log-variance), each f32[A, d]. For the flat VAE: the mean over recordings of their
          posterior means, and the log-variance that they all share.
        Raises:
          ValueError: `recordings` is not 4-dimensional or is empty, they do not suit the modality,
            or `batch` < 1.
        """
        return self._encoded(weights, recordings, batch)[:2]

    def _encoded(
        self,
        weights: EncoderWeights | RepresentationState,
        recordings: jax.Array | np.ndarray | RecordingSource,
        batch: int | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means and log-variances of `encode_posterior`, and what is appended to the means."""
        if len(recordings.shape) != 2 + self.modality.recording_rank or 0 in recordings.shape:
            raise ValueError(
                f"recordings must be a non-empty {self._recordings_form}, got shape "
                f"{recordings.shape}."
            )
        num_actions, num_recordings = recordings.shape[:2]
        if batch is None:
            num_steps = self.modality.num_steps(recordings.shape)
            size = num_recordings * num_steps * self.modality.feature_dim
            batch = min(_ENCODED_ACTIONS, max(1, _ENCODED_FEATURES // size))
        if batch < 1:
            raise ValueError(f"batch={batch} must be at least 1.")
        parts: list[Any] = []
        for chunk in padded_chunks(recordings, batch):
            parts.append(self._posterior(weights.params, weights.batch_stats, chunk))
            # At most one chunk waits while another is encoded, so that memory is bounded.
            parts[-2:-1] = jax.device_get(parts[-2:-1])
        means, log_variances, appended = (
            np.concatenate(part)[:num_actions] for part in zip(*jax.device_get(parts), strict=True)
        )
        return means, log_variances, appended

    def _check_trainable(self, shape: tuple[int, ...]) -> None:
        is_still = self.modality.is_still
        if len(shape) != 2 + self.modality.recording_rank or (not is_still and shape[2] < 2):
            steps = "" if is_still else " with T >= 2 (step 0 is given, the others are predicted)"
            raise ValueError(
                f"recordings must be {self._recordings_form}{steps}, got shape {tuple(shape)}."
            )
        self._batches.check(shape[0], shape[1])

    @property
    def _recordings_form(self) -> str:
        last = {2: "T, D0", 3: "height, width, channels", 4: "T, height, width, channels"}
        return f"[A, S, {last[self.modality.recording_rank]}]"

    def _init_variables(self, key: jax.Array, features: jax.Array) -> Any:
        noise = self._draw_noise(key, features)
        return self._model.init(key, features, noise, training=False)

    def _draw_noise(self, key: jax.Array, features: jax.Array) -> LatentNoise:
        batch_shape = (features.shape[0], features.shape[1])
        config = self.config
        return draw_noise(key, batch_shape, config.action_latent, config.observation_latent)

    def _run_steps(
        self, state: RepresentationState, recordings: jax.Array, num_steps: jax.Array
    ) -> tuple[RepresentationState, Metrics]:
        update = jax.jit(self._update)  # Traced once for its shapes and for the loop.

        def body(
            _: jax.Array, carry: tuple[RepresentationState, Metrics]
        ) -> tuple[RepresentationState, Metrics]:
            state, totals = carry
            state, metrics = update(state, recordings)
            return state, _added(totals, metrics)

        shapes = jax.eval_shape(update, state, recordings)[1]
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        state, totals = jax.lax.fori_loop(0, num_steps, body, (state, zeros))
        return state, _means(totals, num_steps)

    def _update(
        self, state: RepresentationState, recordings: jax.Array
    ) -> tuple[RepresentationState, Metrics]:
        """One gradient step on recordings of which it draws its batch."""
        choice = self._choice(state, recordings.shape)
        batch = recordings[choice.rows, choice.numbers]
        return self._step_on(state, batch, recordings.shape[0])

    def _run_on_source(
        self, state: RepresentationState, source: RecordingSource, num_steps: int
    ) -> tuple[RepresentationState, Metrics]:
        shape = source.shape
        rows, numbers = jax.device_get(self._choices(state, shape=shape, num_steps=num_steps))
        batch = source.gather(rows[0], numbers[0])
        totals: Metrics = {}
        for i in range(num_steps):
            state, metrics = self._step(state, batch, jnp.int32(shape[0]))
            # One step computes and at most one waits while the next batch is gathered.
            jax.block_until_ready(totals)
            totals = _added(totals, metrics) if totals else metrics
            if i + 1 < num_steps:
                batch = source.gather(rows[i + 1], numbers[i + 1])
        return state, _means(totals, num_steps)

    def _choices_of(
        self, state: RepresentationState, shape: tuple[int, ...], num_steps: int
    ) -> Choice:
        """What the next `num_steps` steps see, int32[num_steps, ...]."""
        steps = state.step + jnp.arange(num_steps, dtype=jnp.int32)
        return jax.lax.map(lambda step: self._choice(replace(state, step=step), shape), steps)

    def _step_on(
        self, state: RepresentationState, batch: jax.Array, num_actions: int | jax.Array
    ) -> tuple[RepresentationState, Metrics]:
        """One gradient step, and its metrics, on a batch [B, S, T, D0] of `num_actions` actions."""
        features, (_, key_noise) = self._features(batch), self._step_keys(state)
        weight = reconstruction_weight(self._batches.epoch(state.step, num_actions))
        gradient_of = jax.value_and_grad(self._loss, has_aux=True)
        (loss, (terms, batch_stats)), grads = gradient_of(
            state.params, state.batch_stats, features, key_noise, weight
        )
        updates, opt_state = self._optimizer.update(grads, state.opt_state, state.params)
        metrics = {
            "loss": loss,
            "reconstruction": terms.reconstruction,
            "kl_action": terms.kl_action,
            "kl_observation": terms.kl_observation,
            "grad_norm": jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(grads))),
        }
        counted = {"recording": features, "loss": loss, "gradient": grads}
        metrics |= {PREFIX + name: finiteness.count(values) for name, values in counted.items()}
        state = replace(
            state,
            params=optax.apply_updates(state.params, updates),
            batch_stats=batch_stats,
            opt_state=opt_state,
            step=state.step + 1,
        )
        return state, metrics

    def _step_keys(self, state: RepresentationState) -> tuple[jax.Array, jax.Array]:
        """Keys of this step: of its batch, and of the latents' noise."""
        key_batch, key_noise = jax.random.split(jax.random.fold_in(state.key_steps, state.step))
        return key_batch, key_noise

    def _choice(self, state: RepresentationState, shape: tuple[int, ...]) -> Choice:
        """Which recordings, of [A, S_total, ...], this step sees."""
        key_batch, _ = self._step_keys(state)
        return self._batches.choice(state.key_epochs, key_batch, state.step, shape)

    def _features(self, recordings: jax.Array) -> jax.Array:
        """f32[..., T, D] of stored recordings [..., T, D0] or of images.

        Raises:
          ValueError: the modality's `featurize` gives something else.
        """
        features = self.modality.featurize(recordings)
        leading = recordings.shape[: recordings.ndim - self.modality.recording_rank]
        num_steps = self.modality.num_steps((0, 0, *recordings.shape[len(leading) :]))
        expected = (*leading, num_steps, self.modality.feature_dim)
        if features.shape != expected or features.dtype != jnp.float32:
            raise ValueError(
                f"Modality {self.modality.name!r} made {features.dtype}{features.shape} of "
                f"recordings {recordings.dtype}{recordings.shape}; float32{expected} was expected. "
                "Correct its featurize or feature_dim, or give it the recordings it is made for."
            )
        return features

    def _loss(
        self,
        params: Any,
        batch_stats: Any,
        features: jax.Array,
        key_noise: jax.Array,
        weight: jax.Array,
    ) -> tuple[jax.Array, tuple[ElboTerms, Any]]:
        """Training loss; also its terms and the new running averages."""
        output, updated = self._model.apply(
            {"params": params, "batch_stats": batch_stats},
            features,
            self._draw_noise(key_noise, features),
            training=True,
            mutable=["batch_stats"],
        )
        terms = elbo_terms(
            output,
            features,
            self.modality.num_categories,
            kl_recordings=self.config.kl_recordings,
            has_shared_variance=self.modality.image_shape is not None,
        )
        return weighted_loss(terms, weight), (terms, updated["batch_stats"])

    def _posterior_of(
        self, params: Any, batch_stats: Any, recordings: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        variables = {"params": params, "batch_stats": batch_stats}
        features = self._features(recordings)
        posterior: Any = self._model.apply(variables, features, method="posterior")
        appended: Any = jnp.zeros((len(features), 0), jnp.float32)
        if self.appends_changes:
            appended = self._model.apply(variables, features, method="mean_changes")
        return *posterior, appended


def _added(totals: Metrics, metrics: Metrics) -> Metrics:
    """Sums over steps; counts of what is not finite stay those of the first step that has any."""
    is_first = sum(value for name, value in totals.items() if name.startswith(PREFIX)) == 0
    return {
        name: jnp.where(is_first, metrics[name], total)
        if name.startswith(PREFIX)
        else total + metrics[name]
        for name, total in totals.items()
    }


def _means(totals: Metrics, num_steps: int | jax.Array) -> Metrics:
    count = jnp.asarray(num_steps, jnp.float32)
    return {
        name: total if name.startswith(PREFIX) else total / count for name, total in totals.items()
    }
