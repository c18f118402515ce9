# SPDX-License-Identifier: Apache-2.0
"""Changes of the cell while units run: over HTTP, and their effect on the map."""

from __future__ import annotations

import asyncio
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest

from master_server.api.routes import cell as routes
from master_server.app import make_app
from master_server.cells import cell_loading
from master_server.cells.published import PublishedCell
from master_server.core import Master
from master_server.security import Access
from shared.cell import Cell, PlacedMesh
from shared.errors import InputError, Refusal
from shared.kinematics import DHJoint, Robot
from shared.meshes import box_mesh
from shared.messages import JointsRequest, matrix_of
from shared.settings import Settings
from shared.transforms import from_xyz_rpy
from shared.wire import MEDIA_TYPE
from tests.master_server.fakes import START_NS, FakeUnit, S, joined, sees_all
from tests.master_server.test_app import OPERATOR, UNIT, Desk

NOW_NS = START_NS + S
ZIP = {"Content-Type": "application/zip"}
MOVED = from_xyz_rpy((0.7, 0.5, 0.1), (0.0, 0.0, 0.5))


def watched(size_m: tuple[float, float, float] = (1.0, 2.0, 0.5), reach_m: float = 0.3) -> Cell:
    """A box of 20 x 40 x 10 voxels, a crate that may be moved, and an arm."""
    joints = [DHJoint("shoulder", 0.2, 0.0, np.pi / 2.0), DHJoint("elbow", 0.0, reach_m, 0.0)]
    robot = Robot.from_dh(joints, [None, box_mesh("arm", (0.1, 0.1, 0.1)), None])
    crate = PlacedMesh("crate", box_mesh("crate", (0.2, 0.2, 0.2)), from_xyz_rpy((0.5, 0.5, 0.1), (0.0, 0.0, 0.0)))
    return Cell("test", np.zeros(3), np.array(size_m), objects=(crate,), robot=robot)


def live(one: Master, *keys: int) -> FakeUnit:
    """Return a unit that has just reported and sees everything, in a cell whose robot reports."""
    one.put_joints(JointsRequest(positions=(0.0, 0.0)), NOW_NS)
    unit = joined(one)
    unit.update(NOW_NS, keys, seen=sees_all(one))
    assert one.view(NOW_NS).complete
    return unit


# ---------------------------------------------------------------------- the master


def test_after_a_move_reports_count_once_units_use_the_new_pose() -> None:
    one = Master(watched(), Settings())
    unit = live(one, 5, 6)
    old = unit.versions
    answer = one.move_object("crate", matrix_of(MOVED))
    assert answer.cell == one.published.reference
    assert (answer.versions.cell, answer.versions.lattice) == (2, 1)
    view = one.view(NOW_NS)
    assert (view.keys.tolist(), view.complete) == ([], False)
    assert view.reasons == ("unit 1 (10.0.0.1) is stale: it does not work with the current cell yet",)
    # A frame in progress still belongs to the old cell; its answer names the new one.
    told = unit.update(NOW_NS, [5, 6], seen=sees_all(one))
    assert told.cell == answer.cell
    assert told.lattice is None
    assert not one.view(NOW_NS).complete
    assert not one.coverage.has(1)
    assert unit.versions != old
    unit.update(NOW_NS, [7])
    assert one.view(NOW_NS).reasons == ("unit 1 (10.0.0.1) has not reported what it looks through",)
    unit.update(NOW_NS, [7], seen=sees_all(one))
    view = one.view(NOW_NS)
    assert (view.keys.tolist(), view.complete) == ([7], True)


def test_another_box_makes_another_lattice_and_old_reports_are_dropped() -> None:
    one = Master(watched(), Settings())
    unit = live(one, 5)
    before = unit.versions
    one.change_cell(watched((2.0, 2.0, 0.5)))
    assert (one.versions.cell, one.versions.lattice) == (2, 2)
    assert one.lattice.shape == (40, 40, 10)
    told = unit.update(NOW_NS, [5], seen=sees_all(one))
    assert told.lattice is not None
    assert told.settings is not None
    assert told.cell is not None
    view = one.view(NOW_NS)
    assert (view.lattice.shape, view.keys.tolist(), view.complete) == ((40, 40, 10), [], False)
    # The new cell with the old lattice is refused as well.
    half = before.model_copy(update={"cell": 2})
    unit.versions = half
    unit.update(NOW_NS, [5], seen=sees_all(one))
    assert one.view(NOW_NS).keys.tolist() == []
    unit.update(NOW_NS, [5], seen=sees_all(one))
    assert one.view(NOW_NS).complete


