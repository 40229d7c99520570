"""Shape Stacking: what it is made of, and what each budget spends (docs/shape_stacking.md).

`shape_stacking` places shapes along a line; `shape_stacking-no-place` always at the middle,
`shape_stacking-2d-place` on a square.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from envs_mjx.shape_stacking import (
    Shape,
    ShapeStacking,
    StackingSettings,
    films,
    load_shapes,
    published_split,
    shape_universe,
)
from envs_mjx.shape_stacking.play import PICTURE_SHAPE, draw_pictures, record_block
from jaxnew.observations import RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import image_modality
from jaxnew.rollout.contract import Episode, RolloutConfig
from jaxnew.sampling import SetConfig
from jaxnew.task.budgets import LoopConfig, StageOneBudget, StageTwoBudget
from jaxnew.task.domain import published
from jaxnew.task.places import file_of
from jaxnew.task.presentation import Film, Filming, Measured, Presentation
from jaxnew.task.task import Drawing, Play, Task

# 60,000 steps on 32 shapes with 52 of 1,024 pictures each.
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


_STAGE_ONE = {
    "smoke": StageOneBudget(
        num_recordings=2,
        model=_HVAE.in_minutes(num_steps=2, actions_per_batch=2, recordings_per_action=2),
        checkpoint_every=1,
        cost="half a minute on one core, most of it for compiling",
        stores_drawn=True,
    ),
    "laptop": StageOneBudget(
        num_recordings=64,
        model=_HVAE.in_minutes(num_steps=1800, actions_per_batch=16, recordings_per_action=4),
        checkpoint_every=100,
        cost="20 minutes on one core, and 1.1 GB on disk",
        stores_drawn=True,
    ),
    "paper": StageOneBudget(
        num_recordings=1024,
        model=_HVAE,
        checkpoint_every=500,
        cost="10 days on one core, from the rate of `laptop`",
        chunk_steps=10,
        counts_epochs=True,
    ),
}

# Without normalisation, since observations are images.
_PAPER = StageTwoBudget(
    num_updates=732,
    final_episodes=5000,
    cost="20 hours on one core, from the rate of `laptop`",
    ppo=PPOConfig(
        rollout=RolloutConfig(num_steps=128, normalize_observations=False, normalize_rewards=False),
        microbatch_size=16,  # Images: what one core computes fastest.
        lr_steps=100_000_000,
    ),
    sets=SetConfig(size=20),
    hyperparameters=Hyperparameters(entropy_coefficient=0.01),
    loop=LoopConfig(chunk_updates=1, evaluate_every=25, evaluation_episodes=40, checkpoint_every=5),
)

_STAGE_TWO = {
    "smoke": _PAPER.vary(
        num_updates=2,
        final_episodes=4,
        cost="half a minute",
        ppo__rollout__num_envs=2,
        ppo__rollout__num_steps=11,
        ppo__num_epochs=2,
        ppo__num_minibatches=2,
        ppo__microbatch_size=0,
        ppo__lr_steps=1024,
        sets__size=5,
        loop__evaluate_every=1,
        loop__evaluation_episodes=4,
        loop__checkpoint_every=1,
    ),
    # 204,800 placements: shorter rollouts than the paper's, so four times the gradient steps.
    "laptop": _PAPER.vary(
        num_updates=200,
        final_episodes=1000,
        cost="80 minutes on one core",
        ppo__rollout__num_steps=32,
        ppo__lr_steps=200 * 32 * 32,
        loop__evaluate_every=20,
        loop__evaluation_episodes=80,
    ),
    # The paper's numbers and 1/20 of its steps; evaluated more often, and on more episodes.
    "short": _PAPER.vary(
        num_updates=37,
        final_episodes=1000,
        cost="about 1.1 hours on one core",
        loop__evaluate_every=5,
        loop__evaluation_episodes=80,
        loop__checkpoint_every=2,
    ),
    "paper": _PAPER,
    # As many steps as the paper's, in worlds that fill an accelerator.
    "accelerator": _PAPER.vary(
        num_updates=184,
        cost="nobody measured how long it takes",
        ppo__rollout__num_envs=1024,
        ppo__rollout__num_steps=16,
        ppo__microbatch_size=0,
        loop__evaluate_every=10,
        loop__evaluation_episodes=1024,
    ),
}


def _play(shapes: tuple[Shape, ...]) -> Play:
    return Play(
        format=RecordingFormat("Shape Stacking play, viewpoints", (2,), "float32"),
        record_block=record_block,
        block_actions=810,
        modalities={"image": image_modality("image", PICTURE_SHAPE, is_still=True)},
        drawing=Drawing(
            format=RecordingFormat("Shape Stacking play, pictures", PICTURE_SHAPE, "uint8"),
            draw=partial(draw_pictures, shapes=shapes),
            folder="pictures",
        ),
        folder="viewpoints",
    )


def _draw(env: Any, episode: Episode, *, size: int) -> Film:
    shown = films.seen(env, episode.states, episode.actions)
    page = partial(films.page, shown, shapes=env.shapes)
    return Film(films.draw(env, shown, size), episode.metrics, page)


# No height is a success by itself. 1.3 m is what random play reaches on average that never stops
# (`experiments.anchors`): a policy that has learned something builds higher.
_FILMING = Filming(
    _draw,
    success_from=1.3,
    criterion="at least 1.3 m, the mean of random play that never stops",
    has_pages=True,
)


def _task(
    variant: str, position_dim: int, paper_variant: str, shapes: tuple[Shape, ...] = ()
) -> Task:
    return Task(
        name=f"shape_stacking{variant}",
        make_environment=partial(ShapeStacking, position_dim=position_dim, shapes=shapes),
        environment=StackingSettings(),
        make_universe=partial(shape_universe, shapes),
        splits={name: published(partial(published_split, name)) for name in ("default", "full")},
        plays=(_play(shapes),),
        stage_one=_STAGE_ONE,
        stage_two=_STAGE_TWO,
        selection_metric="final_height",
        evaluation_width=16,
        shown=Presentation(
            paper_environment="Shape Stacking",
            paper_variant=paper_variant,
            measured=Measured(training={"ours": 46.0}, evaluation=4.6),
            filming=_FILMING,
            anchors="experiments.untrained.stacking:measure_anchors",
        ),
        other_universes=partial(_with_shapes, variant, position_dim, paper_variant),
        actions_name="shape_stacking",
    )


def _with_shapes(variant: str, position_dim: int, paper_variant: str, name: str) -> Task:
    """The task with the shapes of a user's file behind its own."""
    path = file_of(name, "Shape Stacking takes a CSV file: solid,scale,yaw_deg,red,green,blue.")
    task = _task(variant, position_dim, paper_variant, load_shapes(path))
    return replace(task, universe_name=str(path))


TASK = _task("", 1, "")
TASKS = {
    "no-place": _task("-no-place", 0, "no_place"),
    "2d-place": _task("-2d-place", 2, "2d_place"),
}
