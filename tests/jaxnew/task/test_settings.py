"""One tree of settings: what can be set, in which ranges, and that it arrives."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs_host.create.config import VERSION as CREATE_VERSION
from envs_host.create.config import CreateConfig, CreateRules, PhysicsConfig, RewardConfig
from envs_host.create.hosting import CreateHost
from envs_host.pool import PoolSettings
from envs_mjx.shape_stacking import ShapeStacking
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.table import engineered_table
from jaxnew.storage.config import ConfigError, differences
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from jaxnew.task.settings import (
    EmbedConfig,
    TrainConfig,
    check_seed,
    identity,
    only_computed,
    read_train_config,
    upgraded,
    with_set,
    with_settings,
)
from jaxnew.task.task import Task
from jaxnew.training import train_config
from tests import toy_device, toy_task

RECORDED = json.loads((Path(__file__).parent / "recorded_configs.json").read_text())
NOT_SET = (
    *("task", "method", "representation", "table_hash", "split", "split_seed", "split_hash"),
    *("seed", "trained_on", "start", "environment_version"),
)


def config_of(task: Task, seed: int = 1, method: str = "ours") -> TrainConfig:
    """Of a run on the first engineered vectors."""
    domain = Domain.of(task)
    name = next(iter(domain.universe.engineered))
    table = engineered_table(domain.universe, name)
    return train_config(domain, method, name, table, task.budget("smoke"), seed)


LADDER = config_of(toy_device.TASK)
EMBED = EmbedConfig(
    task="toy-ladder",
    representation="hvae",
    split="default",
    split_hash="a",
    observations_hash="b",
    seed=31,
    train_on="train",
    model=RepresentationConfig(),
)


def leaves(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """(path, value) of every field that is no group."""
    for field in fields(config):
        value, name = getattr(config, field.name), f"{path}{field.name}"
        if is_dataclass(value):
            yield from leaves(value, f"{name}.")
        else:
            yield name, value


# What can be set.

numbers = st.floats(1e-6, 1e6)
CHOICES = {
    "num_updates": st.integers(1, 10**9),
    "num_clusters": st.integers(0, 50),
    "conditions_position": st.booleans(),
    "network.state_width": st.integers(1, 999),
    "ppo.num_epochs": st.integers(1, 9),
    "ppo.max_grad_norm": numbers,
    "ppo.rollout.normalize_rewards": st.booleans(),
    "sets.size": st.integers(1, 99),
    "sets.is_fixed": st.just(False),  # A fixed set has no clusters.
    "hyperparameters.learning_rate": st.floats(0, 1),
    "hyperparameters.entropy_coefficient": st.floats(0, 1e9),
    "hyperparameters.discount": st.floats(0, 1),
    "hyperparameters.failure_coefficient": numbers,
    "hyperparameters.representation_noise": numbers,
    "loop.evaluate_every": st.integers(1, 99),
    "loop.evaluation_set_size": st.integers(0, 99),
    "environment.time_limit": st.integers(1, 9),
    "environment.reward_scale": st.floats(-1e9, 1e9),
    "environment.is_inverted": st.booleans(),
}


@pytest.mark.property
@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.dictionaries(st.sampled_from(sorted(CHOICES)), st.none()).flatmap(
        lambda names: st.fixed_dictionaries({name: CHOICES[name] for name in names})
    )
)
def test_texts_and_values_are_set_alike(values: dict[str, Any]) -> None:
    typed = with_set(LADDER, values)
    assert typed == with_set(LADDER, [f"{path}={value}" for path, value in values.items()])
    found = dict(leaves(typed))
    assert {path: found[path] for path in values} == values
    changed = {path for path, _, _ in differences(identity(LADDER), identity(typed))}
    assert changed == {
        path for path, value in values.items() if value != dict(leaves(LADDER))[path]
    }
    assert type(typed) is type(LADDER)


@pytest.mark.unit
@pytest.mark.parametrize("config", [LADDER, config_of(load_task("create-push")), EMBED])
def test_every_field_can_be_set_but_those_that_follow(config: Any) -> None:
    given: dict[str, Any] = {}
    for path, value in leaves(config):
        if path in (*NOT_SET, "observations_hash", "train_on"):
            for assignments in ({path: value}, [f"{path}={value}"], {path: "other"}):
                with pytest.raises(ConfigError, match=rf"^{path} cannot be set; .*"):
                    with_set(config, assignments)
        elif value is not None:
            assert with_set(config, {path: value}) == config
            given[path] = value
    assert len(given) > 8
    assert with_set(config, given) == config


@pytest.mark.unit
@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("task", "give --task"),
        ("method", "give --method"),
        ("representation", "give --representation"),
        ("split", "give --split"),
        ("split_seed", "give --split_seed"),
        ("seed", "give --seed"),
        ("table_hash", "it follows from what is trained on what"),
        ("split_hash", "it follows from what is trained on what"),
        ("trained_on", "it follows from what is trained on what"),
        ("start", "it follows from what is trained on what"),
    ],
)
def test_what_follows_says_from_what(path: str, says: str) -> None:
    with pytest.raises(ConfigError, match=f"{path} cannot be set; {says}"):
        with_set(LADDER, [f"{path}=1"])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"hyperparameters.learning_rate": -1.0}, r"learning_rate=-1.0 must be in \[0, 1\]"),
        ({"hyperparameters.learning_rate": 1.5}, r"learning_rate=1.5 must be in \[0, 1\]"),
        ({"hyperparameters.discount": 2.0}, r"discount=2.0 must be in \[0, 1\]"),
        ({"hyperparameters.gae_lambda": -0.1}, r"gae_lambda=-0.1 must be in \[0, 1\]"),
        ({"hyperparameters.clip": -1.0}, "clip=-1.0 must be at least 0"),
        ({"hyperparameters.entropy_coefficient": -1.0}, "entropy_coefficient=-1.0 must be at"),
        ({"hyperparameters.value_coefficient": -1.0}, "value_coefficient=-1.0 must be at least 0"),
        ({"hyperparameters.clip": float("nan")}, "must be a finite float"),
        ({"hyperparameters.representation_noise": -0.1}, "representation_noise=-0.1 must be at"),
        ({"network.state_width": 0}, "state_width=0 must be at least 1"),
        ({"network.utility_width": -3}, "utility_width=-3 must be at least 1"),
        ({"num_updates": 0}, "num_updates=0 must be at least 1"),
        ({"num_clusters": -1}, "num_clusters=-1 must be at least 0"),
        ({"num_clusters": 3, "sets.is_fixed": True}, "num_clusters=3 needs sets that are drawn"),
        ({"sets.size": 0}, "size=0 must be at least 1"),
        ({"loop.chunk_updates": 0}, "chunk_updates=0 must be at least 1"),
        ({"loop.evaluation_set_size": -1}, "evaluation_set_size=-1 must be at least 0"),
        ({"ppo.max_grad_norm": 0.0}, "max_grad_norm=0.0 must be positive"),
        ({"ppo.rollout.num_envs": 0}, "num_envs=0 must be at least 1"),
        ({"environment.time_limit": 0}, "time_limit=0 must be 1 or more"),
        ({"environment.is_hard": True}, "environment.is_hard does not exist"),
        ({"environment.reward_scal": 2.0}, r"Did you mean environment\.reward_scale\?"),
        (
            {"environment.reward_scale": "much"},
            "environment.reward_scale must be float, got 'much'",
        ),
        ({"environment": "hard"}, "environment is a group of fields; set one of them"),
        ({"pool": "many"}, "pool has nothing to set, got 'many'"),
        ({"pool.timeout_s": 5.0}, "pool is None in this configuration"),
    ],
)
def test_ranges_and_names(changes: dict[str, Any], says: str) -> None:
    texts = [f"{path}={value}" for path, value in changes.items()]
    for assignments in (changes, texts):
        with pytest.raises(ConfigError, match=says):
            with_set(LADDER, assignments)


@pytest.mark.unit
def test_the_last_value_counts() -> None:
    texts = ["environment.reward_scale=2", "num_updates=9", "environment.reward_scale=3"]
    once = with_set(LADDER, texts)
    assert (once.environment.reward_scale, once.num_updates) == (3.0, 9)
    again = with_set(once, {"environment.reward_scale": 4.0})
    assert again == with_set(LADDER, ["num_updates=9", "environment.reward_scale=4"])
    with pytest.raises(ConfigError, match=r"must look like path.to.field=value"):
        with_set(LADDER, ["environment.reward_scale"])
    with pytest.raises(ConfigError, match=r"environment\.x cannot be set: environment is None"):
        with_set(config_of(toy_task.TASK), ["environment.x=2"])


@pytest.mark.unit
@pytest.mark.parametrize("seed", [2**32, -1, True, 1.5, "1", None, np.int64(3)])
def test_seeds_are_taken_whole_or_refused(seed: Any) -> None:
    for make in (
        lambda: check_seed(seed),
        lambda: replace(LADDER, seed=seed),
        lambda: replace(LADDER, split_seed=seed),
        lambda: replace(EMBED, seed=seed),
        lambda: config_of(toy_device.TASK, seed=seed),
    ):
        with pytest.raises(ConfigError, match=r"seed=.* must be an integer in 0\.\.4294967295"):
            make()
    for legal in (0, 2**32 - 1):
        assert check_seed(legal) == legal
        assert replace(LADDER, seed=legal).seed == legal


# Where it arrives.

# Another legal value of every setting of the domains inside jit, and of some on the host.
OTHER: dict[str, dict[str, Any]] = {
    "grid_world": {
        "max_moves": 20,
        "subgoal_reward": 0.5,
        "goal_reward": 2.0,
        "time_penalty": 0.1,
        "fixed_layout": 3,
    },
    "recommender": {"max_recommendations": 7},
    "shape_stacking-2d-place": {
        "physics": "mjx",
        "reward_variant": "paper",
        "has_shadows": True,
        "max_actions": 4,
    },
}


def described(env: Any) -> list[Any]:
    """All that an environment inside jit was made from, in a form that can be compared."""
    found = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(env.default_params)]
    if isinstance(env, ShapeStacking):
        found += [env.position_dim, env.engine.name, env._settings]
    return found


@pytest.mark.unit
@pytest.mark.parametrize("name", sorted(OTHER))
def test_settings_reach_environments_inside_jit(name: str) -> None:
    """One at a time; and back, so that only the setting made the difference."""
    config, task = config_of(load_task(name)), load_task(name)
    assert OTHER[name].keys() == {field.name for field in fields(task.environment)}
    published = described(with_settings(task, config).environment_of())
    for field, value in OTHER[name].items():
        changed = with_set(config, {f"environment.{field}": value})
        configured = with_settings(task, changed)
        assert getattr(configured.environment, field) == value
        env = configured.environment_of()
        assert described(env) != published, field
        found = differences(identity(config), identity(changed))
        assert [path for path, _, _ in found] == [f"environment.{field}"]
        default = getattr(task.environment, field)
        assert with_set(changed, {f"environment.{field}": default}) == config
    assert described(with_settings(task, config).environment_of()) == published
    if name.startswith("shape_stacking"):
        on_the_host = with_set(config, ["environment.physics=mujoco"])
        stacking: Any = with_settings(task, on_the_host).environment_of()
        assert (stacking.engine.name, stacking.position_dim) == ("mujoco_c", 2)


@pytest.mark.unit
def test_settings_reach_pools_on_the_host() -> None:
    task = load_task("create-push")
    assert task.host is not None
    received: dict[str, Any] = {}

    def make_pool(**arguments: Any) -> Any:
        received.update(arguments)
        raise KeyboardInterrupt

    assignments = [
        "environment.step_limit=7",
        "environment.physics.gravity=1.5",
        " environment.rewards.goal = 3",
        "pool.timeout_s=5",
        "pool.on_worker_death=restart",
    ]
    changed = with_settings(task, with_set(config_of(task), assignments))
    assert changed.host is not None
    host = replace(changed.host, make_pool=make_pool)
    environments = host.environments(4, 7, 2, changed.environment)
    # A level's limit of steps, and one action more.
    assert environments.max_episode_steps == 8
    with pytest.raises(KeyboardInterrupt):
        environments.start()
    assert received.pop("settings") == PoolSettings(on_worker_death="restart", timeout_s=5.0)
    assert received.pop("environment") == CreateRules(
        physics=PhysicsConfig(gravity=1.5), rewards=RewardConfig(goal=3.0), step_limit=7
    )
    assert received == {"num_envs": 4, "num_halves": 2, "num_workers": 2, "seed": 7}
    same = replace(changed, host=task.host, environment=task.environment)
    assert same == task, "nothing else of the task changes"


@pytest.mark.unit
def test_rules_of_create_change_what_happens() -> None:
    """The no-op over and over, in the environment that workers run: a limit ends it earlier, and
    what an action is paid for being alive shows."""

    def rewards_under(rules: CreateRules) -> list[float]:
        plain = {**dataclasses.asdict(rules), "action_ids": "universe"}
        host = CreateHost("Push", config=plain)
        host.reset(np.random.SeedSequence(1))
        rewards, is_over = [], False
        while not is_over:
            step = host.step(CreateConfig().no_op_id, np.zeros(2, np.float32))
            rewards.append(step.reward)
            is_over = step.terminated or step.truncated
        return rewards

    task = load_task("create-push")
    config = config_of(task)
    published = rewards_under(config.environment)
    limited = with_set(config, {"environment.step_limit": 1, "environment.stop_speed": 0.0})
    assert len(rewards_under(limited.environment)) == 2
    paid = with_set(config, {"environment.rewards.alive": 0.5})
    assert rewards_under(paid.environment)[0] == pytest.approx(published[0] + 0.49)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"pool.on_worker_deth": "restart"}, r"Did you mean pool\.on_worker_death\?"),
        ({"pool.on_worker_death": "again"}, r"pool\.on_worker_death must be one of 'raise', 'res"),
        ({"pool.timeout_s": "soon"}, r"pool\.timeout_s must be float, got 'soon'"),
        ({"pool.timeout_s": 0}, "timeout_s=0.0 must be above 0 seconds"),
        ({"pool.max_restarts": -1}, "max_restarts=-1 must be 0 or more"),
        ({"pool": "restart"}, r"pool is a group of fields; set one of them: pool\.on_worker_death"),
        ({"environment.rewards": "many"}, "environment.rewards is a group of fields"),
        ({"environment.move_threshold": 2.0}, "move_threshold=2.0 must be from 0 to 1"),
    ],
)
def test_wrong_settings_of_a_pool(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        with_set(config_of(load_task("create-ladder")), changes)


@pytest.mark.unit
def test_how_a_run_is_computed_is_no_part_of_it() -> None:
    config = config_of(load_task("create-push"))
    restarting = with_set(config, {"pool.on_worker_death": "restart"})
    assert restarting != config
    assert identity(restarting) == identity(config)
    assert "pool" not in identity(config)
    assert json.loads(json.dumps(identity(config))) == identity(config)
    assert only_computed(config, ["pool.on_worker_death=restart"]) == restarting
    for assignments in (["num_updates=3"], {"environment.step_limit": 3}):
        with pytest.raises(ConfigError, match=r"the run is there; only pool\.FIELD=value can be"):
            only_computed(config, assignments)
    with pytest.raises(ConfigError, match="pool is None"):
        only_computed(LADDER, ["pool.timeout_s=5"])


# What is read.


@pytest.mark.unit
def test_a_config_survives_json() -> None:
    for task in (toy_device.TASK, load_task("create-push-no-subgoals")):
        config = with_set(config_of(task), {"num_updates": 3, "ppo.num_epochs": 2})
        plain = json.loads(json.dumps(identity(config)))
        assert upgraded(plain) == plain
        assert read_train_config(plain, task) == (config, task)
    # And the task is found again.
    assert read_train_config(identity(LADDER))[1] == toy_device.TASK


@pytest.mark.golden
@pytest.mark.parametrize("recorded", RECORDED, ids=lambda recorded: recorded["task"])
def test_configs_of_the_revision_before_are_read(recorded: dict[str, Any]) -> None:
    """Written by revision 0be589c at smoke budget: sets were part of the rollout, and settings of
    the environment were texts."""
    task = load_task(recorded["task"])
    expected = config_of(task, seed=31, method=recorded["method"])
    if recorded["task"] == "shape_stacking-2d-place":
        assert recorded["environment"][0] == "environment.physics=mujoco"
        changes = {"physics": "mujoco", "reward_variant": "paper"}
        expected = with_set(expected, {f"environment.{k}": v for k, v in changes.items()})
        expected = with_set(expected, {"num_updates": 3})
    if recorded["task"] == "create-push-no-subgoals":
        expected = with_set(expected, {"sets.padded_size": 60})
        # Before CREATE's errata.
        expected, task = (replace(value, environment_version=0) for value in (expected, task))
    assert "set_size" in recorded["ppo"]["rollout"]
    before = json.dumps(recorded)
    assert differences(upgraded(recorded), identity(expected)) == []
    assert read_train_config(recorded, task) == (expected, task)
    assert json.dumps(recorded) == before, "what was read is left alone"
    assert "network" not in recorded
    assert "representation_noise" not in recorded["hyperparameters"]
    older = {k: v for k, v in recorded.items() if k not in ("num_clusters", "conditions_position")}
    assert upgraded(older) == upgraded(recorded)
    if not recorded["environment"]:
        del older["environment"]
        assert upgraded(older) == upgraded(recorded)
    assert upgraded({"members": [recorded, older]}) == {"members": [identity(expected)] * 2}


@pytest.mark.unit
def test_configs_of_encoders_are_read() -> None:
    recorded = identity(EMBED)
    del recorded["split_seed"]
    assert upgraded(recorded) == identity(EMBED)
    of_0_3_0 = dict(list(recorded["model"].items())[:11])  # All that it had, the paper's settings.
    assert upgraded({**recorded, "model": of_0_3_0}) == identity(EMBED)
    assert upgraded(identity(replace(EMBED, split_seed=4)))["split_seed"] == 4
    with pytest.raises(ConfigError, match="no run of a policy: its config has no ppo and task"):
        read_train_config(recorded)


@dataclass(frozen=True)
class OtherSettings:
    """Of another task than the run's."""

    height: int = 3


