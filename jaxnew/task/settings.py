"""The settings of runs: a tree of dataclasses for each stage, and one grammar for its fields."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

from jaxnew.policy.config import NetworkConfig
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.config import RepresentationConfig
from jaxnew.sampling import SetConfig
from jaxnew.storage import config as config_lib
from jaxnew.storage.config import Assignments, ConfigError
from jaxnew.task.budgets import LoopConfig
from jaxnew.task.domain import load_task
from jaxnew.task.places import import_recorded
from jaxnew.task.task import Task

# How a run is computed; no part of what it is.
COMPUTED = "pool"
_MAX_SEED = 2**32 - 1
_SettingsT = TypeVar("_SettingsT", "TrainConfig", "EmbedConfig")


def check_seed(seed: int, name: str = "seed") -> int:
    """`seed`, which PRNG keys take whole.

    Raises:
      ConfigError: it is no integer in 0..2^32 - 1.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= _MAX_SEED:
        raise ConfigError(f"{name}={seed!r} must be an integer in 0..{_MAX_SEED}.")
    return seed


@dataclass(frozen=True)
class EmbedConfig:
    """All that fixes a stage-one run.

    Attributes:
      task: that brings the actions, or the name of the actions where tasks share them.
      representation: its name, such as `hvae-relative`.
      split, split_seed, split_hash: whose train actions are learned from.
      observations_hash: of the recordings.
      seed: of the run.
      train_on: part of the split, or `all` for an oracle.
      model: hyper-parameters.
    """

    task: str
    representation: str
    split: str
    split_hash: str
    observations_hash: str
    seed: int
    train_on: str
    model: RepresentationConfig
    split_seed: int = 0

    def __post_init__(self) -> None:
        check_seed(self.seed)
        check_seed(self.split_seed, "split_seed")


@dataclass(frozen=True)
class TrainConfig:
    """All that fixes a policy's run, and how it is computed.

    Attributes:
      task, method, representation: what is trained, by name or place.
      table_hash, split_hash: of the table and of the split.
      split, split_seed: which split, and the seed that drew it.
      seed: of the run.
      num_updates: rollouts with their gradient steps.
      ppo: shapes of the learner.
      sets: which sets it learns with.
      hyperparameters: its numbers.
      loop: evaluations and checkpoints.
      trained_on: part of the split whose actions it is trained with.
      start: what fine-tuning begins with, or "fresh parameters".
      num_clusters: training sets are drawn from half of so many clusters of the representations;
        0 for the paper's runs, which draw from all actions.
      conditions_position: the position's head reads the chosen action.
      network: sizes of the policy's networks.
      environment_version: see `Task`.
      environment: settings of the environment, of the type of `Task.environment`.
      pool: how environments on the host are run, of the type of `HostDomain.pool_settings`; no part
        of what the run is.
    """

    task: str
    method: str
    representation: str
    table_hash: str
    split: str
    split_hash: str
    seed: int
    num_updates: int
    ppo: PPOConfig
    sets: SetConfig
    hyperparameters: Hyperparameters
    loop: LoopConfig
    trained_on: str = "train"
    start: str = "fresh parameters"
    split_seed: int = 0
    num_clusters: int = 0
    conditions_position: bool = False
    network: NetworkConfig = field(default_factory=NetworkConfig)
    environment_version: int = 0
    environment: Any = None
    pool: Any = None

    def __post_init__(self) -> None:
        check_seed(self.seed)
        check_seed(self.split_seed, "split_seed")
        self.hyperparameters.check()
        for name, low in (("num_updates", 1), ("num_clusters", 0)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name}={getattr(self, name)} must be at least {low}.")
        if self.sets.is_fixed and self.num_clusters:
            raise ConfigError(
                f"num_clusters={self.num_clusters} needs sets that are drawn, and {self.method} is "
                "trained with a fixed one; leave out num_clusters."
            )


# Given by arguments of their own, or computed from what was given.
_NOT_SET = {
    "task": "--task",
    "method": "--method",
    "representation": "--representation",
    "split": "--split",
    "split_seed": "--split_seed",
    "seed": "--seed",
    "table_hash": "",
    "split_hash": "",
    "observations_hash": "",
    "train_on": "the -oracle in --representation",
    "trained_on": "",
    "environment_version": "",
    "start": "",
}


def train_config_type(task: Task) -> type[TrainConfig]:
    """`TrainConfig` with the types of a task's own settings."""
    pool = None if task.host is None else task.host.pool_settings
    return _typed(cast(Hashable, type(task.environment)), cast(Hashable, type(pool)))


@functools.cache
def _typed(environment: Any, pool: Any) -> type[TrainConfig]:
    own = [
        ("environment", environment, field(default=None)),
        ("pool", pool, field(default=None)),
    ]
    return dataclasses.make_dataclass("TrainConfig", own, bases=(TrainConfig,), frozen=True)


