"""The toy of `tests/toy_host.py` as a task, for commands: `--task=tests.toy_task:TASK`."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.environment import ActionSpec, ObservationSpec
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.rollout.contract import Episode, RolloutConfig
from jaxnew.sampling import SetConfig
from jaxnew.task.budgets import LoopConfig, StageTwoBudget
from jaxnew.task.presentation import ActionStudy, Film, Filming, Presentation
from jaxnew.task.task import HostDomain, Task
from tests import toy_host

A, NO_OP = toy_host.NUM_ACTIONS, toy_host.NUM_ACTIONS - 1


def universe() -> ActionUniverse:
    ids = np.arange(A)
    vectors = np.column_stack(
        [2.0 * toy_host.is_good(ids) - 1.0, np.cos(ids), np.sin(3 * ids), ids % 3 - 1.0]
    ).astype(np.float32)
    return ActionUniverse(
        name="Toy-v0",
        class_labels=(ids % 2).astype(np.int32),
        class_names=("good", "bad"),
        primary_parameter=ids.astype(np.float64),
        action_names=tuple(f"action {i}" for i in ids),
        content=vectors,
        engineered={"gt4": vectors},
    )


def split(universe: ActionUniverse, seed: int) -> ActionSplit:
    order = np.random.default_rng(seed).permutation(NO_OP).astype(np.int32)
    return ActionSplit(
        train=np.sort(order[:11]),
        validation=np.sort(order[11:17]),
        test=np.sort(order[17:]),
        universe_hash=universe.hash,
        seed=seed,
        always_available=np.array([NO_OP], np.int32),
    )


def make_pool(**arguments: Any) -> toy_host.ToyPool:
    return toy_host.ToyPool(**arguments)


def draw(settings: None, episode: Episode, *, size: int) -> Film:
    """The frames of an episode in red, and a last one that is green after a success."""
    assert settings is None
    assert episode.seed is not None
    env = toy_host.ToyEnv()
    scale = size // toy_host.SIZE
    frames = [env.reset(episode.seed)]
    for action in episode.actions:
        frame, _, _, _, metrics = env.step(int(action.id), np.asarray(action.position))
        frames.append(frame)
    colored = np.zeros((len(frames) + 1, size, size, 3), np.uint8)
    colored[:-1, ..., 0] = np.kron(frames, np.ones((1, scale, scale)))
    colored[-1, ..., 1] = 255 * int(metrics["is_success"])
    return Film(list(colored), metrics)


def even_share(table: np.ndarray, share: float) -> np.ndarray:
    """Eight actions, so large a share of which are good."""
    good = np.arange(0, NO_OP, 2)[: round(8 * share)]
    bad = np.arange(1, NO_OP, 2)[: 8 - len(good)]
    return np.sort(np.concatenate([good, bad])).astype(np.int32)


_SMOKE = StageTwoBudget(
    num_updates=4,
    ppo=PPOConfig(
        rollout=RolloutConfig(
            num_envs=4,
            num_steps=8,
            normalize_observations=False,
            normalize_rewards=False,
        ),
        num_epochs=2,
        num_minibatches=2,
        microbatch_size=0,
        lr_steps=1024,
    ),
    sets=SetConfig(4),
    hyperparameters=Hyperparameters(entropy_coefficient=0.005),
    loop=LoopConfig(chunk_updates=1, evaluate_every=2, evaluation_episodes=6, checkpoint_every=1),
    final_episodes=8,
    cost="seconds",
)

TASK = Task(
    name="toy",
    make_universe=universe,
    splits={"default": split},
    host=HostDomain(
        make_pool=make_pool,
        action_spec=ActionSpec(A, position_dim=2),
        observation_spec=ObservationSpec((toy_host.SIZE, toy_host.SIZE), np.uint8, 0, 255),
        max_episode_steps=lambda settings: toy_host.MAX_STEPS,
        stack_size=3,
    ),
    stage_two={"smoke": _SMOKE, "longer": _SMOKE.vary(num_updates=40)},
    shown=Presentation(
        studies={
            "goodness": ActionStudy(
                "share of good actions",
                (0.0, 0.5, 1.0),
                even_share,
                "Good actions are worth something.",
                lambda value: f"ours_analysis[unseen_fraction={value:.1f}]",
                figure="9c",
            )
        },
        filming=Filming(draw),
    ),
)
