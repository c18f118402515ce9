# SPDX-License-Identifier: Apache-2.0
"""Viewers of a master's map, without browsers: each receives everything that a browser would."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgpack
import psutil
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

WINDOW = "master_server.viewer.window"

MESSAGES_MIN = 10
"""Number of messages after which a viewer has the whole cell."""

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 3.0],
    "fov": 1.0,
    "image_height": 800,
    "image_width": 1280,
    "near": 0.01,
    "far": 1000.0,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
"""First message of a browser."""


async def watch(url: str, token: str, ready: asyncio.Event) -> None:
    """Receive until cancelled."""
    subprotocol = Subprotocol(f"viser-v{version('viser')}")
    address = f"{url.replace('http', 'ws', 1)}/viewer/"
    headers = {"Authorization": f"Bearer {token}"}
    async with connect(
        address, subprotocols=[subprotocol], additional_headers=headers, max_size=None, proxy=None
    ) as socket:
        await socket.send(msgpack.packb(CAMERA))
        received = 0
        async for _ in socket:
            received += 1
            if received == MESSAGES_MIN:
                ready.set()


async def run(url: str, token_file: Path, master_pid: int, count: int, seeing: Path) -> None:
    """Run `count` viewers until terminated. Write the file `seeing` once all of them have the cell."""
    token = token_file.read_text().strip()
    each_ready = [asyncio.Event() for _ in range(count)]
    tasks = [asyncio.ensure_future(watch(url, token, ready)) for ready in each_ready]
    everyone = asyncio.ensure_future(asyncio.gather(*(ready.wait() for ready in each_ready)))
    waited: list[asyncio.Future[Any]] = [everyone, *tasks]
    await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
    if everyone.done():
        # The master has a core to itself in a benchmark. Its viewer is a process of its own and may run on any core.
        for child in psutil.Process(master_pid).children():
            if WINDOW in child.cmdline():
                child.cpu_affinity(list(range(os.cpu_count() or 1)))
        seeing.touch()
    await asyncio.gather(*tasks)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(run(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5])))
