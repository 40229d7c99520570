"""Grid World: what it is made of, and what each budget spends (spec grid_world, method 3 and 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from envs_mjx.grid_world import GridWorld, drawing, play, skill_universe, skills
from jaxnew.actions import ActionUniverse, random_halves_split
from jaxnew.environment import Action
from jaxnew.observations import RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.learner import Modality, RepresentationConfig
from jaxnew.rollout.device import RolloutConfig
from jaxnew.task import (
    Baselines,
    Filming,
    LoopConfig,
    Measured,
    Play,
    StageOneBudget,
    StageTwoBudget,
    Task,
)


def _record_block(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    return np.asarray(play.record(jax.random.key(seed), ids, num_recordings))


def _draw_episode(
    env: GridWorld,
    states: Sequence[Any],
    actions: Sequence[Action],
    rewards: Sequence[float],
    *,
    size: int,
) -> list[np.ndarray]:
    del env
    return drawing.draw_episode(states, [int(action.id) for action in actions], rewards, size)


def _targets(universe: ActionUniverse) -> Mapping[str, np.ndarray]:
    del universe
    return {
        "net displacement": skills.net_displacement(),
        "per-move coordinates": skills.move_displacements(),
    }


def _stage_one(
    num_recordings: int, hvae: RepresentationConfig, vae_steps: int, cost: str
) -> StageOneBudget:
    # The flat VAE draws a multiple of all train actions per step (spec method 4).
    vae = replace(hvae, kind="vae", num_steps=vae_steps, actions_per_batch=128)
    return StageOneBudget(
        num_recordings=num_recordings,
        configs={"hvae": hvae, "vae": vae},
        chunk_steps=min(20, hvae.num_steps),
        checkpoint_every=max(20, hvae.num_steps // 20),
        cost=cost,
    )


_HVAE = RepresentationConfig()
_PPO = PPOConfig()

TASK = Task(
    name="grid_world",
    make_environment=GridWorld,
    make_universe=skill_universe,
    splits={"default": random_halves_split},
    play=Play(
        format=RecordingFormat(
            modality="GridWorld-v0 play",
            shape=(play.NUM_POSITIONS, 2),
            dtype="uint8",
            low=0,
            high=play.PLAY_SIZE - 1,
        ),
        record_block=_record_block,
        block_actions=128,
        modalities={
            "xy": Modality("xy", 2, "gaussian", 0, play.featurize_xy),
            "relative": Modality("relative", 2, "gaussian", 0, play.featurize_relative),
            "onehot": Modality(
                "onehot", 2 * play.PLAY_SIZE, "categorical", play.PLAY_SIZE, play.featurize_onehot
            ),
        },
    ),
    # Spec method 3: 1,024 recordings, 672 of them a step, 40,000 steps; `fast` is the setting that
    # the release's README suggests (64 recordings, 500 epochs of 4 steps).
    stage_one={
        "smoke": _stage_one(
            16,
            replace(_HVAE, num_steps=8, recordings_per_action=4, actions_per_batch=16),
            8,
            "seconds",
        ),
        "laptop": _stage_one(
            256,
            replace(_HVAE, num_steps=800, recordings_per_action=32, actions_per_batch=32),
            400,
            "about a minute on two cores",
        ),
        "fast": _stage_one(
            1024,
            replace(_HVAE, num_steps=2000, recordings_per_action=64),
            2000,
            "17 minutes on two cores",
        ),
        "paper": replace(
            _stage_one(1024, _HVAE, 10_000, "60 hours on two cores"), counts_epochs=True
        ),
    },
    # Spec method 6, column Grid World.
    stage_two={
        "smoke": StageTwoBudget(
            num_updates=4,
            ppo=PPOConfig(
                rollout=RolloutConfig(num_envs=8, num_steps=32), microbatch_size=0, lr_steps=1024
            ),
            hyperparameters=Hyperparameters(),
            loop=LoopConfig(
                chunk_updates=2, evaluate_every=2, evaluation_episodes=64, checkpoint_every=2
            ),
            final_episodes=128,
            cost="seconds",
        ),
        "laptop": StageTwoBudget(
            num_updates=500,
            ppo=replace(_PPO, lr_steps=500 * _PPO.steps_per_update),
            hyperparameters=Hyperparameters(),
            loop=LoopConfig(),
            final_episodes=5000,
            cost="about 4 minutes on two cores",
        ),
        "paper": StageTwoBudget(
            num_updates=2441,
            ppo=_PPO,
            hyperparameters=Hyperparameters(),
            loop=LoopConfig(),
            final_episodes=5000,
            cost="about 15 minutes on two cores",
        ),
    },
    baselines=Baselines(
        continuous_rollout_share=0.5, sums_gaussian_entropy=True, finetune_share=0.25
    ),
    measured=Measured(
        training={
            "ours": 61_000,
            "continuous": 143_000,
            "nearest-neighbour": 62_000,
            "no-subsampling": 13_000,
        },
        evaluation=7_000,
    ),
    paper_environment="Grid World",
    representation_targets=_targets,
    filming=Filming(_draw_episode),
)
