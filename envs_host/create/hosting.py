"""CREATE in the form that `envs_host.pool` runs: ids and positions in, gray frames out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from envs_host.create.config import CreateConfig
from envs_host.create.environment import CreateEnv
from envs_host.protocol import Step

EPISODE_METRICS = (
    "is_success",
    "target_hit",
    "episode_return",
    "episode_length",
    "subgoal_reward",
    "num_placed",
    "num_blocked",
    "num_no_op",
)


class CreateHost:
    """One level, whose actions are ids of tools; the rollout owns the available sets.

    Everything in an episode (the noise of the level) follows from the seed of its reset.

    In a pool, whose arguments are plain:

        config = CreateConfig(action_ids="universe", end_on_goal=True)
        kwargs = {"level": "Push", "config": dataclasses.asdict(config)}
        HostPool("envs_host.create.hosting:CreateHost", kwargs, ...)

    Args:
      level: name of a level or a level file.
      deterministic: True leaves out the noise of the level's positions.
      config: all settings, as a config or in the form of `dataclasses.asdict`; default: the paper's
        with `action_ids="universe"`. With `split="analysis"`, ids are of the 3-degree list of
        tools; parts of a split and action sets are the rollout's.

    Raises:
      LevelError: there is no such level.
      ValueError: the config has action sets, or no gray frames.
    """

    position_dim = 2
    episode_metrics = EPISODE_METRICS

    def __init__(
        self,
        level: str = "Push",
        deterministic: bool = False,
        config: CreateConfig | Mapping[str, Any] | None = None,
    ) -> None:
        if config is None:
            config = CreateConfig(action_ids="universe")
        elif not isinstance(config, CreateConfig):
            config = CreateConfig.from_plain(config)
        if config.action_ids != "universe":
            raise ValueError(
                f"action_ids={config.action_ids!r} must be 'universe' in a pool: the rollout owns "
                "the action sets and sends ids of tools."
            )
        if config.observation != "gray":
            raise ValueError(
                f"observation={config.observation!r} must be 'gray' in a pool: that is what the "
                "policy looks at."
            )
        self.env = CreateEnv(level, deterministic, config)
        self.observation_shape = self.env.observation_space.shape or ()
        self.observation_dtype = np.uint8

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        """Starts an episode; returns its first frame uint8[84, 84]."""
        observation, _ = self.env.reset(seed=_bits(seed))
        return observation

    def step(self, action_id: int, position: np.ndarray) -> Step:
        """Tries to place tool `action_id` at `position` f32[2] in [-1, 1]^2; 40 substeps pass."""
        observation, reward, terminated, truncated, _ = self.env.step(
            {"index": action_id, "position": position}
        )
        return Step(observation, reward, terminated, truncated, self._metrics())

    def film(
        self, seed: np.random.SeedSequence, ids: np.ndarray, positions: np.ndarray, size: int
    ) -> tuple[list[np.ndarray], Mapping[str, float]]:
        """Plays an episode again, for people.

        Args:
          seed: with which the episode was reset.
          ids, positions: int[T] and f32[T, 2], what its steps were told.
          size: pixels of the side.

        Returns:
          The frames of `films.episode_frames`, and the metrics after the last step.
        """
        # Imported late: pictures for people are no business of worker processes.
        from envs_host.create.films import episode_frames
        from envs_host.create.illustration import RenderOptions

        actions = [{"index": int(i), "position": p} for i, p in zip(ids, positions, strict=True)]
        options = RenderOptions(size=size)
        frames = list(episode_frames(self.env, _bits(seed), actions, options))
        return frames, self._metrics()

    def _metrics(self) -> Mapping[str, float]:
        summary = self.env.episode.summary
        return {
            "is_success": float(summary.goal_hit),
            "target_hit": float(summary.target_hit),
            "episode_return": summary.reward,
            "episode_length": float(summary.length),
            "subgoal_reward": summary.subgoal_reward,
            "num_placed": float(summary.num_placed),
            "num_blocked": float(summary.num_blocked),
            "num_no_op": float(summary.num_no_op),
        }

    def close(self) -> None:
        self.env.close()


def _bits(seed: np.random.SeedSequence) -> int:
    """A seed of 64 bits, so that no two of a run's episodes share a layout by chance."""
    return int(seed.generate_state(1, np.uint64)[0])
