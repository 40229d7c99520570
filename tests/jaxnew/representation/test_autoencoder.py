"""What an encoder appends to its means (docs/method.md, "Representation table and its report")."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.learner import RepresentationLearner, RepresentationState
from jaxnew.representation.modality import Modality, vector_modality

A, S, T = 6, 5, 4
CONFIG = RepresentationConfig(
    encoder_width=8,
    inference_width=8,
    hidden_width=8,
    action_latent=3,
    observation_latent=2,
    actions_per_batch=4,
    recordings_per_action=3,
    num_steps=3,
    standardizes=True,
)


def trained(
    config: RepresentationConfig, modality: Modality, recordings: np.ndarray
) -> tuple[RepresentationLearner, RepresentationState]:
    """(learner, state after all steps)."""
    stage1 = RepresentationLearner(config, modality, appends_changes=True)
    state = stage1.init(jax.random.key(0), recordings.shape)
    state, _ = stage1.train_steps(state, jax.numpy.asarray(recordings), config.num_steps)
    return stage1, state


@pytest.mark.oracle
@pytest.mark.parametrize(("kind", "latent"), [("hvae", 3), ("vae", 2)])
def test_mean_changes_follow_the_means_of_the_posterior(kind: str, latent: int) -> None:
    """Float32 means of five numbers up to a few hundred, over a scale of the same size."""
    rng = np.random.default_rng(1)
    recordings = rng.normal(size=(A, S, T, 2)) * [1.0, 100.0] + [0.0, 50.0]
    recordings = recordings.astype(np.float32)
    stage1, state = trained(
        dataclasses.replace(CONFIG, kind=kind), vector_modality("v", 2), recordings
    )
    vectors = stage1.encode(state, recordings, batch=4)
    assert vectors.shape == (A, latent + 2 * (T - 1))
    np.testing.assert_allclose(
        vectors[:, :latent], stage1.encode_posterior(state, recordings)[0], atol=1e-6
    )
    unit = np.sqrt(np.asarray(state.batch_stats["scales"]["squared_change"]) + 1e-6)
    changes = (recordings[:, :, 1:] - recordings[:, :, :1]).mean(axis=1) / unit
    np.testing.assert_allclose(vectors[:, latent:], changes.reshape(A, -1), rtol=1e-4, atol=1e-4)
    assert 0.1 < changes[..., 1].std() / changes[..., 0].std() < 10  # Each number in its own unit.
    # Of other recordings of other actions, in any number.
    few = recordings[2:3, :1]
    expected = ((few[:, :, 1:] - few[:, :, :1]).mean(axis=1) / unit).reshape(1, -1)
    np.testing.assert_allclose(
        stage1.encode(state, few)[:, latent:], expected, rtol=1e-4, atol=1e-4
    )
