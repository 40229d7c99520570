"""CREATE: twelve puzzles, what they are made of, what each budget spends (docs/create.md).

`create-push` and its siblings; `create-push-no-subgoals` pays for the goal only,
`create-push-analysis` has the tools of the difficulty analysis, 3 degrees apart.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from envs_host.create.config import VERSION, CreateRules, RewardConfig
from envs_host.create.hosting import CreateHost
from envs_host.create.levels import TASK_NAMES, load_level
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
from jaxnew.environment import ActionSpec, ObservationSpec
from jaxnew.observations import RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.modality import Modality
from jaxnew.rollout.contract import Episode, RolloutConfig
from jaxnew.task.budgets import Baselines, LoopConfig, StageOneBudget, StageTwoBudget
from jaxnew.task.domain import published
from jaxnew.task.places import UsageError
from jaxnew.task.presentation import ActionStudy, Film, Filming, Measured, Presentation
from jaxnew.task.task import HostDomain, Play, Task

FRAME_SIZE = 84
_MIX_SEED = 0
_MEASURED = Measured(training={"ours": 470.0}, evaluation=100.0)

_PAPER = StageTwoBudget(
    num_updates=4882,
    final_episodes=5000,
    cost="35 hours on one core, 21 on two, from the rate of `short`",
    ppo=PPOConfig(
        rollout=RolloutConfig(num_steps=384, normalize_observations=False, normalize_rewards=False),
        microbatch_size=16,  # Images: what one core computes fastest.
        lr_steps=100_000_000,
    ),
    hyperparameters=Hyperparameters(entropy_coefficient=0.005),
    loop=LoopConfig(chunk_updates=1, evaluate_every=50, checkpoint_every=10),
)

_STAGE_TWO = {
    "smoke": _PAPER.vary(
        num_updates=2,
        final_episodes=8,
        cost="seconds",
        ppo__rollout__num_envs=4,
        ppo__rollout__num_steps=12,
        ppo__num_epochs=2,
        ppo__num_minibatches=2,
        ppo__microbatch_size=0,
        ppo__lr_steps=1024,
        sets__size=5,
        loop__evaluate_every=1,
        loop__evaluation_episodes=4,
        loop__checkpoint_every=1,
    ),
    # 2.15 M steps on the paper's horizon of the learning rate: just past the first point of its
    # curves, which is at 2.14 M (Push, Obstacle).
    "short": _PAPER.vary(
        num_updates=175,
        cost="1.3 hours on one core",
        loop__evaluate_every=10,
        loop__evaluation_episodes=320,
        loop__checkpoint_every=5,
    ),
    "paper": _PAPER,
}

_STAGE_ONE = {
    "smoke": StageOneBudget(
        num_recordings=4,
        model=STATE_HVAE.in_minutes(num_steps=4, actions_per_batch=8, recordings_per_action=2),
        checkpoint_every=20,
        cost="half a minute, most of it for recording 2,366 tools",
    ),
    "laptop": StageOneBudget(
        num_recordings=128,
        model=STATE_HVAE.in_minutes(num_steps=2000, actions_per_batch=64, recordings_per_action=4),
        checkpoint_every=200,
        cost="3 minutes on two cores, most of it for recording",
    ),
    "paper": StageOneBudget(
        num_recordings=1024,
        model=STATE_HVAE,
        checkpoint_every=4000,
        cost="4 days on two cores, from the rate of `laptop`",
        vae_steps=10_000,
        counts_epochs=True,
    ),
}


def _positions_only(recordings: Any) -> Any:
    """The ball's position f32[..., 7, 2], all that the paper's text speaks of."""
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
_UNIVERSES = tuple(f"{spacing}-degrees" for spacing in _SPACINGS)
_PLAYS = {spacing: (_play(spacing), video_play(spacing)) for spacing in _SPACINGS}


def _host_arguments(level: str, split: str, rules: CreateRules) -> dict[str, Any]:
    """Arguments of `CreateHost`, as plain values."""
    return {"level": level, "config": {**asdict(rules), "split": split, "action_ids": "universe"}}


def _make_pool(
    level: str,
    split: str,
    *,
    num_envs: int,
    num_halves: int,
    num_workers: int,
    seed: int,
    settings: PoolSettings,
    environment: CreateRules,
) -> HostPool:
    return HostPool(
        "envs_host.create.hosting:CreateHost",
        _host_arguments(level, split, environment),
        num_envs,
        num_workers,
        seed,
        num_halves=num_halves,
        **asdict(settings),
    )


def _draw(level: str, split: str, environment: CreateRules, episode: Episode, *, size: int) -> Film:
    """Plays the episode again, from its seed and its actions."""
    host = CreateHost(**_host_arguments(level, split, environment))
    ids = np.array(episode.action_ids)
    positions = np.array([np.asarray(action.position) for action in episode.actions])
    assert episode.seed is not None
    return Film(*host.film(episode.seed, ids, positions, size))


_STUDIES = {
    "angle": ActionStudy(
        "least angle to a training tool (degrees)",
        ANALYSIS_ANGLES_DEG,
        lambda table, value: angle_test_ids(value),
        "Tools at least so far from every angle of training tools, all classes pooled and without "
        "wrap-around (figure 9a, the release's rule).",
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
        "9b; the release compared squared distances).",
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
      level: of `TASK_NAMES`, or a level file of the user's own.
      with_subgoals: False: subgoals and the target's hit are worth nothing.
      is_analysis: the tools of the analysis, 3 degrees apart, with its split and studies.
    """
    spacing = ANALYSIS_SPACING_DEG if is_analysis else DEFAULT_SPACING_DEG
    definition = load_level(level)
    place = (level, "analysis" if is_analysis else "default")
    suffix = ("" if with_subgoals else "-no-subgoals") + ("-analysis" if is_analysis else "")
    studies = _STUDIES
    if not with_subgoals:  # The paper's analyses had them.
        studies = {name: replace(study, paper_method=None) for name, study in _STUDIES.items()}
    variants = ([] if with_subgoals else ["no_subgoal_reward"]) + is_analysis * ["analysis"]
    return Task(
        name=f"create-{definition.name.lower()}{suffix}",
        make_universe=partial(tool_universe, spacing),
        splits={"default": published(analysis_split)} if is_analysis else _SPLITS,
        host=HostDomain(
            make_pool=partial(_make_pool, *place),
            action_spec=ActionSpec(tool_universe(spacing).num_actions, position_dim=2),
            observation_spec=ObservationSpec((FRAME_SIZE, FRAME_SIZE), np.uint8, 0, 255),
            max_episode_steps=lambda rules: (rules.step_limit or definition.step_limit) + 1,
            stack_size=3,
            pool_settings=PoolSettings(),
        ),
        environment_version=VERSION,
        environment=CreateRules(rewards=RewardConfig(with_subgoals=with_subgoals)),
        plays=_PLAYS[spacing],
        stage_one=_STAGE_ONE,
        stage_two=_STAGE_TWO,
        # Of the Full split alone, and only while training.
        validation_groups={} if is_analysis else {"full": attrgetter("class_labels")},
        baselines=Baselines(
            continuous_rollout_share=2 / 3, fixed_set_minibatches=6, finetune_share=1 / 6
        ),
        shown=Presentation(
            paper_environment=f"CREATE {definition.name}",
            paper_variant="_".join(variants),
            measured=_MEASURED,
            studies=studies if is_analysis else {},
            filming=Filming(partial(_draw, *place)),
        ),
        universe_name=_UNIVERSES[is_analysis],
        other_universes=partial(_with_tools, level, with_subgoals),
        actions_name="create-analysis" if is_analysis else "create",
    )


def _with_tools(level: str, with_subgoals: bool, name: str) -> Task:
    """The level with the tools of the other list."""
    if name not in _UNIVERSES:
        raise UsageError(
            f"CREATE has no tools {name!r}; it has those of {' and '.join(_UNIVERSES)}."
        )
    is_analysis = name == _UNIVERSES[True]
    return create_task(level, with_subgoals=with_subgoals, is_analysis=is_analysis)


_SPLITS = {name: published(partial(published_split, name)) for name in ("default", "full")}


_VARIANTS = [
    create_task(level, with_subgoals=with_subgoals, is_analysis=is_analysis)
    for level in TASK_NAMES
    for with_subgoals in (True, False)
    for is_analysis in (False, True)
]
TASK = create_task("Push")
# Recordings and encoders name the list of tools that they are of: `create` or `create-analysis`.
TASKS = {task.name.removeprefix("create-"): task for task in _VARIANTS} | {
    "analysis": create_task("Push", is_analysis=True)
}
