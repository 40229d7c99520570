"""A pool of worker processes that hold many environments and exchange batches in shared memory.

A decision costs one byte to and one byte from each worker; everything else is in arrays that all
processes map. Environment i's episode e is seeded with `SeedSequence(seed, spawn_key=(i, e))` and
results are ordered by environment, so rollouts do not depend on the number of workers or halves.
The state of the pool is the seed, the number of each environment's running episode and the actions
of that episode: bringing it back is replaying, which makes resuming and the replacement of a lost
worker exact.

    kwargs = {"id": "my_package:MyEnv-v0"}
    with HostPool("envs_host.protocol:GymnasiumHost.make", kwargs, 32, 2, seed=0) as pool:
        observations = pool.reset()
        step = pool.step(ids, positions)
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs_host._workers import ReplayMismatch, WorkerError, Workers
from envs_host.channel import FIRST_CODE
from envs_host.episodes import Episodes
from envs_host.memory import Setup
from envs_host.protocol import PoolSettings, WorkerDeath

__all__ = ["HostPool", "HostStep", "PoolSettings", "ReplayMismatch", "WorkerError"]


@dataclass(frozen=True)
class HostStep:
    """One decision of the n environments of a half, or of the whole pool, ordered by environment.

    Attributes:
      observations: [n, ...] what to act on next: of the new episode where one ended. A view of
        shared memory, not writable, valid until the next `send` of its half.
      final_observations: [n, ...] what the step really produced, in every row. A view, as above.
      rewards: f32[n]; a copy, like all that follow.
      terminated, truncated: bool[n] natural ends, and ends by a limit.
      metrics: {name: f32[n]} of the episode that the step belongs to, up to this step.
    """

    observations: np.ndarray
    final_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    metrics: dict[str, np.ndarray]


class HostPool:
    """N environments in worker processes. A context manager; close it at the end.

    Halves are consecutive ranges of environments that are sent and received apart, so that one can
    simulate while a policy looks at the other; every worker has environments of each. Where an
    episode ends, the worker starts the next one at once.

    Workers ignore Ctrl-C and end with this process, however it ends. What they print appears on
    this process's stderr.

    Args:
      factory: `package.module:NAME`, imported in the workers, which get this process's import
        path and not its main module. It makes a `HostEnvironment`.
      kwargs: its keyword arguments; JSON must be able to express them.
      num_envs: N, a multiple of num_halves.
      num_workers: processes, at most N / num_halves.
      seed: of everything random, 0 .. 2^63 - 1.
      num_halves: 2, or 1 for no overlap; more are possible.
      on_worker_death, timeout_s, start_timeout_s, max_restarts, pin_cores: see `PoolSettings`.

    Raises:
      ValueError: an argument is not as above.
      WorkerError: a worker could not make its environments.
    """

    def __init__(
        self,
        factory: str,
        kwargs: Mapping[str, Any] | None,
        num_envs: int,
        num_workers: int,
        seed: int,
        *,
        num_halves: int = 2,
        on_worker_death: WorkerDeath = PoolSettings.on_worker_death,
        timeout_s: float = PoolSettings.timeout_s,
        start_timeout_s: float = PoolSettings.start_timeout_s,
        max_restarts: int = PoolSettings.max_restarts,
        pin_cores: bool = PoolSettings.pin_cores,
    ) -> None:
        _check_arguments(num_envs, num_workers, seed, num_halves)
        PoolSettings(on_worker_death, timeout_s, start_timeout_s, max_restarts, pin_cores)
        self.num_envs, self.num_halves, self.num_workers = num_envs, num_halves, num_workers
        self._episodes = Episodes(seed, num_envs)
        self._workers = Workers(
            _setups(factory, kwargs, num_envs, num_workers, num_halves, pin_cores),
            self._episodes,
            timeout_s=timeout_s,
            start_timeout_s=start_timeout_s,
            max_restarts=max_restarts if on_worker_death == "restart" else 0,
        )
        self._arrays = self._workers.arrays
        self._observations = _read_only(self._arrays.observations)
        self._final_observations = _read_only(self._arrays.final_observations)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return self._workers.format.observation_shape

    @property
    def observation_dtype(self) -> np.dtype[Any]:
        return np.dtype(self._workers.format.observation_dtype)

    @property
    def position_dim(self) -> int:
        return self._workers.format.position_dim

    @property
    def episode_metrics(self) -> tuple[str, ...]:
        return self._workers.format.episode_metrics

    @property
    def seed(self) -> int:
        return self._episodes.seed

    @property
    def episodes(self) -> np.ndarray:
        """int64[N] number of the running episode of each environment, from 0; -1 before."""
        return self._episodes.numbers.copy()

    @property
    def worker_pids(self) -> tuple[int, ...]:
        return self._workers.pids

    def rows(self, half: int) -> slice:
        """The environments of a half."""
        size = self.num_envs // self.num_halves
        return slice(half * size, (half + 1) * size)

    def reset(self) -> np.ndarray:
        """Starts the next episode in every environment: number 0 at first, then 1, ...

        Returns:
          Observations [N, ...], a view that is valid until the next `send`.
        """
        self._check_idle()
        self._episodes.begin_next()
        self._workers.restore()
        return self._observations[:]

    def reset_numbered(self, seed: int) -> np.ndarray:
        """Starts an evaluation: environment i of N plays the episodes i, i + N, ... of a seed.

        Episode n is seeded with `SeedSequence(seed, spawn_key=(n,))`, so that it is the same in
        pools of any size. Whatever ran is given up; `load_state` brings it back, and there is no
        state of an evaluation.

        Args:
          seed: 0 .. 2^63 - 1, in place of the pool's own.

        Returns:
          Observations [N, ...], as `reset`.
        """
        self._check_idle()
        _check_seed(seed)
        self._episodes.begin_numbered(seed)
        self._workers.restore()
        return _read_only(self._arrays.observations)

    def send(self, half: int, ids: np.ndarray, positions: np.ndarray | None = None) -> None:
        """Has the workers do one decision in a half; they start at once.

        Args:
          half: 0 .. num_halves - 1, one that is not running.
          ids: integer[n] action ids, n = N / num_halves.
          positions: float[n, k]; may be None if k = 0.

        Raises:
          ValueError: an argument is not as above.
          RuntimeError: no episode has begun, the half is running, or the pool is closed.
        """
        self._check_half(half)
        self._check_begun()
        if half in self._workers.in_flight:
            raise RuntimeError(f"Half {half} is running; receive it first.")
        rows = self.rows(half)
        self._send(half, *self._checked_actions(ids, positions, rows.stop - rows.start))

    def _send(self, half: int, ids: np.ndarray, positions: np.ndarray) -> None:
        rows = self.rows(half)
        self._arrays.ids[rows], self._arrays.positions[rows] = ids, positions
        self._workers.send(half)

    def receive(self, half: int) -> HostStep:
        """Waits for the decision that was sent to a half.

        Raises:
          WorkerError: a worker is lost and may not be replaced. The pool is closed then, but for
            `state_dict`, which gives each half's state after its last decision that was received.
          ReplayMismatch: a worker was replaced, but its environments came out otherwise.
          RuntimeError: nothing was sent, or the pool is closed.
        """
        self._check_half(half)
        if half not in self._workers.in_flight:
            raise RuntimeError(f"Half {half} is not running; send actions first.")
        self._receive(half)
        return self._result(self.rows(half))

    def _receive(self, half: int) -> None:
        self._workers.wait(half)
        arrays, rows = self._arrays, self.rows(half)
        is_end = arrays.terminated[rows] | arrays.truncated[rows]
        self._episodes.act(rows, arrays.ids[rows], arrays.positions[rows], is_end)

    def step(self, ids: np.ndarray, positions: np.ndarray | None = None) -> HostStep:
        """One decision in all environments: ids [N], positions [N, k]; see `send`, `receive`."""
        self._check_idle()
        self._check_begun()
        ids, positions = self._checked_actions(ids, positions, self.num_envs)
        for half in range(self.num_halves):
            self._send(half, ids[self.rows(half)], positions[self.rows(half)])
        for half in range(self.num_halves):
            self._receive(half)
        return self._result(slice(0, self.num_envs))

    def _result(self, rows: slice) -> HostStep:
        arrays = self._arrays
        return HostStep(
            self._observations[rows],
            self._final_observations[rows],
            arrays.rewards[rows].copy(),
            arrays.terminated[rows].copy(),
            arrays.truncated[rows].copy(),
            {name: arrays.metrics[rows, j].copy() for j, name in enumerate(self.episode_metrics)},
        )

    def state_dict(self, num_steps: int | None = None) -> dict[str, np.ndarray]:
        """Everything that `load_state` needs, as small arrays; no half may be running.

        Args:
          num_steps: L, how many steps of the running episodes there is room for: the step limit of
            the environment, where the shapes of the state must not change. None: as many as needed.

        Returns:
          seed int64[], episodes int64[N], observation_crc int64[N], lengths int64[N], ids
          int32[L, N], positions f32[L, N, k].
        """
        self._check_begun(may_be_closed=True)
        if self._episodes.is_numbered:
            raise RuntimeError("An evaluation has no state; load_state or a new pool goes on.")
        if self._workers.in_flight and not self._workers.why_closed:
            raise RuntimeError(f"Halves {self._workers.in_flight} are running; receive them first.")
        return {
            **self._episodes.state(num_steps),
            "observation_crc": self._workers.checksums(range(self.num_envs)),
        }

    def load_state(self, state: Mapping[str, Any]) -> np.ndarray:
        """Goes on where `state_dict` was called, in a pool with any number of workers and halves.

        The pool's seed becomes that of the state.

        Returns:
          Observations [N, ...], those of the time; a view as from `reset`.

        Raises:
          ValueError: the state is that of another kind of pool.
          ReplayMismatch: the environments did not come out as they were; they have changed, or
            do not follow from seed and actions alone. The pool is closed then.
        """
        self._check_idle()
        self._episodes.load(state)
        self._workers.restore()
        self._workers.check_replay(dict(enumerate(np.asarray(state["observation_crc"]).tolist())))
        return self._observations[:]

    def close(self) -> None:
        """Ends the workers; arrays that were handed out stay valid."""
        self._workers.close("close() was called")

    def __reduce__(self) -> Any:
        raise TypeError(
            "A HostPool has processes, which cannot be copied; make another one and give it "
            "state_dict() by load_state()."
        )

    def __enter__(self) -> HostPool:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._workers.why_closed:
            raise RuntimeError(f"The pool is closed: {self._workers.why_closed}. Make a new one.")

    def _check_idle(self) -> None:
        self._check_open()
        if self._workers.in_flight:
            raise RuntimeError(f"Halves {self._workers.in_flight} are running; receive them first.")

    def _check_begun(self, may_be_closed: bool = False) -> None:
        if not may_be_closed:
            self._check_open()
        if not self._episodes.have_begun:
            raise RuntimeError("No episode has begun; call reset() or load_state(...) first.")

    def _check_half(self, half: int) -> None:
        self._check_open()
        if not 0 <= half < self.num_halves:
            raise ValueError(f"half={half} must be 0 .. {self.num_halves - 1}.")

    def _checked_actions(
        self, ids: np.ndarray, positions: np.ndarray | None, n: int
    ) -> tuple[np.ndarray, np.ndarray]:
        ids = np.asarray(ids)
        if positions is None and self.position_dim == 0:
            positions = np.zeros((n, 0), np.float32)
        positions = np.asarray(positions)
        if ids.shape != (n,) or ids.dtype.kind not in "iu":
            raise ValueError(f"ids are {ids.dtype}{list(ids.shape)}; they must be integer[{n}].")
        if positions.shape != (n, self.position_dim) or positions.dtype.kind != "f":
            raise ValueError(
                f"positions are {positions.dtype}{list(positions.shape)}; they must be "
                f"float[{n}, {self.position_dim}]."
            )
        ids32 = ids.astype(np.int32)
        if (ids32 != ids).any():
            raise ValueError(f"ids must fit into 32 bits; got {ids.min()} .. {ids.max()}.")
        return ids32, positions


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _check_arguments(num_envs: int, num_workers: int, seed: int, num_halves: int) -> None:
    if not 1 <= num_halves < FIRST_CODE:
        raise ValueError(f"num_halves={num_halves} must be 1 .. {FIRST_CODE - 1}.")
    if num_envs < 1 or num_envs % num_halves:
        above = max(-(-num_envs // num_halves), 1) * num_halves
        raise ValueError(
            f"num_envs={num_envs} must be a multiple of num_halves={num_halves}; try {above}."
        )
    if not 1 <= num_workers <= num_envs // num_halves:
        raise ValueError(
            f"num_workers={num_workers} must be 1 .. {num_envs // num_halves}, so that each has "
            "environments of every half."
        )
    _check_seed(seed)


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed={seed} must be 0 .. 2^63 - 1.")


def _setups(
    factory: str,
    kwargs: Mapping[str, Any] | None,
    num_envs: int,
    num_workers: int,
    num_halves: int,
    pin_cores: bool,
) -> list[Setup]:
    """What each worker is: an even share of the environments of every half."""
    try:
        plain = json.loads(json.dumps(dict(kwargs or {})))
    except TypeError as err:
        raise ValueError(
            f"kwargs={kwargs!r} must be plain numbers, strings, lists and dictionaries: {err}."
        ) from err
    cores: list[int | None] = [None]
    if pin_cores and hasattr(os, "sched_getaffinity"):  # Not on macOS.
        cores = [*sorted(os.sched_getaffinity(0))]
    size = num_envs // num_halves
    return [
        Setup(
            factory,
            plain,
            num_envs,
            tuple(
                (half * size + w * size // num_workers, half * size + (w + 1) * size // num_workers)
                for half in range(num_halves)
            ),
            cores[w % len(cores)],
        )
        for w in range(num_workers)
    ]
