# SPDX-License-Identifier: Apache-2.0
"""The route that a master is compared with: FastAPI decodes an update into an array, and nothing more."""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

import msgpack
import numpy as np
import uvicorn
from fastapi import FastAPI, Request, Response

from shared.clock import monotonic_ns
from shared.files import write_whole
from shared.wire import MEDIA_TYPE

app = FastAPI()


@app.post("/update")
async def update(request: Request) -> Response:
    """Decode bytes to an array and encode it back to bytes."""
    now_ns = monotonic_ns()
    keys = np.frombuffer(msgpack.unpackb(await request.body())["keys"], "<u4")
    answer = {"received_at_ns": now_ns, "answered_at_ns": monotonic_ns(), "voxels": len(keys)}
    return Response(msgpack.packb(answer), media_type=MEDIA_TYPE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until terminated."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load_generator.bare_fastapi")
    parser.add_argument("--ready-file", type=Path, required=True)
    options = parser.parse_args(arguments)
    listener = socket.create_server(("127.0.0.1", 0), backlog=256)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    ready = {"url": f"http://127.0.0.1:{listener.getsockname()[1]}", "pid": os.getpid()}
    # The socket listens from here on; connections wait in its backlog until they are served.
    write_whole(options.ready_file, json.dumps(ready).encode(), synced=False)
    config = uvicorn.Config(app, log_config=None, access_log=False, server_header=False, date_header=False)
    uvicorn.Server(config).run(sockets=[listener])
    return 0


if __name__ == "__main__":
    sys.exit(main())
