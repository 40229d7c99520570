"""Grid World at the paper's shapes: steps per second, where the time goes, how far from the floor.

    python -m experiments.benchmarks.training
    python -m experiments.benchmarks.training --noparts    # The first alone, in half a minute.

Where the time goes is measured by ablation: the compiled whole against the same program with one
part replaced by a cheap stand-in, in alternation in one process. A part's share is what goes away
with it. Shares need not add up to one: what a part costs depends on what runs beside it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs_mjx.grid_world import GridWorld, GridWorldParams, GridWorldState
from experiments.benchmarks import _floor, _trainers
from experiments.benchmarks import _measure as m
from jaxnew import sampling
from jaxnew.environment import Action, Transition
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.ppo import Hyperparameters, Learner, TrainState, gae
from jaxnew.ppo.objective import Minibatch, normalize_advantages
from jaxnew.rollout.contract import RolloutBatch
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions, AvailableSet
from jaxnew.trainer import Trainer

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("bool", "parts", True, "Whether parts, floor and evaluation are measured, too.")


@struct.dataclass
class CountedSets(Actions):
    """Sets counted off instead of drawn."""

    def draw(self, keys: jax.Array) -> AvailableSet:
        first = jnp.arange(keys.size).reshape(*keys.shape, 1)
        ids = self.pool.ids[(first + jnp.arange(self.set_size)) % self.pool.size]
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
        actions: Actions,
        available: AvailableSet,
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


Subjects = dict[str, m.Subject]


def rollout_subjects(trainer: Trainer, state: TrainState) -> Subjects:
    """The rollout, and versions of it in each of which one part is replaced."""
    whole = trainer.rollout
    assert isinstance(whole, DeviceRollout)
    unscaled = replace(whole.config, normalize_observations=False, normalize_rewards=False)
    counted = CountedSets(**vars(trainer.training))
    variants = {
        "without normalisation": replace(whole, config=unscaled),
        "without inference": replace(whole, method=WithoutInference()),
        "without sampling": replace(whole, method=WithoutSampling()),
        "without environment": replace(whole, env=StillWorld()),
    }
    return {
        "rollout": _trainers.collecting(trainer, state),
        "without set drawing": _trainers.collecting(trainer, state, actions=counted),
        **{name: _trainers.collecting(trainer, state, it) for name, it in variants.items()},
    }


def learning_subjects(trainer: Trainer, state: TrainState) -> Subjects:
    """Likewise for the gradient steps; and the advantages alone."""
    learner, numbers = trainer.learner, trainer.config.hyperparameters
    parts = learner.rollout, learner.config
    whole = _trainers.learning(trainer, state)

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

    return {
        "learning": whole,
        "without gradients": _trainers.learning(trainer, state, WithoutGradient(*parts)),
        "without permutation": _trainers.learning(trainer, state, InOrder(*parts)),
        "advantages": m.compiled(advantages, lambda key: (whole.inputs(key)[3],)),
    }


def set_subjects(trainer: Trainer) -> Subjects:
    """One set for every step of an update: as it is drawn, and by sorting noise over the pool."""
    actions, steps = trainer.training, trainer.config.ppo.steps_per_update

    def by_sorting(keys: jax.Array) -> jax.Array:
        draw = sampling._by_sorting_noise
        return jax.vmap(lambda key: draw(key, actions.pool, actions.set_size))(keys)

    def inputs(key: jax.Array) -> tuple[jax.Array]:
        return (jax.random.split(key, steps),)

    return {
        "set drawing": m.compiled(actions.draw, inputs),
        "top-k of noise": m.compiled(by_sorting, inputs),
    }


def report_parts(report: m.Report, trainer: Trainer, timings: dict[str, m.Timing]) -> None:
    """Every timing, and where an update's time goes."""
    ppo, shapes = trainer.config.ppo, _trainers.describe(trainer)
    covers = {"update": ["auto-reset", "policy", "update"], "rollout": ["auto-reset", "policy"]}
    whole, update = "", timings["update"]
    for name, timing in timings.items():
        is_set = name in ("set drawing", "top-k of noise")
        whole = name if name in ("rollout", "learning") else whole
        is_ablated = name.startswith("without")
        report.timing(
            f"{whole} {name}" if is_ablated else name,
            timing,
            work={"sets" if is_set else "steps": ppo.steps_per_update},
            num_envs=ppo.rollout.num_envs,
            includes=covers.get(name, []),
            how=f"{'a part has a cheap stand-in' if is_ablated else 'compiled alone'}; {shapes}",
        )
        if is_ablated:
            of_whole = m.share_saved(timings[whole], timing)
            of_update = m.share_saved(timings[whole], timing, update)
            values = {f"of {whole} ({clock})": share for clock, share in of_whole.items()}
            values |= {f"of update ({clock})": share for clock, share in of_update.items()}
            how = f"1 - time {name} / time of the whole {whole}, of medians"
            report.values(f"share of {name.removeprefix('without ')}", values, how=how)
        elif name != "update":
            how = "time of the part compiled alone over that of the update"
            report.ratio(f"{name} / update", timing, update, how=how)
    if "top-k of noise" in timings:
        slow, fast = timings["top-k of noise"], timings["set drawing"]
        report.ratio("top-k of noise / set drawing", slow, fast)


