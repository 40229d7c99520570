"""Every figure that the spec gives for Shape Stacking's physics, measured (spec 10 and 13).

    python -m experiments.stacking_figures > results/shape_stacking/engines.md
    python -m experiments.stacking_figures --physics=mjx   # MJX beside MuJoCo's C engine.

Anchors are policies that need no training. Their action sets are 20 shapes of all 810; the same
episodes are played on each engine.
"""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from absl import flags

from envs_mjx.shape_stacking import rules, scene, shape_library
from envs_mjx.shape_stacking.engines import Engine, make_engine
from envs_mjx.shape_stacking.shapes import NUM_SHAPES
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from experiments.pipeline import flags as flag
from experiments.untrained import towers as stacking
from experiments.untrained.towers import FLAT_TOPPED, SETTLE_ONLY, Drop

SET_SIZE = 20
# Two engines' values that are farther apart than this, m, are listed.
_DIFFERENT_M = 0.005


def engines_of(physics: str) -> dict[str, Engine]:
    """The columns of the tables: C in both its forms, and for `mjx` that beside them."""
    engines = {
        "one contact per pair of hulls": make_engine("mujoco"),
        "several": make_engine("mujoco", has_multiple_contacts=True),
    }
    return engines | ({"MJX": make_engine("mjx")} if physics == "mjx" else {})


@dataclass(frozen=True)
class Start:
    """How an episode begins.

    Attributes:
      action_set: int[20] ids.
      cylinder_id: of both start cylinders.
      center, gap: of their x, m.
    """

    action_set: np.ndarray
    cylinder_id: int
    center: float
    gap: float


Policy = Callable[[np.random.Generator, Start], list[Drop]]


@dataclass(frozen=True)
class Anchor:
    """A policy that needs no training.

    Attributes:
      name: of it.
      policy: all drops of an episode.
      height, reward: what the spec found, as text.
    """

    name: str
    policy: Policy
    height: str
    reward: str


def random_play(stop_probability: float) -> Policy:
    """Uniform choices and positions; before each, it stops with this probability."""

    def play(rng: np.random.Generator, start: Start) -> list[Drop]:
        drops: list[Drop] = []
        for _ in range(scene.NUM_PLACEMENTS):
            if rng.random() < stop_probability:
                return [*drops, (SETTLE_ONLY, 0.0)]
            shape_id, x = int(rng.choice(start.action_set)), float(rng.uniform(-1.0, 1.0))
            is_repeat = any(shape_id == dropped for dropped, _ in drops)
            drops.append((SETTLE_ONLY if is_repeat else shape_id, x))
        return drops

    return play


def scripted(rng: np.random.Generator, start: Start) -> list[Drop]:
    """Flat-topped shapes, largest scale first, all on the left cylinder; then nothing more."""
    del rng
    library = shape_library()
    labels = [CLASS_NAMES.index(name) for name in FLAT_TOPPED]
    flat = start.action_set[np.isin(library.class_labels[start.action_set], labels)]
    ordered = flat[np.argsort(-library.s[flat], kind="stable")][: scene.NUM_PLACEMENTS]
    drops: list[Drop] = [(int(i), start.center - start.gap / 2.0) for i in ordered]
    return drops + [(SETTLE_ONLY, 0.0)] * (scene.NUM_PLACEMENTS - len(drops))


ANCHORS = (
    Anchor("stop at once", random_play(1.0), "0.342 +- 0.011", "0.171"),
    Anchor("random, stops with probability 0.5", random_play(0.5), "0.60", "0.38"),
    Anchor("random, never stops", random_play(0.0), "1.37 +- 0.05, 1.16 +- 0.06", "0.94, 0.80"),
    Anchor("scripted", scripted, "4.28 +- 0.28", "3.30"),
)


def draw_start(rng: np.random.Generator) -> Start:
    """Spec 3."""
    return Start(
        rng.choice(NUM_SHAPES, SET_SIZE, replace=False),
        int(rng.choice(rules.START_CYLINDERS)),
        float(rng.uniform(*rules.START_CENTER)),
        float(rng.uniform(*rules.START_GAP)),
    )


