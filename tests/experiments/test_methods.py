"""The methods of the paper through the commands: train, reload, evaluate, fine-tune."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jaxnew.policy.config import NetworkConfig
from jaxnew.storage import metrics
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.methods import VARIANTS, adapted, trained_ids, variant_of
from jaxnew.task.places import UsageError
from tests.experiments.commands import OPTIMIZED, ROOT, evaluation, read_json, run, run_alone
from tests.experiments.several import run_several

TASKS = ("grid_world", "recommender")


# (task, method, representation) -> sizes of the sets that train and test episodes offer.
SIZES = {
    ("grid_world", "ours", "gt12"): (50, 50),
    ("grid_world", "nearest-neighbour", "gt12"): (512, 50),
    ("grid_world", "continuous", "gt12"): (50, 50),
    ("grid_world", "no-subsampling", "gt12"): (512, 50),
    ("grid_world", "no-entropy", "random-12"): (50, 50),
    ("grid_world", "random", "gt12"): (50, 50),
    ("grid_world", "modulated", "gt12"): (50, 50),
    ("recommender", "ours", "product"): (50, 50),
}
FULL = ("recommender", "nearest-neighbour", "product-mu")
SIZES_OF_FULL = (5000, 50)
FOLDER = "{1}-{2}-default-smoke-31"
SHORT = ("--set=num_updates=1", "--set=loop.evaluation_episodes=8")
EPISODES = ("--sets=train,test", "--episodes=32")


def training(name: tuple[str, str, str], runs: Path) -> tuple[str, ...]:
    """Flags of `train`."""
    flags = (f"--task={name[0]}", f"--method={name[1]}", f"--representation={name[2]}")
    return (*flags, "--budget=smoke", f"--runs={runs}")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run for each of `SIZES`."""
    folder = tmp_path_factory.mktemp("runs")
    run_several("train", [(*training(name, folder), *SHORT) for name in SIZES])
    return folder


@pytest.fixture(scope="module")
def evaluated(runs: Path) -> Path:
    """The same, each run evaluated."""
    paths = [runs / name[0] / FOLDER.format(*name) for name in SIZES]
    run_several("evaluate", [(f"--run={path}", *EPISODES) for path in paths])
    return runs


def check_evaluations(path: Path, sizes: tuple[int, int]) -> None:
    for part, size in zip(("train", "test"), sizes, strict=True):
        result = evaluation(path, f"{part}-best-sampled-m{size}")
        assert result["set_size"] == size
        assert result["num_episodes"] == 32


@pytest.mark.integration
@pytest.mark.parametrize("name", SIZES, ids="-".join)
def test_methods_train_and_are_evaluated(evaluated: Path, name: tuple[str, str, str]) -> None:
    path = evaluated / name[0] / FOLDER.format(*name)
    config = read_json(path / "config.json")
    assert (config["task"], config["method"], config["representation"]) == name
    check_evaluations(path, SIZES[name])


@pytest.mark.integration
@pytest.mark.slow
def test_a_fixed_set_of_5000_trains_and_is_evaluated(tmp_path: Path) -> None:
    """As users run it, for it computes a lot."""
    run_alone("train", *training(FULL, tmp_path), environment=OPTIMIZED)
    path = tmp_path / FULL[0] / FOLDER.format(*FULL)
    run_alone("evaluate", f"--run={path}", *EPISODES, environment=OPTIMIZED)
    check_evaluations(path, SIZES_OF_FULL)


@pytest.mark.integration
def test_a_policy_goes_on_with_new_actions(runs: Path) -> None:
    """Both kinds of policy, warm and from scratch; the discrete head is as large as its set."""
    jobs, folders = [], []
    for method, start, flags in (
        ("ours", "warm", ()),
        ("nearest-neighbour", "scratch", ("--scratch",)),
    ):
        path = runs / "grid_world" / FOLDER.format("", method, "gt12")
        jobs.append((f"--run={path}", "--budget=smoke", *flags))
        folders.append(path / f"finetune-{start}-smoke-31")
    run_several("finetune", jobs)
    for folder in folders:
        assert read_json(folder / "config.json")["trained_on"] == "test"
        assert metrics.read(folder)[-1]["step"] == 1
    assert "cannot be fine-tuned" in run("finetune", f"--run={folder}", fails=True)


