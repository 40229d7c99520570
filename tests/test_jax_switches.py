"""JAX's switches that change the dtypes of numbers: with them programs compute as without.

`jax_enable_x64` widens every array that is made without a dtype, and with it what is drawn at
random. `jax_numpy_dtype_promotion=strict` refuses to mix dtypes. Under both at once nothing can be
widened in silence, so most tests set both. What goes wrong then does so while a program is traced;
only what is drawn has to be computed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world import GridWorld
from envs_mjx.grid_world.play import record
from envs_mjx.recommender import Recommender
from envs_mjx.shape_stacking import ShapeStacking
from envs_mjx.shape_stacking.engines.mjx import Mjx
from examples.kicks import Kicks
from jaxnew.environment import Action, ActionSpec, Environment
from jaxnew.policy.continuous import DiagonalGaussian
from jaxnew.policy.method import METHODS, MethodContext, make_method
from jaxnew.ppo import TrainState
from jaxnew.representation.batches import flat_vae_choice, hvae_choice
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.learner import RepresentationLearner
from jaxnew.representation.modality import one_hot_modality
from jaxnew.representation.objective import draw_noise
from jaxnew.representation.table import engineered_table
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.settings import with_set
from jaxnew.trainer import Trainer
from jaxnew.training import train_config
from tests.experiments.commands import ENVIRONMENT, run_alone
from tests.experiments.create_runs import parameters

X64, STRICT = {"JAX_ENABLE_X64": "1"}, {"JAX_NUMPY_DTYPE_PROMOTION": "strict"}


Leaves = list[tuple[str, Any]]


def in_both_modes(function: Callable[[], Any]) -> tuple[Leaves, Leaves]:
    """The leaves of what `function` returns, without and with both switches; keys as numbers."""

    def leaves() -> Leaves:
        found = jax.tree_util.tree_leaves_with_path(function())
        return [(jax.tree_util.keystr(path), leaf) for path, leaf in found]

    without = leaves()
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        return without, leaves()


def assert_same_dtypes(function: Callable[..., Any], *arguments: Any) -> None:
    """`function` can be traced with the switches, and its results have the dtypes as without."""
    # A function of its own each time, as traces are kept.
    without, with_both = in_both_modes(lambda: jax.eval_shape(lambda *x: function(*x), *arguments))
    assert without == with_both


def assert_same_bits(function: Callable[[], Any]) -> None:
    """What `function` computes has the same dtypes and bits with the switches."""

    def numbers(leaves: Leaves) -> dict[str, np.ndarray]:
        is_key = jax.dtypes.prng_key
        return {
            path: np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, is_key) else x)
            for path, x in leaves
        }

    without, with_both = map(numbers, in_both_modes(function))
    assert {name: x.dtype for name, x in without.items()} == {
        name: x.dtype for name, x in with_both.items()
    }
    assert [name for name in without if without[name].tobytes() != with_both[name].tobytes()] == []


def grid_world() -> Trainer:
    domain = Domain.of(load_task("grid_world"))
    table = engineered_table(domain.universe, "gt12")
    config = train_config(domain, "ours", "gt12", table, domain.task.budget("smoke"), 1)
    few = ("num_envs=4", "num_steps=8")
    # Times the discount it is another number in 64 bits, also when that is rounded to 32.
    config = with_set(
        config,
        [
            "sets.size=10",
            "hyperparameters.gae_lambda=0.92",
            *(f"ppo.rollout.{field}" for field in few),
        ],
    )
    return Trainer.of(config, domain.task, domain.split, table)


@pytest.mark.integration
def test_grid_world_trains_with_the_same_bits() -> None:
    """XLA may round otherwise where loops count in 64 bits; in this program it does not."""

    trainer = grid_world()
    state = trainer.init()
    assert_same_dtypes(trainer.init)
    assert_same_bits(lambda: trainer.chunk(state, 2))


@pytest.mark.unit
def test_episodes_are_played() -> None:
    trainer = grid_world()
    params = jax.eval_shape(trainer.init)

    def played(state: TrainState, key: jax.Array) -> Any:
        rollout, actions = trainer.rollout, trainer.watched["train"]
        assert isinstance(rollout, DeviceRollout)
        return [
            rollout.play(state.policy, actions, key, jnp.int32(0), is_greedy, keeps_all=True)
            for is_greedy in (False, True)
        ]

    assert_same_dtypes(played, params, jax.random.key(0))


@pytest.mark.unit
def test_what_is_drawn_has_the_same_bits() -> None:
    ids, vectors, users = np.arange(40), np.zeros((40, 3)), Recommender()
    params = users.default_params

    def draws() -> Any:
        groups, many = Actions.of(vectors, ids, 6, groups=ids % 4), Actions.of(vectors, ids, 30)

        @jax.jit
        def drawn(keys: jax.Array, groups: Actions, many: Actions) -> Any:
            sets = groups.draw(keys)
            growing = groups.growing(2, 2).at(sets, jnp.arange(len(keys), dtype=jnp.int32))
            point = DiagonalGaussian(groups.table, 1.0 + groups.table)
            return (
                (sets, growing, many.draw(keys), groups.table),
                point.sample(keys[0]),
                hvae_choice(keys[1], keys[2], jnp.int32(3), (9, 7), 4, 3),
                flat_vae_choice(keys[3], (9, 7), 5),
                draw_noise(keys[4], (4, 3), 2, 5),
                record(keys[5], jnp.arange(4), 3),
                jax.vmap(users.reset_env, (0, None))(keys, params),
            )

        return drawn(jax.random.split(jax.random.key(0), 8), groups, many)

    assert_same_bits(draws)


@pytest.mark.unit
@pytest.mark.parametrize("kind", ["hvae", pytest.param("vae", marks=pytest.mark.slow)])
def test_encoders_train(kind: str) -> None:
    sizes = {"encoder_width": 8, "inference_width": 8, "hidden_width": 8, "action_latent": 4}
    config = RepresentationConfig(
        **sizes, kind=kind, observation_latent=3, actions_per_batch=4, recordings_per_action=4
    )

    def trained(key: jax.Array, recordings: jax.Array) -> Any:
        learner = RepresentationLearner(config, one_hot_modality("onehot", 2, 5))
        state = learner.init(key, recordings.shape)
        return learner.train_steps(state, recordings, 2)

    assert_same_dtypes(trained, jax.random.key(0), jnp.zeros((8, 6, 2, 2), jnp.uint8))


@pytest.mark.unit
@pytest.mark.parametrize("name", sorted(METHODS))
def test_methods_with_a_position_and_a_stop_act(name: str) -> None:
    spec = ActionSpec(9, position_dim=2, has_stop=True)
    context = MethodContext(
        train_ids=np.arange(5), action_spec=spec, conditions_position=name == "ours"
    )
    actions = Actions.of(np.zeros((9, 3)), np.arange(9), 4)

    def act(key: jax.Array, obs: jax.Array) -> Any:
        method = make_method(name, context)
        params = method.init(key, obs[0], 3)
        available = actions.draw(jax.random.split(key, len(obs)))
        rows = actions.rows(method.project(params, actions.offered(available)), available)
        distribution = method.distribution(params, obs, rows, available.mask)
        samples = distribution.sample(key), distribution.mode()
        return params, [
            (
                x,
                distribution.log_prob(x),
                distribution.entropy(x),
                method.decode(x, available, actions.table),
            )
            for x in samples
        ]

    assert_same_dtypes(act, jax.random.key(0), jnp.zeros((2, 6), jnp.float32))


@pytest.mark.contract
@pytest.mark.parametrize("make", [GridWorld, Recommender, ShapeStacking, Kicks])
def test_environments_step(make: Callable[[], Environment[Any, Any]]) -> None:
    env = make()
    action = Action(
        jnp.int32(3), jnp.zeros(env.action_spec.position_dim, jnp.float32), jnp.bool_(False)
    )

    def two_steps(key: jax.Array) -> Any:
        obs, state = env.reset(key, env.default_params)
        return obs, state, env.step(key, state, action, env.default_params)

    assert_same_dtypes(two_steps, jax.random.key(0))


@pytest.mark.slow  # A minute: MJX's program is compiled twice.
@pytest.mark.contract
def test_towers_are_drawn_and_simulated_by_mjx_with_the_same_bits() -> None:
    def placed() -> Any:
        env = ShapeStacking(physics=Mjx(settle_steps=3, num_slots=4), has_shadows=True)
        params = env.default_params
        start = jax.jit(env.reset)(jax.random.key(3), params)
        action = Action(jnp.int32(5), jnp.full(1, 0.1, jnp.float32), jnp.bool_(False))
        return start, jax.jit(env.step)(jax.random.key(4), start[1], action, params)

    assert_same_bits(placed)


SMOKE = "--budget=smoke"
# Under each switch alone, and, where programs compile for long, under both.
COMMANDS: dict[str, tuple[dict[str, str], list[tuple[str, ...]]]] = {
    **{
        f"{name} {title}": (switch, commands)
        for title, switch in (("x64", X64), ("strict", STRICT))
        for name, commands in (
            ("grid_world", [("train", "--representation=hvae"), ("evaluate",)]),
            ("grid_world one-hot", [("embed", "--representation=hvae-onehot")]),
            ("grid_world sweep", [("sweep", "--representation=gt5", "--seeds=1,2")]),
            ("kicks", [("train", "--task=examples.kicks:TASK", "--representation=hvae")]),
            (
                "recommender",
                [("train", "--task=recommender", "--representation=product"), ("evaluate",)],
            ),
        )
    },
    "create": (
        X64 | STRICT,
        [
            ("train", "--task=create", "--representation=hvae", "--workers=1"),
            ("evaluate", "--workers=1"),
        ],
    ),
    "shape_stacking": (
        X64 | STRICT,
        [
            (
                *("train", "--task=shape_stacking", "--representation=gt21"),
                *("--set=num_updates=1",),
            ),
            ("evaluate",),
        ],
    ),
    "shape_stacking images": (
        X64 | STRICT,
        [
            (
                *("embed", "--task=shape_stacking", "--representation=hvae", "--recordings=1"),
                "--set=model.recordings_per_action=1",
            )
        ],
    ),
}


@pytest.mark.slow  # Some six minutes for all of them.
@pytest.mark.integration
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_work_and_save_32_bits(name: str, tmp_path: Path) -> None:
    switches, commands = COMMANDS[name]
    path = tmp_path / "run"
    for module, *flags in commands:
        of_run = (f"--run={path}", "--sets=test", "--episodes=4")
        new = (SMOKE, f"--workdir={path}", f"--runs={tmp_path / 'runs'}")
        more = of_run if module == "evaluate" else new
        run_alone(module, *flags, *more, environment=ENVIRONMENT | switches)
    for member in sorted(path.glob("members/*")) or [path]:
        assert {x.dtype for x in parameters(member).values()} == {np.dtype(np.float32)}
