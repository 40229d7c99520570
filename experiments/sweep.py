"""Trains many seeds and hyper-parameters as one program, sharded over all devices.

    python -m experiments.sweep --representation=gt12 --seeds=31,41,51,61 \
        --vary=entropy_coefficient=0.01,0.05 --vary=learning_rate=3e-4,1e-3

Every combination becomes an ordinary run directory, as `train` would have made it.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags
from flax import struct

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import Domain, find_table
from experiments.pipeline.methods import file_name, variant_of
from experiments.pipeline.training import (
    EVALUATION_SEED,
    SPLITS_WATCHED,
    TrainConfig,
    Trainer,
    save_inputs,
)
from jaxnew import config as config_lib
from jaxnew import loop
from jaxnew.checkpoint import Checkpointer
from jaxnew.cores import available_cores
from jaxnew.evaluation import Evaluator
from jaxnew.metrics import MetricsLog, read
from jaxnew.ppo import Hyperparameters, TrainState
from jaxnew.representation.table import RepresentationTable
from jaxnew.run_directory import RunDirectory
from jaxnew.sampling import ActionPool

SEEDS = flags.DEFINE_list("seeds", ["31", "41", "51", "61", "71"], "Seeds of the members.")
VARY = flags.DEFINE_multi_string("vary", [], "hyperparameter=value,value,... (repeatable).")
REPRESENTATION_BUDGET = flags.DEFINE_string(
    "representation_budget", None, "Budget of a representation to be trained; default: --budget."
)
AT_ONCE = flags.DEFINE_integer(
    "members_at_once", 0, "Members that a device vmaps; 0: all, or 1 on CPUs.", lower_bound=0
)


@struct.dataclass
class SweepState:
    """The members of a sweep; every leaf has a leading axis of M members.

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
        """Updates done; the same for all members."""
        return int(self.members.step[0])


