"""A worker process as the pool sees it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from envs_host import channel as codes
from envs_host.channel import Channel, HungUp
from envs_host.memory import Failure, Setup

# Environments do one thing each; threads of their libraries would only fight for the cores.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "BLIS_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
}
EXIT_S = 5.0  # How long a worker that was asked to end may take.
_SIGNALS = {int(member): member.name for member in signal.Signals}
_DUMP_S = 1.0  # How long a worker that hangs may take to say where.


class Lost(Exception):
    """A worker is of no more use; the text says what happened.

    Attributes:
      failure: what the worker itself told, None if it could not.
    """

    def __init__(self, reason: str, failure: Failure | None = None) -> None:
        super().__init__(reason)
        self.failure = failure


class WorkerProcess:
    """Starts a worker, exchanges messages with it, and knows why it is gone.

    A lost worker may be started again.

    Attributes:
      setup: what the worker is.
      answers: halves that it has stepped since they were last asked for.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.answers: set[int] = set()
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: Channel
        self._report: IO[bytes]
        self._last_words = ""

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Starts the process, anew if it was there; it will answer with its format."""
        self.stop(grace_s=0.0)
        self._report = tempfile.TemporaryFile()  # noqa: SIM115 It lives as long as the process.
        here, there = socket.socketpair()
        self._channel = Channel(here)
        report = self._report.fileno()
        command = [sys.executable, "-P", "-m", "envs_host.worker", str(there.fileno()), str(report)]
        # A mask is inherited, so Ctrl-C cannot hit the worker before it ignores it.
        old = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                command,
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": _import_path()},
                stdin=subprocess.DEVNULL,
                pass_fds=(there.fileno(), report),
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, old)
            there.close()
        with contextlib.suppress(HungUp):  # Found when its answer is read.
            self._channel.send(codes.SETUP, self.setup)

    def signal(self, code: int) -> None:
        """Asks for something. That the worker is gone shows when its answer is read."""
        self.answers.discard(code)
        with contextlib.suppress(HungUp):
            self._channel.signal(code)

    def send_memory(self, descriptor: int) -> None:
        with contextlib.suppress(HungUp):
            self._channel.send_memory(descriptor)

    def send(self, code: int, payload: Any, timeout_s: float) -> None:
        """Sends a message that may be too large for the socket to hold.

        Raises:
          Lost: it was not read in time.
        """
        self._set_timeout(timeout_s)
        try:
            self._channel.send(code, payload)
        except HungUp:
            pass
        except TimeoutError:
            raise self._hung(timeout_s) from None

    def read(self, timeout_s: float) -> tuple[int, Any]:
        """The next answer, as (code, payload).

        Raises:
          Lost: the worker failed or ended, or there was no answer in time. It is dead then.
        """
        self._set_timeout(timeout_s)
        try:
            code, payload = self._channel.receive()
        except TimeoutError:
            raise self._hung(timeout_s) from None
        except HungUp:
            raise self._ended() from None
        if code == codes.FAILED:
            self.stop(grace_s=0.0)
            raise Lost(f"raised an exception while it {payload.activity}", payload)
        if code < codes.FIRST_CODE:
            self.answers.add(code)
        return code, payload

    def _set_timeout(self, timeout_s: float) -> None:
        if self._channel.socket.gettimeout() != timeout_s:
            self._channel.socket.settimeout(timeout_s)

    def _hung(self, timeout_s: float) -> Lost:
        """Kills a worker that does not answer, after asking it where it is."""
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGUSR1)
        deadline = time.monotonic() + _DUMP_S
        before, text = "", self._read_report()
        while (not text or text != before) and time.monotonic() < deadline:
            time.sleep(0.02)
            before, text = text, self._read_report()
        self.stop(grace_s=0.0)
        return Lost(f"gave no answer in {timeout_s:g} s{self._said()}")

    def _ended(self) -> Lost:
        """Says how a worker that has closed its end came to its end."""
        self.stop()
        assert self._process is not None
        status = self._process.returncode
        if status >= 0:
            return Lost(f"ended with exit status {status}; its own messages are on stderr")
        name = _SIGNALS.get(-status, f"signal {-status}")
        hint = " (which is also what happens when memory runs out)" if name == "SIGKILL" else ""
        return Lost(f"was killed by {name}{hint}{self._said()}")

    def _said(self) -> str:
        return f". It was at:\n{self._last_words}" if self._last_words else ""

    def _read_report(self) -> str:
        # The worker writes at the file's one position, so it must not be moved.
        return os.pread(self._report.fileno(), 1 << 16, 0).decode(errors="replace").rstrip()

    def hang_up(self) -> None:
        """Asks the worker to close its environments and to exit."""
        if self._process is not None:
            with contextlib.suppress(OSError):
                self._channel.socket.shutdown(socket.SHUT_WR)

    def stop(self, grace_s: float = EXIT_S) -> None:
        """Returns when the process is no more; it is killed when `grace_s` have passed."""
        if self._process is None or self._process.returncode is not None:
            return
        self.hang_up()
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._last_words = self._read_report()
        self._report.close()
        self._channel.socket.close()


def _import_path() -> str:
    """What a worker must have in PYTHONPATH to find the modules that its parent finds."""
    own = str(Path(__file__).resolve().parents[1])
    entries = [os.path.abspath(entry) for entry in sys.path]
    return os.pathsep.join([*entries, *([own] if own not in entries else [])])


def exit_all(workers: Sequence[WorkerProcess], owner: int) -> None:
    """Ends all workers, unless this is a copy of the pool in a forked process."""
    if os.getpid() != owner:
        return
    for worker in workers:
        worker.hang_up()
    deadline = time.monotonic() + EXIT_S
    for worker in workers:
        worker.stop(max(deadline - time.monotonic(), 0.0))