@pytest.mark.unit
def test_what_each_method_changes() -> None:
    """docs/method.md, "Baselines and ablations", on the paper's budgets."""
    for name in TASKS:
        domain = Domain.of(load_task(name), None)
        paper = domain.task.stage_two["paper"]
        found = {m: adapted(paper, m, domain.task, domain.split) for m in VARIANTS}
        assert found["ours"] == found["random"] == paper
        assert found["no-entropy"].hyperparameters.entropy_coefficient == 0.0
        assert paper.hyperparameters.entropy_coefficient > 0.0
        for fixed in ("no-subsampling", "nearest-neighbour"):
            assert found[fixed].sets.is_fixed
            assert found[fixed].num_updates == paper.num_updates
        steps = {m: b.num_updates * b.ppo.steps_per_update for m, b in found.items()}
        assert all(abs(s - steps["ours"]) <= paper.ppo.steps_per_update for s in steps.values())
    helped = (ROOT / "docs" / "commands" / "train.md").read_text()
    assert all(f" {name}," in helped for name in VARIANTS)
    with pytest.raises(UsageError, match=r"Unknown method 'our'\. Methods: ours, "):
        variant_of("our")


@pytest.mark.unit
@pytest.mark.parametrize("name", [*TASKS, "create-push", "shape_stacking"])
def test_what_a_modulated_utility_is_trained_with(name: str) -> None:
    """docs/method.md, "Modulated utility": as many steps, half the passes, eight times as many
    minibatches in each."""
    domain = Domain.of(load_task(name), None)
    for budget_name, budget in domain.task.stage_two.items():
        found = adapted(budget, "modulated", domain.task, domain.split)
        assert (found.network.state_width, found.network.utility_width) == (256, 64)
        numbers = found.hyperparameters
        assert (numbers.representation_noise, numbers.final_entropy) == (0.2, 0.1)
        assert (found.sets.size, budget.sets.training_size) == (budget.sets.size, 0)
        assert found.sets.training_size == (budget.sets.size + 1) // 2
        assert found.num_updates == budget.num_updates
        assert found.ppo.steps_per_update == budget.ppo.steps_per_update
        # Two environments of 11 steps cannot be divided by eight.
        is_odd = (name, budget_name) == ("shape_stacking", "smoke")
        times = 1 if is_odd else 8
        assert found.ppo.num_minibatches == times * budget.ppo.num_minibatches
        assert (found.ppo.num_epochs, budget.ppo.num_epochs) in ((2, 4), (2, 2))  # 2 of `smoke`.
        assert budget.network == NetworkConfig()


@pytest.mark.unit
def test_sizes_of_the_published_methods() -> None:
    """docs/method.md, "PPO": rollout lengths, minibatches and fixed sets."""
    grid, reco = (Domain.of(load_task(name), None) for name in TASKS)
    continuous = [
        adapted(d.task.stage_two["paper"], "continuous", d.task, d.split).ppo for d in (grid, reco)
    ]
    assert [ppo.rollout.num_steps for ppo in continuous] == [256, 256]
    assert [ppo.minibatch_size for ppo in continuous] == [2048, 2048]
    numbers = [
        len(trained_ids(method, d.task, d.split))
        for method in ("no-subsampling", "nearest-neighbour")
        for d in (grid, reco)
    ]
    assert numbers == [512, 2000, 512, 5000]
    fixed = trained_ids("no-subsampling", reco.task, reco.split)
    again = np.random.RandomState(42).choice(reco.split.train, 2000, replace=False)
    np.testing.assert_array_equal(fixed, again)
    assert grid.task.baselines.sums_gaussian_entropy
    assert not reco.task.baselines.sums_gaussian_entropy
