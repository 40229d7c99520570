"""The workers of a pool together: started, asked, and replaced when they are lost."""

from __future__ import annotations

import logging
import os
import weakref
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from envs_host import channel as codes
from envs_host._process import Lost, WorkerProcess, exit_all
from envs_host.episodes import Episodes
from envs_host.memory import Format, Setup, SharedArrays, new_memory

_LOG = logging.getLogger("envs_host.pool")


class WorkerError(RuntimeError):
    """A worker died, raised or gave no answer. The text has all of the following.

    Attributes:
      worker: its index.
      environments: indices of its environments.
      seeds: (seed, spawn key) of their running episodes: `np.random.SeedSequence(seed,
        spawn_key=spawn_key)` starts one again. A key is (environment, episode), in an evaluation
        (number of the episode,).
      environment: the one that was at work when the worker raised; None where that is not known.
      reason: what happened.
      traceback: of the exception in the worker; empty if there was none.
    """

    def __init__(
        self,
        worker: int,
        environments: Sequence[int],
        seeds: tuple[tuple[int, tuple[int, ...]], ...],
        lost: Lost,
    ) -> None:
        self.worker, self.seeds, self.reason = worker, seeds, str(lost)
        self.environments = tuple(environments)
        self.environment = None if lost.failure is None else lost.failure.environment
        self.traceback = "" if lost.failure is None else lost.failure.traceback
        what = "" if self.environment is None else f", in environment {self.environment}"
        keys = ", ".join(str(key) for _, key in seeds)
        parts = "(environment, episode)" if len(seeds[0][1]) == 2 else "(number of the episode,)"
        super().__init__(
            f"Worker {worker} {self.reason}{what}.\nIt held environments "
            f"{list(self.environments)}, with seed {seeds[0][0]} and spawn keys {parts} "
            f"{keys}.\n{self.traceback}".rstrip()
        )


class ReplayMismatch(RuntimeError):
    """Replaying what was done did not lead to the same observations: nothing can be restored."""


