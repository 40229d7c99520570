"""Kicks: a puck is kicked over a table into a goal, with kicks that are known by recordings only.

A domain in one file: universe, environment, play, budgets. `docs/your_own_domain.md` explains it.
Run it with `--task=examples.kicks:TASK`.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.actions import ActionSplit, ActionUniverse, random_halves_split
from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec, Transition
from jaxnew.observations import RecordingFormat, action_rng
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.modality import Modality
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.sampling import SetConfig
from jaxnew.task.budgets import StageOneBudget, StageTwoBudget
from jaxnew.task.presentation import Presentation
from jaxnew.task.task import Play, Task

NUM_KICKS = 300
NUM_FRAMES = 8  # Positions of the puck after the start that a recording shows.
CLASSES = ("straight", "left", "right")
MAX_LENGTH = 0.7  # Half the table is 1.


def kick_paths(angle: np.ndarray, length: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Where the puck slides, relative to its start: f32[A, 9, 2]; it slows down while it turns."""
    share = np.arange(NUM_FRAMES, 0, -1) / np.arange(1, NUM_FRAMES + 1).sum()
    heading = angle[:, None] + turn[:, None] * np.linspace(0.0, 1.0, NUM_FRAMES)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    steps = steps * (length[:, None] * share)[..., None]
    return np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0), (0, 0))).astype(np.float32)


@lru_cache(maxsize=1)
def kick_universe() -> ActionUniverse:
    """300 kicks, a third of each class; the engineered vector `path` f32[A, 16] shows all of it."""
    rng = np.random.default_rng(2026)
    labels = np.arange(NUM_KICKS, dtype=np.int32) % len(CLASSES)
    angle = rng.uniform(-np.pi, np.pi, NUM_KICKS)
    length = rng.uniform(0.15, MAX_LENGTH, NUM_KICKS)
    turn = np.array([0.0, 1.0, -1.0])[labels] * rng.uniform(0.8, 1.6, NUM_KICKS)
    paths = kick_paths(angle, length, turn)
    return ActionUniverse(
        name="Kicks-v0",
        class_labels=labels,
        class_names=CLASSES,
        primary_parameter=angle,
        action_names=tuple(
            f"{CLASSES[label]}, {np.degrees(a):.0f} degrees, {size:.2f} long"
            for label, a, size in zip(labels, angle, length, strict=True)
        ),
        content=paths,
        engineered={"path": paths[:, 1:].reshape(NUM_KICKS, -1)},
    )


