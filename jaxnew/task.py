"""A domain, composed in one place: environment, actions, play, presets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.cores import available_cores
from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec
from jaxnew.observations import RecordBlock, RecordingFormat
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.learner import Modality, RepresentationConfig
from jaxnew.representation.sources import DrawRecordings
from jaxnew.rollout.pool import HostEnvironments, HostPool


@dataclass(frozen=True)
class Drawing:
    """How recordings that are kept in a small form become what encoders read, such as frames.

    Attributes:
      format: shape, dtype and bounds of one drawn recording.
      draw: `(ids int[n], recordings [n, *play's format.shape]) -> [n, *format.shape]`, each by
        itself. NumPy only: it runs while the device computes.
      folder: of drawn recordings that are stored.
    """

    format: RecordingFormat
    draw: DrawRecordings
    folder: str


@dataclass(frozen=True)
class Play:
    """How a domain's actions are recorded.

    Attributes:
      format: shape, dtype and bounds of one recording.
      record_block: `(seed, ids int32[n], S) -> [n, S, *format.shape]`; see `observations.collect`.
      block_actions: actions recorded per call.
      modalities: how recordings (drawn ones, if there is a drawing) become network inputs, by name;
        the first is the default.
      drawing: see `Drawing`; None: encoders read the recordings themselves.
      folder: of the recordings; another for each play of a task.
      stage_one: presets by budget for its modalities; without any, those of the task.
    """

    format: RecordingFormat
    record_block: RecordBlock
    block_actions: int
    modalities: Mapping[str, Modality]
    drawing: Drawing | None = None
    folder: str = "recordings"
    stage_one: Mapping[str, StageOneBudget] = field(default_factory=dict)

    @property
    def seen(self) -> RecordingFormat:
        """What encoders read."""
        return self.format if self.drawing is None else self.drawing.format


@dataclass(frozen=True)
class StageOneBudget:
    """How much is spent on a representation.

    Attributes:
      num_recordings: recordings per action to collect.
      configs: hyper-parameters by kind, `hvae` and `vae`.
      chunk_steps: gradient steps per compiled call.
      checkpoint_every: gradient steps between checkpoints.
      cost: what it takes; shown before it starts.
      stores_drawn: recordings of a play with a drawing are drawn once and stored; else they are
        drawn for each batch. The numbers are the same.
      counts_epochs: the steps are those of the default split, and encoders that are trained on
        more or fewer actions take as many passes over them, not as many steps (spec method 3).
    """

    num_recordings: int
    configs: Mapping[str, RepresentationConfig]
    chunk_steps: int
    checkpoint_every: int
    cost: str
    stores_drawn: bool = False
    counts_epochs: bool = False

    def config(self, kind: str, num_actions: int, num_default: int) -> RepresentationConfig:
        """The hyper-parameters of an encoder.

        Args:
          kind: of `configs`.
          num_actions: that it is trained on.
          num_default: that those of the default split are trained on.
        """
        config = self.configs[kind]
        if not self.counts_epochs:
            return config
        per_pass, usually = (n // config.actions_per_batch for n in (num_actions, num_default))
        return replace(config, num_steps=config.num_steps * per_pass // usually)


@dataclass(frozen=True)
class LoopConfig:
    """The rhythm of policy training, in updates.

    Attributes:
      chunk_updates: updates per compiled call.
      evaluate_every: updates between evaluations on train and validation sets.
      evaluation_episodes: episodes per evaluation and split.
      evaluation_set_size: actions in its sets; 0 for as many as in training.
      checkpoint_every: updates between `latest` checkpoints.
    """

    chunk_updates: int = 5
    evaluate_every: int = 25
    evaluation_episodes: int = 640
    evaluation_set_size: int = 0
    checkpoint_every: int = 50


@dataclass(frozen=True)
class StageTwoBudget:
    """How much is spent on a policy.

    Attributes:
      num_updates: rollouts with their gradient steps.
      ppo: shapes of the learner.
      hyperparameters: its numbers.
      loop: evaluations and checkpoints.
      final_episodes: episodes per split of an evaluation after training.
      cost: what it takes; shown before it starts.
    """

    num_updates: int
    ppo: PPOConfig
    hyperparameters: Hyperparameters
    loop: LoopConfig
    final_episodes: int
    cost: str


@dataclass(frozen=True)
class Baselines:
    """Where the paper's baselines differ from domain to domain (spec method 8).

    Attributes:
      continuous_rollout_share: steps per update of the continuous output over those of ours.
      sums_gaussian_entropy: its entropy is summed over dimensions instead of averaged.
      fixed_set: `ids -> ids` of the one set that the utility policy scores where it is trained
        without subsampling.
      fixed_set_minibatches: minibatches per pass of the utility policy without subsampling; 0 for
        as many as with it.
      finetune_share: updates of fine-tuning on new actions over those of training (spec method 9).
    """

    continuous_rollout_share: float = 1.0
    sums_gaussian_entropy: bool = False
    fixed_set: Callable[[np.ndarray], np.ndarray] = lambda ids: ids
    fixed_set_minibatches: int = 0
    finetune_share: float = 1.0


@dataclass(frozen=True)
class ActionStudy:
    """Pools of actions that a trained policy is evaluated on, from easy to hard.

    Attributes:
      axis: what `values` are.
      values: the paper's.
      ids: `(table f32[A, d], value) -> int32[n]` actions that sets are drawn from.
      note: the rule, for readers of the table.
      paper_method: `value ->` name of the row in the paper's results, or None if it has none.
      figure: number of the paper's figure, or empty.
    """

    axis: str
    values: tuple[float, ...]
    ids: Callable[[np.ndarray, float], np.ndarray]
    note: str
    paper_method: Callable[[float], str] | None = None
    figure: str = ""


@dataclass(frozen=True)
class Measured:
    """Speeds on one core of the machine that `README.md` names; for foretelling durations.

    Attributes:
      training: environment steps per second by method; one that is absent is taken as `ours`.
      evaluation: episodes per second.
    """

    training: Mapping[str, float]
    evaluation: float


class Film(NamedTuple):
    """An episode to look at.

    Attributes:
      frames: uint8[height, width, 3] each, all of one size; the last one shows the end.
      metrics: of the pool's `episode_metrics`, at the end.
    """

    frames: list[np.ndarray]
    metrics: Mapping[str, float]


class MakeFilm(Protocol):
    """Plays an episode of a pool again, from its seed and the T actions that it was told.

    Args:
      seed: of the episode, see `jaxnew.rollout.pool.HostPool`.
      ids, positions: int32[T] and f32[T, k].
      size: pixels of the frames' height.
    """

    def __call__(
        self, seed: np.random.SeedSequence, ids: np.ndarray, positions: np.ndarray, *, size: int
    ) -> Film: ...


class DrawEpisode(Protocol):
    """Draws an episode of an environment inside jit.

    Args:
      env: where it was played.
      states: T + 1 states, the start and what `step_env` returned after each action.
      actions: T actions.
      rewards: T rewards.
      size: pixels of the frames' height, about.

    Returns:
      Frames uint8[height, width, 3], all of one size; the last one shows the end.
    """

    def __call__(
        self,
        env: Any,
        states: Sequence[Any],
        actions: Sequence[Action],
        rewards: Sequence[float],
        *,
        size: int,
    ) -> list[np.ndarray]: ...


class MakePage(Protocol):
    """An episode of an environment inside jit as an interactive page.

    Args:
      env, states, actions: as of `DrawEpisode`.

    Returns:
      HTML.
    """

    def __call__(self, env: Any, states: Sequence[Any], actions: Sequence[Action]) -> str: ...


@dataclass(frozen=True)
class Filming:
    """How episodes of an environment inside jit are shown.

    Attributes:
      draw: see `DrawEpisode`.
      make_page: see `MakePage`; None where there is none.
      success_from: an episode whose `Task.selection_metric` is at least this is a success.
      criterion: the same in words, where the metric is not success itself. The sheet of an
        evaluation's last pictures then shows the best and the worst of them.
    """

    draw: DrawEpisode
    success_from: float = 1.0
    criterion: str = ""
    make_page: MakePage | None = None


@dataclass(frozen=True)
class HostDomain:
    """Environments that run on the host, in a pool.

    Attributes:
      make_pool: `(*, num_envs, num_halves, num_workers, seed)`, and `settings` too where there are
        `pool_settings` -> a `jaxnew.rollout.pool.HostPool` whose numbers do not depend on halves,
        workers and settings.
      action_spec: of the actions; there is no stop bit.
      observation_spec: of one observation of the pool. `uint8[height, width]` are frames, which the
        policy sees as stacks; other shapes it sees as they are.
      max_episode_steps: length of the longest episode.
      stack_size: frames in a stack.
      pool_settings: frozen dataclass, how workers are run; `--set=pool.FIELD=value` changes it.
        None: there is nothing to set.
      make_film: an episode to look at, or None where it cannot be drawn; see `MakeFilm`.

    Raises:
      ValueError: the actions have a stop bit.
    """

    make_pool: Callable[..., HostPool]
    action_spec: ActionSpec
    observation_spec: ObservationSpec
    max_episode_steps: int
    stack_size: int = 1
    pool_settings: Any = None
    make_film: MakeFilm | None = None

    def __post_init__(self) -> None:
        if self.action_spec.has_stop:
            raise ValueError("Actions of host environments are ids and positions, without a stop.")

    @property
    def policy_observation(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of one observation as the policy sees it."""
        shape = self.observation_spec.shape
        if len(shape) == 2:
            shape = (*shape, self.stack_size)
        return jax.ShapeDtypeStruct(shape, self.observation_spec.dtype)

    def environments(self, num_envs: int, seed: int, num_workers: int = 0) -> HostEnvironments:
        """A pool in two halves where that is possible, made when first needed.

        Args:
          num_envs: N.
          seed: of the training episodes.
          num_workers: processes; 0 for one per core. At most one for each environment of a half.
        """
        num_halves = 1 if num_envs % 2 else 2
        num_workers = min(num_workers or available_cores(), num_envs // num_halves)
        make = partial(
            self.make_pool,
            num_envs=num_envs,
            num_halves=num_halves,
            num_workers=num_workers,
            seed=seed,
            **({} if self.pool_settings is None else {"settings": self.pool_settings}),
        )
        return HostEnvironments(make, self.max_episode_steps, self.stack_size)


def _no_environment() -> Environment:
    raise ValueError(
        "The environments of this task run on the host, and what was asked for needs one that runs "
        "inside jit. train, evaluate and finetune work with either."
    )


@dataclass(frozen=True)
class Task:
    """A domain. Modules in `experiments/tasks/` define one called `TASK`.

    Attributes:
      name: of the folder of its runs, and for a task of `experiments/tasks` what `--task` takes.
      make_universe: all its actions.
      splits: named ways to split the universe, each from a seed; the first is the default.
      split_seed: seed of the splits; one for the project, so that all runs share them.
      play: recordings of actions, or None for a domain whose representations are given.
      more_plays: recordings of other kinds of the same actions; their modalities have other names.
      stage_one, stage_two: presets by budget.
      make_environment: the environment where it runs inside jit, made when first needed, from no
        arguments or from any fields of `environment_settings`; else
      environment_settings: frozen dataclass, what can be set of it with
        `--set=environment.FIELD=value`. None: there is nothing to set.
      host: the environments on the host.
      selection_metric: episode metric that checkpoints are selected by, on validation sets.
      evaluation_width: episodes that evaluations play at a time inside jit; the last of these
        batches may play more than were asked for, so it is small where steps are dear. On
        accelerators at least as many as training has environments.
      validation_groups: by split, `universe -> label int[A] of every action`: while training,
        the validation sets of such a split are drawn from half of the groups (spec method 2.2).
        Evaluations after training, and splits that are not named, know no groups.
      baselines: settings of the paper's baselines.
      measured: speeds, or None where nobody measured them.
      paper_environment: name of the domain in the paper's results, or None.
      paper_variant: what the paper's results append to the names of methods for this variant of the
        domain, such as `no_subgoal_reward`; empty for the domain itself.
      representation_targets: `universe -> {name: f[A, k]}`, what a linear map of a good
        representation should explain; for the report.
      studies: what `analyze` offers for this task beside what it offers for every one.
      filming: how episodes are shown where the environment runs inside jit, or None where they
        cannot be drawn; on the host see `HostDomain.make_film`.
      actions_name: folder of recordings and encoders, for tasks that share their actions and play;
        also a name that `--task` takes for one of them. None for a task with its own.
      place: `package.module:NAME` that the task was loaded from, or None for one of
        `experiments/tasks`; filled in by whoever loads it.

    Raises:
      ValueError: there is not exactly one of `make_environment` and `host`; two plays share a
        folder or the name of a modality; or groups are for a split that does not exist.
    """

    name: str
    make_universe: Callable[[], ActionUniverse]
    splits: Mapping[str, Callable[[ActionUniverse, int], ActionSplit]]
    stage_two: Mapping[str, StageTwoBudget]
    make_environment: Callable[..., Environment] = _no_environment
    environment_settings: Any = None
    host: HostDomain | None = None
    play: Play | None = None
    more_plays: tuple[Play, ...] = ()
    stage_one: Mapping[str, StageOneBudget] = field(default_factory=dict)
    split_seed: int = 0
    selection_metric: str = "is_success"
    evaluation_width: int = 128
    validation_groups: Mapping[str, Callable[[ActionUniverse], np.ndarray]] = field(
        default_factory=dict
    )
    baselines: Baselines = field(default_factory=Baselines)
    measured: Measured | None = None
    paper_environment: str | None = None
    paper_variant: str = ""
    representation_targets: Callable[[ActionUniverse], Mapping[str, np.ndarray]] | None = None
    studies: Mapping[str, ActionStudy] = field(default_factory=dict)
    filming: Filming | None = None
    actions_name: str | None = None
    place: str | None = None

    def __post_init__(self) -> None:
        if (self.host is None) == (self.make_environment is _no_environment):
            raise ValueError(f"Task {self.name} needs one of make_environment and host.")
        names = [name for play in self.plays for name in play.modalities]
        folders = [play.folder for play in self.plays]
        folders += [play.drawing.folder for play in self.plays if play.drawing is not None]
        for what, found in (("modalities", names), ("folders of recordings", folders)):
            if len(set(found)) < len(found):
                raise ValueError(
                    f"Task {self.name}: the {what} {found} must be distinct; rename one."
                )
        unknown = sorted(set(self.validation_groups) - set(self.splits))
        if unknown:
            raise ValueError(
                f"Task {self.name} has validation_groups for {unknown}; its splits are "
                f"{sorted(self.splits)}."
            )

    @property
    def plays(self) -> tuple[Play, ...]:
        """All kinds of recordings, the default first; none if representations are given."""
        return () if self.play is None else (self.play, *self.more_plays)

    @property
    def action_spec(self) -> ActionSpec:
        """What an action of the domain consists of."""
        if self.host is not None:
            return self.host.action_spec
        return self.make_environment().action_spec

    @property
    def reference(self) -> str:
        """What `--task` must be, so that another process finds this task."""
        return self.place or self.name

    @property
    def default_split(self) -> str:
        return next(iter(self.splits))

    def make_split(self, name: str, universe: ActionUniverse) -> ActionSplit:
        """The split called `name`.

        Raises:
          ValueError: there is none of that name.
        """
        if name not in self.splits:
            raise ValueError(
                f"Task {self.name} has no split {name!r}; choose one of {sorted(self.splits)}."
            )
        return self.splits[name](universe, self.split_seed)