def test_joints_are_kept_while_the_robot_is_the_same() -> None:
    one = Master(watched(), Settings())
    live(one)
    one.change_cell(watched((2.0, 2.0, 0.5)))
    assert one.robot.newest is not None
    one.change_cell(watched(reach_m=0.4))
    assert one.robot.newest is None


def test_the_same_cell_again_leaves_units_live() -> None:
    one = Master(watched(), Settings())
    live(one, 5)
    assert one.change_cell(watched()).versions.cell == 1
    assert one.view(NOW_NS).complete


def test_an_invalid_cell_changes_nothing() -> None:
    one = Master(watched(), Settings())
    live(one, 5)
    with pytest.raises(InputError, match="smaller box"):
        one.change_cell(watched((90.0, 90.0, 20.0)))
    with pytest.raises(Refusal, match="object box: not in this cell; its objects are crate"):
        one.move_object("box", matrix_of(MOVED))
    assert one.view(NOW_NS).complete


# ---------------------------------------------------------------------- over HTTP


@pytest.fixture
def desk() -> Desk:
    return Desk(make_app(Master(watched(), Settings()), Access(UNIT.encode(), OPERATOR.encode())))


def packed(files: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


CELL_YAML = "name: new\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\nstatic: [{name: table, box: [0.5, 0.5, 0.1]}]\n"


async def document_of(desk: Desk) -> dict[str, Any]:
    found: dict[str, Any] = (await desk.call("GET", "/cell")).json()
    return found


async def test_a_zip_of_a_folder_replaces_the_cell(desk: Desk) -> None:
    response = await desk.call("PUT", "/cell", content=packed({"cell.yaml": CELL_YAML}), headers=ZIP)
    assert response.status_code == 200, response.text
    document = await document_of(desk)
    assert response.json()["cell"]["name"] == document["name"] == "new"
    assert response.json()["versions"]["cell"] == 2
    mesh = await desk.call("GET", f"/cell/meshes/{document['static'][0]['mesh']}", UNIT)
    assert mesh.status_code == 200


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"no zip", "expected the cell's folder as a zip, got a damaged one"),
        (packed({"cell.yaml": CELL_YAML + "more: 1\n"}), "cell.yaml: more: expected a key out of"),
        (packed({"cell.yaml": CELL_YAML.replace("max: [1, 1, 1]", "max: [99, 99, 99]")}), "smaller box"),
        (
            packed(
                {
                    "cell.yaml": "name: a\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n"
                    "static: [{name: hall, box: [500, 500, 500], pose: {xyz: [900, 0, 0]}}]\n"
                }
            ),
            "set scale: 0.001",
        ),
    ],
)
async def test_an_invalid_zip_changes_nothing(desk: Desk, content: bytes, said: str) -> None:
    before = await document_of(desk)
    response = await desk.call("PUT", "/cell", content=content, headers=ZIP)
    assert response.status_code == 422
    assert said in response.json()["detail"]
    assert "\n" not in response.json()["detail"]
    assert "/tmp" not in response.json()["detail"]
    assert await document_of(desk) == before


@pytest.mark.parametrize("as_msgpack", [False, True])
async def test_an_edited_document_replaces_the_cell(desk: Desk, as_msgpack: bool) -> None:
    document = await document_of(desk)
    document["objects"][0]["T_world_mesh"] = MOVED.tolist()
    document["box_max_m"] = [1.0, 1.0, 1.0]
    if as_msgpack:
        body, kind = msgpack.packb(document), MEDIA_TYPE
    else:
        body, kind = json.dumps(document).encode(), "application/json"
    response = await desk.call("PUT", "/cell", content=body, headers={"Content-Type": kind})
    assert response.status_code == 200, response.text
    assert await document_of(desk) == document
    assert (response.json()["versions"]["cell"], response.json()["versions"]["lattice"]) == (2, 2)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"objects": [{"name": "a", "mesh": "0" * 64, "T_world_mesh": np.eye(4).tolist()}]}, "bytes with sha256"),
        ({"box_max_m": [0.0, 0.0, 0.0]}, "expected box_max_m above box_min_m"),
        ({"name": "a\nb"}, "name"),
        ({"more": 1}, "more"),
    ],
)
async def test_an_invalid_document_changes_nothing(desk: Desk, change: dict[str, Any], said: str) -> None:
    before = await document_of(desk)
    for document in ({**before, **change}, [], "cell"):
        response = await desk.call("PUT", "/cell", json=document)
        assert response.status_code == 422
        assert "\n" not in response.json()["detail"]
        if isinstance(document, dict):
            assert said in response.json()["detail"]
    response = await desk.call("PUT", "/cell", content=b"{", headers={"Content-Type": "application/json"})
    assert response.status_code == 422
    assert await document_of(desk) == before