@dataclass(frozen=True)
class Sweep:
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
        configs: list[TrainConfig],
        devices: list[jax.Device],
        members_at_once: int = 0,
    ) -> Sweep:
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
        table, pool = self.trainer.table, self.trainer.training_pool
        # One after the other: the batched QR of orthogonal initialisers never returns on CPUs
        # (jaxlib 0.10.2).
        init = jax.jit(
            lambda keys: jax.lax.map(lambda key: self.trainer.learner.init(key, table, pool), keys)
        )
        members = jax.device_put(init(keys), self.sharding)
        worst = jnp.full(len(self.configs), -jnp.inf)
        return SweepState(members, members, jax.device_put(worst, self.sharding))

    @cached_property
    def _updates(self) -> Any:
        def run(members: TrainState, hyperparameters: Hyperparameters, n: int) -> Any:
            table, pool = self.trainer.table, self.trainer.training_pool
            update = self._for_members(
                lambda state, numbers: self.trainer.learner.updates(state, numbers, table, pool, n)
            )
            return update(members, hyperparameters)

        return jax.jit(run, static_argnames="n")

    @cached_property
    def _evaluation(self) -> Any:
        """Mean episode metrics per member, {split/metric: f32[M]}."""
        episodes = self.trainer.config.loop.evaluation_episodes
        key = jax.random.key(EVALUATION_SEED)

        def of_member(state: TrainState) -> dict[str, jax.Array]:
            results: dict[str, jax.Array] = {}
            for name in SPLITS_WATCHED:
                evaluator, pool = self.trainer.watched(name)

                def block(
                    start: jax.Array, evaluator: Evaluator = evaluator, pool: ActionPool = pool
                ) -> dict[str, jax.Array]:
                    return evaluator.play_block(
                        state.params,
                        state.rollout.observation_statistics,
                        self.trainer.table,
                        pool,
                        key,
                        start,
                    )

                blocks = jax.lax.map(block, jnp.arange(0, episodes, evaluator.width))
                results |= {
                    f"{name}/{metric}": jnp.mean(values.reshape(-1)[:episodes])
                    for metric, values in blocks.items()
                }
            return results

        return jax.jit(self._for_members(of_member))

    @cached_property
    def _keep_best(self) -> Any:
        def keep(state: SweepState, metric: jax.Array) -> SweepState:
            is_better = metric > state.best_metric

            def pick(new: jax.Array, old: jax.Array) -> jax.Array:
                return jnp.where(is_better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            best = jax.tree.map(pick, state.members, state.best)
            return SweepState(state.members, best, jnp.maximum(metric, state.best_metric))

        return jax.jit(keep)

    def chunk(self, state: SweepState, num_updates: int) -> tuple[SweepState, dict[str, float]]:
        """Updates, and an evaluation where one is due; metrics are named `MEMBER/metric`."""
        members, metrics = self._updates(state.members, self.hyperparameters, n=num_updates)
        state = replace(state, members=members)
        config = self.trainer.config
        is_last = state.step == config.num_updates
        if is_last or state.step % config.loop.evaluate_every == 0:
            results = self._evaluation(members)
            state = self._keep_best(state, results[self.trainer.selection_metric])
            metrics = {**metrics, **results}
        values = {name: np.asarray(value) for name, value in metrics.items()}
        return state, {
            f"{member:03d}/{name}": float(value[member])
            for name, value in values.items()
            for member in range(len(self.configs))
        }


def main() -> None:
    # Each core is a device; without effect on accelerators.
    jax.config.update("jax_num_cpu_devices", available_cores())
    task = flag.load_task(flag.TASK.value)
    if task.host is not None:
        raise flag.UsageError(
            f"The environments of {task.name} run on the host, so its runs cannot be one program. "
            "Run `python -m experiments.train` once per --seed, with "
            "--set=hyperparameters.NAME=VALUE for what is to vary."
        )
    domain = Domain.of(task, flag.SPLIT.value)
    runs = Path(flag.RUNS.value)
    budget = flag.budget_of(task.stage_two, flag.BUDGET.value, "Stage two")
    name = flag.REPRESENTATION.value
    variant_of(flag.METHOD.value)  # Before a representation is trained for it.
    table = find_table(domain, runs, name, REPRESENTATION_BUDGET.value or flag.BUDGET.value)
    base = TrainConfig.of(domain, flag.METHOD.value, name, table, budget, flag.SEED.value)
    base = base.with_set(flag.SET.value)
    configs = member_configs(base, parse_seeds(SEEDS.value), VARY.value)
    trainer = Trainer.of(configs[0], task, domain.split, table)
    sweep = Sweep.of(trainer, configs, jax.devices(), AT_ONCE.value)
    folder = f"sweep-{file_name(base.method)}-{Path(name).stem}"
    path = Path(flag.WORKDIR.value or domain.folder(runs) / folder)
    plain = {"members": [config_lib.to_dict(config) for config in configs]}
    with RunDirectory.open_or_create(path, plain, flag.OVERWRITE.value) as run:
        print(
            f"{len(configs)} members on {len(sweep.devices)} device(s), {base.num_updates} updates "
            f"each ({len(configs)} x {budget.cost}, less what they share) in {path}."
        )
        result = loop.run(
            sweep.init(),
            chunk=sweep.chunk,
            run_directory=run,
            total_steps=base.num_updates,
            chunk_steps=base.loop.evaluate_every,
            checkpoint_every=base.loop.checkpoint_every,
            title=f"sweep of {len(configs)}",
            work_per_step=base.ppo.steps_per_update * len(configs),
            may_be_nan=("*",),  # One diverged member does not end the others.
            finite_part=lambda state: (),
        )
        if not result.was_interrupted:
            write_members(run, sweep, result.state, domain, table)


def parse_seeds(texts: list[str]) -> list[int]:
    """Seeds as given by the flag.

    Raises:
      UsageError: one is not an integer, or stands there twice.
    """
    try:
        seeds = [int(text) for text in texts]
    except ValueError as err:
        raise flag.UsageError(f"--seeds must be integers separated by commas: {err}.") from err
    if not seeds or len(set(seeds)) != len(seeds):
        raise flag.UsageError(f"--seeds needs distinct seeds and at least one, got {texts}.")
    return seeds


def member_configs(base: TrainConfig, seeds: list[int], vary: list[str]) -> list[TrainConfig]:
    """One config per seed and combination of the varied hyper-parameters.

    Raises:
      UsageError: an entry of `vary` is not `name=value,value`, or there is no such hyper-parameter.
    """
    legal = [field.name for field in fields(Hyperparameters)]
    axes = []
    for entry in vary:
        name, _, values = entry.partition("=")
        try:
            axes.append([(name, float(value)) for value in values.split(",")])
        except ValueError as err:
            raise flag.UsageError(
                f"--vary={entry} must look like name=value,value: {err}."
            ) from err
        if name not in legal:
            raise flag.UsageError(
                f"--vary={entry}: choose a hyper-parameter of {', '.join(legal)}."
            )
    return [
        replace(
            base,
            seed=seed,
            hyperparameters=replace(base.hyperparameters, **dict(combination)),
        )
        for combination in itertools.product(*axes)
        for seed in seeds
    ]


def write_members(
    run: RunDirectory, sweep: Sweep, state: SweepState, domain: Domain, table: RepresentationTable
) -> None:
    """Writes one run directory per member, and prints how each did.

    All appear at once, when all are whole; members that are there are left alone.
    """
    lines = read(run.path / "metrics.jsonl")
    partial, members = run.path / "members.partial", run.path / "members"
    num_updates = sweep.trainer.config.num_updates
    summary = []
    for index, config in enumerate(sweep.configs):
        path = members / f"{index:03d}"
        best, latest = (
            jax.tree.map(lambda x, i=index: x[i], tree) for tree in (state.best, state.members)
        )
        best_metric = float(state.best_metric[index])
        has_best = bool(np.isfinite(best_metric))
        metadata = {
            "best_metric": best_metric if has_best else None,
            "best_step": int(best.step) if has_best else None,
            "elapsed_s": lines[-1].get("time/elapsed_s", 0.0),
        }
        if not members.exists():
            plain = config_lib.to_dict(config)
            with RunDirectory.open_or_create(partial / path.name, plain, True) as member:
                save_inputs(member, domain.split, table)
                write_metrics(member, lines, f"{index:03d}/")
                checkpointer = Checkpointer(member.checkpoints)
                if has_best:
                    checkpointer.save("best", int(best.step), best, metadata)
                checkpointer.save("latest", num_updates, latest, metadata)
        row = {"member": path.name, "seed": config.seed, **metadata}
        summary.append({**row, "hyperparameters": config_lib.to_dict(config.hyperparameters)})
        print(f"{path}: seed {config.seed}, {sweep.trainer.selection_metric} {best_metric:.4f}")
    if not members.exists():
        partial.rename(members)
    run.record_evaluation("members", {"members": summary})
    print(json.dumps(max(summary, key=lambda row: row["best_metric"] or -np.inf)))


def write_metrics(member: RunDirectory, lines: list[dict[str, Any]], prefix: str) -> None:
    """The lines of one member, under the names that `train` gives them."""
    with MetricsLog(member.path) as log:
        for line in lines:
            values = {
                name.removeprefix(prefix): value
                for name, value in line.items()
                if name.startswith(prefix) and value is not None
            }
            if values:
                log.write(line["step"], values)


if __name__ == "__main__":
    flag.run_command(main)
