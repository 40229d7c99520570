"""Policies without training: what they do, what they reach, and where figures find them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.recommender import product_universe
from envs_mjx.shape_stacking import ShapeStacking, shape_library
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.anchors import stack
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import UsageError, load_task
from experiments.pipeline.training import EVALUATION_SEED
from experiments.reports.anchors import Anchors, anchors_of, lines_of, markdown, notes_of
from experiments.reports.runs import Group, read_runs
from experiments.untrained import stacking
from experiments.untrained.recommender import rates
from experiments.untrained.stacking import StackingAnchor
from jaxnew.policy import Categorical
from jaxnew.sampling import AvailableSet
from jaxnew.storage import config as config_lib
from tests.experiments.commands import run
from tests.experiments.handwritten import plain_config, write_run

# ---- The Recommender ----


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "expected"), [("random", 0.156), ("dot", 0.271), ("oracle", 0.573)]
)
def test_anchors_on_sets_of_fifty(name: str, expected: float) -> None:
    table = jnp.asarray(product_universe().engineered["product-mu"])
    found = rates(np.arange(len(table)), table, name, 50, 1024)["click_through_rate"]
    # Rates of single episodes deviate by up to 0.2: 0.2 / 32 and the spec's own 0.003; 3 of them.
    assert found["mean"] == pytest.approx(expected, abs=0.02)


@pytest.mark.integration
def test_the_command_is_of_the_recommender_unless_told_otherwise() -> None:
    lines = run("anchors", "--sets=test", "--set_sizes=50", "--episodes=128").splitlines()
    header = (
        "| products | set size | policy | click-through rate [95 % interval] | episode length |"
    )
    first = lines.index(header)
    assert [line.split(" | ")[:3] for line in lines[first + 2 :]] == [
        ["| test", "50", name] for name in ("random", "dot", "oracle")
    ]
    output = run("anchors", "--task=grid_world", fails=True)
    assert "Task grid_world has no anchors; there are those of recommender and" in output


# ---- Shape Stacking: what the policies do ----

# Cubes by size (690 and 719 are the largest flat shapes here), a sphere, a plate, a cone.
IDS = np.array([735, 660, 690, 402, 719, 606], np.int32)
SIZES = stacking.flat_sizes()[IDS]


def moves(name: str, number: float, mask: np.ndarray | None = None, dim: int = 1) -> Any:
    mask = np.ones(len(IDS), bool) if mask is None else mask
    obs = jnp.array([-0.625, number])
    return StackingAnchor(name, dim).distribution({}, obs, jnp.asarray(SIZES), jnp.asarray(mask))


@pytest.mark.unit
def test_flat_tops_are_those_of_the_spec() -> None:
    sizes, library = stacking.flat_sizes()[:, 0], shape_library()
    # Spec 2.1: horizontal rectangles, arches, rectangles, plates, cubes and cylinders.
    ranges = ((240, 300), (480, 540), (540, 600), (600, 660), (660, 720), (780, 810))
    is_flat = np.zeros(810, bool)
    for first, end in ranges:
        is_flat[first:end] = True
    np.testing.assert_array_equal(sizes > 0.0, is_flat)
    np.testing.assert_allclose(sizes[is_flat], library.s[is_flat], rtol=1e-6)


@pytest.mark.unit
def test_the_script_stacks_flat_shapes_by_size_on_the_left_cylinder() -> None:
    key, available = jax.random.key(0), AvailableSet(jnp.asarray(IDS), jnp.ones(6, bool))
    anchor = StackingAnchor("scripted", 1)
    played = [
        anchor.decode(moves("scripted", t).sample(key), available, jnp.zeros(0)) for t in range(10)
    ]
    s = shape_library().s
    flat = sorted([660, 690, 719, 606], key=lambda i: -s[i])
    assert [int(action.id) for action in played] == flat + [-1] * 6
    assert all(action.position.tolist() == [-0.625] for action in played)
    assert not any(bool(action.stop) for action in played)
    # Padding is no shape.
    mask = flat[0] != IDS
    assert int(IDS[int(moves("scripted", 0, mask).sample(key).choice)]) == flat[1]
    assert int(moves("scripted", 3, mask).sample(key).choice) == -1
    assert moves("scripted", 0, dim=2).sample(key).position.tolist() == [-0.625, 0.0]
    assert moves("scripted", 0, dim=0).sample(key).position.shape == (0,)


@pytest.mark.unit
def test_random_play_is_uniform_and_stops_as_told() -> None:
    mask = IDS != 690
    keys = jax.random.split(jax.random.key(1), 4000)

    def drawn(name: str) -> Any:
        return jax.vmap(moves(name, 2, mask, dim=2).sample)(keys)

    half = drawn("random, stops with probability 0.5")
    assert isinstance(moves("stop at once", 0).choice, Categorical)
    counts = np.bincount(np.asarray(half.choice), minlength=6)
    # Binomial: sqrt(4000 * 0.2 * 0.8) = 25 for choices, 32 for stops; 4 deviations.
    np.testing.assert_allclose(counts, np.where(mask, 800, 0), atol=100)
    assert int(half.stop.sum()) == pytest.approx(2000, abs=128)
    assert bool(drawn("stop at once").stop.all())
    assert not bool(drawn("random, never stops").stop.any())
    position = np.asarray(half.position)
    assert position.shape == (4000, 2)
    assert -1.0 <= position.min() < -0.99 < 0.99 < position.max() < 1.0
    # Deviation of a uniform number 0.577 / sqrt(4000) = 0.009, 4 of them.
    np.testing.assert_allclose(position.mean(axis=0), 0.0, atol=0.04)
    assert abs(np.corrcoef(position.T)[0, 1]) < 0.07


@pytest.mark.golden
def test_stopping_at_once_on_the_starts_of_evaluations() -> None:
    """Spec 10: the cylinder's s, one of three, and half of it as the reward."""
    found = stacking.play(MujocoC(), 1, np.arange(405), "stop at once", 20, 8)
    env, key = ShapeStacking(MujocoC()), jax.random.key(EVALUATION_SEED)

    @jax.jit
    @jax.vmap
    def cylinder(number: jax.Array) -> jax.Array:
        _, key_reset, _ = jax.random.split(jax.random.fold_in(key, number), 3)
        return env.reset_env(key_reset, env.default_params)[1].bodies.shape_ids[0]

    sizes = shape_library().s[np.asarray(cylinder(jnp.arange(8)))]
    np.testing.assert_allclose(found["final_height"], sizes, atol=0.001)
    assert len(np.unique(sizes)) > 1
    np.testing.assert_allclose(found["reward"], found["final_height"] / 2.0, rtol=1e-6)
    np.testing.assert_array_equal(found["is_stopped"], 1.0)
    np.testing.assert_array_equal(found["num_steps"], 1.0)


