"""Messages between a pool and a worker: one byte over a socket, for some with a payload behind it.

A message is a code; codes below `FIRST_CODE` are halves: "step half 1", "half 1 has been stepped".
Both ends of the socket belong to one user's processes, so payloads may be pickled.
"""

from __future__ import annotations

import pickle
import socket
import struct
from typing import Any

FIRST_CODE = 200

# To the worker.
SETUP = 200  # Payload: `Setup`. Answer: FORMAT.
MEMORY = 201  # With the descriptor of the shared memory. No answer.
RESTORE = 202  # Payload: `Restore`. Answers: any number of PROGRESS, then RESTORED.
# To the pool.
FORMAT = 203  # Payload: `Format`.
PROGRESS = 204
RESTORED = 205
FAILED = 206  # Payload: `Failure`. The worker then exits.

_WITH_PAYLOAD = {SETUP, RESTORE, FORMAT, FAILED}
_LENGTH = struct.Struct("!Q")


class HungUp(Exception):
    """The other end of a channel is closed."""


class Channel:
    """One end of a stream socket.

    Every method raises `HungUp` when the other end is closed, and `TimeoutError` when the socket
    has a timeout and it passes.
    """

    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def signal(self, code: int) -> None:
        """Sends a code without payload."""
        self._send(bytes((code,)))

    def send(self, code: int, payload: Any) -> None:
        data = pickle.dumps(payload)
        self._send(bytes((code,)) + _LENGTH.pack(len(data)) + data)

    def send_memory(self, descriptor: int) -> None:
        try:
            socket.send_fds(self.socket, [bytes((MEMORY,))], [descriptor])
        except ConnectionError as err:
            raise HungUp from err

    def receive(self) -> tuple[int, Any]:
        """The next code and its payload, None if it has none."""
        try:
            data = self.socket.recv(1)
        except ConnectionError as err:
            raise HungUp from err
        if not data:
            raise HungUp
        code = data[0]
        if code not in _WITH_PAYLOAD:
            return code, None
        (length,) = _LENGTH.unpack(self._receive_exactly(_LENGTH.size))
        return code, pickle.loads(self._receive_exactly(length))

    def receive_memory(self) -> int:
        """The descriptor that `send_memory` sent; it must be the next message."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self.socket, 1, 1)
        except ConnectionError as err:
            raise HungUp from err
        if not data:
            raise HungUp
        assert data[0] == MEMORY
        return descriptors[0]

    def _send(self, data: bytes) -> None:
        try:
            self.socket.sendall(data)
        except ConnectionError as err:
            raise HungUp from err

    def _receive_exactly(self, length: int) -> bytes:
        parts = []
        while length:
            try:
                part = self.socket.recv(min(length, 1 << 20))
            except ConnectionError as err:
                raise HungUp from err
            if not part:
                raise HungUp
            parts.append(part)
            length -= len(part)
        return b"".join(parts)
