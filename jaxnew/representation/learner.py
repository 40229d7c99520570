"""Training of stage 1: recordings of the train actions -> an encoder of actions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxnew.representation.batches import flat_vae_batch, hvae_batch
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.hvae import HVAE
from jaxnew.representation.modality import Modality
from jaxnew.representation.objective import (
    ElboTerms,
    LatentNoise,
    draw_noise,
    elbo_terms,
    reconstruction_weight,
    weighted_loss,
)
from jaxnew.representation.vae import FlatVAE

__all__ = ["Modality", "RepresentationConfig", "RepresentationLearner", "RepresentationState"]

Metrics = dict[str, jax.Array]


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


class RepresentationLearner:
    """Trains an HVAE or a flat VAE and encodes actions with it.

    Recordings are given in their stored dtype, `[A, S_total, T, D0]`, and become features only
    after a batch has been drawn.
    """

    def __init__(self, config: RepresentationConfig, modality: Modality) -> None:
        self.config = config
        self.modality = modality
        self._model = _build_model(config, modality)
        # Spec method 3.7: elementwise clamp, then RAdam with betas 0.9 and 0.999, eps 1e-8.
        self._optimizer = optax.chain(
            optax.clip(config.gradient_clip), optax.radam(config.learning_rate, threshold=5.0)
        )
        self._run = jax.jit(self._run_steps)
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
        features = jnp.zeros((1, 1, num_steps, self.modality.feature_dim))
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
        self, state: RepresentationState, recordings: jax.Array, num_steps: int
    ) -> tuple[RepresentationState, Metrics]:
        """Takes `num_steps` gradient steps; `2k` at once equal two calls of `k` bit for bit (CPU).

        The number of steps is a traced bound of one compiled loop, so that every value runs the
        same program.

        Args:
          state: not changed.
          recordings: [A_train, S_total, T, D0], stored dtype; kept on the device between calls if
            it is a `jax.Array`.
          num_steps: at least 1.
        Returns:
          The new state, and f32[] metrics: means over the steps of `loss`, `reconstruction`,
          `kl_action`, `kl_observation` and `grad_norm` (before the clamp), and `nonfinite`, the
          number of non-finite entries of losses and gradients over all steps.
        Raises:
          ValueError: see `init`; or `num_steps` < 1, or the recordings do not suit the modality.
        """
        self._check_trainable(recordings.shape)
        if num_steps < 1:
            raise ValueError(f"num_steps={num_steps} must be at least 1.")
        return self._run(state, jnp.asarray(recordings), jnp.int32(num_steps))

    def encode(
        self, state: RepresentationState, recordings: jax.Array | np.ndarray, batch: int = 8
    ) -> np.ndarray:
        """Action representations: the posterior means of `encode_posterior`, f32[A, d]."""
        return self.encode_posterior(state, recordings, batch)[0]

    def encode_posterior(
        self, state: RepresentationState, recordings: jax.Array | np.ndarray, batch: int = 8
    ) -> tuple[np.ndarray, np.ndarray]:
        """Posterior of each action given all its recordings, batch norm in inference mode.

        Works on any actions, seen in training or not (paper algorithm 2), and on any number of
        recordings per action, which need not be that of training.

        Args:
          state: trained state; only its parameters and running averages are read.
          recordings: [A, S, T, D0], stored dtype; may stay on the host.
          batch: actions encoded at a time; bounds memory, does not change the result beyond
            rounding.
        Returns:
          (mean, log-variance), each f32[A, d]. For the flat VAE: the mean over recordings of their
          posterior means, and the log-variance that they all share.
        Raises:
          ValueError: `recordings` is not 4-dimensional or is empty, they do not suit the modality,
            or `batch` < 1.
        """
        if len(recordings.shape) != 2 + self.modality.recording_rank or 0 in recordings.shape:
            raise ValueError(
                f"recordings must be a non-empty {self._recordings_form}, got shape "
                f"{recordings.shape}."
            )
        if batch < 1:
            raise ValueError(f"batch={batch} must be at least 1.")
        parts = [
            self._posterior(state.params, state.batch_stats, chunk)
            for chunk in _padded_chunks(recordings, batch)
        ]
        means, log_variances = zip(*jax.device_get(parts), strict=True)
        num_actions = len(recordings)
        return np.concatenate(means)[:num_actions], np.concatenate(log_variances)[:num_actions]

    def _check_trainable(self, shape: tuple[int, ...]) -> None:
        is_still = self.modality.is_still
        if len(shape) != 2 + self.modality.recording_rank or (not is_still and shape[2] < 2):
            steps = "" if is_still else " with T >= 2 (step 0 is given, the others are predicted)"
            raise ValueError(
                f"recordings must be {self._recordings_form}{steps}, got shape {tuple(shape)}."
            )
        config, (num_actions, num_recordings) = self.config, shape[:2]
        if self._pools_recordings:
            if self._flat_batch_size(num_actions) < 1:
                raise ValueError(
                    f"actions_per_batch * recordings_per_action = "
                    f"{config.actions_per_batch * config.recordings_per_action} is less than the "
                    f"{num_actions} train actions; the flat VAE needs at least one recording per "
                    "action and step. Raise either field."
                )
            return
        if num_actions < config.actions_per_batch:
            raise ValueError(
                f"actions_per_batch={config.actions_per_batch} exceeds the {num_actions} train "
                f"actions; set it to at most {num_actions}."
            )
        if num_recordings < config.recordings_per_action:
            raise ValueError(
                f"recordings_per_action={config.recordings_per_action} exceeds the "
                f"{num_recordings} recordings per action; set it to at most {num_recordings} or "
                "collect more recordings."
            )

    @property
    def _recordings_form(self) -> str:
        last = {2: "T, D0", 3: "height, width, channels", 4: "T, height, width, channels"}
        return f"[A, S, {last[self.modality.recording_rank]}]"

    @property
    def _pools_recordings(self) -> bool:
        """Whether batches are drawn from all recordings alike: the flat VAE, but not of images,
        whose batches are those of the HVAE (spec method 4)."""
        return self.config.kind == "vae" and self.modality.image_shape is None

    def _flat_batch_size(self, num_actions: int) -> int:
        """Recordings in a flat-VAE batch: `A * floor(B * S / A)` (spec method 4)."""
        total = self.config.actions_per_batch * self.config.recordings_per_action
        return total // num_actions * num_actions

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
        def body(
            _: jax.Array, carry: tuple[RepresentationState, Metrics]
        ) -> tuple[RepresentationState, Metrics]:
            state, totals = carry
            state, metrics = self._update(state, recordings)
            return state, jax.tree.map(jnp.add, totals, metrics)

        shapes = jax.eval_shape(self._update, state, recordings)[1]
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        state, totals = jax.lax.fori_loop(0, num_steps, body, (state, zeros))
        means = {name: total / num_steps for name, total in totals.items()}
        return state, {**means, "nonfinite": totals["nonfinite"]}

    def _update(
        self, state: RepresentationState, recordings: jax.Array
    ) -> tuple[RepresentationState, Metrics]:
        """One gradient step; metrics of this step."""
        features, epoch, key_noise = self._draw(state, recordings)
        weight = reconstruction_weight(epoch)
        gradient_of = jax.value_and_grad(self._loss, has_aux=True)
        (loss, (terms, batch_stats)), grads = gradient_of(
            state.params, state.batch_stats, features, key_noise, weight
        )
        updates, opt_state = self._optimizer.update(grads, state.opt_state, state.params)
        nonfinite = sum(jnp.sum(~jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, grads)))
        metrics = {
            "loss": loss,
            "reconstruction": terms.reconstruction,
            "kl_action": terms.kl_action,
            "kl_observation": terms.kl_observation,
            "grad_norm": jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(grads))),
            "nonfinite": jnp.asarray(nonfinite, jnp.float32),
        }
        state = replace(
            state,
            params=optax.apply_updates(state.params, updates),
            batch_stats=batch_stats,
            opt_state=opt_state,
            step=state.step + 1,
        )
        return state, metrics

    def _draw(
        self, state: RepresentationState, recordings: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """This step's (features f32[B, S, T, D], epoch int32[], key of the latents' noise)."""
        key_step = jax.random.fold_in(state.key_steps, state.step)
        key_batch, key_noise = jax.random.split(key_step)
        config = self.config
        if not self._pools_recordings:
            epoch = state.step // (recordings.shape[0] // config.actions_per_batch)
            batch = hvae_batch(
                state.key_epochs,
                key_batch,
                state.step,
                recordings,
                config.actions_per_batch,
                config.recordings_per_action,
            )
        else:
            epoch = state.step  # Spec method 4: an epoch is one step.
            batch = flat_vae_batch(
                key_batch, recordings, self._flat_batch_size(recordings.shape[0])
            )
        return self._features(batch), epoch, key_noise

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
        terms = elbo_terms(output, features, self.modality.num_categories)
        return weighted_loss(terms, weight), (terms, updated["batch_stats"])

    def _posterior_of(
        self, params: Any, batch_stats: Any, recordings: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        variables = {"params": params, "batch_stats": batch_stats}
        posterior: Any = self._model.apply(
            variables, self._features(recordings), method="posterior"
        )
        return posterior


def _build_model(config: RepresentationConfig, modality: Modality) -> HVAE | FlatVAE:
    if config.kind == "hvae":
        return HVAE(
            encoder_width=config.encoder_width,
            inference_width=config.inference_width,
            hidden_width=config.hidden_width,
            action_latent=config.action_latent,
            observation_latent=config.observation_latent,
            gaussian_dim=modality.gaussian_dim,
            image_shape=modality.image_shape,
            is_still=modality.is_still,
        )
    return FlatVAE(
        encoder_width=config.encoder_width,
        hidden_width=config.hidden_width,
        observation_latent=config.observation_latent,
        gaussian_dim=modality.gaussian_dim,
        image_shape=modality.image_shape,
        is_still=modality.is_still,
    )


def _padded_chunks(
    recordings: jax.Array | np.ndarray, batch: int
) -> Iterator[jax.Array | np.ndarray]:
    """Chunks [batch, S, T, D0] of all actions; the last repeats its last action up to `batch`.

    Equal shapes, so that one program encodes them all.
    """
    num_actions = len(recordings)
    batch = min(batch, num_actions)
    for start in range(0, num_actions, batch):
        rows = np.minimum(np.arange(start, start + batch), num_actions - 1)
        yield recordings[rows]
