# SPDX-License-Identifier: Apache-2.0
"""Requests and answers between the master and its viewer: msgpack with a length before it, over a socket pair.

The viewer asks and the master answers, never the other way round; so the viewer is never sent more than it takes.
"""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TookTooLong
from typing import Any

import msgpack

from shared.errors import WireError

LENGTH = struct.Struct("<I")

MESSAGE_MAX_BYTES = 2**26
"""A map of 2**18 voxels takes 1.3 MB, a mesh at most some 30."""

CONVERSATION_S = 15.0
"""An answer that took longer is of no use to anyone in front of a window; a picture takes up to 5 s."""


def pack(message: dict[str, Any]) -> bytes:
    """A message as it travels."""
    data: bytes = msgpack.packb(message)
    return LENGTH.pack(len(data)) + data


def _length(head: bytes) -> int:
    (length,) = LENGTH.unpack(head)
    if length > MESSAGE_MAX_BYTES:
        raise WireError(f"viewer: expected messages of at most {MESSAGE_MAX_BYTES} bytes, got one of {length}")
    return int(length)


async def receive(reader: asyncio.StreamReader) -> dict[str, Any] | None:
    """The next message; None at the end.

    Raises:
        WireError: it is absurdly long.
    """
    try:
        length = _length(await reader.readexactly(LENGTH.size))
        return dict(msgpack.unpackb(await reader.readexactly(length), strict_map_key=False))
    except (asyncio.IncompleteReadError, ConnectionError):
        return None


class Asker:
    """The viewer's end: any thread may ask; answers come in any order."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._waiting: dict[int, Future[dict[str, Any]]] = {}
        self._numbers = itertools.count()

    def ask(self, **question: Any) -> dict[str, Any]:
        """The master's answer.

        Raises:
            WireError: there was none within `CONVERSATION_S`, or the master is gone.
        """
        number = next(self._numbers)
        answer: Future[dict[str, Any]] = Future()
        self._waiting[number] = answer
        try:
            with self._sending:
                self._connection.sendall(pack({"id": number, **question}))
            return answer.result(CONVERSATION_S)
        except TookTooLong as error:
            raise WireError(f"the master did not answer within {CONVERSATION_S:g} s") from error
        except OSError as error:
            raise WireError(f"the master is gone: {error}") from error
        finally:
            self._waiting.pop(number, None)

    def listen(self) -> None:
        """Hand out answers until the master is gone."""
        while (message := self._receive()) is not None:
            waiting = self._waiting.get(message["id"])
            if waiting is not None and not waiting.done():
                waiting.set_result(message)

    def _receive(self) -> dict[str, Any] | None:
        head = self._read(LENGTH.size)
        data = None if head is None else self._read(_length(head))
        return None if data is None else dict(msgpack.unpackb(data, strict_map_key=False))

    def _read(self, count: int) -> bytes | None:
        data = bytearray()
        while len(data) < count:
            try:
                piece = self._connection.recv(min(count - len(data), 2**20))
            except OSError:
                return None
            if not piece:
                return None
            data += piece
        return bytes(data)
