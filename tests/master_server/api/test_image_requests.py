# SPDX-License-Identifier: Apache-2.0
"""Images are requested from a unit only while a caller waits for one."""

from __future__ import annotations

import asyncio
from typing import Any

import httpx
import pytest

from master_server.api import image_requests as module
from master_server.api.image_requests import PNG_SIGNATURE
from master_server.app import make_app
from master_server.security import Access
from shared.messages import DONE, MAX_IMAGE_BYTES, Command, Ended, Outcome
from shared.wire import decode_update_answer
from tests.master_server.fakes import FakeUnit, master
from tests.master_server.test_app import OPERATOR, UNIT, Desk

IMAGE = PNG_SIGNATURE + b"picture"


@pytest.fixture
def desk() -> Desk:
    return Desk(make_app(master(), Access(UNIT.encode(), OPERATOR.encode())))


async def requested(desk: Desk, unit: FakeUnit, path: str, callers: int = 1) -> tuple[list[Any], tuple[Command, ...]]:
    """Return callers that wait for an image, and the commands that the unit receives."""
    waiting = [asyncio.ensure_future(desk.call("GET", path)) for _ in range(callers)]
    while not unit.master.registry.get(unit.initialized.id).commands:
        await asyncio.sleep(0.001)
    commands = decode_update_answer((await desk.update(unit)).content).commands
    return waiting, commands


async def put(desk: Desk, path: str, command: int, png: bytes = IMAGE, ip: str = "10.0.0.1") -> httpx.Response:
    return await desk.call("PUT", f"{path}?command={command}", UNIT, ip, content=png)


@pytest.mark.parametrize("raw", [False, True])
async def test_concurrent_requests_share_one_image(desk: Desk, raw: bool) -> None:
    unit = await desk.register()
    waiting, commands = await requested(desk, unit, f"/units/1/images/foreground?raw={raw:d}", callers=3)
    assert [(command.verb, command.image, command.raw) for command in commands] == [("image", "foreground", raw)]
    assert (await put(desk, "/units/1/images/foreground", commands[0].id)).status_code == 204
    for response in await asyncio.gather(*waiting):
        assert (response.status_code, response.content) == (200, IMAGE)
        assert response.headers["content-type"] == "image/png"
        assert response.headers.get("x-depth-range-m") == (None if raw else "0.3 6")
    # The image is not stored, and its command is not shown as an operator's.
    assert (await put(desk, "/units/1/images/foreground", commands[0].id)).status_code == 409
    assert (await desk.call("GET", "/units")).json()[0]["last_command"] is None
    await desk.update(unit, done=(Ended.of(commands[0].id, DONE),))
    assert decode_update_answer((await desk.update(unit)).content).commands == ()


async def test_a_missing_image_times_out(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    await desk.register()
    monkeypatch.setattr(module, "IMAGE_EXPIRES_S", 0.05)
    response = await desk.call("GET", "/units/1/images/depth")
    assert response.status_code == 504
    assert response.json()["detail"] == "unit 1: its image did not come within 0.05 s, see GET /units"
    assert not desk.app.services.image_requests._pending


async def test_a_failed_image_reports_its_reason(desk: Desk) -> None:
    unit = await desk.register()
    (waiting,), (command,) = await requested(desk, unit, "/units/1/images/expected")
    await desk.update(unit, done=(Ended.of(command.id, Outcome("refused", "the pose of its camera is not known yet")),))
    response = await waiting
    assert response.status_code == 409
    assert response.json()["detail"] == "unit 1: no image: the pose of its camera is not known yet"


async def test_an_image_that_was_not_requested_is_refused(desk: Desk) -> None:
    unit = await desk.register()
    await desk.register("10.0.0.2", "B")
    path = "/units/1/images/depth"
    assert (await put(desk, path, 1)).status_code == 409
    (waiting,), (command,) = await requested(desk, unit, path)
    assert (await put(desk, path, command.id, ip="10.0.0.2")).status_code == 403
    assert (await put(desk, path, command.id + 1)).status_code == 409
    assert (await put(desk, path, command.id, b"<svg>")).status_code == 422
    assert (await put(desk, path, command.id, b"\0" * (MAX_IMAGE_BYTES + 1))).status_code == 413
    assert not waiting.done()
    assert (await put(desk, path, command.id)).status_code == 204
    assert (await waiting).content == IMAGE


async def test_unknown_images(desk: Desk) -> None:
    assert (await desk.call("GET", "/units/1/images/depth")).status_code == 404
    await desk.register()
    assert (await desk.call("GET", "/units/1/images/colour")).status_code == 422