async def test_a_zip_beyond_its_bound_is_refused(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "MAX_ZIP_BYTES", 1000)
    response = await desk.call("PUT", "/cell", content=b"\0" * 1001, headers=ZIP)
    assert response.status_code == 413


async def test_one_cell_is_read_at_a_time_and_within_its_timeout(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    content = packed({"cell.yaml": CELL_YAML})
    first, second = await asyncio.gather(
        desk.call("PUT", "/cell", content=content, headers=ZIP), desk.call("PUT", "/cell", content=content, headers=ZIP)
    )
    assert sorted((first.status_code, second.status_code)) == [200, 409]
    monkeypatch.setattr(cell_loading, "LOAD_TIMEOUT_S", 0.01)
    response = await desk.call("PUT", "/cell", content=content, headers=ZIP)
    assert (response.status_code, response.json()["detail"]) == (
        422,
        "cell: expected files that can be read within 0.01 s",
    )


async def test_no_file_is_left_on_the_disk(desk: Desk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cell_loading.tempfile, "tempdir", str(tmp_path))
    for content in (packed({"cell.yaml": CELL_YAML}), b"no zip"):
        await desk.call("PUT", "/cell", content=content, headers=ZIP)
        assert await asyncio.to_thread(lambda: list(tmp_path.iterdir())) == []


async def test_an_object_is_moved(desk: Desk) -> None:
    response = await desk.call("PUT", "/cell/objects/crate/pose", json={"T_world_object": MOVED.tolist()})
    assert response.status_code == 200, response.text
    document = await document_of(desk)
    assert document["objects"][0]["T_world_mesh"] == MOVED.tolist()
    etag = (await desk.call("GET", "/cell")).headers["etag"]
    assert etag == f'"{response.json()["cell"]["sha256"]}"'


@pytest.mark.parametrize(
    ("name", "pose", "status", "said"),
    [
        ("tray", MOVED.tolist(), 404, "object tray: not in this cell; its objects are crate"),
        ("crate", (2.0 * MOVED).tolist(), 422, "T_world_object"),
        ("crate", np.diag((1.0, 1.0, -1.0, 1.0)).tolist(), 422, "right-handed"),
        ("crate", MOVED.tolist()[:3], 422, "T_world_object"),
        ("crate", from_xyz_rpy((5000.0, 0.0, 0.0), (0.0, 0.0, 0.0)).tolist(), 422, "within 1000 m"),
        ("crate", None, 422, "T_world_object"),
    ],
)
async def test_an_invalid_move_changes_nothing(desk: Desk, name: str, pose: Any, status: int, said: str) -> None:
    before = await document_of(desk)
    response = await desk.call("PUT", f"/cell/objects/{name}/pose", json={"T_world_object": pose})
    assert response.status_code == status
    assert said in response.json()["detail"]
    assert await document_of(desk) == before


async def test_the_folder_of_the_demo_cell_can_be_uploaded(desk: Desk) -> None:
    folder = Path(__file__).resolve().parents[4] / "assets" / "cells" / "demo"

    def read() -> tuple[bytes, PublishedCell]:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for file in folder.glob("*.*"):
                archive.write(file, file.name)
        return buffer.getvalue(), PublishedCell.of(Cell.load(folder / "cell.yaml"))

    content, expected = await asyncio.to_thread(read)
    response: httpx.Response = await desk.call("PUT", "/cell", content=content, headers=ZIP)
    assert response.status_code == 200, response.text
    assert response.json()["cell"] == expected.reference.model_dump()
    assert desk.app.services.master.published.meshes == expected.meshes
