"""The reference figures of Shape Stacking (docs/shape_stacking.md), measured on its engines.

    python -m experiments.benchmarks.stacking_spec > results/shape_stacking/engines.md
    python -m experiments.benchmarks.stacking_spec --physics=mjx   # MJX beside MuJoCo's C engine.

Anchors are policies that need no training. Their action sets are 20 shapes of all 810; the same
episodes are played on each engine.
"""

from __future__ import annotations

import importlib.metadata
import sys

import jax
import numpy as np

from envs_mjx.shape_stacking.engines import Engine, make_engine
from envs_mjx.shape_stacking.shapes import NUM_SHAPES
from experiments.flags import Arguments
from experiments.reports import tables
from experiments.untrained import stacking, towers

ARGUMENTS = Arguments(__doc__)
ARGUMENTS.define("integer", "episodes", 60, "Episodes of each anchor.", lower_bound=2)
ARGUMENTS.define(
    "enum",
    "physics",
    "mujoco",
    "mjx: MJX as well; on a CPU that takes half an hour.",
    choices=["mujoco", "mjx"],
)

SET_SIZE = 20
# Two engines' values that are farther apart than this, m, are listed.
_DIFFERENT_M = 0.005

# By anchor, the height and the reward that are known.
KNOWN = {
    "stop at once": ("0.342 +- 0.011", "0.171"),
    "random, stops with probability 0.5": ("0.60", "0.38"),
    "random, never stops": ("1.37 +- 0.05, 1.16 +- 0.06", "0.94, 0.80"),
    "scripted": ("4.28 +- 0.28", "3.30"),
}

Columns = dict[str, list[towers.Row]]


def engines_of(physics: str) -> dict[str, Engine]:
    """The columns of the tables: C in both its forms, and for `mjx` that beside them."""
    engines = {
        "one contact per pair of hulls": make_engine("mujoco"),
        "several": make_engine("mujoco", has_multiple_contacts=True),
    }
    return engines | ({"MJX": make_engine("mjx")} if physics == "mjx" else {})


def figures_table(columns: Columns) -> list[str]:
    """The checks; values that are off by more than the tolerance are bold."""
    rows = []
    for found in zip(*columns.values(), strict=True):
        first = found[0]
        spec = first.spec if isinstance(first.spec, str) else f"{first.spec:.3f}"
        tolerance = "" if first.tolerance is None else f"{first.tolerance:g}"
        rows.append([str(first.check), first.what, spec, tolerance, *map(_shown, found)])
    return tables.table(["check", "what", "reference", "tolerance", *columns], rows)


def differences_table(columns: Columns, one: str, other: str) -> list[str]:
    """The checks in which two engines differ by more than 5 mm (cosines: 0.005)."""
    rows = [
        [str(a.check), a.what, f"{a.value:.4f}", f"{b.value:.4f}", f"{b.value - a.value:+.4f}"]
        for a, b in zip(columns[one], columns[other], strict=True)
        if not abs(a.value - b.value) <= _DIFFERENT_M
    ]
    return tables.table(["check", "what", one, other, "difference"], rows)


def _shown(row: towers.Row) -> str:
    text = f"{row.value:.4f}"
    if row.tolerance is None or isinstance(row.spec, str):
        return text
    return text if abs(row.value - row.spec) <= row.tolerance else f"**{text}**"


def anchors_table(engines: dict[str, Engine], episodes: int) -> list[str]:
    """Mean +- its standard error over the episodes."""
    envs, rows = [stacking.OpenStacking(engine) for engine in engines.values()], []
    for name in stacking.NAMES:
        cells = [name, *KNOWN[name]]
        for env in envs:
            found = stacking.play(env, name, np.arange(NUM_SHAPES), SET_SIZE, episodes)
            heights = found["final_height"]
            error = heights.std(ddof=1) / np.sqrt(episodes)
            cells += [f"{heights.mean():.3f} +- {error:.3f}", f"{found['reward'].mean():.3f}"]
        rows.append(cells)
    measured = [f"{what}, {name}" for name in engines for what in ("height", "reward")]
    return tables.table(["policy", "height, reference", "reward, reference", *measured], rows)


def main() -> None:
    has_mjx, episodes = ARGUMENTS.physics == "mjx", ARGUMENTS.episodes
    engines, version = engines_of(ARGUMENTS.physics), importlib.metadata.version
    names = [f"MuJoCo's C engine {version('mujoco')}"]
    if has_mjx:
        names.append(f"MJX {version('mujoco-mjx')} on {jax.devices()[0].device_kind}")
    print("# Shape Stacking: what the engines do\n")
    command = f"python -m experiments.benchmarks.stacking_spec {' '.join(sys.argv[1:])}"
    print(f"    {command.rstrip()}\n\n{', '.join(names)}. Values beyond the tolerance are bold.\n")
    print("## Reference figures (m)\n")
    columns = {name: towers.measured(engine) for name, engine in engines.items()}
    print(*figures_table(columns), sep="\n")
    if has_mjx:
        print("\n## Where MJX and C with several contacts differ by more than 0.005\n")
        print(*differences_table(columns, "several", "MJX"), sep="\n")
    print(f"\n## Policies without training, {episodes} episodes, mean +- standard error\n")
    print(*anchors_table(engines, episodes), sep="\n")


if __name__ == "__main__":
    ARGUMENTS.start(main)
