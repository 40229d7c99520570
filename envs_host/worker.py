"""A worker process of `envs_host.pool.HostPool`, which starts it as `python -m envs_host.worker`.

It holds some environments of every half, answers one byte with one byte per decision, and exits
when the other end of its socket is closed.
"""

from __future__ import annotations

import contextlib
import faulthandler
import io
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from envs_host import channel as codes
from envs_host.channel import Channel, HungUp
from envs_host.memory import Failure, Format, Restore, Setup, SharedArrays, episode_key
from envs_host.protocol import HostEnvironment, load_factory
from jaxnew.cores import signal_at_parents_end
from jaxnew.host_checks import checked_observation, checked_step

# A worker in the middle of a step gets this long to finish once the pool's process is gone.
GRACE_S = 1.0


class ProtocolError(Exception):
    """An environment breaks the protocol."""


class Host:
    """The environments of one worker.

    Attributes:
      format: of all environments.
      environment: the one at work, None between them.
      activity: what the worker is doing; it goes into error messages.
    """

    def __init__(self, setup: Setup) -> None:
        self.environment: int | None = None
        self.activity = "started"
        self.format: Format
        self._setup = setup
        self._seed, self._is_numbered = 0, False
        self._arrays: SharedArrays
        self._environments: dict[int, HostEnvironment] = {}

    def make_environments(self) -> None:
        if self._setup.core is not None and hasattr(os, "sched_setaffinity"):  # Not on macOS.
            os.sched_setaffinity(0, {self._setup.core})
        make = load_factory(self._setup.factory)
        for first, end in self._setup.halves:
            for i in range(first, end):
                self.environment = i
                self._environments[i] = make(**self._setup.kwargs)
        self.environment = None
        self.format = self._common_format()

    def _common_format(self) -> Format:
        formats = {i: _format_of(env) for i, env in self._environments.items()}
        first = next(iter(formats.values()))
        for i, other in formats.items():
            if other != first:
                raise ProtocolError(
                    f"The factory makes different environments: {first} and, for environment {i}, "
                    f"{other}. All must have the same shapes, dtypes and metrics."
                )
        return first

    def share(self, descriptor: int) -> None:
        """Maps the memory that the pool made, and closes the descriptor."""
        self._arrays = SharedArrays.over(descriptor, self.format, self._setup.num_envs)
        os.close(descriptor)

    def restore(self, restore: Restore, tell_progress: Callable[[], None]) -> None:
        """Starts the environments' running episodes and replays what happened in them."""
        self.activity = "restored environments"
        self._seed, self._is_numbered = restore.seed, restore.is_numbered
        for i, (ids, positions) in restore.logs.items():
            self.environment = i
            observation = self._reset(i, int(self._arrays.episodes[i]))
            for t, (action_id, position) in enumerate(zip(ids.tolist(), positions, strict=True)):
                observation, _, terminated, truncated, _ = self._stepped(
                    i, action_id, position.copy()
                )
                if terminated or truncated:
                    raise ProtocolError(
                        f"Replaying {len(ids)} actions, the episode ended after {t + 1}, which it "
                        "had not done before: the environment does not follow from its seed and "
                        "actions alone, or it has changed."
                    )
                tell_progress()
            self._arrays.observations[i] = observation
            tell_progress()
        self.environment = None

    def step(self, half: int) -> None:
        """Does one decision in the environments of a half; those that end start anew."""
        self.activity = f"stepped half {half}"
        arrays, names = self._arrays, self.format.episode_metrics
        first, end = self._setup.halves[half]
        rewards, terminations, truncations, rows = [], [], [], []
        actions = zip(
            arrays.ids[first:end].tolist(), arrays.positions[first:end].copy(), strict=True
        )
        for i, (action_id, position) in enumerate(actions, first):
            self.environment = i
            observation, reward, terminated, truncated, metrics = self._stepped(
                i, action_id, position
            )
            arrays.final_observations[i] = observation
            rewards.append(reward)
            terminations.append(terminated)
            truncations.append(truncated)
            rows.append([float(metrics[name]) for name in names])
            if terminated or truncated:
                observation = self._reset(i, int(arrays.episodes[i]) + 1)
            arrays.observations[i] = observation
        self.environment = None
        arrays.rewards[first:end] = rewards
        arrays.terminated[first:end] = terminations
        arrays.truncated[first:end] = truncations
        arrays.metrics[first:end] = rows

    def _reset(self, i: int, episode: int) -> np.ndarray:
        key = episode_key(i, episode, self._setup.num_envs, self._is_numbered)
        env = self._environments[i]
        observation = env.reset(np.random.SeedSequence(self._seed, spawn_key=key))
        with _promises():
            # Assigning one of another shape would broadcast, of another dtype cast.
            return checked_observation(f"{type(env).__name__}.reset", env, observation)

    def _stepped(self, i: int, action_id: int, position: np.ndarray) -> tuple[Any, ...]:
        """Steps an environment; the five parts of `protocol.Step`, checked."""
        env = self._environments[i]
        step, what = env.step(action_id, position), f"{type(env).__name__}.step"
        with _promises():
            observation, *rest = checked_step(what, step, self.format.episode_metrics)
            return checked_observation(what, env, observation), *rest

    def close(self) -> None:
        for env in self._environments.values():
            close = getattr(env, "close", None)
            if close is not None:
                close()


