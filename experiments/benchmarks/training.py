"""Training at the paper's shapes: steps per second, where the time goes, how far from the floor.

    python -m experiments.benchmarks.training

Where the time goes is measured by ablation: the compiled whole against the same program with one
part replaced by a cheap stand-in, in alternation in one process. A part's share is what goes away
with it. Shares need not add up to one: what a part costs depends on what runs beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs_mjx.grid_world import GridWorld, GridWorldParams, GridWorldState
from experiments.benchmarks import _floor, _trainers
from experiments.benchmarks import _measure as m
from experiments.pipeline.training import Trainer
from jaxnew import sampling
from jaxnew.environment import Action, Transition
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.ppo import Hyperparameters, Learner, TrainState, gae
from jaxnew.ppo.objective import Minibatch, normalize_advantages
from jaxnew.rollout.batch import RolloutBatch
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import ActionPool, AvailableSet


class CountedSets(DeviceRollout):
    """Sets counted off instead of drawn."""

    def _draw(self, key: jax.Array, shape: tuple[int, ...], pool: ActionPool) -> AvailableSet:
        del key
        first = jnp.arange(shape[0]).reshape(-1, *[1] * len(shape))
        index = (first + jnp.arange(self.config.set_size)) % pool.size
        ids = jnp.broadcast_to(pool.ids[index], (*shape, self.config.set_size))
        return AvailableSet(ids, ids >= 0)


@struct.dataclass
class FirstChoice(Categorical):
    """A categorical distribution that always draws the first entry."""

    def sample(self, key: jax.Array) -> jax.Array:
        """int32[...] zeros; no random number."""
        del key
        return jnp.zeros(self.logits.shape[:-1], jnp.int32)


class WithoutSampling(UtilityMethod):
    """Scores the actions, then takes the first."""

    def distribution(
        self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        return FirstChoice(super().distribution(params, obs, projected, mask).logits)


class WithoutInference(UtilityMethod):
    """Scores and values of zero; still samples among the scores."""

    def distribution(
        self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        return Categorical.masked(jnp.zeros(mask.shape), mask)

    def value(self, params: Any, obs: jax.Array) -> jax.Array:
        return jnp.zeros(obs.shape[:-1])


class StillWorld(GridWorld):
    """Nothing moves and no episode ends; the observation is the action's id everywhere."""

    def step(
        self, key: jax.Array, state: GridWorldState, action: Action, params: GridWorldParams
    ) -> Transition:
        obs = jnp.full(self.observation_spec(params).shape, action.id, jnp.float32)
        is_done = action.id < 0
        info = dict.fromkeys(self.episode_metrics, jnp.float32(0.0))
        return obs, state, jnp.float32(0.0), is_done, is_done, {**info, "final_observation": obs}


class WithoutGradient(Learner):
    """Gradients are a number that depends on every entry of the minibatch."""

    def _gradient(
        self,
        params: Any,
        minibatch: Minibatch,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        fixed_set: AvailableSet | None = None,
    ) -> tuple[Any, dict[str, jax.Array]]:
        total = sum(jnp.sum(leaf.astype(jnp.float32)) for leaf in jax.tree.leaves(minibatch))
        total = jnp.asarray(total) * 1e-6
        return jax.tree.map(lambda p: jnp.full_like(p, total), params), {"loss/total": total}


class InOrder(Learner):
    """Minibatches of neighbouring transitions: nothing is permuted."""

    def _minibatch_indices(self, key: jax.Array) -> jax.Array:
        del key
        indices = jnp.arange(self.config.steps_per_update).reshape(-1, self.config.minibatch_size)
        return jnp.tile(indices, (self.config.num_epochs, 1))


class WithoutOptimizer(Learner):
    """Plain gradient descent in place of clipping and Adam."""

    @property
    def optimizer(self) -> optax.GradientTransformation:
        return optax.identity()


Timings = dict[str, m.Timing]