def report_floor(report: m.Report, trainer: Trainer, update: m.Timing) -> None:
    """The floor of an update and the fraction of it that training reaches."""
    ppo, actions = trainer.config.ppo, trainer.training
    shapes = _floor.Shapes(
        obs_size=trainer.rollout.observation.shape[0],
        representation_size=actions.table.shape[1],
        num_actions=actions.table.shape[0],
        set_size=actions.set_size,
        steps=ppo.steps_per_update,
        epochs=ppo.num_epochs,
        gradient_steps=ppo.num_epochs * ppo.num_minibatches,
    )
    cached, memory = _floor.update_bytes(shapes)
    per_step = {
        "operations": _floor.update_operations(shapes) / shapes.steps,
        "cached bytes": cached / shapes.steps,
        "memory bytes": memory / shapes.steps,
    }
    how = "counted from the shapes, see experiments/benchmarks/_floor.py"
    report.values("floor: needed per environment step", per_step, how=how)
    floor = _floor.floor_seconds(shapes, _floor.measure_rates(report))
    seconds = update.median.wall_s
    values = {
        **floor,
        "update_s": seconds,
        "fraction of floor": floor["max_s"] / seconds,
        "fraction of sum": floor["sum_s"] / seconds,
    }
    how = "needed operations and bytes over the best rates measured above, in this process"
    report.values("floor of an update", values, how=how)


def report_evaluation(report: m.Report, trainer: Trainer, state: TrainState) -> None:
    """Episodes per second of a policy on test action sets."""
    num_episodes, actions = 200 if report.is_quick else 5000, trainer.actions("test")

    def play(key: jax.Array) -> Any:
        return trainer.rollout.measure(state.policy, actions, key, num_episodes)

    timing = report.measure({"evaluation": m.Subject(play, lambda key: (key,))})["evaluation"]
    report.timing(
        "evaluation, sampled actions",
        timing,
        work={"episodes": num_episodes},
        num_envs=trainer.task.evaluation_width,
        includes=["set drawing", "policy", "transfer"],
        how=f"{num_episodes} episodes on test sets; {_trainers.describe(trainer)}",
    )


def main() -> None:
    report = m.Report("training", ARGUMENTS)
    trainer = _trainers.make_trainer(report.is_quick)
    # Two updates, after which episodes no longer start together.
    state, _ = trainer.chunk(trainer.init(), 2)
    subjects = {"update": _trainers.updating(trainer, state)}
    if ARGUMENTS.parts:
        subjects |= rollout_subjects(trainer, state) | learning_subjects(trainer, state)
        subjects |= set_subjects(trainer)
    timings = report.measure(subjects)
    report_parts(report, trainer, timings)
    if ARGUMENTS.parts:
        report_floor(report, trainer, timings["update"])
        report_evaluation(report, trainer, state)


if __name__ == "__main__":
    ARGUMENTS.start(main)