@pytest.mark.unit
def test_a_run_of_another_version_of_the_environment_is_refused() -> None:
    old = next(recorded for recorded in RECORDED if recorded["task"] == "create-push-no-subgoals")
    says = r"version 0 of the environment of create-push-.*, which is version 1 now .*: train again"
    for plain in (old, {**identity(config_of(load_task(old["task"]))), "environment_version": 0}):
        with pytest.raises(ConfigError, match=says):
            read_train_config(plain)
    newer = {**identity(LADDER), "environment_version": 2}
    with pytest.raises(ConfigError, match=r"version 2 of .* which is version 0 now"):
        read_train_config(newer)


@pytest.mark.contract
@pytest.mark.parametrize("name", ["grid_world", "recommender", "shape_stacking", "create-push"])
def test_versions_of_environments_are_those_in_their_names(name: str) -> None:
    task = load_task(name)
    version = CREATE_VERSION if task.host else int(task.environment_of().name.rpartition("-v")[2])
    assert task.environment_version == version
    assert config_of(task).environment_version == version


@pytest.mark.unit
def test_a_run_of_another_task_is_refused() -> None:
    plain = identity(LADDER)
    with pytest.raises(ConfigError, match=r"environment\..* does not exist"):
        read_train_config(plain, replace(toy_device.TASK, environment=OtherSettings()))
    with pytest.raises(UsageError, match="Unknown task 'ladder'"):
        read_train_config({**plain, "task": "ladder"})
    assert config_of(toy_task.TASK).environment is None
