# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio

import httpx
import pytest

from simulation.fleet.power import HEAD_BYTES_MAX, LABELS, PowerSwitch


async def posted(switch: PowerSwitch, url: str) -> tuple[int, str]:
    async with httpx.AsyncClient(trust_env=False) as client:
        answer = await client.post(url)
    return answer.status_code, answer.json()["detail"]


async def test_buttons_reach_the_switch() -> None:
    asked: list[tuple[str, str]] = []

    async def switch(verb: str, address: str) -> str | None:
        asked.append((verb, address))
        return "it has none already" if len(asked) > 1 else None

    async with PowerSwitch(switch) as power:
        assert set(power.actions) == set(LABELS.values())
        url = power.actions[LABELS["cut"]].format(id=1, ip="127.0.0.2", serial="A")
        assert await posted(power, url) == (200, "done")
        assert await posted(power, url) == (409, "it has none already")
        assert (await posted(power, url.replace("/cut/", "/burn/")))[0] == 404
        # Who does not know its secret, as another page of the browser, finds nothing.
        host = url.split("/", 3)[:3]
        assert (await posted(power, "/".join([*host, "x", "cut", "127.0.0.2"])))[0] == 404
        async with httpx.AsyncClient(trust_env=False) as client:
            assert (await client.get(url)).status_code == 404
    assert asked == [("cut", "127.0.0.2")] * 2
    with pytest.raises(httpx.ConnectError):
        await posted(power, url)


@pytest.mark.parametrize("request_", [b"", b"\r\n\r\n", b"POST\r\n\r\n", b"x" * (HEAD_BYTES_MAX + 1)])
async def test_noise_is_nothing(request_: bytes) -> None:
    async def switch(verb: str, address: str) -> str | None:
        raise AssertionError(verb)

    async with PowerSwitch(switch) as power:
        port = int(power.actions[LABELS["cut"]].split("/")[2].split(":")[1])
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(request_)
        writer.write_eof()
        answer = await reader.read()
        assert answer == b"" or answer.startswith(b"HTTP/1.1 404")
        writer.close()
