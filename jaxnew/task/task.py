"""A domain, composed in one place: environment, actions, play, presets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.collection import RecordBlock
from jaxnew.cores import available_cores
from jaxnew.environment import ActionSpec, Environment, ObservationSpec
from jaxnew.observations import RecordingFormat
from jaxnew.representation.modality import Modality
from jaxnew.representation.sources import DrawRecordings
from jaxnew.rollout.pool import HostEnvironments, HostPool
from jaxnew.task.budgets import Baselines, StageOneBudget, StageTwoBudget
from jaxnew.task.places import UsageError, budget_of
from jaxnew.task.presentation import Presentation


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
      record_block: `(seed, ids int32[n], S) -> [n, S, *format.shape]`; see `collection.collect`.
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
class HostDomain:
    """Environments that run on the host, in a pool.

    Attributes:
      make_pool: `(*, num_envs, num_halves, num_workers, seed)`, and `settings` too where there are
        `pool_settings`, and `environment` where the task has settings of it -> a
        `jaxnew.rollout.pool.HostPool` whose numbers do not depend on halves, workers and
        `settings`.
      action_spec: of the actions; there is no stop bit.
      observation_spec: of one observation of the pool. `uint8[height, width]` are frames, which the
        policy sees as stacks; other shapes it sees as they are.
      max_episode_steps: settings of the environment, or None -> length of the longest episode.
      stack_size: frames in a stack.
      pool_settings: frozen dataclass, how workers are run; `--set=pool.FIELD=value` changes it.
        None: there is nothing to set.

    Raises:
      ValueError: the actions have a stop bit.
    """

    make_pool: Callable[..., HostPool]
    action_spec: ActionSpec
    observation_spec: ObservationSpec
    max_episode_steps: Callable[[Any], int]
    stack_size: int = 1
    pool_settings: Any = None

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

    def environments(
        self, num_envs: int, seed: int, num_workers: int = 0, environment: Any = None
    ) -> HostEnvironments:
        """A pool in two halves where that is possible, made when first needed.

        Args:
          num_envs: N.
          seed: of the training episodes.
          num_workers: processes; 0 for one per core. At most one for each environment of a half.
          environment: settings of the environment, None where there are none.
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
            **({} if environment is None else {"environment": environment}),
        )
        return HostEnvironments(make, self.max_episode_steps(environment), self.stack_size)


@dataclass(frozen=True)
class Task:
    """A domain. Where one is at home (`experiments/tasks`, or a module of a user's) it is `TASK`.

    Attributes:
      name: of the folder of its runs, and what `load_task` takes for one of the project's.
      make_universe: all its actions.
      splits: named ways to split the universe, each from a seed; the first is the default.
      stage_two: presets by budget.
      make_environment: the environment where it runs inside jit, from the fields of `environment`
        by name; else
      host: the environments on the host.
      environment: settings of the environment, a frozen dataclass of plain values;
        `set={"environment.FIELD": value}` changes them for a run. None: there is nothing to set.
      environment_version: raised by changes that may move a learning curve; a run of another
        version is refused.
      plays: kinds of recordings of the actions, the default first; none for a domain whose
        representations are given. Their modalities have different names.
      stage_one: presets by budget.
      selection_metric: episode metric that checkpoints are selected by, on validation sets.
      evaluation_width: episodes that evaluations play at a time inside jit; the last of these
        batches may play more than were asked for, so it is small where steps are dear. On
        accelerators at least as many as training has environments.
      validation_groups: by split, `universe -> label int[A] of every action`: while training,
        the validation sets of such a split are drawn from half of the groups. Evaluations after
        training, and splits that are not named, know no groups.
      baselines: settings of the paper's baselines.
      shown: how it is shown.
      universe_name: of its actions among those of `other_universes`.
      other_universes: a name or a file -> the same task with the actions of another list, or of the
        user's file; its `universe_name` is what was given. Raises `UsageError`. None: there are no
        others.
      actions_name: folder of recordings and encoders, for tasks that share their actions and play;
        also a name that `load_task` takes for one of them. None for a task with its own.
      place: `package.module:NAME` that the task was loaded from, or None for one of the project's;
        filled in by whoever loads it.

    Raises:
      ValueError: there is not exactly one of `make_environment` and `host`; two plays share a
        folder or the name of a modality; or groups are for a split that does not exist.
    """

    name: str
    make_universe: Callable[[], ActionUniverse]
    splits: Mapping[str, Callable[[ActionUniverse, int], ActionSplit]]
    stage_two: Mapping[str, StageTwoBudget]
    make_environment: Callable[..., Environment] | None = None
    host: HostDomain | None = None
    environment: Any = None
    environment_version: int = 0
    plays: tuple[Play, ...] = ()
    stage_one: Mapping[str, StageOneBudget] = field(default_factory=dict)
    selection_metric: str = "is_success"
    evaluation_width: int = 128
    validation_groups: Mapping[str, Callable[[ActionUniverse], np.ndarray]] = field(
        default_factory=dict
    )
    baselines: Baselines = field(default_factory=Baselines)
    shown: Presentation = field(default_factory=Presentation)
    universe_name: str = ""
    other_universes: Callable[[str], Task] | None = None
    actions_name: str | None = None
    place: str | None = None

    def __post_init__(self) -> None:
        if (self.host is None) == (self.make_environment is None):
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

    def environment_of(self, settings: Any = None) -> Environment:
        """The environment where it runs inside jit.

        Args:
          settings: in place of `environment`.

        Raises:
          ValueError: the environments run on the host.
        """
        if self.make_environment is None:
            raise ValueError(
                f"The environments of task {self.name} run on the host, and what was asked for "
                "needs one that runs inside jit. train, evaluate and finetune work with either."
            )
        settings = settings or self.environment
        if settings is None:
            return self.make_environment()
        fields = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings)}
        return self.make_environment(**fields)

    def with_universe(self, name: str) -> Task:
        """The same task with other actions: those called `name`, or of the file `name`.

        Args:
          name: see `other_universes`; empty for its own.

        Raises:
          UsageError: there are no such actions.
        """
        if name in ("", self.universe_name):
            return self
        if self.other_universes is None:
            raise UsageError(f"Task {self.name} has no universe {name!r}, only its own.")
        return self.other_universes(name)

    @property
    def action_spec(self) -> ActionSpec:
        """What an action of the domain consists of."""
        return self.environment_of().action_spec if self.host is None else self.host.action_spec

    @property
    def reference(self) -> str:
        """What `load_task` takes, so that another process finds this task."""
        return self.place or self.name

    @property
    def default_split(self) -> str:
        """Name of the first split."""
        return next(iter(self.splits))

    def check_workers(self, num_workers: int) -> None:
        """Refuses processes for environments that take none.

        Raises:
          UsageError: there are some, and the environments run inside jit.
        """
        if num_workers and self.host is None:
            raise UsageError(
                f"num_workers={num_workers}: the environments of {self.name} run inside jit, not "
                "in processes of their own; leave it out (--workers)."
            )

    def budget(self, name: str) -> StageTwoBudget:
        """The preset of stage two called `name`.

        Raises:
          UsageError: there is none of that name.
        """
        return budget_of(self.stage_two, name, "Stage two")
