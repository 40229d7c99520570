"""CREATE as a Gymnasium environment (docs/create.md)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from envs_host.create.action_sets import Sampler, draw_action_set, uniform_ids
from envs_host.create.config import CreateConfig
from envs_host.create.episode import Episode
from envs_host.create.geometry import Point
from envs_host.create.layout import Layout, draw_layout
from envs_host.create.levels import Level, load_level
from envs_host.create.tools import Tool, all_tools
from envs_host.create.world import Placement, World
from jaxnew.actions import checked_ids

if TYPE_CHECKING:
    from envs_host.create.illustration import RenderOptions

_DRAWING = "envs_host.create.drawing"
_FILMS = "envs_host.create.films"

Action = Mapping[str, Any]


class CreateEnv(gymnasium.Env):
    """Physics puzzles: place tools so that the target ball reaches the goal.

    Observation: the frame after the action, uint8: gray [84, 84], RGB [84, 84, 3], or [0] with
    `observation="none"`. The stack of three frames belongs to the training wrapper.

    Action: {"index": int, "position": f32[2]}. The index is a place in the available set (or a
    tool's id, with `action_ids="universe"`); the position is the tool's centre, normalised, clipped
    to [-1, 1]. Available ids are constant in an episode and in `info["available_ids"]` of every
    reset and step; entry 0 is the no-op.

    Reward, ends: `episode.Episode`. `truncated` is the step limit, `terminated` every other end;
    the paper's runs treated both as ends.

    `info` of every step: `available_ids`, `goal_hit`, `target_hit` (so far), `placement` (of this
    action: placed, no_op, blocked, invalid). At the end also `ends`, why, and `summary`, the totals
    of `episode.Summary`.

    Start: the level's positions, plus noise unless `deterministic`. Noise and action sets come from
    the seed given to `reset`.

    Copies between two steps, by `copy.deepcopy` or `pickle`, go on as the original does, to the
    bit; nobody watches them. They take as long as the episode's actions so far.

        env = CreateEnv("Push", config=CreateConfig(observation="none"))
        observation, info = env.reset(seed=0)
        action = {"index": 1, "position": np.array([0.6, -0.05], np.float32)}
        observation, reward, terminated, truncated, info = env.step(action)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's name)

    def __init__(
        self,
        level: str | Path | Level = "Push",
        deterministic: bool = False,
        config: CreateConfig | None = None,
        candidates: Sequence[int] | np.ndarray | None = None,
        sampler: Sampler = uniform_ids,
        render_mode: str | None = None,
        render_options: RenderOptions | None = None,
    ) -> None:
        """An environment of one level.

        Args:
          level: name, JSON file, or a level.
          deterministic: True leaves out the noise of the level's positions.
          config: settings; default: those of the paper.
          candidates: ids that action sets are drawn from, instead of the config's part of a split.
          sampler: how a set is drawn from the candidates.
          render_mode: "rgb_array" for `render`, or None.
          render_options: what `render` shows; default: 1024 pixels with everything.

        Raises:
          LevelError, ValueError: the level, the candidates or the render mode cannot be used.
        """
        self.level = level if isinstance(level, Level) else load_level(level)
        self.deterministic = deterministic
        self.config = config or CreateConfig()
        self.render_mode = render_mode
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r} must be None or 'rgb_array'.")
        self._tools = all_tools(self.config.angle_spacing)
        self._candidates = self._checked_candidates(candidates)
        self._sampler = sampler
        self._draw = None if self.config.observation == "none" else _load(_DRAWING).draw
        # Called after every 4 substeps, for films.
        self.watch: Callable[[World], None] | None = None
        self._trail = None if render_mode is None else _load(_FILMS).Trail()
        self._render_options = render_options
        self._available = np.arange(len(self._tools), dtype=np.int32)
        self._episode: Episode | None = None
        self._is_over = True
        self.action_space = gymnasium.spaces.Dict(
            {
                "index": gymnasium.spaces.Discrete(self._num_choices()),
                "position": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
            }
        )
        shape = _observation_shape(self.config)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)

    @property
    def world(self) -> World:
        """The physical world of this episode."""
        return self.episode.world

    @property
    def episode(self) -> Episode:
        """The rules and totals of this episode.

        Raises:
          RuntimeError: `reset` has not been called.
        """
        if self._episode is None:
            raise RuntimeError("There is no episode yet; call reset() first.")
        return self._episode

    @property
    def available_ids(self) -> np.ndarray:
        """int32[n] the tool behind each index, this episode."""
        return self._available

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode with a new layout and a new action set.

        Args:
          seed: None goes on with the generator as it is.
          options: not used.
        """
        super().reset(seed=seed)
        # Two streams, so that the layouts of a seed do not depend on the size of the action set.
        layout_rng, set_rng = self.np_random.spawn(2)
        self._episode = Episode(self._layout(layout_rng), self.config)
        self._is_over = False
        if self._trail is not None:
            self._trail.restart(self.world)
        if self.config.action_ids == "set":
            self._available = draw_action_set(
                set_rng,
                self._candidates,
                self.config.action_set_size,
                self.config.no_op_id,
                self._sampler,
            )
        return self._observe(), self._info(Placement.NO_OP)

    def step(self, action: Action) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Places the tool if it may be placed, and lets 40 substeps (1.33 s) pass.

        Raises:
          ValueError: the action is not one of the action space's form.
          RuntimeError: the episode is over.
        """
        episode = self.episode
        if self._is_over:
            raise RuntimeError("The episode is over; call reset() first.")
        watch = None if self.watch is None and self._trail is None else self._show
        episode.simulate(*self._read(action), watch)
        observation = self._observe()
        outcome = episode.judge()
        self._is_over = bool(outcome.ends)
        info = self._info(outcome.placement)
        if outcome.ends:
            info["ends"] = tuple(end.value for end in outcome.ends)
            info["summary"] = asdict(episode.summary)
        return observation, outcome.reward, outcome.terminated, outcome.truncated, info

    def would_be_valid(self, index: int, position: Sequence[float] | np.ndarray) -> bool:
        """Whether an action would place its tool now; nothing is changed.

        False for the no-op, for a blocked tool and for a position outside [-1, 1]^2.
        """
        tool, point = self._read({"index": index, "position": position})
        return self.world.check_placement(tool, point) == Placement.PLACED

    def render(self) -> np.ndarray | None:
        """uint8[size, size, 3] picture for people, if the render mode is "rgb_array"."""
        if self._trail is None:
            return None
        films = _load(_FILMS)
        options = self._render_options or films.DEFAULT_OPTIONS
        picture: np.ndarray = films.picture(self.world, self._trail, self.episode.summary, options)
        return picture

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "watch": None}

    def _show(self, world: World) -> None:
        """Lets those who follow the world between decisions see it."""
        for watch in (self._trail, self.watch):
            if watch is not None:
                watch(world)

    def _layout(self, rng: np.random.Generator) -> Layout:
        if self.deterministic:
            return Layout(self.level)
        if self.config.task_id >= 0:
            rng = np.random.default_rng(self.config.task_id)
        return draw_layout(self.level, rng)

    def _observe(self) -> np.ndarray:
        if self._draw is None:
            return np.zeros(0, np.uint8)
        frame: np.ndarray = self._draw(
            self.world.sprites(), mode=self.config.observation, size=self.config.render_size
        )
        return frame

    def _info(self, placement: Placement) -> dict[str, Any]:
        return {
            "available_ids": self._available.copy(),
            "goal_hit": self.episode.summary.goal_hit,
            "target_hit": self.episode.summary.target_hit,
            "placement": placement.value,
        }

    def _read(self, action: Action) -> tuple[Tool, Point]:
        """The tool and the position of an action."""
        try:
            index = int(action["index"])
            x, y = np.asarray(action["position"], np.float64).tolist()
        except (KeyError, TypeError, ValueError, IndexError) as err:
            raise ValueError(
                f"action={action!r} must be {{'index': int, 'position': [x, y]}}."
            ) from err
        if not 0 <= index < len(self._available):
            raise ValueError(
                f"index={index} is not in 0..{len(self._available) - 1}, the places of the "
                "available set."
            )
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError(f"position=({x}, {y}) must be two finite numbers in [-1, 1].")
        return self._tools[self._available[index]], (x, y)

    def _checked_candidates(self, candidates: Sequence[int] | np.ndarray | None) -> np.ndarray:
        if candidates is None:
            return self.config.action_split().ids(self.config.split_part)
        ids = np.sort(checked_ids(candidates, len(self._tools), "candidates"))
        if self.config.no_op_id in ids:
            raise ValueError(
                f"candidates: the no-op {self.config.no_op_id} is always available; leave it out."
            )
        return ids

    def _num_choices(self) -> int:
        if self.config.action_ids == "universe":
            return len(self._tools)
        if self.config.action_set_size > len(self._candidates):
            raise ValueError(
                f"action_set_size={self.config.action_set_size} exceeds the "
                f"{len(self._candidates)} candidates; choose at most that."
            )
        return self.config.action_set_size


def _observation_shape(config: CreateConfig) -> tuple[int, ...]:
    size = config.render_size
    return {"gray": (size, size), "rgb": (size, size, 3), "none": (0,)}[config.observation]


def _load(name: str) -> ModuleType:
    """A module of pictures, imported only by what draws.

    Raises:
      ImportError: it, or what it needs, is not there.
    """
    try:
        return importlib.import_module(name)
    except ImportError as err:
        raise ImportError(
            f"{name} cannot be imported ({err}). For physics without pictures set "
            "observation='none' and render_mode=None."
        ) from err