@contextlib.contextmanager
def _promises() -> Iterator[None]:
    """What is wrong with what an environment gave is wrong with the environment."""
    try:
        yield
    except ValueError as err:
        raise ProtocolError(str(err)) from None


def _format_of(env: HostEnvironment) -> Format:
    dtype = np.dtype(env.observation_dtype)
    if dtype not in (np.dtype(np.uint8), np.dtype(np.float32)):
        raise ProtocolError(f"observation_dtype={dtype} must be uint8 or float32.")
    return Format(
        tuple(int(size) for size in env.observation_shape),
        dtype.name,
        int(env.position_dim),
        tuple(env.episode_metrics),
    )


def serve(channel: Channel) -> None:
    """Answers the pool until it hangs up."""
    host: Host | None = None
    try:
        _, setup = channel.receive()
        host = Host(setup)
        with _exceptions_told(channel, host):
            host.make_environments()
        channel.send(codes.FORMAT, host.format)
        host.share(channel.receive_memory())
        while True:
            _answer(channel, host)
    except HungUp:
        if host is not None:
            host.close()


def _answer(channel: Channel, host: Host) -> None:
    code, payload = channel.receive()
    with _exceptions_told(channel, host):
        if code == codes.RESTORE:
            host.restore(payload, lambda: channel.signal(codes.PROGRESS))
        else:
            host.step(code)
    channel.signal(codes.RESTORED if code == codes.RESTORE else code)


@contextlib.contextmanager
def _exceptions_told(channel: Channel, host: Host) -> Iterator[None]:
    """Sends any exception to the pool and ends the worker: its environments are in no known state.

    `SystemExit` is one of them: an environment has no business ending the process.
    """
    try:
        yield
    except HungUp:
        raise
    except BaseException as err:
        # A broken promise is told in a sentence; where it was found says nothing more.
        told = f"{err}" if isinstance(err, ProtocolError) else traceback.format_exc()
        failure = Failure(host.environment, host.activity, told)
        channel.send(codes.FAILED, failure)
        raise SystemExit(1) from err


def _exit_without_parent(end: socket.socket, parent: int) -> None:
    """Ends the process when the pool's process is gone, even in the middle of a long step.

    That shows on the socket; and, where some other process has inherited the pool's end of it,
    by a new parent.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})  # The main thread's to answer.
    poll = select.poll()
    poll.register(end, 0)  # No event but that the other end is closed.
    while not poll.poll(2000) and os.getppid() == parent:
        pass
    time.sleep(GRACE_S)
    os._exit(1)


def main(socket_descriptor: int, report_descriptor: int) -> None:
    """Serves on an inherited socket.

    Args:
      socket_descriptor: of the worker's end.
      report_descriptor: of the file that gets a traceback when the process crashes, and on SIGUSR1.
    """
    parent = os.getppid()
    # A stopped process could not end itself. No signal that ends it: it may be that only the thread
    # of the pool's process is gone that started it.
    signal_at_parents_end(signal.SIGCONT)
    # Ctrl-C reaches the whole process group; ending is the pool's decision. The pool blocked the
    # signal so that it could not arrive before this line.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    for descriptor in (socket_descriptor, report_descriptor):
        os.set_inheritable(descriptor, False)
    faulthandler.enable(report_descriptor)
    faulthandler.register(signal.SIGUSR1, report_descriptor, all_threads=False)
    # What environments print is seen, but does not mix with the output of the pool's process.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    end = socket.socket(fileno=socket_descriptor)
    threading.Thread(target=_exit_without_parent, args=(end, parent), daemon=True).start()
    serve(Channel(end))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
