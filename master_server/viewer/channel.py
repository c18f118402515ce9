# SPDX-License-Identifier: Apache-2.0
"""Requests and answers between the viewer and the master: msgpack with a length prefix, over a socket pair.

Only the viewer sends requests, and only the master answers. So the viewer never receives more than it requested.
"""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TookTooLong
from typing import TypeVar

import msgpack
from pydantic import TypeAdapter, ValidationError

from master_server.viewer.messages import RefusedAnswer, Request, ViewerMessage
from shared.configuration import sentence
from shared.errors import Refusal, WireError

Answer = TypeVar("Answer", bound=ViewerMessage)

REQUESTS: TypeAdapter[Request] = TypeAdapter(Request)

LENGTH = struct.Struct("<I")

MESSAGE_MAX_BYTES = 2**26
"""A map of 2**18 voxels takes 1.3 MB, a mesh at most some 30."""

CONVERSATION_S = 15.0
"""A later answer is of no use to a user in front of a browser; an image takes up to 5 s."""


def pack(number: int, message: ViewerMessage) -> bytes:
    """Encode a request, or the answer to the request of this number."""
    data: bytes = msgpack.packb((number, message.model_dump()))
    return LENGTH.pack(len(data)) + data


def _length(head: bytes) -> int:
    (length,) = LENGTH.unpack(head)
    if length > MESSAGE_MAX_BYTES:
        raise WireError(f"viewer: expected messages of at most {MESSAGE_MAX_BYTES} bytes, got one of {length}")
    return int(length)


async def receive(reader: asyncio.StreamReader) -> tuple[int, Request] | None:
    """Return the next request and its number; None at the end.

    Raises:
        WireError: the request is too long, or is no valid request of the viewer.
    """
    try:
        length = _length(await reader.readexactly(LENGTH.size))
        number, fields = _unpacked(await reader.readexactly(length))
        return number, REQUESTS.validate_python(fields)
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    except ValidationError as error:
        raise WireError(f"viewer: {sentence(error)}") from error


def _unpacked(data: bytes) -> tuple[int, object]:
    number, fields = msgpack.unpackb(data, strict_map_key=False)
    return int(number), fields


class MasterChannel:
    """The viewer's end of the channel: any thread may send requests; answers come in any order."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._waiting: dict[int, Future[object]] = {}
        self._numbers = itertools.count()

    def request(self, request: ViewerMessage, kind: type[Answer]) -> Answer:
        """Send a request and return the master's answer, which has type `kind`.

        Raises:
            Refusal: 500, the master refuses, or its answer has another type.
            WireError: no answer came within `CONVERSATION_S`, or the master has ended.
        """
        number = next(self._numbers)
        answer: Future[object] = Future()
        self._waiting[number] = answer
        try:
            with self._sending:
                self._connection.sendall(pack(number, request))
            return _answer_of(answer.result(CONVERSATION_S), kind)
        except TookTooLong as error:
            raise WireError(f"the master did not answer within {CONVERSATION_S:g} s") from error
        except OSError as error:
            raise WireError(f"the master has ended: {error}") from error
        finally:
            self._waiting.pop(number, None)

    def listen(self) -> None:
        """Deliver answers to the waiting threads until the master ends."""
        while (message := self._receive()) is not None:
            number, fields = message
            waiting = self._waiting.get(number)
            if waiting is not None and not waiting.done():
                waiting.set_result(fields)

    def _receive(self) -> tuple[int, object] | None:
        head = self._read(LENGTH.size)
        data = None if head is None else self._read(_length(head))
        return None if data is None else _unpacked(data)

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


def _answer_of(fields: object, kind: type[Answer]) -> Answer:
    if isinstance(fields, dict) and "refused" in fields:
        raise Refusal(500, RefusedAnswer.model_validate(fields).refused)
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise Refusal(500, f"viewer: the master's answer is no {kind.__name__}: {sentence(error)}") from error
