"""What a uniformly random agent achieves, beside the release's numbers.

    python -m envs_host.create.random_agent --episodes 600 --seed 0 [--levels Push,Funnel]

prints one block per task: our mean, the release's mean over 600 episodes, and their difference in
standard errors. The agent picks an entry of its 50-tool set and a position in [-1, 1]^2 uniformly.
"""

from __future__ import annotations

import argparse
import math
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from envs_host.create.action_sets import draw_action_set
from envs_host.create.config import CreateConfig
from envs_host.create.episode import End, Episode
from envs_host.create.layout import draw_layout
from envs_host.create.levels import TASK_NAMES, load_level
from envs_host.create.tools import all_tools

RELEASE_EPISODES = 600
MEASURES = (
    "length",
    "goal",
    "target hit",
    "return",
    "placed",
    "blocked",
    "no-ops",
    "end: time",
    "end: target out",
    "end: marker out",
    "end: still",
)
# One number per measure; the release reports no target hits for plain tasks.
RELEASE: Mapping[str, tuple[float | None, ...]] = {
    "Push": (9.86, 0.015, 0.078, 0.279, 6.32, 3.32, 0.22, 0.052, 0.053, 0.852, 0.043),
    "Obstacle": (36.20, 0.0, 0.008, 0.209, 9.07, 26.43, 0.70, 0.173, 0.0, 0.063, 0.763),
    "Seesaw": (14.64, 0.0, None, 0.061, 5.80, 8.53, 0.32, 0.210, 0.770, 0.0, 0.020),
    "Belt": (29.59, 0.0, None, 0.164, 10.93, 18.05, 0.60, 0.365, 0.135, 0.0, 0.500),
    "Buckets": (9.16, 0.005, None, 0.110, 5.37, 3.59, 0.20, 0.032, 0.912, 0.0, 0.057),
    "Cannon": (10.07, 0.008, 0.047, 0.174, 4.93, 4.92, 0.22, 0.058, 0.030, 0.833, 0.078),
    "Navigate": (13.74, 0.002, 0.025, 0.121, 7.89, 5.55, 0.30, 0.082, 0.013, 0.067, 0.838),
    "Collide": (11.46, 0.005, None, 0.104, 5.38, 5.83, 0.26, 0.102, 0.895, 0.0, 0.003),
    "Moving": (9.85, 0.022, None, 0.267, 6.46, 3.17, 0.22, 0.058, 0.942, 0.0, 0.0),
    "Ladder": (9.85, 0.010, 0.070, 0.223, 6.22, 3.41, 0.22, 0.050, 0.058, 0.870, 0.022),
    "Basket": (10.46, 0.013, None, 0.456, 5.78, 4.45, 0.23, 0.043, 0.943, 0.0, 0.013),
    "Funnel": (15.96, 0.035, None, 0.390, 6.66, 8.96, 0.34, 0.153, 0.453, 0.0, 0.393),
}
_GOAL_REWARD = 9.5  # 10 less 0.1 for each of about five tools.
_RATES = ("goal", "target hit", "end: time", "end: target out", "end: marker out", "end: still")


@dataclass(frozen=True)
class Comparison:
    """One measure of one task: our mean, the release's, and their distance in standard errors."""

    measure: str
    ours: float
    release: float | None
    z: float | None


def random_episodes(
    level_name: str, num_episodes: int, seed: int, config: CreateConfig | None = None
) -> np.ndarray:
    """f64[n, 11] one row per episode, one column per entry of `MEASURES`.

    Ends are shares: an episode that ends for two reasons counts once, in the order of `End`.
    """
    config = config or CreateConfig(observation="none")
    return np.array(
        [
            _play(
                level_name,
                np.random.default_rng([seed, zlib.crc32(level_name.encode()), number]),
                config,
            )
            for number in range(num_episodes)
        ]
    )


def compare(level_name: str, episodes: np.ndarray) -> list[Comparison]:
    """Our means beside the release's.

    Standard errors are those of the difference of the two means: binomial for rates, with the
    pooled rate (and one more success and failure, so that 0 of 600 is no certainty), else from our
    episodes' variance. Returns hang on rare goals of about 10, so their variance is at least that
    of the pooled goal rate.
    """
    num_ours = len(episodes)
    share = 1.0 / num_ours + 1.0 / RELEASE_EPISODES

    def binomial_variance(column: int) -> float:
        hits = episodes[:, column].sum() + (RELEASE[level_name][column] or 0.0) * RELEASE_EPISODES
        rate = (hits + 1.0) / (num_ours + RELEASE_EPISODES + 2.0)
        return float(rate * (1.0 - rate))

    found = []
    for column, measure in enumerate(MEASURES):
        ours = float(episodes[:, column].mean())
        release = RELEASE[level_name][column]
        if release is None:
            found.append(Comparison(measure, ours, None, None))
            continue
        variance = float(episodes[:, column].var())
        if measure in _RATES:
            variance = binomial_variance(column)
        elif measure == "return":
            variance = max(variance, _GOAL_REWARD**2 * binomial_variance(MEASURES.index("goal")))
        error = max(math.sqrt(variance * share), 1e-9)  # A few episodes may all be alike.
        found.append(Comparison(measure, ours, release, (ours - release) / error))
    return found


def _play(level_name: str, rng: np.random.Generator, config: CreateConfig) -> list[float]:
    level = load_level(level_name)
    tools = all_tools(config.angle_spacing)
    candidates = config.action_split().ids(config.split_part)
    ids = draw_action_set(rng, candidates, config.action_set_size, config.no_op_id)
    episode = Episode(draw_layout(level, rng), config)
    ends: tuple[End, ...] = ()
    while not ends:
        x, y = rng.uniform(-1.0, 1.0, 2)
        ends = episode.step(tools[rng.choice(ids)], (float(x), float(y))).ends
    total = episode.summary
    by_end = [float(ends[0] == end) for end in
              (End.STEP_LIMIT, End.TARGET_OUT, End.MARKER_OUT, End.STILL)]  # fmt: skip
    return [
        total.length, total.goal_hit, total.target_hit, total.reward, total.num_placed,
        total.num_blocked, total.num_no_op, *by_end,
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Plays and prints; the options are in the module's docstring."""
    parser = argparse.ArgumentParser(description="A random agent beside the release's numbers.")
    parser.add_argument("--episodes", type=int, default=RELEASE_EPISODES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--levels", default=",".join(TASK_NAMES))
    options = parser.parse_args(arguments)
    distances = []
    for name in options.levels.split(","):
        start_s = time.perf_counter()
        episodes = random_episodes(name, options.episodes, options.seed)
        seconds = time.perf_counter() - start_s
        rate = episodes[:, 0].sum() / seconds
        print(f"{name}: {len(episodes)} episodes, {seconds:.1f} s, {rate:.0f} actions/s")
        for row in compare(name, episodes):
            if row.release is None or row.z is None:
                print(f"  {row.measure:16s} {row.ours:8.3f}        -")
            else:
                distances.append(row.z)
                print(f"  {row.measure:16s} {row.ours:8.3f} {row.release:8.3f}  z {row.z:+.2f}")
    deviation, largest = np.std(distances), max(distances, key=abs)
    print(f"{len(distances)} comparisons: z deviates by {deviation:.2f}, largest {largest:+.2f}")


if __name__ == "__main__":
    main()