class Workers:
    """Workers, the memory that they share, and which halves they are stepping.

    Attributes:
      format: of the environments.
      arrays: shared with the workers.
      in_flight: halves that were sent and not received, in the order of sending.
      why_closed: empty while the workers live.
    """

    def __init__(
        self,
        setups: Sequence[Setup],
        episodes: Episodes,
        *,
        timeout_s: float,
        start_timeout_s: float,
        max_restarts: int,
    ) -> None:
        self.in_flight: list[int] = []
        self.why_closed = ""
        self._episodes = episodes
        self._timeout_s, self._start_timeout_s = timeout_s, start_timeout_s
        self._max_restarts, self._num_restarts = max_restarts, 0
        self._workers = [WorkerProcess(setup) for setup in setups]
        self._close_memory: Callable[[], object] = lambda: None
        # Also runs when the pool is forgotten and when the interpreter ends.
        self._exit_all = weakref.finalize(self, exit_all, self._workers, os.getpid())
        try:
            self._start()
        except BaseException:
            self.close("a worker did not start")
            raise

    @property
    def pids(self) -> tuple[int, ...]:
        return tuple(worker.pid for worker in self._workers)

    def _start(self) -> None:
        for worker in self._workers:
            worker.start()
        formats = []
        for w, worker in enumerate(self._workers):
            try:
                formats.append(self._format_of(worker))
            except Lost as err:
                raise self._error(w, err) from None
        if len(set(formats)) > 1:
            raise ValueError(f"The workers made different environments: {formats}.")
        self.format: Format = formats[0]
        num_envs = len(self._episodes.numbers)
        self._memory = new_memory(self.format, num_envs)
        self._close_memory = weakref.finalize(self, os.close, self._memory)
        self.arrays = SharedArrays.over(self._memory, self.format, num_envs)
        self._episodes.share(self.arrays.episodes, self.format.position_dim)
        for worker in self._workers:
            worker.send_memory(self._memory)

    def _format_of(self, worker: WorkerProcess) -> Format:
        code, found = worker.read(self._start_timeout_s)
        assert code == codes.FORMAT
        assert isinstance(found, Format)
        return found

    def send(self, half: int) -> None:
        """Has all workers step a half."""
        self.in_flight.append(half)
        for worker in self._workers:
            worker.signal(half)

    def wait(self, half: int) -> None:
        """Returns when all workers have stepped a half.

        Raises:
          WorkerError: a worker is lost and may not be replaced; all are closed then.
        """
        for w, worker in enumerate(self._workers):
            while half not in worker.answers:
                try:
                    worker.read(self._timeout_s)
                except Lost as err:
                    self._replace(w, err, has_observations=True)
        self.in_flight.remove(half)

    def restore(self) -> None:
        """Brings all environments to where `episodes` says that they are."""
        lost: dict[int, Lost] = {}
        for w, worker in enumerate(self._workers):
            try:
                self._ask_to_restore(worker)
            except Lost as err:
                lost[w] = err
        for w, worker in enumerate(self._workers):
            try:
                if w in lost:
                    raise lost[w]
                self._wait_until_restored(worker)
            except Lost as err:
                self._replace(w, err, has_observations=False)

    def _ask_to_restore(self, worker: WorkerProcess) -> None:
        restore = self._episodes.restore(_environments(worker.setup.halves))
        worker.send(codes.RESTORE, restore, self._timeout_s)

    def _wait_until_restored(self, worker: WorkerProcess) -> None:
        while worker.read(self._timeout_s)[0] != codes.RESTORED:
            pass  # It has replayed an action.

    def _replace(self, w: int, lost: Lost, has_observations: bool) -> None:
        """Starts a lost worker again, brings its environments back and sends it what was running.

        Args:
          w: the worker.
          lost: how.
          has_observations: those of environments that are not running are there; they must come
            out the same.
        """
        worker = self._workers[w]
        known = _environments(worker.setup.halves) if has_observations else []
        before = dict(zip(known, self.checksums(known).tolist(), strict=True))
        while True:
            error = self._error(w, lost)
            if self._num_restarts == self._max_restarts:
                self.close(f"worker {w} was lost")
                raise error from None
            self._num_restarts += 1
            count = f"restart {self._num_restarts} of {self._max_restarts}"
            _LOG.warning("Replacing a worker (%s). %s", count, error)
            try:
                self._start_again(worker)
                break
            except Lost as err:
                lost = err
        self.check_replay(before)
        for half in self.in_flight:
            worker.signal(half)

    def _start_again(self, worker: WorkerProcess) -> None:
        worker.start()
        found = self._format_of(worker)
        if found != self.format:
            raise Lost(f"came back with other environments: {found}, not {self.format}")
        worker.send_memory(self._memory)
        self._ask_to_restore(worker)
        self._wait_until_restored(worker)

    def _error(self, w: int, lost: Lost) -> WorkerError:
        environments = _environments(self._workers[w].setup.halves)
        return WorkerError(w, environments, self._episodes.seeds(environments), lost)

    def checksums(self, environments: Iterable[int]) -> np.ndarray:
        """int64[n] of the environments' observations, -1 where a step may have overwritten them."""
        rows, halves = self.arrays.observations, self._workers[0].setup.halves
        size = len(rows) // len(halves)
        return np.array(
            [
                -1 if i // size in self.in_flight else zlib.crc32(rows[i].tobytes())
                for i in environments
            ],
            np.int64,
        )

    def check_replay(self, before: Mapping[int, int]) -> None:
        """Compares the observations with the `checksums` of the same environments.

        Raises:
          ReplayMismatch: some are others; the workers are closed then.
        """
        after = dict(zip(before, self.checksums(before).tolist(), strict=True))
        wrong = [i for i in before if before[i] >= 0 and after[i] != before[i]]
        if wrong:
            self.close("replaying its actions led elsewhere")
            raise ReplayMismatch(
                f"After replaying their actions, environments {wrong} have other observations than "
                "before. They must follow from the seed of the reset and the actions alone, and "
                "be made by the same code with the same arguments."
            )

    def close(self, why: str) -> None:
        """Ends all workers: at once where they are idle, by force where they hang."""
        self.why_closed = self.why_closed or why
        self._exit_all()
        self._close_memory()


def _environments(halves: Iterable[tuple[int, int]]) -> list[int]:
    return [i for first, end in halves for i in range(first, end)]
