"""CREATE through the commands at smoke budget: train, save, load and evaluate.

Every level, and on top every method, representation and variant: `RUNS` gives each of them to a
level. Then fine-tuning, and the studies of the analysis. What is made as elsewhere is `slow`.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_host.create.levels import TASK_NAMES, load_level
from envs_host.create.tools import (
    analysis_split,
    angle_test_ids,
    embedding_test_ids,
    mix_ids,
    published_split,
    tool_universe,
)
from jaxnew.actions import ActionSplit
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from tests.experiments.commands import ROOT, of_new_actions, read_json, run
from tests.experiments.create_probes import acted
from tests.experiments.create_runs import parameters
from tests.experiments.several import run_several

pytestmark = pytest.mark.integration

WIDTH = 32  # Of every representation, so that policies share their programs.
EPISODES = 6
ACTED_IDS = "tests.experiments.create_probes:acted_ids"
COMMON = ("--budget=smoke", "--workers=1")  # Of `train` and `finetune`.
EMBED = "create/embed-{}-default-smoke-31"
POOL = ("--set=pool.on_worker_death=restart", "--set=pool.max_restarts=3")
SHORT = ("--set=num_updates=1", "--set=loop.evaluation_episodes=2")


Job = tuple[str, ...]


@dataclass(frozen=True)
class Run:
    """A run of `train`; `representation` may be a path below the folder of all runs."""

    task: str
    method: str = "ours"
    representation: str = "gt32"
    flags: tuple[str, ...] = SHORT
    split: str = "default"


# An engineered table, a fixed set, and the other list of tools.
FEW = {
    "push": Run("create-push", flags=()),
    "moving": Run("create-moving", "nearest-neighbour"),
    "analysis": Run("create-push-analysis"),
}
OTHERS = {
    "obstacle": Run("create-obstacle", representation=EMBED.format("hvae")),
    "collide": Run("create-collide", "continuous"),
    "seesaw": Run("create-seesaw", representation=EMBED.format("vae")),
    "navigate": Run("create-navigate", representation=EMBED.format("hvae-oracle")),
    "ladder": Run("create-ladder", representation=EMBED.format("hvae-position")),
    "cannon": Run("create-cannon", representation="mine.npz"),
    "belt": Run("create-belt", "no-entropy"),
    "buckets": Run("create-buckets", "random"),
    "basket": Run("create-basket", "no-subsampling"),
    "funnel": Run("create-funnel", "modulated", "random-32"),
    "conditioned": Run("create-push", flags=(*SHORT, "--set=conditions_position=true")),
    "no-subgoals": Run("create-push-no-subgoals"),
    "full": Run("create-push", flags=(*SHORT, "--split=full"), split="full"),
}
RUNS = FEW | OTHERS
NAMES = [*FEW, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
HIT_REWARD = {"create-obstacle": 2.0, "create-push-no-subgoals": 0.0}


def split_of(name: str) -> ActionSplit:
    return analysis_split() if name == "analysis" else published_split(RUNS[name].split)


def embed(folder: Path, *names: str) -> None:
    jobs = []
    for name in names:
        size = "observation_latent" if name == "vae" else "action_latent"
        flags = (f"--representation={name}", f"--set=model.{size}={WIDTH}", f"--runs={folder}")
        # As many as a step of training takes; most of the time is for recording 2,366 tools.
        flags = (*flags, "--recordings=2")
        jobs.append(("--task=create-push", "--budget=smoke", *flags))
    run_several("embed", jobs)


def train(runs: Path, names: Iterable[str]) -> dict[str, str]:
    """What `train` prints for each of `RUNS`."""
    jobs = []
    for name in names:
        run = RUNS[name]
        given = runs / run.representation
        representation = given if given.exists() else run.representation
        flags = (f"--representation={representation}", f"--workdir={runs / name}", *run.flags)
        jobs.append((f"--task={run.task}", f"--method={run.method}", *COMMON, *flags))
    outputs = run_several("train", jobs, probe=ACTED_IDS)
    return dict(zip(names, outputs, strict=True))


def evaluate(runs: Path, names: Iterable[str], more: Mapping[str, Job]) -> dict[str, str]:
    """What `evaluate` prints for each of `RUNS` on its test tools, and for more jobs."""
    common = (f"--episodes={EPISODES}", "--workers=1")
    jobs = [*((f"--run={runs / name}", *common) for name in names), *more.values()]
    outputs = run_several("evaluate", jobs, probe=ACTED_IDS)
    return dict(zip([*names, *more], outputs, strict=True))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all runs."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def encoders(runs: Path) -> Path:
    """The same with recordings, four encoders, and a table of the user's own."""
    embed(runs, "hvae", "vae", "hvae-oracle", "hvae-position")
    vectors = np.random.default_rng(0).normal(size=(tool_universe().num_actions, WIDTH))
    np.savez(runs / "mine.npz", ids=np.arange(len(vectors)), vectors=vectors)
    return runs


