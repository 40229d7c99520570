"""One zero-shot episode of a trained policy, as an animation and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.pipeline.training import EVALUATION_SEED, Trainer, load_state, load_trainer
from jaxnew.environment import Action
from jaxnew.ppo import TrainState
from jaxnew.sampling import ActionPool, draw_sets
from jaxnew.task import Task

DRAWN_TASK = "grid_world"


@dataclass(frozen=True)
class Episode:
    """An episode as it was played.

    Attributes:
      number: i of `Evaluator`, which plays the same episode under the same seed.
      states: T + 1 environment states.
      actions: T actions.
      rewards: T rewards.
      metrics: the environment's `episode_metrics`, at the end.
      is_success: see `Filming`.
      available_ids: int32[m] the actions there were to choose from.
    """

    number: int
    states: list[Any]
    actions: list[Action]
    rewards: list[float]
    metrics: dict[str, float]
    is_success: bool
    available_ids: np.ndarray

    @property
    def action_ids(self) -> list[int]:
        """Of its actions; an action that stops has an id, too."""
        return [int(action.id) for action in self.actions]


def play_episodes(
    trainer: Trainer,
    state: TrainState,
    split: str,
    first: int,
    count: int,
    seed: int = EVALUATION_SEED,
) -> list[Episode]:
    """Episodes `first..first+count-1`, sampled, exactly as `Evaluator.run` plays them.

    Args:
      trainer: of the run.
      state: whose parameters and statistics play.
      split: the part of the split that available sets are drawn from.
      first, count: numbers of the episodes; inference runs at the evaluator's width.
      seed: of the evaluation.
    """
    width = trainer.evaluator.width
    programs = _programs(trainer, state, seed)
    episodes: list[Episode] = []
    for start in range(first, first + count, width):
        episodes += _play_block(trainer, programs, split, jnp.arange(start, start + width))
    return episodes[:count]


def _programs(trainer: Trainer, state: TrainState, seed: int) -> tuple[Any, Any]:
    """The start of a block of episodes and one step of it, with the keys of `Evaluator`."""
    evaluator, method = trainer.evaluator, trainer.evaluator.method
    env, env_params = evaluator.env, evaluator.env_params
    padded_size = evaluator.padded_set_size or None
    statistics = state.rollout.observation_statistics

    @jax.jit
    def start(pool: ActionPool, numbers: jax.Array) -> tuple[Any, Any]:
        key = jax.random.key(seed)
        keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), 3))(numbers)
        available = draw_sets(keys[:, 0], pool, evaluator.set_size, padded_size)
        obs, env_state = jax.vmap(env.reset_env, in_axes=(0, None))(keys[:, 1], env_params)
        projected = method.project(state.params, trainer.table)[available.ids]
        return (keys[:, 2], available, projected), (obs, env_state)

    @jax.jit
    def step(fixed: Any, carry: Any, t: jax.Array) -> tuple[Any, Any]:
        (keys, available, projected), (obs, env_state) = fixed, carry
        if evaluator.normalize_observations:
            obs = statistics.normalize(obs)
        distribution = method.distribution(state.params, obs, projected, available.mask)
        keys_now = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, t)))(keys)
        sample = jax.vmap(lambda d, k: d.sample(k))(distribution, keys_now[:, 0])
        action = method.decode(sample, available, trainer.table)
        obs, env_state, reward, terminated, truncated, info = jax.vmap(
            env.step_env, in_axes=(0, 0, 0, None)
        )(keys_now[:, 1], env_state, action, env_params)
        metrics = {name: info[name] for name in env.episode_metrics}
        return (obs, env_state), (action, reward, terminated | truncated, metrics)

    return start, step


def _play_block(
    trainer: Trainer, programs: tuple[Any, Any], split: str, numbers: jax.Array
) -> list[Episode]:
    """The evaluator's episodes `numbers`, with every state kept."""
    evaluator = trainer.evaluator
    start, step = programs
    fixed, carry = start(trainer.pools[split], numbers)
    states, steps = [jax.device_get(carry[1])], []
    for t in range(evaluator.env.max_episode_steps(evaluator.env_params)):
        carry, outcome = step(fixed, carry, jnp.int32(t))
        states.append(jax.device_get(carry[1]))
        steps.append(jax.device_get(outcome))
    done = np.stack([step_done for _, _, step_done, _ in steps])
    sets = np.asarray(fixed[1].ids)[:, : evaluator.set_size]
    episodes = []
    for row, number in enumerate(np.asarray(numbers)):
        length = 1 + int(np.argmax(done[:, row]))  # The time limit ends every episode.
        of_row = partial(jax.tree.map, lambda x, i=row: x[i])
        metrics = {name: float(value) for name, value in of_row(steps[length - 1][3]).items()}
        episodes.append(
            Episode(
                number=int(number),
                states=[of_row(state) for state in states[: length + 1]],
                actions=[of_row(action) for action, *_ in steps[:length]],
                rewards=[float(reward[row]) for _, reward, *_ in steps[:length]],
                metrics=metrics,
                is_success=is_success(trainer.task, metrics),
                available_ids=sets[row],
            )
        )
    return episodes


