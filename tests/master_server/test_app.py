# SPDX-License-Identifier: Apache-2.0
"""The contract of the REST interface, against the application without a socket."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest

from master_server.api.metrics import VERSION
from master_server.api.responses import CoverageAnswer
from master_server.api.routes import common
from master_server.app import make_app
from master_server.recording.recorder import Recorder, RecordingConfig
from master_server.security import Access
from shared.clock import monotonic_ns
from shared.messages import InitializeAnswer, RobotAnswer, UnitRow, VoxelsAnswer
from shared.settings import Settings
from shared.timebase import Exchange
from shared.wire import MAX_UPDATE_BYTES, MEDIA_TYPE, decode, decode_update_answer, encode, encode_update, pack_seen
from tests.master_server.fakes import AT_ORIGIN, GOOD, FakeUnit, master, sees_all

UNIT = "unit-token-0123456789"
OPERATOR = "operator-token-0123456789"
MSGPACK = {"Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}


def header(token: str | None) -> dict[str, str]:
    return {} if token is None else {"Authorization": f"Bearer {token}"}


@dataclass
class Desk:
    """One application, and callers at any address with any token."""

    app: Any

    async def call(
        self, method: str, path: str, token: str | None = OPERATOR, ip: str = "10.0.0.1", **more: Any
    ) -> httpx.Response:
        transport = httpx.ASGITransport(app=self.app, client=(ip, 40_000))
        headers = {**header(token), **more.pop("headers", {})}
        async with httpx.AsyncClient(transport=transport, base_url="http://master") as client:
            return await client.request(method, path, headers=headers, **more)

    async def register(self, ip: str = "10.0.0.1", serial: str = "A") -> FakeUnit:
        """Register a unit and set its pose, all over HTTP."""
        unit = FakeUnit(self.app.services.master, ip, serial)
        sent_ns = monotonic_ns()
        request = unit.introduction(sent_ns)
        response = await self.call("POST", "/initialize", UNIT, ip, content=encode(request), headers=MSGPACK)
        assert response.status_code == 200, response.text
        unit.initialized = decode(InitializeAnswer, response.content)
        unit.exchange = Exchange(
            sent_ns, unit.initialized.received_at_ns, unit.initialized.answered_at_ns, monotonic_ns()
        )
        pose = {"T_world_camera": AT_ORIGIN, "origin": "configured"}
        put = await self.call("PUT", f"/units/{unit.initialized.id}/pose", UNIT, ip, json=pose)
        assert put.status_code == 200, put.text
        unit.versions = unit.initialized.versions.model_copy(update=put.json())
        return unit

    async def update(self, unit: FakeUnit, *keys: int, token: str = UNIT, **more: Any) -> httpx.Response:
        body = encode_update(unit.request(monotonic_ns(), keys, **more))
        return await self.call("POST", "/update", token, unit.ip, content=body, headers=MSGPACK)


@pytest.fixture
def desk() -> Desk:
    return Desk(make_app(master(with_robot=True), Access(UNIT.encode(), OPERATOR.encode())))


async def test_from_initialize_to_voxels(desk: Desk) -> None:
    unit = await desk.register()
    response = await desk.update(unit, 0, 411, 7999, seen=sees_all(unit.master))
    assert response.status_code == 200
    assert response.headers["content-type"] == MEDIA_TYPE
    answer = decode_update_answer(response.content)
    assert answer.versions == unit.versions
    assert answer.received_at_ns <= answer.answered_at_ns <= monotonic_ns()
    await desk.call("PUT", "/robot/joints", json={"positions": [0.0, 0.5]})
    found = (await desk.call("GET", "/voxels", UNIT)).json()
    VoxelsAnswer.model_validate(found)
    assert found["voxels"] == [[0, 0, 0], [1, 1, 1], [19, 39, 9]]
    assert found["witnesses"] == [1, 1, 1]
    assert found["lattice"] == {"origin_m": [0.0, 0.0, 0.0], "voxel_size_m": 0.05, "shape": [20, 40, 10]}
    assert (found["complete"], found["reasons"], found["units_live"]) == (True, [], 1)
    # The offset of the clocks is known to half a round trip only.
    assert 0.02 <= found["oldest_view_age_s"] < 1.0


async def test_voxels_in_every_form(desk: Desk) -> None:
    unit = await desk.register()
    await desk.update(unit, 411)
    assert (await desk.call("GET", "/voxels?form=centres")).json()["voxels"] == [[0.075, 0.075, 0.075]]
    packed = await desk.call("GET", "/voxels?form=keys", headers={"Accept": MEDIA_TYPE})
    assert packed.headers["content-type"] == MEDIA_TYPE
    assert msgpack.unpackb(packed.content)["voxels"] == [411]
    assert (await desk.call("GET", "/voxels?form=cubes")).status_code == 422


async def test_unseen_blocks_on_request(desk: Desk) -> None:
    unit = await desk.register()
    before = (await desk.call("GET", "/voxels?unseen=true")).json()["unseen"]
    assert len(before["blocks"]) == 10 * 20 * 5
    assert before["shape"] == [10, 20, 5]
    assert before["voxel_size_m"] == pytest.approx(0.1)
    await desk.update(unit, seen=sees_all(unit.master))
    assert (await desk.call("GET", "/voxels?unseen=true")).json()["unseen"]["blocks"] == []
    assert (await desk.call("GET", "/voxels")).json()["unseen"] is None


async def test_coverage_of_the_cell(desk: Desk) -> None:
    first, second = await desk.register("10.0.0.1", "A"), await desk.register("10.0.0.2", "B")
    await desk.update(first, seen=sees_all(first.master))
    half = np.zeros((10, 20, 5), bool)
    half[:5] = True
    await desk.update(second, seen=pack_seen(half, 0.1))
    found = (await desk.call("GET", "/coverage", UNIT)).json()
    CoverageAnswer.model_validate(found)
    assert found["shares"] == [0.0, 0.5, 0.5, 0.0]
    assert (found["seen_share"], found["block_count"], found["units_live"]) == (1.0, 1000, 2)
    assert found["blocks"] is None
    assert found["complete"] is False
    assert found["reasons"] == ["the robot has not reported its joints yet"]
    packed = await desk.call("GET", "/coverage?blocks=true", headers={"Accept": MEDIA_TYPE})
    blocks = msgpack.unpackb(packed.content)["blocks"]
    assert np.array_equal(np.repeat(blocks["counts"], blocks["runs"]).reshape(blocks["shape"]), 1 + half)


async def test_health_without_a_token(desk: Desk) -> None:
    await desk.register("10.0.0.1", "A")
    await desk.update(await desk.register("10.0.0.2", "B"))
    found = (await desk.call("GET", "/healthz", None)).json()
    assert 0.0 <= found.pop("uptime_s") < 60.0
    assert found == {"status": "ok", "version": VERSION, "units": 2, "live": 1, "storage": "ok"}


async def test_metrics_for_monitoring(desk: Desk) -> None:
    unit = await desk.register()
    for _ in range(3):
        assert (await desk.update(unit, 1, 2)).status_code == 200
    await desk.update(unit, 1, token="wrong-token-0123456789")
    await desk.update(unit, sequence=0)
    response = await desk.call("GET", "/metrics", UNIT)
    assert response.headers["content-type"].startswith("text/plain; version=")
    lines = response.text.splitlines()
    assert 'cellwatch_unit_updates_total{ip="10.0.0.1",unit="1"} 3.0' in lines
    assert 'cellwatch_unit_state{ip="10.0.0.1",state="live",unit="1"} 1.0' in lines
    assert 'cellwatch_updates_refused_total{status="401"} 1.0' in lines
    assert 'cellwatch_updates_refused_total{status="409"} 1.0' in lines
    assert "cellwatch_update_seconds_count 3.0" in lines
    assert UNIT not in response.text


async def test_units_have_a_row_each(desk: Desk) -> None:
    await desk.register("10.0.0.1", "A")
    unit = await desk.register("10.0.0.2", "B")
    await desk.update(unit, 1, 2)
    rows = (await desk.call("GET", "/units")).json()
    for row in rows:
        UnitRow.model_validate(row)
    assert [(row["ip"], row["serial"], row["state"], row["voxels"]) for row in rows] == [
        ("10.0.0.1", "A", "stale", 0),
        ("10.0.0.2", "B", "live", 2),
    ]
    assert rows[1]["health"]["valid_share"] == GOOD.valid_share


async def test_headers_do_not_change_the_callers_address(desk: Desk) -> None:
    unit = await desk.register()
    body = encode_update(unit.request(monotonic_ns()))
    forged = {**MSGPACK, "X-Forwarded-For": "10.0.0.1", "Forwarded": "for=10.0.0.1"}
    response = await desk.call("POST", "/update", UNIT, "10.0.0.66", content=body, headers=forged)
    assert response.status_code == 403
    assert "another IP than 10.0.0.66" in response.json()["detail"]


async def test_an_ipv4_address_is_the_same_on_a_socket_for_both(desk: Desk) -> None:
    unit = await desk.register("10.0.0.1")
    again = await desk.register("::ffff:10.0.0.1")
    assert unit.initialized.id == again.initialized.id


DOORS = [
    # method, path, without a token, the unit's, the operator's
    ("POST", "/initialize", 401, 422, 403),
    ("POST", "/update", 401, 422, 403),
    ("GET", "/voxels", 401, 200, 200),
    ("GET", "/coverage", 401, 200, 200),
    ("GET", "/history", 401, 200, 200),
    ("GET", "/units", 401, 200, 200),
    ("GET", "/settings", 401, 200, 200),
    ("GET", "/cell", 401, 200, 200),
    ("GET", "/robot", 401, 200, 200),
    ("PUT", "/cell", 401, 403, 415),
    ("PUT", "/cell/objects/{name}/pose", 401, 403, 422),
    ("GET", f"/cell/meshes/{'0' * 64}", 401, 404, 404),
    ("PUT", "/settings", 401, 403, 422),
    ("PUT", "/units/1/pose", 401, 422, 422),
    ("PUT", "/robot/joints", 401, 403, 422),
    ("POST", "/units/1/background", 401, 403, 404),
    ("DELETE", "/units/1/background", 401, 403, 404),
    ("POST", "/units/1/calibrate", 401, 403, 404),
    ("POST", "/units/1/refine", 401, 403, 404),
    ("GET", "/units/1/images/depth", 401, 404, 404),
    ("PUT", "/units/1/images/depth?command=1", 401, 404, 403),
    ("DELETE", "/units/1", 401, 403, 404),
    # This application has no folder for recordings.
    ("GET", "/recording", 401, 409, 409),
    ("POST", "/recording", 401, 403, 409),
    ("DELETE", "/recording", 401, 403, 409),
    ("GET", "/healthz", 200, 200, 200),
    ("GET", "/metrics", 401, 200, 200),
]


@pytest.mark.parametrize(("method", "path", "nobody", "unit", "operator"), DOORS)
async def test_tokens(desk: Desk, method: str, path: str, nobody: int, unit: int, operator: int) -> None:
    for token, expected in ((None, nobody), ("wrong-token-0123456789", nobody), (UNIT, unit), (OPERATOR, operator)):
        response = await desk.call(method, path, token)
        assert response.status_code == expected, (token, response.text)
        if expected >= 400:
            detail = response.json()["detail"]
            assert isinstance(detail, str)
            assert "\n" not in detail
            assert UNIT not in detail
            assert OPERATOR not in detail


async def test_every_route_but_health_is_in_the_token_test(desk: Desk) -> None:
    names = {"/1": "/{unit_id}", "0" * 64: "{sha256}", "/depth": "/{kind}", "?command=1": ""}
    listed = set()
    for method, path, *_ in DOORS:
        for value, name in names.items():
            path = path.replace(value, name)
        listed.add((method, path))
    schema = (await desk.call("GET", "/openapi.json", None)).json()
    served = {(method.upper(), path) for path, methods in schema["paths"].items() for method in methods}
    assert served <= listed


async def test_recording_starts_and_stops_at_run_time(tmp_path: Path) -> None:
    watched = master()
    recorder = Recorder(watched, RecordingConfig(free_bytes_min=0), tmp_path)
    desk = Desk(make_app(watched, Access(UNIT.encode(), OPERATOR.encode()), recorder))
    assert (await desk.call("GET", "/recording")).json()["recording"] is False
    began = await desk.call("POST", "/recording")
    assert began.status_code == 200
    assert began.json()["recording"] is True
    ended = (await desk.call("DELETE", "/recording")).json()
    assert ended["file"] == began.json()["file"]
    assert ended["bytes"] == Path(ended["file"]).stat().st_size > 0
    assert (await desk.call("GET", "/recording", UNIT)).json() == ended


async def test_public_reads() -> None:
    desk = Desk(make_app(master(), Access(UNIT.encode(), OPERATOR.encode(), public_reads=True)))
    assert (await desk.call("GET", "/voxels", None)).status_code == 200
    assert (await desk.call("PUT", "/settings", None, json={})).status_code == 401


async def test_a_unit_sets_its_own_pose_and_an_operator_any(desk: Desk) -> None:
    unit = await desk.register("10.0.0.1")
    body = {"T_world_camera": AT_ORIGIN}
    path = f"/units/{unit.initialized.id}/pose"
    assert (await desk.call("PUT", path, UNIT, "10.0.0.2", json=body)).status_code == 403
    assert (await desk.call("PUT", path, OPERATOR, "10.0.0.2", json=body)).json() == {"pose": 2}
    sheared = [[1.0, 0.5, 0.0, 0.0], *AT_ORIGIN[1:]]
    refused = await desk.call("PUT", path, json={"T_world_camera": sheared})
    assert refused.status_code == 422
    assert "T_world_camera" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("/settings", {"voxel_size_m": 5}, "voxel_size_m: input should be less than or equal to 0.1, got 5"),
        ("/settings", {"voxels": 5}, "voxels: extra inputs are not permitted"),
        ("/settings", [1], "value: "),
        ("/robot/joints", {"positions": [1.0]}, "positions: expected 2 numbers"),
        ("/robot/joints", {"positions": ["x", 1]}, "positions.0: "),
        ("/robot/joints", {"positions": [1e300, 1]}, "positions.0: input should be less than or equal to 10000"),
        ("/robot/joints", {"positions": [1, 1], "velocities": [0, -1e39]}, "velocities.1: "),
        ("/robot/joints", {"positions": [True, 1]}, "positions.0: "),
        ("/robot/joints", {"positions": [1.0, 2.0], "speed": 1}, "speed: "),
        ("/robot/joints", {}, "positions: field required"),
        ("/units/x/pose", {"T_world_camera": AT_ORIGIN}, "path.unit_id: "),
        ("/units/1/pose", {"T_world_camera": [[1.0]]}, "T_world_camera"),
    ],
)
async def test_bad_input_is_one_sentence_that_names_the_field(desk: Desk, path: str, body: Any, words: str) -> None:
    response = await desk.call("PUT", path, json=body)
    assert response.status_code == 422
    assert response.json()["detail"].startswith(words)


@pytest.mark.parametrize("body", [b"{", b"\xff\xfe", b'{"positions": [NaN, 1.0]}', b'{"positions": [1e999, 1.0]}'])
async def test_bodies_that_are_no_json_are_refused(desk: Desk, body: bytes) -> None:
    response = await desk.call("PUT", "/robot/joints", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code == 422


@pytest.mark.parametrize("body", [b"\xc1", b"", msgpack.packb({"positions": b"\xff"}), b"\xd7\xff" + b"\0" * 8])
async def test_bodies_that_are_no_msgpack_are_refused(desk: Desk, body: bytes) -> None:
    response = await desk.call("PUT", "/robot/joints", content=body, headers=MSGPACK)
    assert response.status_code == 422


@pytest.mark.parametrize("path", ["/robot/joints", "/settings"])
@pytest.mark.parametrize("depth", [100, 500, 900, 1000, 20_000])
async def test_bodies_nested_too_deeply_are_refused_in_one_sentence(desk: Desk, path: str, depth: int) -> None:
    packed = b"\x81\xa9positions" + b"\x91" * depth + b"\xc0"
    text = b'{"positions": ' + b"[" * depth + b"]" * depth + b"}"
    for body, headers in ((packed, MSGPACK), (text, {"Content-Type": "application/json"})):
        response = await desk.call("PUT", path, content=body, headers=headers)
        assert response.status_code in (400, 422)
        assert isinstance(response.json()["detail"], str)


@pytest.mark.parametrize("token", [None, "wrong-token-0123456789"])
async def test_nothing_is_read_of_a_body_without_a_token(desk: Desk, token: str | None) -> None:
    read = []

    async def never() -> AsyncIterator[bytes]:
        read.append(path)
        yield b"{}"

    for method, path in (("POST", "/initialize"), ("PUT", "/settings"), ("POST", "/update")):
        assert (await desk.call(method, path, token, content=never(), headers=MSGPACK)).status_code == 401
    assert read == []


async def test_invalid_json_names_the_body(desk: Desk) -> None:
    response = await desk.call("PUT", "/settings", content=b"{", headers={"Content-Type": "application/json"})
    assert response.status_code == 422
    assert response.json()["detail"].startswith("body: expected JSON")


@pytest.mark.parametrize("field", ["serial", "model", "software", "boot_id"])
async def test_a_unit_cannot_write_lines_into_logs(desk: Desk, field: str) -> None:
    body = FakeUnit(desk.app.services.master).introduction(monotonic_ns()).model_dump() | {field: "A\nERROR \x1b[2J"}
    response = await desk.call("POST", "/initialize", UNIT, content=msgpack.packb(body), headers=MSGPACK)
    assert response.status_code == 422
    assert field in response.json()["detail"]
    assert "\n" not in response.json()["detail"]


async def test_msgpack_both_ways(desk: Desk) -> None:
    body = msgpack.packb({"voxel_size_m": 0.04})
    response = await desk.call("PUT", "/settings", content=body, headers=MSGPACK)
    assert response.headers["content-type"] == MEDIA_TYPE
    assert decode(Settings, response.content).voxel_size_m == 0.04
    silent = decode(RobotAnswer, (await desk.call("GET", "/robot?since_ns=0", headers=MSGPACK)).content)
    assert (silent.state, silent.age_s, silent.joints) == ("silent", None, ())
    joints = msgpack.packb({"positions": [0.1, 0.2], "velocities": [0.0, 0.0]})
    assert (await desk.call("PUT", "/robot/joints", content=joints, headers=MSGPACK)).status_code == 204
    robot = decode(RobotAnswer, (await desk.call("GET", "/robot", headers=MSGPACK)).content)
    assert robot.state == "fresh"
    assert robot.joints[0].positions == (0.1, 0.2)


async def test_joints_since(desk: Desk) -> None:
    for value in (0.1, 0.2):
        await desk.call("PUT", "/robot/joints", json={"positions": [value, 0.0]})
    everything = (await desk.call("GET", "/robot?since_ns=0")).json()
    assert everything["joints"][-1][1] == [0.2, 0.0]
    newest_ns = everything["joints"][-1][0]
    assert (await desk.call("GET", f"/robot?since_ns={newest_ns}")).json()["joints"] == []
    assert everything["joint_names"] == ["shoulder", "elbow"]


async def test_the_cell_and_its_meshes(desk: Desk) -> None:
    response = await desk.call("GET", "/cell", UNIT)
    document = response.json()
    assert document["name"] == "test"
    unit = await desk.register()
    assert response.headers["etag"] == f'"{unit.initialized.cell.sha256}"'
    sha256 = next(frame["mesh"] for frame in document["robot"]["frames"] if frame["mesh"])
    mesh = await desk.call("GET", f"/cell/meshes/{sha256}", UNIT)
    assert mesh.content == desk.app.services.master.published.meshes[sha256]
    assert "immutable" in mesh.headers["cache-control"]


@pytest.mark.parametrize(
    ("method", "what", "verb"),
    [
        ("POST", "background", "learn_background"),
        ("DELETE", "background", "drop_background"),
        ("POST", "calibrate", "calibrate"),
        ("POST", "refine", "refine"),
    ],
)
async def test_commands_of_an_operator_reach_the_unit(desk: Desk, method: str, what: str, verb: str) -> None:
    unit = await desk.register()
    path = f"/units/{unit.initialized.id}/{what}"
    assert (await desk.call(method, path, UNIT)).status_code == 403
    asked = await desk.call(method, path)
    assert asked.status_code == 202
    answer = decode_update_answer((await desk.update(unit)).content)
    assert [command.model_dump() for command in answer.commands] == [asked.json()]
    assert asked.json()["verb"] == verb
    assert (await desk.call("GET", "/units")).json()[0]["last_command"] == {
        "id": asked.json()["id"],
        "verb": verb,
        "outcome": None,
        "code": None,
        "detail": "",
    }


async def test_a_body_beyond_its_bound_is_refused(desk: Desk) -> None:
    unit = await desk.register()
    assert (await desk.call("PUT", "/settings", content=b" " * (common.MAX_BODY_BYTES + 1))).status_code == 413
    body = b"\0" * (MAX_UPDATE_BYTES + 1)
    assert (await desk.call("POST", "/update", UNIT, content=body, headers=MSGPACK)).status_code == 413

    async def endless() -> AsyncIterator[bytes]:
        while True:
            yield b"\0" * 65536

    assert (await desk.call("POST", "/update", UNIT, content=endless(), headers=MSGPACK)).status_code == 413
    assert (await desk.update(unit, 1)).status_code == 200


async def test_a_missing_body_times_out(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "BODY_TIMEOUT_S", 0.05)
    gate = asyncio.Event()

    async def slow() -> AsyncIterator[bytes]:
        yield b"\x80"
        await gate.wait()

    for path in ("/update", "/initialize"):
        response = await desk.call("POST", path, UNIT, content=slow(), headers=MSGPACK)
        assert response.status_code == 408


async def test_malformed_updates_disturb_nobody(desk: Desk) -> None:
    unit = await desk.register()
    await desk.update(unit, 5)
    body = encode_update(unit.request(monotonic_ns(), [6]))
    rng = np.random.default_rng(1)
    statuses = set()
    for _ in range(300):
        mutated = bytearray(body)
        for place in rng.integers(0, len(mutated), 3):
            mutated[place] = rng.integers(0, 256)
        response = await desk.call("POST", "/update", UNIT, content=bytes(mutated), headers=MSGPACK)
        statuses.add(response.status_code)
        assert response.status_code < 500
    assert 422 in statuses
    other = await desk.register("10.0.0.2", "B")
    assert (await desk.update(other, 7)).status_code == 200
    assert 7 in (await desk.call("GET", "/voxels?form=keys")).json()["voxels"]


async def test_unknown_paths_and_methods(desk: Desk) -> None:
    assert (await desk.call("GET", "/nothing")).status_code == 404
    assert (await desk.call("GET", "/update")).status_code == 405


async def test_json_is_utf_8(desk: Desk) -> None:
    response = await desk.call("PUT", "/settings", content=b'{"voxel_size_m": "\xff"}')
    assert response.status_code == 422
    assert response.json()["detail"] == "body: expected JSON in UTF-8: invalid start byte at byte 18"
