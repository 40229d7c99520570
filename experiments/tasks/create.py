"""CREATE: twelve puzzles, what they are made of, what each budget spends (spec create, method).

`--task=create-push` and its siblings; `create-push-no-subgoals` pays for the goal only (spec create
6.6), `create-push-analysis` has the tools of the difficulty analysis, 3 degrees apart (4.4).
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from envs_host.create.config import CreateConfig, RewardConfig
from envs_host.create.hosting import CreateHost
from envs_host.create.levels import load_level
from envs_host.create.play import NUM_STATES, STATE_SIZE
from envs_host.create.recorder import PoolRecorder
from envs_host.create.tools import (
    angle_test_ids,
    embedding_test_ids,
    mix_ids,
    published_split,
    tool_universe,
)
from envs_host.create.tools.catalogue import ANALYSIS_SPACING_DEG, DEFAULT_SPACING_DEG
from envs_host.create.tools.splits import (
    ANALYSIS_ANGLES_DEG,
    ANALYSIS_DISTANCES,
    ANALYSIS_UNSEEN_RATIOS,
    analysis_split,
)
from envs_host.pool import HostPool, PoolSettings
from experiments.tasks._create_stage_one import STATE, STATE_HVAE, video_play
from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.environment import ActionSpec, ObservationSpec
from jaxnew.observations import RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.learner import Modality, RepresentationConfig
from jaxnew.rollout.device import RolloutConfig
from jaxnew.task import (
    ActionStudy,
    Baselines,
    Film,
    HostDomain,
    LoopConfig,
    Measured,
    Play,
    StageOneBudget,
    StageTwoBudget,
    Task,
)

LEVELS = (
    "Push",
    "Obstacle",
    "Seesaw",
    "Navigate",
    "Ladder",
    "Cannon",
    "Belt",
    "Buckets",
    "Collide",
    "Moving",
    "Basket",
    "Funnel",
)
FRAME_SIZE = 84
_MIX_SEED = 0

# Spec method 6, column CREATE.
_PPO = PPOConfig(
    rollout=RolloutConfig(
        num_envs=32,
        num_steps=384,
        set_size=50,
        normalize_observations=False,
        normalize_rewards=False,
    ),
    microbatch_size=16,  # Images: what one core computes fastest.
    lr_steps=100_000_000,
)
_HYPERPARAMETERS = Hyperparameters(entropy_coefficient=0.005)

_MEASURED = Measured(training={"ours": 470.0}, evaluation=100.0)

_STAGE_TWO = {
    "smoke": StageTwoBudget(
        num_updates=2,
        ppo=replace(
            _PPO,
            rollout=replace(_PPO.rollout, num_envs=4, num_steps=12, set_size=5),
            num_epochs=2,
            num_minibatches=2,
            microbatch_size=0,
            lr_steps=1024,
        ),
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=1, evaluation_episodes=4, checkpoint_every=1
        ),
        final_episodes=8,
        cost="seconds",
    ),
    # 2.15 M steps on the paper's horizon of the learning rate: just past the first point of its
    # curves, which is at 2.14 M (Push, Obstacle).
    "short": StageTwoBudget(
        num_updates=175,
        ppo=_PPO,
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(
            chunk_updates=1, evaluate_every=10, evaluation_episodes=320, checkpoint_every=5
        ),
        final_episodes=5000,
        cost="1.3 hours on one core",
    ),
    "paper": StageTwoBudget(
        num_updates=4882,
        ppo=_PPO,
        hyperparameters=_HYPERPARAMETERS,
        loop=LoopConfig(chunk_updates=1, evaluate_every=50, checkpoint_every=10),
        final_episodes=5000,
        cost="35 hours on one core, 21 on two, from the rate of `short`",
    ),
}


def _stage_one(
    num_recordings: int, hvae: RepresentationConfig, vae_steps: int, cost: str
) -> StageOneBudget:
    # The flat VAE draws a multiple of all train actions per step (spec method 4).
    needed = -(-2048 // hvae.recordings_per_action)
    vae = replace(
        hvae,
        kind="vae",
        num_steps=vae_steps,
        actions_per_batch=max(hvae.actions_per_batch, needed),
    )
    return StageOneBudget(
        num_recordings=num_recordings,
        configs={"hvae": hvae, "vae": vae},
        chunk_steps=min(20, hvae.num_steps),
        checkpoint_every=max(20, hvae.num_steps // 20),
        cost=cost,
    )


_STAGE_ONE = {
    "smoke": _stage_one(
        4,
        replace(STATE_HVAE, num_steps=4, recordings_per_action=2, actions_per_batch=8),
        4,
        "half a minute, most of it for recording 2,366 tools",
    ),
    "laptop": _stage_one(
        128,
        replace(STATE_HVAE, num_steps=4000, recordings_per_action=32, actions_per_batch=32),
        2000,
        "6 minutes on two cores, one of them for recording",
    ),
    "paper": replace(
        _stage_one(1024, STATE_HVAE, 10_000, "4 days on two cores, from the rate of `laptop`"),
        counts_epochs=True,
    ),
}


def _positions_only(recordings: Any) -> Any:
    """The ball's position f32[..., 7, 2], all that the paper's text speaks of (A12)."""
    return recordings[..., 2:4]


def _play(spacing_deg: int) -> Play:
    return Play(
        format=RecordingFormat(
            modality=f"CREATE play, states, {spacing_deg} degrees",
            shape=(NUM_STATES, STATE_SIZE),
            dtype="float32",
        ),
        record_block=PoolRecorder(angle_spacing=spacing_deg),
        block_actions=64,
        modalities={
            "state": STATE,
            "position": Modality("position", 2, "gaussian", 0, _positions_only),
        },
    )


_SPACINGS = (DEFAULT_SPACING_DEG, ANALYSIS_SPACING_DEG)
_PLAY = {spacing: _play(spacing) for spacing in _SPACINGS}
_VIDEO_PLAY = {spacing: video_play(spacing) for spacing in _SPACINGS}


def _published(name: str, universe: ActionUniverse, seed: int) -> ActionSplit:
    del universe, seed  # It cannot be drawn anew (spec create 4.2).
    return published_split(name)


def _analysis(universe: ActionUniverse, seed: int) -> ActionSplit:
    del universe, seed
    return analysis_split()


def _make_pool(
    kwargs: dict[str, Any],
    *,
    num_envs: int,
    num_halves: int,
    num_workers: int,
    seed: int,
    settings: PoolSettings,
) -> HostPool:
    return HostPool(
        "envs_host.create.hosting:CreateHost",
        kwargs,
        num_envs,
        num_workers,
        seed,
        num_halves=num_halves,
        **asdict(settings),
    )


def _make_film(
    kwargs: dict[str, Any],
    seed: np.random.SeedSequence,
    ids: np.ndarray,
    positions: np.ndarray,
    *,
    size: int,
) -> Film:
    return Film(*CreateHost(**kwargs).film(seed, ids, positions, size))


_STUDIES = {
    "angle": ActionStudy(
        "least angle to a training tool (degrees)",
        ANALYSIS_ANGLES_DEG,
        lambda table, value: angle_test_ids(value),
        "Tools at least so far from every angle of training tools, all classes pooled and without "
        "wrap-around (figure 9a, the release's rule; spec create 4.4).",
        lambda value: f"ours_analysis[min_angle_deg={value:g}]",
        figure="9a",
    ),
    "angle-per-class": ActionStudy(
        "least angle to a training tool of the class (degrees)",
        ANALYSIS_ANGLES_DEG,
        lambda table, value: angle_test_ids(value, per_class=True),
        "Tools at least so far from every training tool of their own class, around the circle.",
    ),
    "embedding": ActionStudy(
        "least squared distance to a training tool",
        ANALYSIS_DISTANCES,
        embedding_test_ids,
        "Tools whose representation is at least so far from that of every training tool (figure "
        "9b; the release compared squared distances, spec create A18).",
        lambda value: f"ours_analysis[min_sq_emb_dist={value:.1f}]",
        figure="9b",
    ),
    "mix": ActionStudy(
        "share of unseen tools",
        ANALYSIS_UNSEEN_RATIOS,
        lambda table, value: mix_ids(table, value, _MIX_SEED),
        "Pools with so large a share of tools at a squared distance above 3 (figure 9c).",
        lambda value: f"ours_analysis[unseen_fraction={value:.1f}]",
        figure="9c",
    ),
}


def create_task(level: str, *, with_subgoals: bool = True, is_analysis: bool = False) -> Task:
    """One level as a task.

    Args:
      level: of `LEVELS`, or a level file of the user's own.
      with_subgoals: False: subgoals and the target's hit are worth nothing.
      is_analysis: the tools of the analysis, 3 degrees apart, with its split and studies.
    """
    spacing = ANALYSIS_SPACING_DEG if is_analysis else DEFAULT_SPACING_DEG
    definition = load_level(level)
    config = CreateConfig(
        rewards=RewardConfig(with_subgoals=with_subgoals),
        split="analysis" if is_analysis else "default",
        action_ids="universe",
    )
    kwargs = {"level": level, "config": asdict(config)}
    suffix = ("" if with_subgoals else "-no-subgoals") + ("-analysis" if is_analysis else "")
    splits = {"default": _analysis} if is_analysis else _SPLITS
    studies = _STUDIES
    if not with_subgoals:  # The paper's analyses had them.
        studies = {name: replace(study, paper_method=None) for name, study in _STUDIES.items()}
    variants = ([] if with_subgoals else ["no_subgoal_reward"]) + is_analysis * ["analysis"]
    return Task(
        name=f"create-{definition.name.lower()}{suffix}",
        make_universe=partial(tool_universe, spacing),
        splits=splits,
        host=HostDomain(
            make_pool=partial(_make_pool, kwargs),
            action_spec=ActionSpec(tool_universe(spacing).num_actions, position_dim=2),
            observation_spec=ObservationSpec((FRAME_SIZE, FRAME_SIZE), np.uint8, 0, 255),
            max_episode_steps=definition.step_limit + 1,
            stack_size=3,
            pool_settings=PoolSettings(),
            make_film=partial(_make_film, kwargs),
        ),
        play=_PLAY[spacing],
        more_plays=(_VIDEO_PLAY[spacing],),
        stage_one=_STAGE_ONE,
        stage_two=_STAGE_TWO,
        # Spec create 8.3: of the Full split alone, and only while training.
        validation_groups={} if is_analysis else {"full": attrgetter("class_labels")},
        baselines=Baselines(
            continuous_rollout_share=2 / 3, fixed_set_minibatches=6, finetune_share=1 / 6
        ),
        measured=_MEASURED,
        paper_environment=f"CREATE {definition.name}",
        paper_variant="_".join(variants),
        studies=studies if is_analysis else {},
        actions_name="create-analysis" if is_analysis else "create",
    )


_SPLITS = {name: partial(_published, name) for name in ("default", "full")}


def _tasks() -> dict[str, Task]:
    tasks = {}
    for level in LEVELS:
        for with_subgoals in (True, False):
            for is_analysis in (False, True):
                task = create_task(level, with_subgoals=with_subgoals, is_analysis=is_analysis)
                tasks[task.name.removeprefix("create-")] = task
    return tasks


TASK = create_task("Push")
# Recordings and encoders name the list of tools that they are of: `create` or `create-analysis`.
TASKS = {**_tasks(), "analysis": create_task("Push", is_analysis=True)}
