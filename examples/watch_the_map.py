# SPDX-License-Identifier: Apache-2.0
"""Print what is not free, each time that the master's map changes: `python examples/watch_the_map.py`.

`--url` names the master, `--token-file` either of its two tokens, `--seconds` ends it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import msgpack
from websockets.sync.client import connect

SILENCE_S = 1.0
"""The master sends at least twice a second. After a silence of this length act as if nothing were known."""


def main() -> None:
    """Subscribe to the map and print one line a message."""
    parser = argparse.ArgumentParser(description="print the master's map as it changes")
    parser.add_argument("--url", default="http://localhost:8420")
    parser.add_argument("--token-file", type=Path, default=Path("state/unit.token"))
    parser.add_argument("--seconds", type=float, default=float("inf"))
    chosen = parser.parse_args()

    stream = chosen.url.replace("http", "ws", 1) + "/stream?form=centres"
    headers = {"Authorization": f"Bearer {chosen.token_file.read_text().strip()}"}
    end_s = time.monotonic() + chosen.seconds
    with connect(stream, additional_headers=headers) as master:
        while time.monotonic() < end_s:
            try:
                view = msgpack.unpackb(master.recv(timeout=SILENCE_S))
            except TimeoutError:
                print("STOP: nothing from the master for a second", flush=True)
                continue
            if not view["complete"]:
                print(f"SLOW: the map is not complete: {view['reasons']}", flush=True)
            elif view["voxels"]:
                print(f"SLOW: {len(view['voxels'])} obstacle voxels, the first at {view['voxels'][0]}", flush=True)
            else:
                print("go: no obstacle voxel", flush=True)


if __name__ == "__main__":
    main()