@pytest.mark.integration
@pytest.mark.parametrize(("name", "position_dim"), [("scripted", 0), ("random, never stops", 2)])
def test_anchors_of_the_other_ways_of_placing(name: str, position_dim: int) -> None:
    # Nothing falls far in one physics step, so that every shape is let go above the last one.
    found = stacking.play(MujocoC(settle_steps=1), position_dim, np.arange(405), name, 20, 16)
    placed, repeats = found["num_placed"], found["num_repeats"]
    np.testing.assert_array_equal(found["num_steps"], 10.0)
    # Of 20 shapes of 405, about 40 % are flat-topped.
    assert placed.min() < placed.max() <= 10.0
    assert placed.min() >= 1.0
    expected = 0.0 if name == "scripted" else 10.0 - placed
    np.testing.assert_array_equal(repeats, expected)
    # The more shapes, the higher the last one; and all of them count in the reward's mean.
    assert np.corrcoef(placed, found["final_height"])[0, 1] > 0.2
    assert (found["reward"] > 0.5 * found["final_height"]).all()


@pytest.mark.golden
@pytest.mark.slow
def test_what_the_spec_found() -> None:
    """Spec 10, mean final heights and rewards over all shapes, sets of 20."""
    for name, height, reward, tolerance in (
        # Three standard errors of the spec's 60 episodes (30 of the script's) and of ours.
        ("random, stops with probability 0.5", 0.60, 0.38, 0.2),
        ("random, never stops", 1.37, 0.94, 0.2),
        ("scripted", 4.28, 3.30, 1.0),
    ):
        found = stacking.play(MujocoC(), 1, np.arange(810), name, 20, 128)
        assert found["final_height"].mean() == pytest.approx(height, abs=tolerance), name
        assert found["reward"].mean() == pytest.approx(reward, abs=tolerance), name


# ---- Shape Stacking: files and figures ----


