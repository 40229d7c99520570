"""The ladder of `tests/probe_environments.py` as a task inside jit, small enough for tests.

`--task=tests.toy_device:TASK`. Its actions are recorded, so that encoders can be trained, and its
environment has settings. Its universes are cut from a list without end: action `n` of it climbs
`1 + n % 4` rungs and is worth what action `n % 24` is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from jaxnew.actions import ActionUniverse, random_halves_split
from jaxnew.observations import RecordingFormat, action_rng
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import vector_modality
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.sampling import SetConfig
from jaxnew.task.budgets import LoopConfig, StageOneBudget, StageTwoBudget
from jaxnew.task.places import UsageError
from jaxnew.task.presentation import Presentation
from jaxnew.task.task import Play, Task
from tests import probe_environments as probe

A, NUM_FRAMES = 24, 3


@dataclass(frozen=True)
class LadderSettings:
    """What a run may set.

    Attributes:
      time_limit: steps after which an episode is truncated, 1 or more.
      reward_scale: of every reward.
      is_inverted: bad is good.
    """

    time_limit: int = 4
    reward_scale: float = 1.0
    is_inverted: bool = False

    def __post_init__(self) -> None:
        if self.time_limit < 1:
            raise ValueError(f"time_limit={self.time_limit} must be 1 or more.")


class Ladder(probe.TableWorld):
    """A ladder that is climbed 1 to 4 rungs a step, with settings."""

    def __init__(
        self,
        time_limit: int,
        reward_scale: float,
        is_inverted: bool,
        numbers: Sequence[int] = range(A),
    ) -> None:
        super().__init__(len(numbers))
        ladder = probe.ladder(A, time_limit=time_limit)
        scale = -reward_scale if is_inverted else reward_scale
        columns = np.asarray(numbers) % A
        self._ladder = replace(
            ladder,
            next_state=ladder.next_state[:, columns],
            reward=scale * ladder.reward[:, columns],
            terminates=ladder.terminates[:, columns],
        )

    @property
    def default_params(self) -> probe.TableParams:
        return self._ladder


def universe(numbers: Sequence[int] = range(A)) -> ActionUniverse:
    ids = np.asarray(numbers)
    vectors = np.column_stack([ids % 4 - 1.5, np.cos(ids), np.sin(3 * ids)]).astype(np.float32)
    return ActionUniverse(
        name="Ladder-v0",
        class_labels=(ids % 4).astype(np.int32),
        class_names=("one", "two", "three", "four"),
        primary_parameter=ids.astype(np.float64),
        action_names=tuple(f"action {i}" for i in ids),
        content=vectors,
        engineered={"gt3": vectors},
    )


def record(
    seed: int, ids: np.ndarray, num_recordings: int, numbers: Sequence[int] = range(A)
) -> np.ndarray:
    """f32[n, S, 3, 2] a way that goes up by what the action climbs, from somewhere."""
    ids = np.asarray(numbers)[ids]
    rises = np.arange(NUM_FRAMES)[:, None] * np.array([1.0, 0.5])
    shape = (num_recordings, 1, 1)
    ways = [action_rng(seed, int(i)).normal(size=shape) + rises * (i % 4 + 1) for i in ids]
    return np.stack(ways).astype(np.float32)


PLAY = Play(
    format=RecordingFormat("Ladder play", (NUM_FRAMES, 2), "float32"),
    record_block=record,
    block_actions=8,
    modalities={"way": vector_modality("way", 2)},
)
_HVAE = RepresentationConfig(
    encoder_width=16,
    inference_width=16,
    hidden_width=16,
    action_latent=4,
    observation_latent=4,
    actions_per_batch=3,
    recordings_per_action=2,
    num_steps=4,
)
_STAGE_ONE = StageOneBudget(
    num_recordings=3,
    model=_HVAE,
    checkpoint_every=2,
    cost="seconds",
)
_SMOKE = StageTwoBudget(
    num_updates=4,
    ppo=PPOConfig(
        rollout=RolloutConfig(num_envs=4, num_steps=8),
        num_epochs=1,
        num_minibatches=2,
        microbatch_size=0,
        lr_steps=1024,
    ),
    sets=SetConfig(4),
    hyperparameters=Hyperparameters(entropy_coefficient=0.01),
    loop=LoopConfig(chunk_updates=1, evaluate_every=2, evaluation_episodes=8, checkpoint_every=2),
    final_episodes=8,
    cost="seconds",
)


def _targets(universe: ActionUniverse) -> dict[str, np.ndarray]:
    return {"rungs": universe.class_labels[:, None] + 1.0}


def with_numbers(name: str) -> Task:
    """`FIRST-COUNT`: the task with so many actions of the list, from the first on."""
    if not re.fullmatch(r"\d+-\d+", name):
        raise UsageError(f"A ladder has no universe {name!r}; give FIRST-COUNT.")
    first, count = map(int, name.split("-"))
    numbers = range(first, first + count)
    return replace(
        TASK,
        make_universe=partial(universe, numbers),
        make_environment=partial(Ladder, numbers=numbers),
        plays=(replace(PLAY, record_block=partial(record, numbers=numbers)),),
        universe_name=name,
    )


TASK = Task(
    name="toy-ladder",
    make_universe=universe,
    splits={"default": random_halves_split},
    make_environment=Ladder,
    environment=LadderSettings(),
    plays=(PLAY,),
    stage_one={"smoke": _STAGE_ONE},
    stage_two={"smoke": _SMOKE},
    evaluation_width=8,
    universe_name=f"0-{A}",
    other_universes=with_numbers,
    shown=Presentation(representation_targets=_targets),
    place="tests.toy_device:TASK",
)
