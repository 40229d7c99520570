"""Shape Stacking: what it is made of, and what each budget spends (spec shape_stacking, method).

`--task=shape_stacking` places shapes along a line; `shape_stacking-no-place` always at the middle,
`shape_stacking-2d-place` on a square (spec shape_stacking 10).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from envs_mjx.shape_stacking import (
    ShapeStacking,
    StackingSettings,
    published_split,
    shape_universe,
)
from envs_mjx.shape_stacking.films import draw_episode, episode_page
from envs_mjx.shape_stacking.play import PICTURE_SHAPE, draw_pictures, record_block
from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.observations import RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.learner import RepresentationConfig
from jaxnew.representation.modality import image_modality
from jaxnew.rollout.device import RolloutConfig
from jaxnew.task import (
    Drawing,
    Filming,
    LoopConfig,
    Measured,
    Play,
    StageOneBudget,
    StageTwoBudget,
    Task,
)

# Spec method 3, column Stacking: 60,000 steps on 32 shapes with 52 of 1,024 pictures each.
_HVAE = RepresentationConfig(
    encoder_width=128,
    inference_width=128,
    hidden_width=128,
    action_latent=128,
    observation_latent=128,
    actions_per_batch=32,
    recordings_per_action=52,
    num_steps=60_000,
)
# Spec method 6, column Shape Stacking; without normalisation, since observations are images.
_PPO = PPOConfig(
    rollout=RolloutConfig(
        num_envs=32,
        num_steps=128,
        set_size=20,
        normalize_observations=False,
        normalize_rewards=False,
    ),
    microbatch_size=16,  # Images: what one core computes fastest.
    lr_steps=100_000_000,
)
_HYPERPARAMETERS = Hyperparameters(entropy_coefficient=0.01)


def _stage_one(
    num_recordings: int,
    hvae: RepresentationConfig,
    checkpoint_every: int,
    cost: str,
) -> StageOneBudget:
    # Of images the flat VAE has the HVAE's batches and steps (spec method 4).
    configs = {"hvae": hvae, "vae": replace(hvae, kind="vae")}
    chunk_steps = min(20, checkpoint_every)
    return StageOneBudget(
        num_recordings, configs, chunk_steps, checkpoint_every, cost, stores_drawn=True
    )


_STAGE_ONE = {
    "smoke": _stage_one(
        2,
        replace(_HVAE, num_steps=2, recordings_per_action=2, actions_per_batch=2),
        1,
        "half a minute on one core, most of it for compiling",
    ),
    "laptop": _stage_one(
        64,
        replace(_HVAE, num_steps=5000, recordings_per_action=4, actions_per_batch=16),
        200,
        "50 minutes on one core, and 1.1 GB on disk",
    ),
    "paper": replace(
        _stage_one(1024, _HVAE, 500, "10 days on one core, from the rate of `laptop`"),
        stores_drawn=False,
        counts_epochs=True,
    ),
}

_STAGE_TWO = {
    "smoke": StageTwoBudget(
        num_updates=2,
        ppo=replace(
            _PPO,
            rollout=replace(_PPO.rollout, num_envs=2, num_steps=11, set_size=5),
            num_epochs=2,
            num_minibatches=2,
            microbatch_size=0,
            lr_steps=1024,
        ),
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=1, evaluation_episodes=4, checkpoint_every=1
        ),
        final_episodes=4,
        cost="half a minute",
    ),
    # 204,800 placements: shorter rollouts than the paper's, so four times the gradient steps.
    "laptop": StageTwoBudget(
        num_updates=200,
        ppo=replace(
            _PPO,
            rollout=replace(_PPO.rollout, num_steps=32),
            lr_steps=200 * 32 * 32,
        ),
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=20, evaluation_episodes=80, checkpoint_every=5
        ),
        final_episodes=1000,
        cost="80 minutes on one core",
    ),
    # The paper's numbers and 1/20 of its steps; evaluated more often, and on more episodes.
    "short": StageTwoBudget(
        num_updates=37,
        ppo=_PPO,
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=5, evaluation_episodes=80, checkpoint_every=2
        ),
        final_episodes=1000,
        cost="about 1.1 hours on one core",
    ),
    "paper": StageTwoBudget(
        num_updates=732,
        ppo=_PPO,
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=25, evaluation_episodes=40, checkpoint_every=5
        ),
        final_episodes=5000,
        cost="20 hours on one core, from the rate of `laptop`",
    ),
    # As many steps as the paper's, in worlds that fill an accelerator.
    "accelerator": StageTwoBudget(
        num_updates=184,
        ppo=replace(
            _PPO,
            rollout=replace(_PPO.rollout, num_envs=1024, num_steps=16),
            microbatch_size=0,
        ),
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=10, evaluation_episodes=1024, checkpoint_every=5
        ),
        final_episodes=5000,
        cost="nobody measured how long it takes",
    ),
}

_PLAY = Play(
    format=RecordingFormat("Shape Stacking play, viewpoints", (2,), "float32"),
    record_block=record_block,
    block_actions=810,
    modalities={"image": image_modality("image", PICTURE_SHAPE, is_still=True)},
    drawing=Drawing(
        format=RecordingFormat("Shape Stacking play, pictures", PICTURE_SHAPE, "uint8"),
        draw=draw_pictures,
        folder="pictures",
    ),
    folder="viewpoints",
)

# No height is a success by itself. 1.3 m is what random play reaches on average that never stops
# (`experiments.anchors`): a policy that has learned something builds higher.
_FILMING = Filming(
    draw_episode,
    success_from=1.3,
    criterion="at least 1.3 m, the mean of random play that never stops",
    make_page=episode_page,
)


def _published(name: str, universe: ActionUniverse, seed: int) -> ActionSplit:
    del universe, seed  # It cannot be drawn anew (spec 9).
    return published_split(name)


def _task(variant: str, position_dim: int, paper_variant: str) -> Task:
    return Task(
        name=f"shape_stacking{variant}",
        make_environment=partial(ShapeStacking, position_dim=position_dim),
        environment_settings=StackingSettings(),
        make_universe=shape_universe,
        splits={name: partial(_published, name) for name in ("default", "full")},
        play=_PLAY,
        stage_one=_STAGE_ONE,
        stage_two=_STAGE_TWO,
        selection_metric="final_height",
        evaluation_width=16,
        measured=Measured(training={"ours": 46.0}, evaluation=4.6),
        filming=_FILMING,
        paper_environment="Shape Stacking",
        paper_variant=paper_variant,
        actions_name="shape_stacking",
    )


TASK = _task("", 1, "")
TASKS = {
    "no-place": _task("-no-place", 0, "no_place"),
    "2d-place": _task("-2d-place", 2, "2d_place"),
}
