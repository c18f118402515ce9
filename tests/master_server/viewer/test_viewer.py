# SPDX-License-Identifier: Apache-2.0
"""The viewer without a browser: access, forwarded messages, drawn data."""

from __future__ import annotations

import asyncio
import inspect
import json
import re
import socket
import threading
from collections.abc import AsyncIterator
from http.cookies import Morsel, SimpleCookie
from types import SimpleNamespace
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
import viser

from master_server.api.history import SAMPLES_MAX, History, Sample
from master_server.app import add_viewer, make_app
from master_server.core import Master
from master_server.security import Access, Role
from master_server.viewer.channel import LENGTH, MasterChannel, pack, receive
from master_server.viewer.messages import (
    ApiAnswer,
    ApiRequest,
    BeginAnswer,
    BeginRequest,
    ReadyAnswer,
    ReadyRequest,
    RefusedAnswer,
    StateRequest,
    ViewerMessage,
    ViewerState,
)
from master_server.viewer.panel import contact_sheet, legend_html, status_html, table_html
from master_server.viewer.proxy import LOGIN_PAGE, Gate, is_passed, link_path
from master_server.viewer.scene import (
    SHARED_COLOUR,
    UNIT_COLOURS,
    WITNESS_COLOURS,
    cube,
    linear,
    surface,
    unit_colour,
    view_edges,
)
from master_server.viewer.sessions import LINK_S, LINKS_MAX, SESSION_S, Sessions, Viewer
from master_server.viewer.snapshot import viewer_state
from master_server.viewer.window import voxels_of
from shared.camera import Intrinsics
from shared.errors import Refusal, WireError
from shared.lattice import Lattice
from shared.messages import CommandRow, Health, Progress, UnitRow
from tests.master_server.fakes import START_NS, S, joined, master, sees_all

UNIT, OPERATOR = b"u" * 32, b"o" * 32
WALL_NS = 1_800_000_000 * S


@pytest.fixture
async def served() -> AsyncIterator[SimpleNamespace]:
    app = make_app(master(), Access(UNIT, OPERATOR))
    gate = add_viewer(app, {})
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://master:8420") as client:
        yield SimpleNamespace(gate=gate, client=client)
    assert isinstance(gate, Gate)
    assert not gate.host.is_running


def morsel(response: httpx.Response) -> Morsel[str]:
    (found,) = SimpleCookie(response.headers["set-cookie"]).values()
    return found


async def test_without_a_token_only_the_login_page_is_served(served: SimpleNamespace) -> None:
    answer = await served.client.get("/viewer/")
    assert answer.status_code == 401
    assert answer.text == LOGIN_PAGE
    assert "script-src 'sha256-" in answer.headers["content-security-policy"]
    assert (await served.client.get("/viewer/login")).text == LOGIN_PAGE
    assert not re.search(r"(?:src|href)=.?http", LOGIN_PAGE)


@pytest.mark.parametrize(("token", "viewer"), [(UNIT, Viewer.READER), (OPERATOR, Viewer.OPERATOR)])
async def test_a_token_is_exchanged_for_a_cookie(served: SimpleNamespace, token: bytes, viewer: Viewer) -> None:
    answer = await served.client.post("/viewer/login", json={"token": token.decode()})
    assert answer.status_code == 204
    cookie = morsel(answer)
    assert cookie.key == "cellwatch-viewer-8420"
    assert (cookie["httponly"], cookie["samesite"], cookie["path"]) == (True, "strict", "/viewer")
    assert token.decode() not in answer.headers["set-cookie"]
    page = await served.client.get("/viewer/")
    assert page.status_code == 200
    assert "<title>Cellwatch</title>" in page.text
    assert "connect-src 'self'" in page.headers["content-security-policy"]
    assert served.gate.sessions.viewer(cookie.value, 1) is viewer