def fixed_play(engine: Any, position_dim: int, ids: Any, name: str, *sizes: int) -> Any:
    """Heights that tell apart what was asked for."""
    height = len(name) + position_dim + len(ids) / 1024
    assert engine.name == "mujoco_c"
    assert sizes == (20, 4)
    values = np.array([height, height, height, height + 0.5])
    return {"final_height": values, "reward": values / 2, "num_steps": values}


@pytest.mark.unit
def test_a_file_of_anchors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stacking, "play", fixed_play)
    domain = Domain.of(load_task("shape_stacking-2d-place"), None)
    path = stack(domain, "auto", ["train", "test"], [], 4, tmp_path / "anchors")
    assert path == tmp_path / "anchors" / "default-mujoco_c.json"
    anchors = Anchors.load(path)
    assert (anchors.task, anchors.split) == ("shape_stacking-2d-place", "default")
    assert (anchors.set_size, anchors.num_episodes, anchors.seed) == (20, 4, EVALUATION_SEED)
    assert list(anchors.values) == list(stacking.NAMES)
    found = anchors.values["scripted"]["test"]["final_height"]
    mean = 8 + 2 + 203 / 1024 + 0.125
    assert found["mean"] == pytest.approx(mean)
    # Deviation of (0, 0, 0, 0.5) 0.25, of their mean 0.125; 1.96 of them.
    assert found["high"] - mean == pytest.approx(1.96 * 0.125, abs=1e-3)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        "| policy | actions | final height (m) [95 % interval] | reward [95 % interval] |"
    )
    assert len(lines) == 2 + 4 * 2
    assert lines[-1].startswith(f"| scripted | test | {mean:.3f} [{mean - 0.245:.3f}, ")
    text = markdown(anchors)
    assert text.splitlines()[0] == (
        "Policies without training, shape_stacking-2d-place, split default, engine mujoco_c: "
        "4 episodes each on sets of 20."
    )
    assert text.splitlines()[2:] == lines
    with pytest.raises(UsageError, match=r"sets of one size; got \[10, 20\]"):
        stack(domain, "auto", ["test"], [10, 20], 4, tmp_path)
    with pytest.raises(ValueError, match="physics='bullet' is unknown"):
        stack(domain, "bullet", ["test"], [], 4, tmp_path)


def group_at(folder: Path, split: str = "default", set_size: int = 20) -> Group:
    task = load_task("shape_stacking")
    ppo = config_lib.to_dict(task.stage_two["paper"].ppo)
    ppo["rollout"]["set_size"] = set_size
    config = {**plain_config(split=split), "task": task.name, "ppo": ppo}
    path = write_run(folder / f"run-{split}-{set_size}", config, metric="final_height")
    return Group("ours", task, tuple(read_runs([path])))


def write_anchors(folder: Path, height: float, **changes: Any) -> Anchors:
    interval = {"mean": height, "low": height - 0.1, "high": height + 0.1}
    values = {"stop at once": {part: {"final_height": interval} for part in ("train", "test")}}
    fields = {"task": "shape_stacking", "split": "default", "engine": "mujoco_c", **changes}
    anchors = Anchors(**fields, set_size=20, num_episodes=4, seed=1, values=values)
    anchors.save(folder)
    return anchors


@pytest.mark.unit
def test_anchors_stand_beside_their_runs(tmp_path: Path) -> None:
    runs = tmp_path / "shape_stacking"
    group = group_at(runs)
    assert anchors_of(group) == []
    assert notes_of([group]) == []
    first = write_anchors(runs / "anchors", 0.25)
    full = write_anchors(runs / "anchors", 0.5, split="full")
    assert anchors_of(group) == [first]
    assert lines_of(group) == {"stop at once": 0.25}
    assert lines_of(group, "validation") == {}
    assert lines_of(group_at(runs, "full")) == {"stop at once": 0.5}
    assert lines_of(group_at(runs, set_size=10)) == {}
    # In a sweep, a member is further down.
    assert anchors_of(group_at(runs / "sweep" / "members")) == [first]
    assert anchors_of(group_at(tmp_path / "elsewhere")) == []
    both = notes_of([group, group_at(runs, "full"), group_at(runs / "sweep")])
    assert both == [markdown(first), markdown(full)]
    write_anchors(runs / "anchors", 0.75, engine="mjx")
    assert lines_of(group) == {"stop at once (mjx)": 0.75, "stop at once (mujoco_c)": 0.25}
    file = runs / "anchors" / "default-mjx.json"
    file.write_text(json.dumps({"task": "shape_stacking"}))
    with pytest.raises(UsageError, match=r"default-mjx\.json is damaged"):
        lines_of(group)