def rollout_variants(learner: Learner) -> dict[str, DeviceRollout]:
    """The rollout, and versions of it in each of which one part is replaced."""
    whole = learner.rollout
    unscaled = replace(whole.config, normalize_observations=False, normalize_rewards=False)
    still = StillWorld()
    nothing = CountedSets(still, whole.env_params, _Nothing(), unscaled)
    return {
        "rollout": whole,
        "set drawing": CountedSets(whole.env, whole.env_params, whole.method, whole.config),
        "normalisation": replace(whole, config=unscaled),
        "inference": replace(whole, method=WithoutInference()),
        "sampling": replace(whole, method=WithoutSampling()),
        "environment": replace(whole, env=still),
        "all of them": nothing,
    }


class _Nothing(WithoutInference):
    """Neither scores, nor values, nor samples."""

    def distribution(
        self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        return FirstChoice(jnp.zeros(mask.shape))


def learner_variants(learner: Learner) -> dict[str, Learner]:
    """Likewise for the gradient steps."""
    parts = learner.rollout, learner.config
    return {
        "learning": learner,
        "gradients": WithoutGradient(*parts),
        "permutation": InOrder(*parts),
        "optimizer": WithoutOptimizer(*parts),
    }


def subjects_of(trainer: Trainer, state: TrainState) -> dict[str, m.Subject]:
    """The update, its two halves, their variants, and parts alone."""
    learner, table, pool = trainer.learner, trainer.table, trainer.pools["train"]
    numbers = trainer.config.hyperparameters
    collect = jax.jit(learner.rollout.collect)

    def update_inputs(key: jax.Array) -> tuple[Any, ...]:
        return replace(state, key=key), numbers, table, pool

    def rollout_inputs(key: jax.Array) -> tuple[Any, ...]:
        return key, state.rollout, state.params, table, pool, numbers.discount

    def batch_of(key: jax.Array) -> RolloutBatch:
        return collect(*rollout_inputs(key))[1]

    def learn_inputs(learner: Learner) -> Callable[[jax.Array], tuple[Any, ...]]:
        def inputs(key: jax.Array) -> tuple[Any, ...]:
            key_batch, key_learn = jax.random.split(key)
            opt_state = learner.optimizer.init(state.params)
            batch = batch_of(key_batch)
            return key_learn, state.params, opt_state, batch, numbers, table, state.step

        return inputs

    def advantages(batch: RolloutBatch) -> tuple[jax.Array, jax.Array]:
        values, targets = gae(
            batch.reward,
            batch.value,
            batch.next_value,
            batch.done,
            batch.done,
            numbers.discount,
            numbers.gae_lambda,
        )
        return normalize_advantages(values), targets

    subjects = {"update": m.compiled(learner.update, update_inputs)}
    for name, rollout in rollout_variants(learner).items():
        subjects[name] = m.compiled(rollout.collect, rollout_inputs)
    for name, variant in learner_variants(learner).items():
        subjects[name] = m.compiled(variant.learn, learn_inputs(variant))
    subjects["advantages alone"] = m.compiled(advantages, lambda key: (batch_of(key),))
    return subjects | set_drawing_subjects(trainer)


def set_drawing_subjects(trainer: Trainer) -> dict[str, m.Subject]:
    """One set for every step of an update: as it is drawn, and by sorting noise over the pool."""
    pool, config = trainer.pools["train"], trainer.config.ppo

    def by_sorting(keys: jax.Array) -> jax.Array:
        return jax.vmap(lambda key: sampling._by_sorting_noise(key, pool, config.rollout.set_size))(
            keys
        )

    def inputs(key: jax.Array) -> tuple[jax.Array]:
        return (jax.random.split(key, config.steps_per_update),)

    return {
        "draw_sets alone": m.compiled(
            lambda keys: sampling.draw_sets(keys, pool, config.rollout.set_size), inputs
        ),
        "top-k of noise alone": m.compiled(by_sorting, inputs),
    }


ROLLOUT_PARTS = ("set drawing", "normalisation", "inference", "sampling", "environment")
LEARNING_PARTS = ("gradients", "permutation", "optimizer")


def report_timings(report: m.Report, trainer: Trainer, timings: Timings) -> None:
    """Every timing, with what it is."""
    shapes = _trainers.describe(trainer)
    config = trainer.config.ppo
    covers = {"update": ["auto-reset", "policy", "update"], "rollout": ["auto-reset", "policy"]}
    for name, timing in timings.items():
        if name in ROLLOUT_PARTS or name == "all of them":
            case, how = f"rollout without {name}", "replaced by a cheap stand-in"
        elif name in LEARNING_PARTS:
            case, how = f"learning without {name}", "replaced by a cheap stand-in"
        else:
            case, how = name, "compiled by itself"
        is_sets = name in ("draw_sets alone", "top-k of noise alone")
        report.timing(
            case,
            timing,
            work={"sets" if is_sets else "steps": config.steps_per_update},
            num_envs=config.rollout.num_envs,
            includes=covers.get(name, []),
            how=f"{how}; {shapes}",
        )


def report_shares(report: m.Report, timings: Timings) -> None:
    """Where an update's time goes."""
    update = timings["update"]
    for name in ("rollout", "learning", "advantages alone", "draw_sets alone"):
        how = "time of the part compiled by itself over that of the update"
        report.values(f"{name} / update", m.ratio(timings[name], update), how=how)
    for whole, parts in (
        ("rollout", (*ROLLOUT_PARTS, "all of them")),
        ("learning", LEARNING_PARTS),
    ):
        for part in parts:
            share = m.share_saved(timings[whole], timings[part])
            of_update = m.ratio(timings[whole], update)
            values = {f"of {whole} ({clock})": share[clock] for clock in share}
            values |= {f"of update ({clock})": share[clock] * of_update[clock] for clock in share}
            how = f"1 - time without the part / time of the whole {whole}, of medians"
            report.values(f"share of {part}", values, how=how)
    report.values(
        "top-k of noise / draw_sets",
        m.ratio(timings["top-k of noise alone"], timings["draw_sets alone"]),
        how="time of the first over time of the second, for the same number of sets",
    )


def shapes_of(trainer: Trainer) -> _floor.Shapes:
    """The sizes that the floor is counted from."""
    env, config = trainer.learner.rollout.env, trainer.config.ppo
    return _floor.Shapes(
        obs_size=env.observation_spec(env.default_params).shape[0],
        representation_size=trainer.table.shape[1],
        num_actions=trainer.table.shape[0],
        set_size=config.rollout.set_size,
        steps=config.steps_per_update,
        epochs=config.num_epochs,
        gradient_steps=config.num_epochs * config.num_minibatches,
    )


def report_floor(report: m.Report, trainer: Trainer, update: m.Timing) -> None:
    """The floor of an update and the fraction of it that training reaches, by both clocks."""
    shapes = shapes_of(trainer)
    cached, memory = _floor.update_bytes(shapes)
    per_step = {
        "operations": _floor.update_operations(shapes) / shapes.steps,
        "cached bytes": cached / shapes.steps,
        "memory bytes": memory / shapes.steps,
    }
    how = "counted from the shapes, see experiments/benchmarks/_floor.py"
    report.values("floor: needed per environment step", per_step, how=how)
    measured = {"wall": m.Spread.of(update.wall_s), "cpu": m.Spread.of(update.cpu_s)}
    for clock, rates in _floor.measure_rates(report, m.REPEATS.value, m.QUICK.value).items():
        floor = _floor.floor_seconds(shapes, rates)
        values = {
            **floor,
            "update_s": measured[clock].median,
            "fraction of floor": floor["max_s"] / measured[clock].median,
            "fraction of sum": floor["sum_s"] / measured[clock].median,
        }
        how = "needed operations and bytes over the best rates measured above, in this process"
        report.values(f"floor of an update ({clock} clock)", values, how=how)


def main() -> None:
    report = m.Report("training")
    trainer = _trainers.make_trainer()
    state = _trainers.trained_state(trainer, num_updates=2)
    timings = m.measure(subjects_of(trainer, state), m.REPEATS.value)
    report_timings(report, trainer, timings)
    report_shares(report, timings)
    report_floor(report, trainer, timings["update"])


if __name__ == "__main__":
    m.run_benchmark(main)
