# SPDX-License-Identifier: Apache-2.0
"""What a unit can ask the master, each call one request; errors of HTTP become ours here."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

from edge_unit.http import Http, HttpConnections
from shared.errors import MasterRefused, WireError
from shared.messages import (
    InitializeAnswer,
    InitializeRequest,
    PoseAnswer,
    PoseRequest,
    RobotAnswer,
    UpdateAnswer,
    UpdateRequest,
)
from shared.transforms import Transform
from shared.wire import MAX_ANSWER_BYTES, MEDIA_TYPE, decode, decode_update_answer, encode, encode_update, unpack

TIMEOUT_S = 2.0
"""A master that takes longer is as good as gone: the next frame is worth more than the answer to this one."""

TRANSFER_TIMEOUT_S = 30.0
"""For a mesh of MAX_MESH_BYTES over a network that is slow but works."""

MAX_MESH_BYTES = 128 * 2**20
"""Of one mesh; a robot link has a hundredth of it."""

MSGPACK_BOTH_WAYS = {"Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}

ERROR_CHARS = 300
"""Of the master's reason."""


class MasterClient:
    """A connection to one master, kept open between calls."""

    def __init__(
        self,
        url: str,
        read_token: Callable[[], str],
        source_address: str | None = None,
        http: Http | None = None,
    ) -> None:
        """`read_token` is asked at each registration; `source_address` is an own IP to connect from.

        `http` carries the requests, if not connections of its own. Raises ConfigError when `url` has no host.
        """
        self.url = url.rstrip("/")
        self._read_token = read_token
        self._http = http or HttpConnections(self.url, source_address)
        self._authorization: dict[str, str] = {}

    async def __aenter__(self) -> MasterClient:
        await self.authorize()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._http.close()

    async def authorize(self) -> None:
        """Read the token again.

        Raises:
            ConfigError: there is none.
        """
        token = await asyncio.to_thread(self._read_token)
        self._authorization = {"Authorization": f"Bearer {token}"}

    async def initialize(self, request: InitializeRequest) -> InitializeAnswer:
        """Ask for a slot. Raises as `update`."""
        return decode(InitializeAnswer, await self._call("POST", "/initialize", encode(request)))

    async def update(self, update: UpdateRequest) -> UpdateAnswer:
        """Report a frame.

        Raises:
            MasterUnreachable: nobody answered in time.
            MasterRefused: the master said no; `status` tells how.
            WireError: the answer is none of ours.
        """
        headers = {"Content-Type": MEDIA_TYPE}
        return decode_update_answer(await self._call("POST", "/update", encode_update(update), headers))

    async def robot(self, since_ns: int, timeout_s: float) -> RobotAnswer:
        """Joints after `since_ns` by the master's clock. Raises as `update`."""
        data = await self._call("GET", f"/robot?since_ns={since_ns}", timeout_s=timeout_s)
        return decode(RobotAnswer, data)

    async def put_pose(self, unit_id: int, T_world_camera: Transform, origin: str) -> int:
        """Tell where the camera is; returns the version of the pose. Raises as `update`."""
        request = PoseRequest.model_validate({"T_world_camera": T_world_camera.tolist(), "origin": origin})
        data = await self._call("PUT", f"/units/{unit_id}/pose", encode(request))
        return decode(PoseAnswer, data).pose

    async def cell_document(self) -> dict[str, Any]:
        """The cell's document. Raises as `update`."""
        document = unpack(await self._call("GET", "/cell", timeout_s=TRANSFER_TIMEOUT_S), MAX_ANSWER_BYTES)
        if not isinstance(document, dict):
            raise WireError(f"cell: expected a document, got {type(document).__name__}")
        return document

    async def mesh(self, sha256: str) -> bytes:
        """A mesh in its canonical bytes. Raises as `update`."""
        return await self._call("GET", f"/cell/meshes/{sha256}", timeout_s=TRANSFER_TIMEOUT_S, max_bytes=MAX_MESH_BYTES)

    async def _call(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: Mapping[str, str] = MSGPACK_BOTH_WAYS,
        timeout_s: float = TIMEOUT_S,
        max_bytes: int = MAX_ANSWER_BYTES,
    ) -> bytes:
        answer = await self._http.request(
            method, path, {**self._authorization, **headers}, body, timeout_s, max_bytes
        )
        if answer.status >= 300:
            raise MasterRefused(f"{self.url}{path}: {answer.status}: {_reason(answer.body)}", answer.status)
        return answer.body


def _reason(body: bytes) -> str:
    """The one sentence of a refusal, whichever way it was encoded."""
    text = body[:ERROR_CHARS].decode("utf-8", "replace")
    return text.removeprefix('{"detail":"').removesuffix('"}')