def right_is_new(universe: ActionUniverse, seed: int) -> ActionSplit:
    """Kicks to the right are never trained with: a harder split than random halves."""
    is_right = universe.class_labels == CLASSES.index("right")
    right = np.random.default_rng(seed).permutation(np.flatnonzero(is_right))
    return ActionSplit(
        train=np.flatnonzero(~is_right),
        validation=right[: len(right) // 2],
        test=right[len(right) // 2 :],
        universe_hash=universe.hash,
        seed=seed,
    )


@struct.dataclass
class KicksParams:
    """Rules of the task; every field is traced.

    Attributes:
      max_kicks: int32[] kicks after which an episode is truncated.
      goal_radius: f32[] how near to the goal the puck has to stop.
      goal_reward: f32[] reward of stopping there.
      progress_reward: f32[] reward per unit of distance that a kick brings the puck nearer.
    """

    max_kicks: int | jax.Array = 8
    goal_radius: float | jax.Array = 0.1
    goal_reward: float | jax.Array = 1.0
    progress_reward: float | jax.Array = 1.0


@struct.dataclass
class KicksState:
    """An episode in progress: puck and goal f32[2] (x, y), number of kicks int32[] so far."""

    puck: jax.Array
    goal: jax.Array
    num_kicks: jax.Array


class Kicks(Environment[KicksState, KicksParams]):
    """A table of 2 x 2, the puck on it, and a goal. Its unit is half a side of the table.

    Observation: f32[4] the puck's (x, y), and the goal's (x, y) as seen from the puck.
    Action: `Action.id` int32[] in 0..299, a kick; any other id moves nothing, costs a kick and sets
      `info["invalid_action"]`. Position (k = 0) and stop bit are ignored.
    Reward: f32[] in [-0.7, 1.7]: how much nearer the goal came, and 1 on arrival; 0 for a fall.
    Start: puck and goal uniform over the inner 1.8 x 1.8.
    End: terminated where the puck stops within `goal_radius` (success) or leaves the table on its
      way; truncated after `max_kicks`.
    Parameters: `KicksParams`.
    Info: `is_success`, `is_off_table`, `invalid_action` bool[], `episode_length` int32[].
    """

    name = "Kicks-v0"
    episode_metrics = ("is_success", "is_off_table", "episode_length")

    @property
    def default_params(self) -> KicksParams:
        return KicksParams()

    @property
    def action_spec(self) -> ActionSpec:
        return ActionSpec(num_actions=NUM_KICKS)

    def observation_spec(self, params: KicksParams) -> ObservationSpec:
        """f32[4]; a puck that falls is seen 1.7 from the center at most, so 2.6 from the goal."""
        return ObservationSpec(shape=(4,), dtype=jnp.float32, low=-2.6, high=2.6)

    def max_episode_steps(self, params: KicksParams) -> int:
        return int(params.max_kicks)

    def reset_env(self, key: jax.Array, params: KicksParams) -> tuple[jax.Array, KicksState]:
        """Draws where puck and goal are; consumes `key`."""
        puck, goal = jax.random.uniform(key, (2, 2), jnp.float32, -0.9, 0.9)
        state = KicksState(puck, goal, jnp.int32(0))
        return _observe(state), state

    def step_env(
        self, key: jax.Array, state: KicksState, action: Action, params: KicksParams
    ) -> Transition:
        """One kick; deterministic, `key` is not used."""
        is_valid = (action.id >= 0) & (action.id < NUM_KICKS)
        paths = jnp.asarray(kick_universe().content)
        path = jnp.where(is_valid, paths[jnp.clip(action.id, 0, NUM_KICKS - 1)], 0.0)
        positions = state.puck + path
        next_state = KicksState(positions[-1], state.goal, state.num_kicks + 1)
        distance = jnp.linalg.norm(next_state.puck - state.goal)
        is_off_table = jnp.any(jnp.abs(positions) > 1.0)
        is_success = ~is_off_table & (distance <= params.goal_radius)
        progress = jnp.linalg.norm(state.puck - state.goal) - distance
        arrival = jnp.where(is_success, params.goal_reward, 0.0)
        reward = params.progress_reward * progress + arrival
        terminated = is_success | is_off_table
        info = {
            "is_success": is_success,
            "is_off_table": is_off_table,
            "invalid_action": ~is_valid,
            "episode_length": next_state.num_kicks,
        }
        return (
            _observe(next_state),
            next_state,
            jnp.where(is_off_table, 0.0, reward).astype(jnp.float32),
            terminated,
            ~terminated & (next_state.num_kicks >= params.max_kicks),
            info,
        )


def _observe(state: KicksState) -> jax.Array:
    return jnp.concatenate([state.puck, state.goal - state.puck])


def record_block(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
    """Films each kick on an endless table, from random starts, with a camera that errs by 0.01.

    Args:
      seed: of the play; a kick's recordings depend on it and on the kick's id alone.
      ids: int32[n] kicks.
      num_recordings: S, films of each.

    Returns:
      f32[n, S, 9, 2] positions of the puck.
    """
    paths = kick_universe().content
    films = np.empty((len(ids), num_recordings, *paths.shape[1:]), np.float32)
    for film, action_id in zip(films, ids, strict=True):
        rng = action_rng(seed, int(action_id))
        starts = rng.uniform(-1.0, 1.0, (num_recordings, 1, 2))
        film[:] = starts + paths[action_id] + rng.normal(0.0, 0.01, film.shape)
    return films


def from_the_start(films: jax.Array) -> jax.Array:
    """f32[..., 9, 2] positions relative to the first, in tenths: about -7..7."""
    return 10.0 * (films - films[..., :1, :])


PLAY = Play(
    format=RecordingFormat("Kicks-v0 play", (NUM_FRAMES + 1, 2), "float32", low=-2.0, high=2.0),
    record_block=record_block,
    block_actions=100,
    modalities={"relative": Modality("relative", 2, "gaussian", 0, from_the_start)},
)


_HVAE = RepresentationConfig(
    action_latent=8, actions_per_batch=32, recordings_per_action=16, num_steps=800
)
_STAGE_ONE = StageOneBudget(
    num_recordings=64,
    model=_HVAE,
    checkpoint_every=200,
    cost="about a minute on one core",
)
_STAGE_TWO = StageTwoBudget(
    num_updates=200,
    ppo=PPOConfig(rollout=RolloutConfig(num_envs=32, num_steps=128), lr_steps=200 * 32 * 128),
    sets=SetConfig(20),
    hyperparameters=Hyperparameters(entropy_coefficient=0.01),
    final_episodes=5000,
    cost="half a minute on one core",
)

TASK = Task(
    name="kicks",
    make_environment=Kicks,
    make_universe=kick_universe,
    splits={"default": random_halves_split, "right-is-new": right_is_new},
    plays=(PLAY,),
    stage_one={
        "smoke": _STAGE_ONE.vary(
            num_recordings=8,
            model__num_steps=8,
            model__recordings_per_action=4,
            checkpoint_every=20,
            cost="seconds",
        ),
        "laptop": _STAGE_ONE,
    },
    stage_two={
        "smoke": _STAGE_TWO.vary(
            num_updates=4,
            ppo__rollout__num_envs=8,
            ppo__rollout__num_steps=32,
            ppo__microbatch_size=0,
            loop__chunk_updates=2,
            loop__evaluate_every=2,
            loop__evaluation_episodes=64,
            final_episodes=128,
            cost="seconds",
        ),
        "laptop": _STAGE_TWO,
    },
    shown=Presentation(
        representation_targets=lambda universe: {"where it stops": universe.content[:, -1]}
    ),
)
