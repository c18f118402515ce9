# SPDX-License-Identifier: Apache-2.0
"""A real master on a really full disk: a tmpfs of one megabyte that only its process sees."""

from __future__ import annotations

import asyncio
import errno
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from master_server.persistence import Store
from master_server.persistence.store import FILE_NAME, TRY_EVERY_S
from master_server.security import Role, write_token
from shared.errors import ConfigError
from shared.waiting import within
from tests.master_server.fakes import AT_ORIGIN
from tests.missing import missing
from tests.system.cluster import Cluster, write_cell
from tests.system.test_stream import HttpUnit

NAMESPACES = (("unshare", "--mount"), ("unshare", "--user", "--map-root-user", "--mount"))
MOUNT = 'mount -t tmpfs -o size=1m,mode=700 tmpfs "$0" && exec "$@"'
CLEARS_WITHIN_S = TRY_EVERY_S + 1.0


def on_a_small_disk(folder: Path) -> tuple[str, ...]:
    """Return the command that gives a process an empty disk of one megabyte at `folder`."""
    for unshare in NAMESPACES:
        under = (*unshare, "sh", "-c", MOUNT, str(folder))
        if not subprocess.run((*under, "true"), capture_output=True, check=False).returncode:
            return under
    missing("the kernel allows no mounts here")


def fill(disk: Path) -> Path:
    """Write a file that takes all remaining space."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        for _ in range(1000):
            try:
                file.write(bytes(4096))
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                return filler
    raise AssertionError(f"{disk} has no end")


def start(cluster: Cluster) -> Path:
    """Start a master with a small disk. Return the disk's path for this process."""
    state_dir = cluster.folder / "master"
    state_dir.mkdir()
    cluster.start_master(under=on_a_small_disk(state_dir))
    return Path(cluster.unit_token_file).parent


def changes_are_refused(cluster: Cluster) -> None:
    refusals = [
        cluster.operator.put("/settings", json={"voxel_size_m": 0.04}),
        cluster.operator.put("/units/1/pose", json={"T_world_camera": [[1, 0, 0, 0.7], *AT_ORIGIN[1:]]}),
        cluster.operator.delete("/units/1"),
    ]
    for response in refusals:
        assert response.status_code == 507, response.text
        assert "nothing was changed" in response.json()["detail"]


async def test_changes_are_refused_and_all_else_goes_on_until_there_is_room(tmp_path: Path) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        disk = await asyncio.to_thread(start, cluster)
        unit = HttpUnit(cluster, 1)
        async with unit.client:
            await unit.join()
            await unit.update(1)
            before: Any = cluster.get("/units"), cluster.get("/settings")
            filler = fill(disk)
            changes_are_refused(cluster)
            assert cluster.get("/healthz")["storage"] == "the last change could not be stored"
            for voxel in (2, 3):
                await unit.update(voxel)
                view = cluster.get("/voxels?form=keys")
                assert (view["voxels"], view["complete"]) == ([voxel], True)
            assert cluster.get("/settings") == before[1]
            assert cluster.get("/units")[0]["T_world_camera"] == before[0][0]["T_world_camera"]
            with pytest.raises(ConfigError, match="No space left"):
                write_token(disk, Role.UNIT)
            await unit.update(4)
            filler.unlink()
            assert cluster.put("/settings", {"voxel_size_m": 0.1})["voxel_size_m"] == 0.1
            assert cluster.get("/healthz")["storage"] == "ok"

            # Once more, without any change afterwards.
            filler = fill(disk)
            changes_are_refused(cluster)
            await asyncio.sleep(1.5 * TRY_EVERY_S)
            assert cluster.get("/healthz")["storage"] != "ok"
            filler.unlink()

            async def until_it_is_well() -> None:
                while cluster.get("/healthz")["storage"] != "ok":
                    await asyncio.sleep(0.02)

            assert await within(CLEARS_WITHIN_S, until_it_is_well())
            assert cluster.put("/settings", {"voxel_size_m": 0.08})["voxel_size_m"] == 0.08
        assert "Traceback" not in cluster.log("master")
        stored = tmp_path / "stored"
        stored.mkdir()
        for file in disk.glob(f"{FILE_NAME}*"):
            shutil.copy(file, stored)
        store = Store.open(stored / FILE_NAME)
        saved = store.load()
        store.close()
        assert saved.settings["voxel_size_m"] == 0.08
        assert [unit.T_world_camera for unit in saved.units] == [AT_ORIGIN]
