# SPDX-License-Identifier: Apache-2.0
"""Tell the master the robot's joints, 125 times a second: `python examples/feed_joints.py`.

The joints swing slowly here. Replace `joints_at` by a call of the robot's controller.
`--url` names the master, `--token-file` its operator's token, `--seconds` ends it.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import httpx

PERIOD_S = 0.008
HOME_RAD = (0.0, -1.6, 1.4, -1.4, -1.6, 0.0)
SWING_RAD, TURN_S = 0.3, 8.0


def joints_at(t_s: float) -> tuple[list[float], list[float]]:
    """Return positions (rad) and velocities (rad/s) of the six joints."""
    angle, rate = math.tau * t_s / TURN_S, math.tau / TURN_S
    positions = [HOME_RAD[0] + SWING_RAD * math.sin(angle), *HOME_RAD[1:]]
    return positions, [SWING_RAD * rate * math.cos(angle), 0.0, 0.0, 0.0, 0.0, 0.0]


def main() -> None:
    """Send joints until the time is over, and print how many went out."""
    parser = argparse.ArgumentParser(description="send the joints of a swinging robot")
    parser.add_argument("--url", default="http://localhost:8420")
    parser.add_argument("--token-file", type=Path, default=Path("state/operator.token"))
    parser.add_argument("--seconds", type=float, default=float("inf"))
    chosen = parser.parse_args()

    headers = {"Authorization": f"Bearer {chosen.token_file.read_text().strip()}"}
    start_s, sent = time.monotonic(), 0
    with httpx.Client(base_url=chosen.url, headers=headers) as master:
        while (t_s := time.monotonic() - start_s) < chosen.seconds:
            positions, velocities = joints_at(t_s)
            answer = master.put("/robot/joints", json={"positions": positions, "velocities": velocities})
            if answer.is_error:
                # The master's sentence names the field and the remedy.
                raise SystemExit(f"{chosen.url}: {answer.status_code}: {answer.json()['detail']}")
            sent += 1
            time.sleep(max(0.0, start_s + sent * PERIOD_S - time.monotonic()))
        fresh = master.get("/robot").raise_for_status().json()
    print(f"sent {sent} samples in {chosen.seconds:g} s; the master has the robot at {fresh}")


if __name__ == "__main__":
    main()
