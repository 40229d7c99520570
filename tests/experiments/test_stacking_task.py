"""Shape Stacking's presets against the paper's numbers."""

from __future__ import annotations

import pytest

from jaxnew.task.domain import load_task

TASK = load_task("shape_stacking")


@pytest.mark.golden
def test_the_papers_encoder() -> None:
    budget = TASK.stage_one["paper"]
    assert (budget.num_recordings, budget.counts_epochs) == (1024, True)
    for kind in ("hvae", "vae"):
        config = budget.config(kind, 405, 405)
        assert (config.actions_per_batch, config.recordings_per_action) == (32, 52)
        assert (config.action_latent, config.observation_latent) == (128, 128)
        widths = config.encoder_width, config.inference_width, config.hidden_width
        assert widths == (128, 128, 128)
        # 5,000 epochs of floor(N / 32) steps: 405 shapes, 420 of the Full split, all 810.
        assert budget.config(kind, 405, 405).num_steps == 60_000
        assert budget.config(kind, 420, 405).num_steps == 65_000
        assert budget.config(kind, 810, 405).num_steps == 125_000
    laptop = TASK.stage_one["laptop"]
    assert laptop.config("hvae", 810, 405) == laptop.model


@pytest.mark.golden
def test_the_papers_policy() -> None:
    budget = TASK.stage_two["paper"]
    ppo, numbers = budget.ppo, budget.hyperparameters
    rollout = ppo.rollout
    assert (rollout.num_envs, rollout.num_steps, budget.sets.size) == (32, 128, 20)
    assert not rollout.normalize_observations
    assert not rollout.normalize_rewards
    assert (ppo.num_epochs, ppo.num_minibatches) == (4, 4)
    assert (budget.num_updates, budget.final_episodes) == (732, 5000)
    assert (numbers.entropy_coefficient, numbers.clip) == (0.01, 0.1)
    assert (numbers.discount, numbers.gae_lambda) == (0.99, 0.95)
    assert ppo.lr_steps == 100_000_000
    # Five evaluations of 8 processes.
    loop = budget.loop
    assert (loop.evaluate_every, loop.evaluation_episodes) == (25, 40)