@pytest.mark.parametrize("body", [{"token": "x" * 32}, {"code": "x"}, {"code": ""}, {"token": "\ud800é"}])
async def test_a_wrong_code_or_token_is_refused(served: SimpleNamespace, body: dict[str, str]) -> None:
    answer = await served.client.post(
        "/viewer/login", content=json.dumps(body), headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in (401, 422)
    assert "set-cookie" not in answer.headers


async def test_an_empty_login_is_refused(served: SimpleNamespace) -> None:
    answer = await served.client.post("/viewer/login", json={})
    assert (answer.status_code, answer.json()["detail"]) == (422, "body: expected a code or a token, got neither")


async def test_wrong_logins_are_rate_limited(served: SimpleNamespace) -> None:
    codes = [(await served.client.post("/viewer/login", json={"code": f"guess{i}"})).status_code for i in range(30)]
    assert codes[0] == 401
    assert codes[-1] == 429


async def test_a_link_works_once(served: SimpleNamespace) -> None:
    refused = await served.client.post("/viewer/links", headers={"Authorization": f"Bearer {UNIT.decode()}"})
    assert refused.status_code == 403
    made = await served.client.post("/viewer/links", headers={"Authorization": f"Bearer {OPERATOR.decode()}"})
    path, _, code = made.json()["path"].partition("#")
    assert path == "/viewer/login"
    assert (await served.client.post("/viewer/login", json={"code": code})).status_code == 204
    again = await served.client.post("/viewer/login", json={"code": code})
    assert (again.status_code, "set-cookie" in again.headers) == (401, False)


async def test_another_page_cannot_log_anyone_in(served: SimpleNamespace) -> None:
    code = link_path(served.gate.sessions).partition("#")[2]
    answer = await served.client.post("/viewer/login", json={"code": code}, headers={"Origin": "http://evil"})
    assert answer.status_code == 403
    own = await served.client.post("/viewer/login", json={"code": code}, headers={"Origin": "http://master:8420"})
    assert own.status_code == 204


def test_a_link_expires() -> None:
    sessions = Sessions(Access(UNIT, OPERATOR))
    code = sessions.make_code(START_NS)
    with pytest.raises(Refusal, match="not opened yet"):
        sessions.redeem(code, START_NS + LINK_S * S)
    codes = [sessions.make_code(START_NS) for _ in range(LINKS_MAX + 1)]
    with pytest.raises(Refusal):
        sessions.redeem(codes[0], START_NS)
    assert sessions.redeem(codes[1], START_NS + LINK_S * S - 1) is Viewer.OPERATOR


def test_a_link_is_void_with_the_token_under_which_it_was_made() -> None:
    access = Access(UNIT, OPERATOR)
    sessions = Sessions(access)
    code = sessions.make_code(START_NS)
    access.replace(Role.OPERATOR, b"another-token-0123456789")
    with pytest.raises(Refusal, match="not opened yet"):
        sessions.redeem(code, START_NS)


def test_a_cookie_is_valid_as_long_as_its_token() -> None:
    sessions = Sessions(Access(UNIT, OPERATOR))
    for viewer in Viewer:
        cookie = sessions.cookie(viewer, WALL_NS)
        assert Sessions(Access(UNIT, OPERATOR)).viewer(cookie, WALL_NS + (SESSION_S - 1) * S) is viewer
        assert sessions.viewer(cookie, WALL_NS + SESSION_S * S) is None
        assert Sessions(Access(b"n" * 32, b"m" * 32)).viewer(cookie, WALL_NS) is None
    raised = sessions.cookie(Viewer.READER, WALL_NS).replace("reader", "operator")
    assert sessions.viewer(raised, WALL_NS) is None
    name, expires, signature = sessions.cookie(Viewer.READER, WALL_NS).split(".")
    later = f"{name}.{int(expires) + 1}.{signature}"
    for wrong in ("", "..", later, f"{name}.٣.{signature}", f"{name}.{'9' * 40}.{signature}", "operator.1.", "é.1.2"):
        assert sessions.viewer(wrong, WALL_NS) is None


@pytest.mark.parametrize(
    ("message", "passed"),
    [
        ({"type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0]}, True),
        ({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 0.03}}, True),
        ({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"update_cb": []}}, False),
        ({"type": "GuiUpdateMessage", "uuid": "a", "updates": ["value"]}, False),
        ({"type": "ShareUrlRequest"}, False),
        ({"type": "ShareUrlDisconnect"}, False),
        ({"type": "FileTransferStartUpload"}, False),
        ({"type": ["ViewerCameraMessage"]}, False),
        ({}, False),
        ([], False),
    ],
)
def test_only_actions_of_a_user_are_forwarded(message: Any, passed: bool) -> None:
    assert is_passed(msgpack.packb(message)) is passed


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x81", b"\x91" * 3000, b"\x81\xff"])
def test_noise_is_not_forwarded(data: bytes) -> None:
    assert not is_passed(data)


def test_a_state_has_all_data_to_draw() -> None:
    watched = master()
    history = History(watched)
    history.take(START_NS - S)
    history.take(START_NS)
    state = state_of(watched, history, StateRequest(units=True, unseen=True, since_ns=START_NS - S))
    assert state.history == (Sample(START_NS, None, 0, 0, False),)
    assert state.map.lattice.lattice() == watched.lattice
    assert state.seen is not None
    assert state.seen.blocks.lattice() == watched.coverage.blocks
    assert len(state.seen.bits) == -(-watched.coverage.blocks.cell_count // 8)
    assert state.reasons == ("there is no unit",)
    assert state.robot.state == "none"
    assert "The map is not complete" in status_html(state)
    assert state.units == ()
    assert "No unit has registered yet" in table_html(state.units)
    least = state_of(watched, history, StateRequest())
    assert (least.units, least.history, least.map.reports, least.seen) == (None, (), None, None)


def state_of(watched: Master, history: History, wanted: StateRequest, now_ns: int = START_NS) -> ViewerState:
    """Return a state as it arrives through the channel."""
    packed = pack(1, viewer_state(watched, history, wanted, now_ns))
    _, fields = msgpack.unpackb(packed[LENGTH.size :], strict_map_key=False)
    return ViewerState.model_validate(fields)


def row(watched: Master, **changes: Any) -> UnitRow:
    """Return the row of a master's only unit, with changes."""
    (found,) = watched.units(START_NS)
    return found.model_copy(update=changes)


def test_colours_show_the_count_or_the_unit() -> None:
    watched = master()
    for number, keys in ((1, [3, 4]), (2, [4, 5])):
        joined(watched, number).update(START_NS, keys, seen=sees_all(watched))
    history = History(watched)
    voxels = voxels_of(state_of(watched, history, StateRequest(reports=True)).map)
    assert voxels.owners.tolist() == [1, 0, 2]
    assert voxels.colours(by_unit=False).tolist() == linear([WITNESS_COLOURS[i] for i in (0, 1, 0)]).tolist()
    expected = linear([unit_colour(1), SHARED_COLOUR, unit_colour(2)])
    assert voxels.colours(by_unit=True).tolist() == expected.tolist()
    # The reports were not requested.
    assert voxels_of(state_of(watched, history, StateRequest()).map).owners.tolist() == [0, 0, 0]


def test_linear_colours_match_screen_colours() -> None:
    assert linear([(0, 0, 0), (255, 128, 10)]).tolist() == [[0, 0, 0], [255, 55, 1]]


def test_colours_of_units_differ() -> None:
    colours = np.array([*UNIT_COLOURS, SHARED_COLOUR], int)
    apart = np.abs(colours[:, None] - colours[None]).sum(axis=2) + 999 * np.eye(len(colours), dtype=int)
    assert apart.min() > 100
    assert unit_colour(len(UNIT_COLOURS) + 1) == unit_colour(1)


def test_a_legend_names_the_drawn_colours() -> None:
    rows = (1, 4)
    assert [text in legend_html(False, rows, True) for text in ("1 unit<", "2 units<", "3 or more<", "unit 4")] == [
        True, True, True, False,
    ]  # fmt: skip
    by_unit = legend_html(True, rows, True)
    assert all(f"rgb{unit_colour(unit_id)}" in by_unit and f"unit {unit_id}<" in by_unit for unit_id in rows)
    assert "several units" in by_unit
    assert "not recorded" in legend_html(True, rows, False)


def test_a_view_is_that_of_its_own_camera() -> None:
    wide, narrow = Intrinsics(640, 480, 320.0, 320.0, 319.5, 239.5), Intrinsics(848, 480, 848.0, 848.0, 400.0, 239.5)
    for camera in (wide, narrow):
        edges = view_edges(camera, 2.0)
        assert edges.shape == (8, 2, 3)
        np.testing.assert_array_equal(edges[:4, 0], 0.0)
        pixels = camera.project(edges[:4, 1].astype(np.float64))
        right, bottom = camera.width - 0.5, camera.height - 0.5
        np.testing.assert_allclose(pixels, [(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)], atol=1e-3)
        assert (edges[:4, 1, 2] == 2.0).all()


def test_a_learning_unit_shows_its_progress() -> None:
    watched = master()
    joined(watched)
    health = Health(progress=Progress(task="background", done=12, total=60))
    assert '<progress value="12" max="60"></progress>' in table_html([row(watched, reason="learns", health=health)])
    # A unit of contract 5.0, or its recording, has this as a sentence only.
    assert "<progress" not in table_html([row(watched, reason="learning the background: frame 12 of 60")])


async def test_the_history_has_the_last_minutes() -> None:
    watched = master()
    app = make_app(watched, Access(UNIT, OPERATOR))
    joined(watched, 1).update(START_NS, [3], seen=sees_all(watched))
    for number in range(SAMPLES_MAX + 5):
        app.services.history.take(START_NS + number * S // 1000)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://master:8420") as client:
        assert (await client.get("/history")).status_code == 401
        answer = await client.get("/history", headers={"Authorization": f"Bearer {UNIT.decode()}"})
    state = answer.json()
    assert len(state["at_ns"]) == len(state["voxels"]) == SAMPLES_MAX
    assert state["at_ns"][0] == START_NS + 5 * S // 1000
    assert (state["voxels"][0], state["units_live"][0], state["complete"][0]) == (1, 1, True)
    assert state["oldest_view_age_s"][0] == pytest.approx(0.035, abs=2e-3)


def test_names_reported_by_a_unit_are_escaped() -> None:
    watched = master()
    joined(watched)
    command = CommandRow(id=1, verb="refine", outcome="<i>")
    shown = table_html([row(watched, ip="<b>", reason="<script>alert(1)</script>", last_command=command)])
    assert "refine: &lt;i&gt;" in shown
    assert 'data-unit="1" data-state="stale"' in shown
    assert "&lt;script&gt;" in shown
    assert not re.search("<(?:script|i)>", shown)


def test_the_surface_of_a_block_closes_around_it() -> None:
    lattice = Lattice((1.0, 2.0, 3.0), 0.5, (3, 3, 3))
    inside = np.zeros((3, 3, 3), np.bool_)
    inside[1, 1, 1] = True
    vertices, faces = surface(inside, lattice)
    assert faces.shape == (12, 3)
    np.testing.assert_allclose(vertices.min(0), (1.5, 2.5, 3.5))
    np.testing.assert_allclose(vertices.max(0), (2.0, 3.0, 4.0))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    np.testing.assert_allclose(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0, 6 * 0.25)
    inside[1, 1, 2] = True
    assert len(surface(inside, lattice)[1]) == 20
    assert len(surface(np.zeros_like(inside), lattice)[1]) == 0


def test_the_faces_of_a_voxel_look_outwards() -> None:
    vertices, faces = cube(2.0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0 == pytest.approx(24.0)


def test_three_images_are_joined() -> None:
    first, second, third = (np.full((2, 3, 3), value, np.uint8) for value in (1, 2, 3))
    sheet = contact_sheet([first, second, third])
    assert sheet.shape == (4, 6, 3)
    assert (sheet[0, 0, 0], sheet[0, 5, 0], sheet[3, 0, 0], sheet[3, 5, 0]) == (1, 2, 3, 0)


REQUESTS: tuple[ViewerMessage, ...] = (
    BeginRequest(),
    ReadyRequest(port=8421),
    StateRequest(units=True, since_ns=START_NS),
    ApiRequest(method="PUT", path="/settings", body={"voxel_size_m": 0.1}, viewer=Viewer.OPERATOR),
)


async def test_each_request_arrives_unchanged() -> None:
    reader = asyncio.StreamReader()
    for number, request in enumerate(REQUESTS):
        reader.feed_data(pack(number, request))
    reader.feed_eof()
    assert [await receive(reader) for _ in REQUESTS] == list(enumerate(REQUESTS))
    assert await receive(reader) is None


@pytest.mark.parametrize("fields", [{"verb": "begin", "more": 1}, {"verb": "stop"}, {}, None, {"verb": "ready"}])
async def test_an_unknown_request_is_refused(fields: object) -> None:
    reader = asyncio.StreamReader()
    data = msgpack.packb((1, fields))
    reader.feed_data(LENGTH.pack(len(data)) + data)
    with pytest.raises(WireError, match="viewer: "):
        await receive(reader)


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (BeginAnswer(key="k", actions={"Blink": "http://10.0.0.9/"}, is_replay=False), None),
        (RefusedAnswer(refused="recording: damaged at 3 s"), "recording: damaged at 3 s"),
        (ReadyAnswer(), "no BeginAnswer"),
        (ApiAnswer(status=200, body=b"1"), "no BeginAnswer"),
    ],
)
def test_an_answer_has_the_requested_type(answer: ViewerMessage, expected: str | None) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        channel = MasterChannel(theirs)
        listening = threading.Thread(target=channel.listen)
        listening.start()

        def answer_it() -> None:
            # The first request of a channel is number 0.
            ours.recv(LENGTH.size)
            ours.sendall(pack(0, answer))

        waiting = threading.Thread(target=answer_it)
        waiting.start()
        if expected is None:
            assert channel.request(BeginRequest(), BeginAnswer) == answer
        else:
            with pytest.raises(Refusal, match=expected):
                channel.request(BeginRequest(), BeginAnswer)
        waiting.join()
        ours.shutdown(socket.SHUT_RDWR)
        listening.join()


def test_the_private_attributes_of_viser_that_we_use_exist() -> None:
    """Pin these: `window` authenticates through them, since viser does not; another version may lack them."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        callbacks = server._websock_server._client_connect_cb
        assert isinstance(callbacks, list)
        assert len(inspect.signature(callbacks[0]).parameters) == 1
        assert server._websock_server._live_connections == {}
        assert callable(server.request_share_url)
    finally:
        server.stop()
