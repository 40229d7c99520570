"""Pictures and smooth films of an episode, with traces and a line of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envs_host.create.episode import Summary
from envs_host.create.geometry import Point
from envs_host.create.illustration import RenderOptions, Trace, illustrate
from envs_host.create.sprites import Tone
from envs_host.create.world import World

if TYPE_CHECKING:
    from envs_host.create.environment import CreateEnv

DEFAULT_OPTIONS = RenderOptions()
_FILM_SIZE = 512


class Trail:
    """Where target and marker of a world have been, as far as it was called."""

    def __init__(self) -> None:
        self._targets: list[Point] = []
        self._markers: list[Point] = []

    def restart(self, world: World) -> None:
        """Forgets everything but where they are now."""
        self._targets, self._markers = [], []
        self(world)

    def __call__(self, world: World) -> None:
        positions = world.positions
        self._targets.append(positions.target)
        if positions.marker is not None:
            self._markers.append(positions.marker)

    @property
    def traces(self) -> tuple[Trace, ...]:
        ways = Trace(tuple(self._targets), Tone.TARGET), Trace(tuple(self._markers), Tone.MARKER)
        return tuple(trace for trace in ways if trace.points)


def picture(world: World, trail: Trail, summary: Summary, options: RenderOptions) -> np.ndarray:
    """u8[size, size, 3] the world now, and what the episode has brought so far."""
    has_text = options.with_text
    return illustrate(
        world.sprites(),
        options.size,
        caption=f"action {summary.length}" if has_text else "",
        note=f"return {summary.reward:.2f}" if has_text else "",
        traces=trail.traces if options.with_traces else (),
        is_success=options.with_tint and summary.goal_hit == 1,
    )


def episode_frames(
    env: CreateEnv,
    seed: int,
    actions: Sequence[Mapping[str, Any]],
    options: RenderOptions | None = None,
) -> Iterator[np.ndarray]:
    """Plays an episode again, from its seed and its actions, as a smooth film.

    Args:
      env: as the one that the episode was played in; it is reset and stepped.
      seed: of the `reset` with which the episode began.
      actions: of the episode, in order; those after its end are an error.
      options: default: 512 pixels with everything.

    Yields:
      u8[size, size, 3]: the start, one frame per 4 substeps (10 per action), and the end with the
      final return.
    """
    options = options or RenderOptions(size=_FILM_SIZE)
    env.reset(seed=seed)
    trail = Trail()
    trail.restart(env.world)
    yield picture(env.world, trail, env.episode.summary, options)
    frames: list[np.ndarray] = []

    def watch(world: World) -> None:
        trail(world)
        frames.append(picture(world, trail, env.episode.summary, options))

    previous, env.watch = env.watch, watch
    try:
        for action in actions:
            env.step(action)
            yield from frames
            frames.clear()
    finally:
        env.watch = previous
    yield picture(env.world, trail, env.episode.summary, options)
