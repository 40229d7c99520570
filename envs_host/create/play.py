"""CREATE's play environment: what a tool does to a ball thrown at it (docs/create.md, "Play")."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from envs_host.create.building import build_tool
from envs_host.create.config import PhysicsConfig
from envs_host.create.geometry import DIAGONAL, Point, to_normalised, to_units
from envs_host.create.sprites import Sprite
from envs_host.create.stage import Stage
from envs_host.create.things import Thing
from envs_host.create.tools import Tool, ToolClass, all_tools
from envs_host.create.tools.catalogue import DEFAULT_SPACING_DEG
from envs_host.create.world import ContactWatch, probe_ball

NUM_STATES = 7
STATE_SIZE = 6
POSITION_COLUMNS = (2, 3)
IMAGE_SIZE = 48
MAX_TRIALS = 8

_NUM_RUNS = 3
_STATES_PER_RUN = 3
_SUBSTEPS_PER_STATE = 10
_NUM_SIMULATED = _NUM_RUNS * _STATES_PER_RUN
_STATES_BEFORE_CONTACT = 3
_TOOL_RANGE = 0.7
_CORNER_RANGE = 0.1
_SPEED = 12.5
_SPEED_RANGE = (0.6, 1.4)
_SPEED_PER_TRIAL = 0.4
_NO_OP_DISTANCE = 0.1


@dataclass(frozen=True)
class PlayConfig:
    """How tools are recorded.

    Attributes:
      angle_spacing: which list the ids belong to.
      centred: True keeps the tool in the centre and starts the ball near a corner; False draws
        both.
      physics: see `PhysicsConfig`; its `substeps` are not used.
    """

    angle_spacing: int = DEFAULT_SPACING_DEG
    centred: bool = False
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)


@dataclass(frozen=True)
class Snapshot:
    """The world at the time of one state.

    Attributes:
      state: six numbers, see `record_block`.
      sprites: what is seen, the tool (if it is not the no-op) and then the ball.
    """

    state: tuple[float, ...]
    sprites: tuple[Sprite, ...]


@dataclass(frozen=True)
class Recording:
    """One trajectory of one tool: 7 snapshots 10 substeps (1/3 s) apart, and the trials it took."""

    snapshots: tuple[Snapshot, ...]
    num_trials: int
    has_contact: bool


def record_block(
    seed: int,
    ids: Sequence[int] | np.ndarray,
    num_recordings: int,
    config: PlayConfig | None = None,
    positions_only: bool = False,
) -> np.ndarray:
    """State recordings of tools.

    A tool's recordings depend on the seed, on its id and on their number only, not on the other
    tools of the block; the first S of more recordings are the same.

    Args:
      seed: at least 0.
      ids: int[n] tool ids of the list with `config.angle_spacing`.
      num_recordings: S, trajectories of each tool; the paper has 1,024.
      config: how; default: the paper's.
      positions_only: keeps the ball's position alone, the two numbers of the paper's prose.

    Returns:
      f32[n, S, 7, 6]: tool position and ball position (normalised, the ball's not clipped), ball
      velocity v / 42 - 1, which is the positions' map, so that rest is -1. Or f32[n, S, 7, 2].

    Raises:
      ValueError: an id does not exist, or there is nothing to record.
    """
    blocks = [
        [[snapshot.state for snapshot in recording.snapshots] for recording in of_tool]
        for of_tool in record_worlds(seed, ids, num_recordings, config)
    ]
    states = np.array(blocks, np.float32).reshape(len(ids), num_recordings, NUM_STATES, STATE_SIZE)
    return states[..., list(POSITION_COLUMNS)] if positions_only else states


def record_images(
    seed: int,
    ids: Sequence[int] | np.ndarray,
    num_recordings: int,
    config: PlayConfig | None = None,
) -> np.ndarray:
    """Video recordings of tools: the trajectories of `record_block` with the same arguments, seen.

    All frames in memory; `envs_host.create.poses` keeps what they are drawn from instead.

    Returns:
      u8[n, S, 7, 48, 48] gray frames: tool and ball on white, lines at least one pixel wide.

    Raises:
      ValueError: an id does not exist, or there is nothing to record.
    """
    from envs_host.create.drawing import draw

    of_tools = record_worlds(seed, ids, num_recordings, config)
    frames = np.empty((len(ids), num_recordings, NUM_STATES, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
    for of_tool, recordings in zip(frames, of_tools, strict=True):
        for of_recording, recording in zip(of_tool, recordings, strict=True):
            for place, snapshot in enumerate(recording.snapshots):
                of_recording[place] = draw(snapshot.sprites, "gray", IMAGE_SIZE)
    return frames


def record_worlds(
    seed: int,
    ids: Sequence[int] | np.ndarray,
    num_recordings: int,
    config: PlayConfig | None = None,
) -> Iterator[list[Recording]]:
    """The recordings of `record_block` with what is seen, tool by tool, for drawing images.

    Raises:
      ValueError: as in `record_block`; before the first tool is recorded.
    """
    config = config or PlayConfig()
    tools = all_tools(config.angle_spacing)
    outside = [int(i) for i in ids if not 0 <= i < len(tools)]
    if outside:
        raise ValueError(f"Tool {outside[0]} is not in 0..{len(tools) - 1}.")
    if num_recordings < 1 or seed < 0:
        raise ValueError(
            f"num_recordings={num_recordings} must be at least 1 and seed={seed} at least 0."
        )
    return _record_tools(seed, [tools[int(i)] for i in ids], num_recordings, config)


def mean_trials(
    seed: int, tool_class: ToolClass, num_recordings: int, config: PlayConfig | None = None
) -> float:
    """Mean number of trials over recordings of random tools of one class."""
    config = config or PlayConfig()
    ids = [tool.id for tool in all_tools(config.angle_spacing) if tool.tool_class == tool_class]
    rng = np.random.default_rng(seed)
    drawn = rng.choice(ids, num_recordings)
    seeds = rng.integers(2**31, size=num_recordings)
    trials = [
        next(record_worlds(int(s), [i], 1, config))[0].num_trials
        for s, i in zip(seeds, drawn, strict=True)
    ]
    return float(np.mean(trials))


def _record_tools(
    seed: int, tools: Sequence[Tool], num_recordings: int, config: PlayConfig
) -> Iterator[list[Recording]]:
    for tool in tools:
        yield [
            _record(np.random.default_rng([seed, tool.id, number]), tool, config)
            for number in range(num_recordings)
        ]


def _record(rng: np.random.Generator, tool: Tool, config: PlayConfig) -> Recording:
    """Throws balls at one tool until one touches it, eight at most."""
    tool_position = (0.0, 0.0) if config.centred else _uniform(rng, _TOOL_RANGE)
    throw: _Throw | None = None
    for trial in range(MAX_TRIALS):
        fresh = _Throw(rng, tool, tool_position, trial, config)
        while fresh.overlaps and trial == MAX_TRIALS - 1:  # The release crashes here.
            fresh = _Throw(rng, tool, tool_position, trial, config)
        if fresh.overlaps:
            continue
        throw = fresh
        throw.simulate()
        if throw.has_contact:
            break
    assert throw is not None
    return Recording(throw.window(), trial + 1, throw.has_contact)


class _Throw:
    """One trial: a world with a tool and a ball that flies towards it."""

    def __init__(
        self,
        rng: np.random.Generator,
        tool: Tool,
        tool_position: Point,
        trial: int,
        config: PlayConfig,
    ) -> None:
        start = _ball_start(rng, config.centred)
        self.is_no_op = tool.tool_class == ToolClass.NO_OP
        self.tool_position = tool_position
        self.stage = Stage(config.physics)
        self.watch = ContactWatch(self.stage)
        self.ball = probe_ball(to_units(start))
        self.things: list[Thing] = [self.ball]
        if not self.is_no_op:
            thing = build_tool(tool, to_units(tool_position))
            self.stage.add(thing)
            self.things.insert(0, thing)
        self.overlaps = not self.stage.is_free(self.ball)
        self.stage.add(self.ball)
        self.ball.body.velocity = _velocity(rng, start, tool_position, trial)
        self.snapshots: list[Snapshot] = []
        self.contact_state: int | None = None
        self.has_contact = False

    def simulate(self) -> None:
        """Three runs of 30 substeps, a state every 10; notes the first state after a contact.

        The no-op's contact is nearness to where it would stand: at the time of a state it sets the
        window, at the end of a run it decides whether the trial counts.
        """
        for number in range(_NUM_SIMULATED):
            self.stage.run(_SUBSTEPS_PER_STATE)
            self.snapshots.append(self._snapshot())
            is_touched = self._is_near() if self.is_no_op else self.watch.has_seen_contact
            if is_touched and self.contact_state is None:
                self.contact_state = number
            is_end_of_run = (number + 1) % _STATES_PER_RUN == 0
            if is_touched and (is_end_of_run or not self.is_no_op):
                self.has_contact = True

    def window(self) -> tuple[Snapshot, ...]:
        """Seven of the nine states: three on both sides of the contact, as far as there are.

        Without a contact the middle seven.
        """
        first = 1
        if self.has_contact and self.contact_state is not None:
            last_first = _NUM_SIMULATED - NUM_STATES
            first = min(max(self.contact_state - _STATES_BEFORE_CONTACT, 0), last_first)
        return tuple(self.snapshots[first : first + NUM_STATES])

    def _is_near(self) -> bool:
        ball = to_normalised(self.ball.body.position)
        return math.dist(ball, self.tool_position) / DIAGONAL < _NO_OP_DISTANCE

    def _snapshot(self) -> Snapshot:
        body = self.ball.body
        state = (
            *self.tool_position,
            *to_normalised(body.position),
            # Velocities pass through the map of the positions, so rest is -1.
            *to_normalised(body.velocity),
        )
        sprites = tuple(sprite for thing in self.things for sprite in thing.sprites())
        return Snapshot(state, sprites)


def _ball_start(rng: np.random.Generator, centred: bool) -> Point:
    if not centred:
        return _uniform(rng, 1.0)
    corner = rng.choice([-_TOOL_RANGE, _TOOL_RANGE], 2)
    near = _uniform(rng, _CORNER_RANGE)
    return float(corner[0]) + near[0], float(corner[1]) + near[1]


def _velocity(rng: np.random.Generator, start: Point, target: Point, trial: int) -> Point:
    """Towards the tool's centre, faster from afar and in later trials; units/s."""
    distance = math.dist(start, target)
    speed = float(rng.uniform(*_SPEED_RANGE)) * _SPEED
    speed *= (1.0 + _SPEED_PER_TRIAL * trial) * (1.0 + distance)
    angle = math.atan2(target[1] - start[1], target[0] - start[0])
    return speed * math.cos(angle), speed * math.sin(angle)


def _uniform(rng: np.random.Generator, half_width: float) -> Point:
    x, y = rng.uniform(-half_width, half_width, 2)
    return float(x), float(y)
