# SPDX-License-Identifier: Apache-2.0
"""The client of the master: each method sends one request. HTTP errors are raised as errors of this project."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

import httpx

from edge_unit.tls import tls_context
from shared.errors import ConfigError, MasterRefused, MasterUnreachable, NewerContract, WireError
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    ImageKind,
    InitializeAnswer,
    InitializeRequest,
    PoseAnswer,
    PoseQuality,
    PoseRequest,
    RobotAnswer,
    SlotAnswer,
    UpdateAnswer,
    UpdateRequest,
)
from shared.transforms import Transform
from shared.wire import MAX_ANSWER_BYTES, MEDIA_TYPE, decode, decode_update_answer, encode, encode_update, unpack

TIMEOUT = httpx.Timeout(2.0, connect=0.5)
"""Timeouts of a request. After 2 s the next frame is worth more than the answer to this one.

A connection attempt that starts while the network is cut does not succeed as soon as the network is back, because the
kernel retries only after a second. So the client gives up earlier and starts another attempt."""

TRANSFER_TIMEOUT_S = 30.0
"""Timeout for a mesh of `MAX_MESH_BYTES` over a slow network."""

MAX_MESH_BYTES = 128 * 2**20
"""Maximum size of one mesh. A robot link has a hundredth of it."""

IMAGE_TIMEOUT_S = 5.0
"""Timeout for sending an image. A client that requested the image waits no longer either."""

LIMITS = httpx.Limits(max_connections=4, max_keepalive_connections=4, keepalive_expiry=60.0)
"""One connection each for update, joints, cell and pose, which can run at the same time."""

MSGPACK_BOTH_WAYS = {"Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}

ERROR_CHARS = 300
"""Maximum length of the reason that is kept from a refusal."""


class MasterClient:
    """A connection to one master, kept open between calls."""

    def __init__(
        self,
        url: str | None,
        read_token: Callable[[], str],
        source_address: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        """Read no token yet: `read_token` is called at each registration.

        `source_address` is an IP address of this machine to connect from. `transport` carries the requests in place of
        a network. `tls` checks the master's certificate; without it, the certificate of an https master is checked
        against the CAs of the system. With `url` None there is no master until `set_url` names one.

        Raises:
            ConfigError: `url` is refused by `set_url`.
        """
        self._read_token = read_token
        self._tls = tls
        self.url = ""
        """URL of the master, empty while none is known."""
        if transport is None:
            # The TLS context is needed even with an http master: the next master may use https.
            transport = httpx.AsyncHTTPTransport(
                verify=tls or tls_context(), local_address=source_address, limits=LIMITS
            )
        self._http = httpx.AsyncClient(
            transport=transport,
            timeout=TIMEOUT,
            # No proxy from the environment: the master is on the unit's own network.
            trust_env=False,
        )
        if url is not None:
            self.set_url(url)
        # The master uses none of these headers, and they cost a hundred bytes in each update.
        for name in ("Accept", "Accept-Encoding", "Connection", "User-Agent"):
            del self._http.headers[name]

    def set_url(self, url: str) -> None:
        """Send all further requests to the master at `url`.

        Raises:
            ConfigError: `url` is not a URL, or not https although the master's certificate must be checked.
        """
        parts = urlsplit(url)
        if not parts.hostname:
            raise ConfigError(f"master_url: expected http://host:port, got {url}")
        if self._tls is not None and parts.scheme != "https":
            raise ConfigError(
                f"master_url: expected https, because the master's certificate must be checked, got {url}"
            )
        self.url = url.rstrip("/")
        self._http.base_url = httpx.URL(self.url)

    async def __aenter__(self) -> MasterClient:
        await self.authorize()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._http.aclose()

    async def authorize(self) -> None:
        """Read the token again.

        Raises:
            ConfigError: there is no token.
        """
        token = await asyncio.to_thread(self._read_token)
        self._http.headers["Authorization"] = f"Bearer {token}"

    async def initialize(self, request: InitializeRequest) -> InitializeAnswer:
        """Register, and return the master's answer.

        Raises as `update`, and also:
            MasterRefused: the master speaks an older contract than the unit.
            NewerContract: the master speaks a newer contract, and its answer has fields unknown to this unit.
        """
        try:
            data = await self._call("POST", "/initialize", encode(request))
        except MasterRefused as error:
            # A master of contract 5.0 knows no minor number, and refuses the field.
            if error.status == 422 and error.detail.startswith("contract_minor:"):
                raise self._older(0) from error
            raise
        try:
            answer = decode(InitializeAnswer, data)
        except WireError as error:
            if decode(SlotAnswer, data).contract_minor > CONTRACT_MINOR:
                raise NewerContract(str(error), data) from error
            raise
        if answer.contract_minor < request.contract_minor:
            raise self._older(answer.contract_minor)
        return answer

    def _older(self, minor: int) -> MasterRefused:
        """Return the error for a master of an older `minor`, whether it refused the registration itself or not."""
        ours = f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        detail = f"contract: this master speaks version {CONTRACT_VERSION}.{minor}, this unit {ours}"
        return MasterRefused(f"{self.url}/initialize: {detail}; update the master first", 400, detail)

    async def update(self, update: UpdateRequest) -> UpdateAnswer:
        """Report a frame, and return the answer.

        Raises:
            MasterUnreachable: the master did not answer in time.
            MasterRefused: the master refused the request; `status` is the HTTP status.
            WireError: the answer is not valid.
        """
        headers = {"Content-Type": MEDIA_TYPE}
        return decode_update_answer(await self._call("POST", "/update", encode_update(update), headers))

    async def robot(self, since_ns: int, timeout_s: float) -> RobotAnswer:
        """Return the joints after `since_ns`, in ns of the master's clock. Raises as `update`."""
        data = await self._call("GET", f"/robot?since_ns={since_ns}", timeout=httpx.Timeout(timeout_s))
        return decode(RobotAnswer, data)

    async def put_pose(
        self, unit_id: int, T_world_camera: Transform, origin: str, quality: PoseQuality | None = None
    ) -> int:
        """Report the camera's pose, and return the version of the pose. Raises as `update`."""
        document = {"T_world_camera": T_world_camera.tolist(), "origin": origin, "quality": quality or PoseQuality()}
        request = PoseRequest.model_validate(document)
        data = await self._call("PUT", f"/units/{unit_id}/pose", encode(request))
        return decode(PoseAnswer, data).pose

    async def put_image(self, unit_id: int, kind: ImageKind, command_id: int, png: bytes) -> None:
        """Send an image that a command requested. Raises as `update`."""
        path = f"/units/{unit_id}/images/{kind}?command={command_id}"
        await self._call("PUT", path, png, {"Content-Type": "image/png"}, IMAGE_TIMEOUT_S)

    async def cell_document(self) -> dict[str, Any]:
        """Return the cell's document. Raises as `update`."""
        document = unpack(await self._call("GET", "/cell", timeout=TRANSFER_TIMEOUT_S), MAX_ANSWER_BYTES)
        if not isinstance(document, dict):
            raise WireError(f"cell: expected a document, got {type(document).__name__}")
        return document

    async def mesh(self, sha256: str) -> bytes:
        """Return a mesh in its canonical bytes. Raises as `update`."""
        return await self._call("GET", f"/cell/meshes/{sha256}", timeout=TRANSFER_TIMEOUT_S, limit=MAX_MESH_BYTES)

    async def _call(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: Mapping[str, str] = MSGPACK_BOTH_WAYS,
        timeout: httpx.Timeout | float = TIMEOUT,
        limit: int = MAX_ANSWER_BYTES,
    ) -> bytes:
        if not self.url:
            raise MasterUnreachable("no master is known yet")
        received = bytearray()
        try:
            async with self._http.stream(method, path, content=body, headers=headers, timeout=timeout) as response:
                async for chunk in response.aiter_bytes():
                    received += chunk
                    if len(received) > limit:
                        raise WireError(f"{self.url}{path}: expected at most {limit} bytes, got more")
        except httpx.HTTPError as error:
            raise MasterUnreachable(f"{self.url}{path}: {str(error) or type(error).__name__}") from error
        if response.is_error:
            status, detail = response.status_code, _reason(received)
            raise MasterRefused(f"{self.url}{path}: {status}: {detail}", status, detail)
        return bytes(received)


def _reason(body: bytearray) -> str:
    """Return the sentence of a refusal, from JSON or plain text."""
    text = bytes(body[:ERROR_CHARS]).decode("utf-8", "replace")
    return text.removeprefix('{"detail":"').removesuffix('"}')