def play(engine: Engine, policy: Policy, episodes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Final heights and rewards f32[episodes]; episode i depends on `seed` and i alone."""
    starts, drops = [], []
    for i in range(episodes):
        rng = np.random.default_rng([seed, i])
        starts.append(draw_start(rng))
        drops.append(policy(rng, starts[-1]))
    bodies = stacking.start_scenes(
        [s.cylinder_id for s in starts], [s.center for s in starts], [s.gap for s in starts]
    )
    bodies = stacking.stack(engine, bodies, drops)
    heights, rewards = jax.vmap(rules.tower_height)(bodies), jax.vmap(rules.tower_reward)(bodies)
    return np.asarray(heights), np.asarray(rewards)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


Columns = dict[str, list[stacking.Row]]


def columns_of(engines: dict[str, Engine]) -> Columns:
    """All figures on each engine."""
    return {name: stacking.measured(engine) for name, engine in engines.items()}


def figures_table(columns: Columns) -> str:
    """The checks; values that are off by more than the tolerance are bold."""
    rows = []
    for found in zip(*columns.values(), strict=True):
        first = found[0]
        spec = first.spec if isinstance(first.spec, str) else f"{first.spec:.3f}"
        tolerance = "" if first.tolerance is None else f"{first.tolerance:g}"
        rows.append([str(first.check), first.what, spec, tolerance, *map(_shown, found)])
    return table(["check", "what", "spec", "tolerance", *columns], rows)


def differences_table(columns: Columns, one: str, other: str) -> str:
    """The checks in which two engines differ by more than 5 mm (cosines: 0.005)."""
    rows = [
        [str(a.check), a.what, f"{a.value:.4f}", f"{b.value:.4f}", f"{b.value - a.value:+.4f}"]
        for a, b in zip(columns[one], columns[other], strict=True)
        if not abs(a.value - b.value) <= _DIFFERENT_M
    ]
    return table(["check", "what", one, other, "difference"], rows)


def _shown(row: stacking.Row) -> str:
    text = f"{row.value:.4f}"
    if row.tolerance is None or isinstance(row.spec, str):
        return text
    return text if abs(row.value - row.spec) <= row.tolerance else f"**{text}**"


def anchors_table(engines: dict[str, Engine], episodes: int, seed: int) -> str:
    """Mean +- its standard error over the episodes."""
    rows = []
    for anchor in ANCHORS:
        cells = [anchor.name, anchor.height, anchor.reward]
        for engine in engines.values():
            heights, rewards = play(engine, anchor.policy, episodes, seed)
            error = heights.std(ddof=1) / np.sqrt(episodes)
            cells += [f"{heights.mean():.3f} +- {error:.3f}", f"{rewards.mean():.3f}"]
        rows.append(cells)
    measured = [f"{what}, {name}" for name in engines for what in ("height", "reward")]
    return table(["policy", "height, spec", "reward, spec", *measured], rows)


def main() -> None:
    physics, episodes = flags.FLAGS.physics, flags.FLAGS.episodes
    engines = engines_of(physics)
    version = importlib.metadata.version
    names = [f"MuJoCo's C engine {version('mujoco')}"]
    if physics == "mjx":
        names.append(f"MJX {version('mujoco-mjx')} on {jax.devices()[0].device_kind}")
    print("# Shape Stacking: what the engines do\n")
    print(f"    python -m experiments.stacking_figures {' '.join(sys.argv[1:])}".rstrip())
    print(f"\n{', '.join(names)}. Values beyond the tolerance are bold.\n")
    print("## Figures of the spec (m)\n")
    columns = columns_of(engines)
    print(figures_table(columns))
    if physics == "mjx":
        print("\n## Where MJX and C with several contacts differ by more than 0.005\n")
        print(differences_table(columns, "several", "MJX"))
    print(f"\n## Policies without training, {episodes} episodes, mean +- standard error\n")
    print(anchors_table(engines, episodes, flag.SEED.value))


if __name__ == "__main__":
    # Not at import: other commands have a flag of this name.
    flags.DEFINE_integer("episodes", 60, "Episodes of each anchor.", lower_bound=2)
    flags.DEFINE_enum(
        "physics",
        "mujoco",
        ["mujoco", "mjx"],
        "mjx: MJX as well; on a CPU that takes half an hour.",
    )
    flag.run_command(main)
