"""Grid World: what it is made of, and what each budget spends (docs/grid_world.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from envs_mjx.grid_world import (
    GridWorld,
    GridWorldSettings,
    drawing,
    load_skills,
    play,
    skill_universe,
    skills,
)
from jaxnew.actions import ActionUniverse, random_halves_split
from jaxnew.observations import RecordingFormat
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import Modality
from jaxnew.rollout.contract import Episode
from jaxnew.task.budgets import Baselines, StageOneBudget, StageTwoBudget
from jaxnew.task.places import file_of
from jaxnew.task.presentation import Film, Filming, Measured, Presentation
from jaxnew.task.task import Play, Task


def _record_block(
    seed: int, ids: np.ndarray, num_recordings: int, extra: tuple[str, ...] = ()
) -> np.ndarray:
    return np.asarray(play.record(jax.random.key(seed), ids, num_recordings, extra=extra))


def _with_skills(name: str) -> Task:
    """The task with the skills of a user's file behind its own."""
    path = file_of(name, "Grid World takes a text file with skills such as RR.DD, one per line.")
    extra = load_skills(path)
    (own,) = TASK.plays
    return replace(
        TASK,
        make_universe=partial(skill_universe, extra),
        make_environment=partial(GridWorld, extra=extra),
        plays=(replace(own, record_block=partial(_record_block, extra=extra)),),
        universe_name=str(path),
    )


def _draw(env: Any, episode: Episode, *, size: int) -> Film:
    del env
    shown = episode.states, episode.action_ids, episode.rewards, size
    return Film([*drawing.draw_episode(*shown), drawing.draw_way(*shown)], episode.metrics)


def _targets(universe: ActionUniverse) -> Mapping[str, np.ndarray]:
    del universe
    return {
        "net displacement": skills.net_displacement(),
        "per-move coordinates": skills.move_displacements(),
    }


# Both stages of the paper (docs/method.md): 1,024 recordings, 672 of them a step, 40,000 steps.
_STAGE_ONE = StageOneBudget(
    num_recordings=1024,
    model=RepresentationConfig(),
    checkpoint_every=2000,
    cost="60 hours on two cores",
    vae_steps=10_000,
    counts_epochs=True,
)
_STAGE_TWO = StageTwoBudget(
    num_updates=2441, final_episodes=5000, cost="about 15 minutes on two cores"
)


TASK = Task(
    name="grid_world",
    make_environment=GridWorld,
    environment=GridWorldSettings(),
    make_universe=skill_universe,
    splits={"default": random_halves_split},
    plays=(
        Play(
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
                    "onehot",
                    2 * play.PLAY_SIZE,
                    "categorical",
                    play.PLAY_SIZE,
                    play.featurize_onehot,
                ),
            },
        ),
    ),
    stage_one={
        "smoke": StageOneBudget(
            num_recordings=16,
            model=_STAGE_ONE.model.in_minutes(
                num_steps=8, actions_per_batch=16, recordings_per_action=4
            ),
            checkpoint_every=20,
            cost="seconds",
        ),
        "laptop": StageOneBudget(
            num_recordings=256,
            model=_STAGE_ONE.model.in_minutes(
                num_steps=1600, actions_per_batch=64, recordings_per_action=8
            ),
            checkpoint_every=80,
            cost="about two minutes on one core",
        ),
        "paper": _STAGE_ONE,
    },
    stage_two={
        "smoke": _STAGE_TWO.vary(
            num_updates=4,
            ppo__rollout__num_envs=8,
            ppo__rollout__num_steps=32,
            ppo__microbatch_size=0,
            ppo__lr_steps=1024,
            loop__chunk_updates=2,
            loop__evaluate_every=2,
            loop__evaluation_episodes=64,
            loop__checkpoint_every=2,
            final_episodes=128,
            cost="seconds",
        ),
        "laptop": _STAGE_TWO.vary(
            num_updates=500,
            ppo__lr_steps=500 * _STAGE_TWO.ppo.steps_per_update,
            cost="about 4 minutes on two cores",
        ),
        "paper": _STAGE_TWO,
    },
    other_universes=_with_skills,
    baselines=Baselines(
        continuous_rollout_share=0.5, sums_gaussian_entropy=True, finetune_share=0.25
    ),
    shown=Presentation(
        paper_environment="Grid World",
        measured=Measured(
            training={
                "ours": 61_000,
                "continuous": 143_000,
                "nearest-neighbour": 62_000,
                "no-subsampling": 13_000,
            },
            evaluation=7_000,
        ),
        representation_targets=_targets,
        filming=Filming(_draw, frame_ms=220),
    ),
)