@pytest.fixture(scope="module")
def trained_few(runs: Path) -> dict[str, str]:
    return train(runs, FEW)


@pytest.fixture(scope="module")
def trained_all(trained_few: dict[str, str], encoders: Path) -> dict[str, str]:
    return trained_few | train(encoders, OTHERS)


@pytest.fixture(scope="module")
def evaluated_few(runs: Path, trained_few: dict[str, str]) -> dict[str, str]:
    """Also of `push` in a world without subgoals."""
    assert trained_few
    twin = runs / "twin"
    shutil.copytree(runs / "push", twin)
    config = read_json(twin / "config.json")
    config["task"] = "create-push-no-subgoals"
    config["environment"]["rewards"]["with_subgoals"] = False
    (twin / "config.json").write_text(json.dumps(config))
    provenance = read_json(twin / "provenance.json")
    del provenance["config_hash"]
    (twin / "provenance.json").write_text(json.dumps(provenance))
    flags = ("--sets=train", "--episodes=20")
    more = {f"{name} on train": (f"--run={runs / name}", *flags) for name in ("push", "twin")}
    return evaluate(runs, FEW, more)


def new_tools(runs: Path) -> Job:
    """Records and encodes tools as the page on new actions does; the flags of its `evaluate`."""
    paths = {
        "runs/create/embed-hvae-state-default-laptop-31": runs / EMBED.format("hvae"),
        "runs/create-push/ours-hvae-state-default-short-31": runs / "obstacle",
    }
    (_, _, collect, encode, evaluate, _) = of_new_actions("CREATE", runs, paths)
    assert "200 actions x 4 recordings" in run(*collect)
    assert f"200 actions, {WIDTH} numbers each" in run(*encode)
    assert evaluate[0] == "evaluate"
    return (*evaluate[1:], f"--episodes={EPISODES}", "--workers=1")


@pytest.fixture(scope="module")
def evaluated_others(runs: Path, trained_all: dict[str, str]) -> dict[str, str]:
    """Also of `obstacle` with new tools."""
    assert trained_all
    return evaluate(runs, OTHERS, {"new tools": new_tools(runs)})


@pytest.fixture
def trained(request: pytest.FixtureRequest, name: str) -> str:
    """What `train` printed for a run."""
    outputs = request.getfixturevalue("trained_few" if name in FEW else "trained_all")
    output: str = outputs[name]
    return output


@pytest.fixture
def evaluated(request: pytest.FixtureRequest, name: str) -> str:
    """What `evaluate` printed for a run."""
    outputs = request.getfixturevalue("evaluated_few" if name in FEW else "evaluated_others")
    output: str = outputs[name]
    return output


def evaluation(path: Path, name: str = "test") -> dict[str, Any]:
    (file,) = (path / "evaluation").glob(f"{name}-best-sampled-m*.json")
    found: dict[str, Any] = read_json(file)
    return found


def means(path: Path, name: str = "test") -> dict[str, float]:
    return {key: row["mean"] for key, row in evaluation(path, name)["metrics"].items()}


@pytest.mark.slow
def test_new_tools_are_recorded_encoded_and_placed(
    runs: Path, evaluated_others: dict[str, str]
) -> None:
    """Paper algorithm 2: a policy of 15-degree tools with tools between them."""
    output = evaluated_others["new tools"]
    assert "200 actions of Create-3deg-v0, 0 seen in training, e.g. ramp e=0.1 a=3 " in output
    ids = np.loadtxt(ROOT / "examples" / "tools_3_degrees.txt", int)
    no_op = tool_universe(3).num_actions - 1
    assert acted(output) <= {*ids.tolist(), no_op}
    assert acted(output) - {no_op}
    found = evaluation(runs / "obstacle", "table-new_tools_table-*")
    assert (found["num_actions"], found["num_seen"], found["num_episodes"]) == (200, 0, EPISODES)
    known = {*tool_universe().action_hashes}
    assert not known & {tool_universe(3).action_hashes[i] for i in ids}


