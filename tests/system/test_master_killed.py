# SPDX-License-Identifier: Apache-2.0
"""Processes that write to the master's store, killed in mid-write: what they acknowledged is there, and whole."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from master_server.store import FILE_NAME, Store

KILLS = 100

WRITER = """
import sys, threading
from pathlib import Path
from master_server.store import Store, UnitRecord
from shared.messages import Versions
from shared.settings import Settings

store = Store.open(Path(sys.argv[1]))
begin = int(sys.argv[2])

def units(number):
    for version in range(begin + 1, begin + 10**6):
        pose = tuple(tuple(float(version) for _ in range(4)) for _ in range(4))
        record = UnitRecord(id=number, ip=f"10.0.0.{number}", T_world_camera=pose, pose_version=version)
        store.save_units([record])
        print(f"unit {number} {version}", flush=True)

def settings():
    for version in range(begin + 1, begin + 10**6):
        size_m = 0.01 + version % 1000 * 1e-5
        store.save_settings(Settings(voxel_size_m=size_m), Versions(settings=version))
        print(f"settings 0 {version}", flush=True)

threads = [threading.Thread(target=units, args=(number,), daemon=True) for number in (1, 2)]
threads.append(threading.Thread(target=settings, daemon=True))
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


@pytest.mark.slow
def test_what_a_killed_process_acknowledged_is_stored_and_nothing_is_half_written(tmp_path: Path) -> None:
    """Kills (SIGKILL) a child that holds the store alone and has three writers; the master itself is not in it."""
    path = tmp_path / FILE_NAME
    dice = random.Random(1)
    highest = 0
    acknowledged: dict[str, int] = {}
    for _ in range(KILLS):
        child = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), str(highest)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        lines = [child.stdout.readline()]
        time.sleep(dice.uniform(0.0, 0.05))  # The moment of the kill, anywhere in a write.
        child.send_signal(signal.SIGKILL)
        lines += child.stdout.read().splitlines()
        child.stdout.close()
        child.wait()
        for line in lines:
            fields = line.split()
            if len(fields) == 3:
                acknowledged[f"{fields[0]} {fields[1]}"] = int(fields[2])
        store = Store.open(path)
        saved = store.load()
        store.close()
        stored = {f"unit {unit.id}": unit.pose_version for unit in saved.units}
        for unit in saved.units:
            assert unit.T_world_camera == ((float(unit.pose_version),) * 4,) * 4
        if saved.versions is not None:
            stored["settings 0"] = saved.versions.settings
            assert saved.settings["voxel_size_m"] == 0.01 + saved.versions.settings % 1000 * 1e-5
        # One write may have come to its end without the word of it.
        for name, version in acknowledged.items():
            assert version <= stored[name] <= max(version, highest) + 1
        highest = max(stored.values())
    assert highest > KILLS