def with_set(config: _SettingsT, assignments: Assignments) -> _SettingsT:
    """A copy with fields of the tree set, see `jaxnew.storage.config.set_paths`.

    Raises:
      ConfigError: a field does not exist, cannot be set, or takes no such value.
    """
    for path, _ in config_lib.split_assignments(assignments):
        if path in _NOT_SET and hasattr(config, path):
            instead = _NOT_SET[path]
            how = f"give {instead}" if instead else "it follows from what is trained on what"
            raise ConfigError(f"{path} cannot be set; {how}.")
    return config_lib.set_paths(config, assignments)


def only_computed(config: TrainConfig, assignments: Assignments) -> TrainConfig:
    """`with_set` for a run that is there already: only `pool.FIELD` may be set.

    Raises:
      ConfigError: something else is set, or see `with_set`.
    """
    for path, value in config_lib.split_assignments(assignments):
        if path.partition(".")[0] != COMPUTED:
            raise ConfigError(
                f"{path}={value}: the run is there; only {COMPUTED}.FIELD=value can be set."
            )
    return with_set(config, assignments)


def identity(config: TrainConfig | EmbedConfig) -> dict[str, Any]:
    """What a run is, as the plain JSON of `config.json`."""
    plain = config_lib.to_dict(config)
    plain.pop(COMPUTED, None)
    return plain


def with_settings(task: Task, config: TrainConfig) -> Task:
    """The task with the settings of a run: of its environment, and of its pool."""
    if task.host is not None:
        task = replace(task, host=replace(task.host, pool_settings=config.pool))
    return replace(task, environment=config.environment)


def read_train_config(
    plain: Mapping[str, Any], task: Task | None = None
) -> tuple[TrainConfig, Task]:
    """The config of a run directory, and its task, which is looked up if it is not given.

    Raises:
      ConfigError: it is of no run of a policy, was damaged, or is of another version of the task's
        environment.
      UsageError: there is no such task.
    """
    if "ppo" not in plain or "task" not in plain:
        raise ConfigError(
            "This is no run of a policy: its config has no ppo and task. Give a run of train, "
            "finetune or sweep; those of embed are for --representation."
        )
    task = recorded_task(plain, task)
    pool = None if task.host is None else task.host.pool_settings
    config = config_lib.from_dict(
        train_config_type(task), {**upgraded(plain), COMPUTED: config_lib.plain(pool)}
    )
    made, now = config.environment_version, task.environment_version
    if made != now:
        raise ConfigError(
            f"The run was made with version {made} of the environment of {task.name}, which is "
            f'version {now} now (CHANGELOG.md, "Errata"): train again, or use the jaxnew that made '
            "it."
        )
    return config, task


def recorded_task(plain: Mapping[str, Any], task: Task | None = None) -> Task:
    """The task that a run's config names, unless it is given; its method is imported as well.

    Raises:
      UsageError: there is no such task, or see `import_recorded`.
    """
    if ":" in str(plain.get("method")):
        import_recorded(plain["method"])
    return task or load_task(plain["task"], is_recorded=True)


def upgraded(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """A recorded config in today's form, whichever earlier version wrote it."""
    if "members" in recorded:
        return {"members": [upgraded(member) for member in recorded["members"]]}
    if "ppo" not in recorded:
        model = {**config_lib.plain(RepresentationConfig()), **recorded.get("model", {})}
        return {"split_seed": 0, **recorded, "model": model}
    added: dict[str, Any] = {"split_seed": 0, "num_clusters": 0, "conditions_position": False}
    added["network"] = config_lib.plain(NetworkConfig())
    new: dict[str, Any] = {**added, "environment_version": 0, "environment": [], **recorded}
    new["hyperparameters"] = {
        **config_lib.plain(Hyperparameters()),
        **new["hyperparameters"],
    }
    rollout = dict(new["ppo"]["rollout"])
    if "set_size" in rollout:  # Until 2026-11-29 sets were part of the rollout.
        names = {"set_size": "size", "padded_set_size": "padded_size", "has_fixed_set": "is_fixed"}
        new["sets"] = {name: rollout.pop(old) for old, name in names.items()}
        new["ppo"] = {**new["ppo"], "rollout": rollout}
    new["sets"] = {**config_lib.plain(SetConfig()), **new["sets"]}
    if isinstance(new["environment"], list):  # And settings of the environment were texts.
        settings = load_task(new["task"], is_recorded=True).environment
        if settings is not None:
            texts = [text.removeprefix("environment.") for text in new["environment"]]
            settings = config_lib.set_paths(settings, texts)
        new["environment"] = config_lib.plain(settings)
    return new