def test_every_level_is_there() -> None:
    levels = {run.task.split("-")[1] for run in RUNS.values()}
    assert levels == {level.lower() for level in TASK_NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_a_run_is_trained_and_saved(runs: Path, trained: str, name: str) -> None:
    run, path, split = RUNS[name], runs / name, split_of(name)
    updates = 2 if name == "push" else 1
    config = read_json(path / "config.json")
    table = RepresentationTable.load(path / "table.npz")
    assert (config["task"], config["method"], config["split"]) == (run.task, run.method, run.split)
    assert config["split_hash"] == split.hash
    assert config["table_hash"] == table.hash
    lines = metrics.read(path)
    assert [line["step"] for line in lines if "loss/total" in line] == [*range(1, updates + 1)]
    assert [line["step"] for line in lines if "validation/is_success" in line][-1] == updates
    assert Checkpointer(path / "checkpoints").steps("latest")[-1] == updates
    known = {*split.train.tolist(), *split.validation.tolist(), *split.always_available.tolist()}
    chosen = acted(trained)
    assert chosen <= known, "no test tool is used before the evaluation of test tools"
    assert chosen & {*split.train.tolist()}
    assert chosen & {*split.validation.tolist()}


@pytest.mark.parametrize("name", NAMES)
def test_a_run_is_evaluated_on_test_tools(runs: Path, evaluated: str, name: str) -> None:
    split, found, mean = split_of(name), evaluation(runs / name), means(runs / name)
    chosen = acted(evaluated)
    assert chosen <= {*split.test.tolist(), *split.always_available.tolist()}
    assert chosen & {*split.test.tolist()}
    assert (found["num_episodes"], found["num_actions"]) == (EPISODES, len(split.test))
    assert found["set_size"] == 5
    assert found["step"] in (1, 2)
    for metric, row in found["metrics"].items():
        assert row["low"] <= row["mean"] <= row["high"], metric
    assert all(0.0 <= mean[metric] <= 1.0 for metric in ("is_success", "target_hit"))
    longest = load_level(RUNS[name].task.split("-")[1].capitalize()).step_limit + 1
    assert 1.0 <= mean["num_steps"] == mean["episode_length"] <= longest
    counted = mean["num_placed"] + mean["num_blocked"] + mean["num_no_op"]
    assert counted == pytest.approx(mean["num_steps"], abs=1e-5)
    # docs/create.md, "Rewards": 0.01 for each action not blocked, subgoals, the target's hit; up to
    # 10 for the goal.
    certain = 0.01 * (mean["num_steps"] - mean["num_blocked"]) + mean["subgoal_reward"]
    certain += HIT_REWARD.get(RUNS[name].task, 1.0) * mean["target_hit"]
    above = mean["episode_return"] - certain
    assert -1e-5 <= above <= 10.0 * mean["is_success"] + 1e-5


@pytest.mark.slow
def test_what_methods_are_made_of(runs: Path, trained_all: dict[str, str]) -> None:
    assert trained_all
    config = {name: read_json(runs / name / "config.json") for name in RUNS}
    size = {
        name: {key: value.shape for key, value in parameters(runs / name).items()}
        for name in ("push", "buckets", "collide", "moving", "basket", "conditioned")
    }
    num_train = len(published_split().train) + 1
    entropy = {name: config[name]["hyperparameters"]["entropy_coefficient"] for name in RUNS}
    assert {name for name, value in entropy.items() if value == 0.0} == {"belt"}
    fixed = {name for name in RUNS if config[name]["sets"]["is_fixed"]}
    assert fixed == {"moving", "basket"}
    assert size["basket"] == size["push"], "the utility takes any number of tools"
    assert size["buckets"] == size["push"], "a random policy has heads for positions all the same"
    assert size["moving"]["policy.logits.kernel"] == (64, num_train)
    assert not [key for key in size["moving"] if key.startswith("utility")]
    assert config["collide"]["ppo"]["rollout"]["num_steps"] == 8, "2/3 of 12"
    assert size["collide"]["policy.mean.kernel"] == (64, WIDTH)
    assert not [key for key in size["collide"] if key.startswith("utility")]
    assert size["push"]["auxiliary.heads.alpha.kernel"] == (64, 2)
    assert size["conditioned"]["auxiliary.alpha.kernel"] == (128, 64), "[f(s), a]"


@pytest.mark.slow
def test_representations_are_those_that_were_asked_for(
    runs: Path, trained_all: dict[str, str]
) -> None:
    assert trained_all
    used = {name: RepresentationTable.load(runs / name / "table.npz") for name in RUNS}
    embedded = {name: run.representation for name, run in RUNS.items() if "/" in run.representation}
    for name, representation in embedded.items():
        config = read_json(runs / representation / "config.json")
        assert config["train_on"] == ("all" if "oracle" in representation else "train")
        assert used[name].hash == RepresentationTable.load(runs / representation / "table.npz").hash
        assert metrics.read(runs / representation)[-1]["step"] == 4
    mine = np.load(runs / "mine.npz")["vectors"].astype(np.float32)
    np.testing.assert_array_equal(used["cannon"].vectors, mine)
    np.testing.assert_array_equal(used["push"].vectors, tool_universe().engineered["gt32"])
    assert used["funnel"].vectors.shape == (2366, WIDTH)
    assert used["analysis"].vectors.shape == (10_877, 32)
    names = (*embedded, "cannon", "push", "funnel", "analysis")
    assert len({used[name].hash for name in names}) == len(names), "no two are the same"
    assert all(np.isfinite(used[name].vectors).all() for name in names)


def test_subgoals_and_hits_are_worth_nothing_without_them(
    runs: Path, evaluated_few: dict[str, str]
) -> None:
    """The same policy does the same in both worlds, and is paid for the target's hit in one."""
    assert acted(evaluated_few["push on train"]) == acted(evaluated_few["twin on train"])
    with_hits, without = means(runs / "push", "train"), means(runs / "twin", "train")
    assert with_hits["target_hit"] > 0.0
    paid = with_hits.pop("episode_return") - without.pop("episode_return")
    assert paid == pytest.approx(with_hits["target_hit"], abs=1e-5)
    assert with_hits == without


SOURCES = {"ours": "push", "nearest-neighbour": "moving"}
KINDS = [(method, start) for method in SOURCES for start in ("warm", "scratch")]


@pytest.mark.parametrize(
    "kinds", [KINDS[:2], pytest.param(KINDS[2:], marks=pytest.mark.slow)], ids=list(SOURCES)
)
def test_finetuning_of_each_kind(
    runs: Path, trained_few: dict[str, str], tmp_path: Path, kinds: list[tuple[str, str]]
) -> None:
    """Both policies, warm and from scratch, with all test tools as one set."""
    assert trained_few
    jobs = []
    for method, start in kinds:
        flags = ("--seed=7", *POOL, *(["--scratch"] if start == "scratch" else []))
        workdir = f"--workdir={tmp_path / f'{method}-{start}'}"
        jobs.append((f"--run={runs / SOURCES[method]}", *COMMON, *flags, workdir))
    outputs = run_several("finetune", jobs, probe=ACTED_IDS)
    split = published_split()
    test = {*split.test.tolist(), *split.always_available.tolist()}
    for (method, start), output in zip(kinds, outputs, strict=True):
        path = tmp_path / f"{method}-{start}"
        config = read_json(path / "config.json")
        assert acted(output) <= test
        assert "restarts: [3]" in output
        assert config["trained_on"] == "test"
        assert config["method"] == {"ours": "no-subsampling"}.get(method, method)
        assert config["start"] == {"warm": f"{method}, seed 31"}.get(start, "fresh parameters")
        assert metrics.read(path)[-1]["step"] == 1
        found, source = parameters(path), parameters(runs / SOURCES[method])
        moved = {
            k: np.abs(found[k] - source[k]).max() for k in found if k in source and k[0] in "ce"
        }
        # At most 12 steps of Adam by about 1e-3 each, against parameters of another seed.
        assert (max(moved.values()) < 0.02) == (start == "warm")
        if method == "nearest-neighbour":
            assert found["policy.logits.kernel"].shape == (64, len(split.test) + 1)


Expected = Callable[[np.ndarray], np.ndarray]
STUDIES: dict[str, tuple[str, Expected]] = {
    "angle": ("15", lambda table: angle_test_ids(15)),
    "angle-per-class": ("9", lambda table: angle_test_ids(9, per_class=True)),
    "embedding": ("2.5", lambda table: embedding_test_ids(table, 2.5)),
    "mix": ("0.4", lambda table: mix_ids(table, 0.4, 0)),
}


@pytest.mark.parametrize(
    "names",
    [["embedding"], pytest.param(["angle", "angle-per-class", "mix"], marks=pytest.mark.slow)],
    ids="-".join,
)
def test_studies_of_the_analysis(
    runs: Path, trained_few: dict[str, str], tmp_path: Path, names: list[str]
) -> None:
    assert trained_few
    path = runs / "analysis"
    jobs = [
        (
            f"--study={name}",
            f"--run={path}",
            f"--values={STUDIES[name][0]}",
            "--episodes=4",
            f"--out={tmp_path}",
        )
        for name in names
    ]
    outputs = run_several("analyze", jobs, probe=ACTED_IDS)
    table = RepresentationTable.load(path / "table.npz").vectors
    for name, output in zip(names, outputs, strict=True):
        value, expected = STUDIES[name]
        ids = expected(table)
        no_op = analysis_split().always_available
        assert acted(output) <= {*ids.tolist(), *no_op.tolist()}
        found = evaluation(path, f"{name}-{value}")
        assert (found["num_actions"], found["num_episodes"]) == (len(ids), 4)
        file = tmp_path / f"{name.replace('-', '_')}.csv"
        (row,) = csv.DictReader(file.open())
        assert float(row["mean"]) == found["metrics"]["is_success"]["mean"]
        assert file.with_suffix(".png").stat().st_size > 5_000