def is_success(task: Task, metrics: Mapping[str, float]) -> bool:
    """Whether an episode inside jit that ended with these metrics is shown as a success."""
    least = 1.0 if task.filming is None else task.filming.success_from
    return metrics[task.selection_metric] >= least


def episode_animation(
    run_path: Path,
    out_path: Path,
    split: str = "test",
    episode: int | None = None,
    num_candidates: int = 50,
) -> list[Path]:
    """Plays one episode on sets of unseen actions and writes it as `out_path` (GIF) and as PNG.

    The run's best checkpoint plays, with no further training, the episodes of `evaluate`.

    Args:
      run_path: a run of `train` or a member of `sweep`.
      out_path: of the animation; the picture of the whole path has the same name with `.png`.
      split: part of the split that the available set is drawn from.
      episode: its number; None takes the first successful one of `num_candidates`, and says so.
      num_candidates: episodes 0.. that are looked at.

    Returns:
      The two files; none for another task than Grid World, which is said.

    Raises:
      RunDirectoryError: `run_path` is no run of `train`.
    """
    run, trainer, _ = load_trainer(run_path)
    if trainer.task.name != DRAWN_TASK:
        print(f"No animation of {trainer.task.name}: --figure=8 films episodes of other tasks.")
        return []
    state, _ = load_state(run, trainer, "best")
    if episode is None:
        played = play_episodes(trainer, state, split, 0, num_candidates)
        chosen, how = choose(played)
    else:
        chosen = play_episodes(trainer, state, split, episode, 1)[0]
        how = f"episode {episode}, as asked for"
    files = _draw(chosen, out_path, "train" if split == "train" else "unseen")
    from envs_mjx.grid_world.skills import skill_name

    seen = np.isin(chosen.available_ids, np.asarray(trainer.pools["train"].ids)).sum()
    print(
        f"{out_path}: {how}; sets of {len(chosen.available_ids)} {split} skills, {seen} of them "
        f"seen in training; {'success' if chosen.is_success else 'no success'} with "
        f"{' '.join(skill_name(i) for i in chosen.action_ids)}, return {sum(chosen.rewards):.3f}."
    )
    return files


def choose(played: list[Episode]) -> tuple[Episode, str]:
    """The first successful episode, or the first one if none is; and how it was chosen."""
    successes = [e for e in played if e.is_success]
    numbers = f"episodes {played[0].number}..{played[-1].number}"
    if not successes:
        return played[0], f"episode {played[0].number}: none of {numbers} was successful"
    share = f"{len(successes)} of {len(played)} were"
    return successes[0], f"episode {successes[0].number}, first successful of {numbers} ({share})"


def _draw(episode: Episode, out_path: Path, kind: str) -> list[Path]:
    """The animation and, beside it, the whole path over the last state."""
    from PIL import Image

    from envs_mjx.grid_world import drawing

    out_path.parent.mkdir(parents=True, exist_ok=True)
    frames = drawing.draw_episode(episode.states, episode.action_ids, episode.rewards)
    drawing.animate_episode(frames, out_path)
    before, after = episode.states[:-1], episode.states[1:]
    cells = [(int(x), int(y)) for x, y in [episode.states[0].agent_xy]]
    for a, b, action_id in zip(before, after, episode.action_ids, strict=True):
        cells += list(drawing.skill_path(a, b, action_id))[1:]
    moves = int(episode.states[-1].num_moves)
    caption = f"{len(episode.action_ids)} {kind} skills, {moves} moves"
    note = f"return {sum(episode.rewards):.3f}"
    picture = drawing.draw_state(episode.states[-1], cells, 540, caption, note)
    still = out_path.with_suffix(".png")
    Image.fromarray(picture).save(still)
    return [out_path, still]
