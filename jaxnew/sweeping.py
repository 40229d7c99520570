"""Many seeds and hyper-parameters as one program, sharded over all devices.

Every member ends as an ordinary run directory, as `train` would have made it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew import loop
from jaxnew.checks.run import check_run
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.finiteness import CAUSES, PREFIX, cause_of
from jaxnew.ppo import Hyperparameters, TrainState
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.device import DeviceRollout
from jaxnew.runs import MEMBERS, Runs
from jaxnew.sampling import Actions
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.config import Assignments, plain
from jaxnew.storage.metrics import MetricsLog, read
from jaxnew.storage.progress import say
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.budgets import foretold
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.methods import file_name, variant_of
from jaxnew.task.places import UsageError
from jaxnew.task.settings import TrainConfig, identity, upgraded, with_set
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer
from jaxnew.training import named_table, open_run, train_config


@struct.dataclass
class SweepState:
    """The members of a sweep; every leaf has a leading axis of M members.

    A member that diverged stays as it was before the chunk in which it did, its step as well.

    Attributes:
      members: training states.
      best: the state of each member at its best validation so far.
      best_metric: f32[M] that validation value, -inf before the first.
    """

    members: TrainState
    best: TrainState
    best_metric: jax.Array

    @property
    def step(self) -> int:
        """Updates done, by all members that have not diverged."""
        return int(jnp.max(self.members.step))

    @property
    def is_running(self) -> np.ndarray:
        """bool[M] the members that have not diverged."""
        return np.asarray(self.members.step) == self.step


@dataclass(frozen=True)
class SweepProgram:
    """M runs that differ in seed and hyper-parameters only.

    Attributes:
      trainer: the compiled parts, which all share.
      configs: of the members.
      devices: their number divides that of the members.
      members_at_once: members that a device vmaps; it takes the others after them.
    """

    trainer: Trainer
    configs: tuple[TrainConfig, ...]
    devices: tuple[jax.Device, ...]
    members_at_once: int

    @classmethod
    def of(
        cls,
        trainer: Trainer,
        configs: Sequence[TrainConfig],
        devices: Sequence[jax.Device],
        members_at_once: int = 0,
    ) -> SweepProgram:
        """A sweep on the largest number of `devices` that divides the number of members.

        `members_at_once=0` means all that a device has, but 1 on CPUs, which are faster so: what
        one member needs stays in the caches (`experiments/benchmarks/sweep.py`).
        """
        count = max(n for n in range(1, len(devices) + 1) if len(configs) % n == 0)
        share = len(configs) // count
        default = 1 if devices[0].platform == "cpu" else share
        at_once = min(members_at_once or default, share)
        return cls(trainer, tuple(configs), tuple(devices[:count]), at_once)

    @cached_property
    def sharding(self) -> jax.sharding.NamedSharding:
        """Members are split over the devices."""
        mesh = jax.sharding.Mesh(np.array(self.devices), ("members",))
        return jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("members"))

    def _for_members(self, function: Any) -> Any:
        """`function` of one member, for all: mapped within a device, split over the devices.

        No device waits for another, as they would if the compiler split the mapped program.
        """

        def on_a_device(*members: Any) -> Any:
            if self.members_at_once == len(self.configs) // len(self.devices):
                return jax.vmap(function)(*members)
            batch_size = self.members_at_once if self.members_at_once > 1 else None
            return jax.lax.map(lambda member: function(*member), members, batch_size=batch_size)

        return jax.shard_map(
            on_a_device,
            mesh=self.sharding.mesh,
            in_specs=self.sharding.spec,
            out_specs=self.sharding.spec,
            check_vma=False,  # Initial carries of the scans inside are the same on every device.
        )

    @cached_property
    def hyperparameters(self) -> Hyperparameters:
        """Numbers of all members, f32[M] each."""
        stacked = jax.tree.map(
            lambda *values: jnp.array(values, jnp.float32),
            *(config.hyperparameters for config in self.configs),
        )
        return jax.device_put(stacked, self.sharding)

    def init(self) -> SweepState:
        """Every member before its first update."""
        keys = jnp.stack([jax.random.key(config.seed) for config in self.configs])
        actions = self.trainer.training
        # One after the other: the batched QR of orthogonal initialisers never returns on CPUs
        # (jaxlib 0.10.2).
        init = jax.jit(
            lambda keys: jax.lax.map(lambda key: self.trainer.learner.init(key, actions), keys)
        )
        members = jax.device_put(init(keys), self.sharding)
        worst = jnp.full(len(self.configs), -jnp.inf, jnp.float32)
        return SweepState(members, members, jax.device_put(worst, self.sharding))

    @cached_property
    def _updates(self) -> Any:
        def run(members: TrainState, hyperparameters: Hyperparameters, n: int) -> Any:
            actions = self.trainer.training

            def updated(state: TrainState, numbers: Hyperparameters, is_running: jax.Array) -> Any:
                found, metrics = self.trainer.learner.updates(state, numbers, actions, n)
                is_sound = sum(v for name, v in metrics.items() if name.startswith(PREFIX)) == 0
                is_kept = is_running & is_sound
                return jax.tree.map(lambda x, y: jnp.where(is_kept, x, y), found, state), metrics

            is_running = members.step == jnp.max(members.step)
            return self._for_members(updated)(members, hyperparameters, is_running)

        return jax.jit(run, static_argnames="n")

    @cached_property
    def _evaluation(self) -> Any:
        """Mean episode metrics per member, {split/metric: f32[M]}."""
        episodes = self.trainer.config.loop.evaluation_episodes
        key = jax.random.key(EVALUATION_SEED)

        rollout = self.trainer.rollout
        assert isinstance(rollout, DeviceRollout)

        def of_member(state: TrainState) -> dict[str, jax.Array]:
            results: dict[str, jax.Array] = {}
            for part, actions in self.trainer.watched.items():

                def block(start: jax.Array, actions: Actions = actions) -> dict[str, jax.Array]:
                    return rollout.play(state.policy, actions, key, start)[0]

                blocks = jax.lax.map(block, jnp.arange(0, episodes, rollout.width, jnp.int32))
                results |= {
                    f"{part}/{metric}": jnp.mean(values.reshape(-1)[:episodes])
                    for metric, values in blocks.items()
                }
            return results

        return jax.jit(self._for_members(of_member))

    @cached_property
    def _keep_best(self) -> Any:
        def keep(state: SweepState, metric: jax.Array) -> SweepState:
            is_running = state.members.step == jnp.max(state.members.step)
            is_better = is_running & (metric > state.best_metric)

            def pick(new: jax.Array, old: jax.Array) -> jax.Array:
                return jnp.where(is_better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            best = jax.tree.map(pick, state.members, state.best)
            best_metric = jnp.where(is_better, metric, state.best_metric)
            return SweepState(state.members, best, best_metric)

        return jax.jit(keep)

    def chunk(self, state: SweepState, num_updates: int) -> tuple[SweepState, dict[str, float]]:
        """Updates, and an evaluation where one is due; metrics are named `MEMBER/metric`.

        Raises:
          NonFiniteError: no member is left that has not diverged.
        """
        was_running, step = state.is_running, state.step + num_updates
        members, metrics = self._updates(state.members, self.hyperparameters, n=num_updates)
        state = replace(state, members=members)
        metrics = _of_members(metrics, was_running)
        self._tell_diverged(state, was_running, metrics, step)
        config = self.trainer.config
        is_last = step == config.num_updates
        if is_last or loop.is_passed(config.loop.evaluate_every, step - num_updates, step):
            results = self._evaluation(members)
            state = self._keep_best(state, results[self.trainer.selection_metric])
            metrics |= _of_members(results, state.is_running)
        return state, {
            f"{member:03d}/{name}": float(value[member])
            for name, value in metrics.items()
            for member in range(len(self.configs))
        }

    def _tell_diverged(
        self, state: SweepState, was_running: np.ndarray, metrics: Mapping[str, Any], step: int
    ) -> None:
        """Says which members diverged in a chunk that was to end at `step`.

        Raises:
          NonFiniteError: none is left.
        """
        steps, names = np.asarray(state.members.step), member_names(self.configs)
        for member in np.flatnonzero(was_running & (steps < step)):
            cause = cause_of({name: value[member] for name, value in metrics.items()})
            what, advice = CAUSES[cause or "parameter"]
            print(f"{names[member]} diverged by update {step}: {what} first. {advice}", flush=True)
        if steps.max() < step:
            raise loop.NonFiniteError(
                f"All {len(names)} members diverged, the last by update {step}; see above, or "
                "nonfinite/* of the metrics. Vary other values."
            )


def _of_members(metrics: Mapping[str, Any], are_meant: np.ndarray) -> dict[str, np.ndarray]:
    """f32[M] each, NaN for members that are not meant."""
    return {name: np.where(are_meant, np.asarray(value), np.nan) for name, value in metrics.items()}


def sweep(
    task: Task | str,
    table: RepresentationTable | str | Path,
    *,
    seeds: Iterable[int],
    vary: Mapping[str, Sequence[float]] | None = None,
    method: str = "ours",
    budget: str = "laptop",
    split: str | None = None,
    split_seed: int = 0,
    set: Assignments = (),
    representation_budget: str | None = None,
    workdir: Path | str | None = None,
    runs: Path | str = "runs",
    overwrite: bool = False,
    members_at_once: int = 0,
) -> Runs:
    """Trains every seed with every combination of hyper-parameters, as one program.

    Args:
      task, table, method, budget, split, split_seed, set, representation_budget, runs, overwrite:
        as of `train`.
      seeds: of the members, each once.
      vary: values by field of `Hyperparameters`.
      workdir: directory of the sweep, whose `members/` are the runs; default: below `runs`, under
        a name that no other sweep has.
      members_at_once: members that a device vmaps; 0: all, or 1 on CPUs.

    Raises:
      UsageError: the environments run on the host, or as of `train`.
      NonFiniteError: every member diverged.
    """
    task = load_task(task) if isinstance(task, str) else task
    if task.host is not None:
        raise UsageError(
            f"The environments of {task.name} run on the host, so its runs cannot be one program. "
            "Run `train` once per seed, with set=hyperparameters.NAME=VALUE for what is to vary."
        )
    domain, runs = Domain.of(task, split, split_seed), Path(runs)
    variant_of(method)  # Before a representation is trained for it.
    listed = checked_seeds(seeds)
    name, found = named_table(domain, runs, table, budget, representation_budget)
    preset = task.budget(budget)
    base = with_set(train_config(domain, method, name, found, preset, listed[0]), set)
    configs = member_configs(base, listed, vary or {})
    trainer = Trainer.of(configs[0], task, domain.split, found)
    check_run(task, trainer.rollout, configs[0].method, np.asarray(trainer.training.table))
    program = SweepProgram.of(trainer, configs, jax.devices(), members_at_once)
    members = [identity(config) for config in configs]
    words = ["sweep", file_name(method), Path(name).stem.replace(":", "-")]
    words += [domain.split_label] * (domain.split_label != task.default_split)
    words += [budget, *(vary or {}), _digest(members)]
    path = Path(workdir or domain.folder(runs) / "-".join(words))
    recorded = {MEMBERS: members}
    with RunDirectory.open_or_create(path, recorded, overwrite, upgrade=upgraded) as directory:
        say(
            f"{len(configs)} members on {len(program.devices)} device(s), {base.num_updates} "
            f"updates each ({foretold(preset, base)}; {len(configs)} times that, less what they "
            f"share) in {path}."
        )
        result = loop.run(
            program.init(),
            program.chunk,
            directory,
            loop.Rhythm(base.num_updates, base.loop.chunk_updates, base.loop.checkpoint_every),
            loop.Display(
                f"sweep of {len(configs)}",
                work_per_step=base.ppo.steps_per_update * len(configs),
            ),
            may_be_nan=("*",),  # Members that diverged have no numbers.
        )
        if result.was_interrupted:
            return Runs(path, (), task, result.interrupted_by)
        write_members(directory, program, result.state)
    return Runs.load(directory.path, task)


def _digest(members: Sequence[Mapping[str, Any]]) -> str:
    """Eight letters that other members would not have."""
    return hashlib.sha256(json.dumps(members, sort_keys=True).encode()).hexdigest()[:8]


def checked_seeds(seeds: Iterable[int]) -> list[int]:
    """Distinct seeds, at least one.

    Raises:
      UsageError: there is none, or one stands there twice.
    """
    listed = list(seeds)
    if not listed or len(dict.fromkeys(listed)) != len(listed):
        raise UsageError(f"A sweep needs distinct seeds and at least one, got {listed}.")
    return listed


def member_configs(
    base: TrainConfig, seeds: Sequence[int], vary: Mapping[str, Sequence[float]]
) -> list[TrainConfig]:
    """One config per seed and combination of the varied hyper-parameters.

    Raises:
      UsageError: there is no such hyper-parameter, or no value for it.
      ValueError: a value is out of its range.
    """
    legal = [field.name for field in fields(Hyperparameters)]
    for name, values in vary.items():
        if name not in legal or not len(values) or len({*values}) != len(values):
            raise UsageError(
                f"Cannot vary {name} over {list(values)}: give at least one value, each once, for "
                f"a hyper-parameter of {', '.join(legal)}."
            )
    combinations = itertools.product(*vary.values())
    return [
        replace(
            base,
            seed=seed,
            hyperparameters=replace(
                base.hyperparameters,
                **dict(zip(vary, map(float, combination), strict=True)),
            ),
        )
        for combination in combinations
        for seed in seeds
    ]


def member_names(configs: Sequence[TrainConfig]) -> list[str]:
    """What tells members apart, as names of folders: `entropy_coefficient=0.01-seed=31`."""
    numbers = [plain(config.hyperparameters) for config in configs]
    varied = [name for name in numbers[0] if len({of[name] for of in numbers}) > 1]
    return [
        "-".join([*(f"{name}={of[name]!r}" for name in varied), f"seed={config.seed}"])
        for config, of in zip(configs, numbers, strict=True)
    ]


def write_members(directory: RunDirectory, program: SweepProgram, state: SweepState) -> None:
    """Writes one run directory per member, and a row for each, see `Runs`.

    All appear at once, when all are whole; members that are there are left alone.
    """
    lines = read(directory.path / "metrics.jsonl")
    partial, members = directory.path / f"{MEMBERS}.partial", directory.path / MEMBERS
    names = member_names(program.configs)
    if (members / "000").exists():  # Until 0.2.0 they were numbered.
        names = [f"{index:03d}" for index in range(len(names))]
    rows = []
    for index, (name, config) in enumerate(zip(names, program.configs, strict=True)):
        path = members / name
        best, latest = (
            jax.tree.map(lambda x, i=index: x[i], tree) for tree in (state.best, state.members)
        )
        best_metric = float(state.best_metric[index])
        has_best = bool(np.isfinite(best_metric))
        metadata = {
            "best_metric": best_metric if has_best else None,
            "best_step": int(best.step) if has_best else None,
            "elapsed_s": lines[-1].get("time/elapsed_s", 0.0),
            **_divergence(lines, f"{index:03d}/"),
        }
        if not members.exists():
            trainer = replace(program.trainer, config=config)
            with open_run(partial / name, trainer, overwrite=True) as member:
                mark = write_metrics(member, lines, f"{index:03d}/")
                checkpointer, kept = Checkpointer(member.checkpoints), {**metadata, "metrics": mark}
                if has_best:
                    checkpointer.save("best", int(best.step), best, kept)
                checkpointer.save("latest", int(latest.step), latest, kept)
                member.note_saved()
        numbers = plain(config.hyperparameters)
        rows.append({"path": str(path), "seed": config.seed, **metadata, **numbers})
    if not members.exists():
        partial.rename(members)
    directory.record_evaluation(MEMBERS, {MEMBERS: rows})


def _divergence(lines: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, Any]:
    """At which update a member had diverged, and what was not finite first; None if it did not."""
    for line in lines:
        cause = cause_of(
            {n.removeprefix(prefix): v for n, v in line.items() if n.startswith(prefix)}
        )
        if cause is not None:
            return {"diverged_at": line["step"], "diverged_by": cause}
    return {"diverged_at": None, "diverged_by": None}


def write_metrics(member: RunDirectory, lines: list[dict[str, Any]], prefix: str) -> dict[str, Any]:
    """The lines of one member, under the names that `train` gives them; returns their mark."""
    with MetricsLog(member.path) as log:
        for line in lines:
            values = {
                name.removeprefix(prefix): value
                for name, value in line.items()
                if name.startswith(prefix) and value is not None
            }
            if values:
                log.write(line["step"], values)
        return log.mark
