# SPDX-License-Identifier: Apache-2.0
"""The operator's window in a real browser, with a real master and real units."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, expect
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from master_server.viewer.scene import STATE_COLOURS, VIEW_FOV_RAD, view_edges, view_of
from shared.camera import Intrinsics
from shared.transforms import apply, inverse, look_at
from tests.system.browser import LOAD_MS, OUT, Witness, a_browser, opened, shot
from tests.system.cluster import CELL, START_S, Cluster, stop, until, write_cell, write_recording
from tests.system.test_demo import running
from tests.system.test_replay import start_replay

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

LOOKING_ALONG_Y = {"xyz": [1.0, -1.0, 1.0], "rpy_deg": [-90.0, 0.0, 0.0]}
LOOKING_ALONG_X = {"xyz": [-1.0, 1.0, 1.0], "rpy_deg": [-90.0, 0.0, -90.0]}
FOCALS_PX = {1: 120.0, 2: 200.0}
"""Focal lengths of a wide camera and a narrow one."""

SEEN_S = 40.0
"""Time limit of a change on the screen, rendered without a graphics card on a busy machine."""

PRINTED_S = 10.0
"""Time limit of the next line of the master's output."""

GONE_S = 5.0
"""Time limit for a stopped process to end."""

VISER = Subprotocol("viser-v1.1.1")


class TerminalCluster(Cluster):
    """A cluster whose master believes that its output is a terminal."""

    def start(self, name: str, *arguments: str, under: Sequence[str] = ()) -> subprocess.Popen[str]:
        if name != "master":
            return super().start(name, *arguments, under=under)
        self.terminal, theirs = pty.openpty()
        with (self.folder / "master.log").open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *arguments], stdout=theirs, stderr=log, text=True, close_fds=True
            )
        os.close(theirs)
        self.processes.append(process)
        return process

    def printed_link(self) -> str:
        """Return the link that the master has printed."""
        said = ""
        while (found := re.search(r"the viewer is at (\S+/viewer/login#\S+)", said)) is None:
            readable, _, _ = select.select([self.terminal], [], [], PRINTED_S)
            assert readable, f"no link was printed: {said}"
            said += os.read(self.terminal, 4096).decode()
        return found.group(1)


@pytest.fixture(scope="module", autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Replace the guard of each test, because browser and cluster live as long as this module."""
    before = set(psutil.Process().children(recursive=True))
    yield
    _, alive = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, timeout=GONE_S)
    assert alive == []


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TerminalCluster]:
    folder = tmp_path_factory.mktemp("viewer")
    with TerminalCluster(folder, write_cell(folder)) as cluster:
        cluster.start_master("--set", "unit_actions.Ring the bell=http://127.0.0.1:9/{ip}")
        for number, pose in enumerate((LOOKING_ALONG_Y, LOOKING_ALONG_X), 1):
            frames = str(write_recording(folder / f"frames{number}", FOCALS_PX[number]))
            source = {"kind": "recorded", "folder": frames, "fps": 10.0, "loop": True}
            cluster.start_unit(number, source, T_world_camera=pose)
        cluster.until_live(2, 3 * START_S)
        until(lambda: len(cluster.get("/voxels")["voxels"]) >= 80, "the patch")
        yield cluster


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with a_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def witness() -> Witness:
    return Witness()


@pytest.fixture(scope="module")
def page(cluster: TerminalCluster, browser: Browser, witness: Witness) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    witness.watch(context)
    yield opened(context, cluster.printed_link())
    context.close()


def on_screen(page: Page, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the pixels (N, 2) x, y of world points (N, 3), in the initial view."""
    eye, target = view_of(*(np.array(CELL["box"][corner]) for corner in ("min", "max")))
    rect = page.evaluate("() => document.querySelector('canvas').getBoundingClientRect().toJSON()")
    seen = apply(inverse(look_at(eye, target)), points_m)
    focal_px = rect["height"] / 2.0 / np.tan(VIEW_FOV_RAD / 2.0)
    middle = np.array([rect["x"] + rect["width"] / 2.0, rect["y"] + rect["height"] / 2.0])
    return np.rint(middle + focal_px * seen[:, :2] / seen[:, 2:]).astype(np.int64)


def is_obstacle(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels in the hues of obstacles: red above green above blue, by far."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    return (red > 90) & (red - green > 30) & (green - blue > 8) | (red - green > 80) & (red - blue > 80)


def count_of(picture: NDArray[np.uint8], state: str, place: NDArray[np.int64]) -> int:
    """Return the number of pixels around a place (x, y) in the colour of a state."""
    (x, y), reach = place, 90
    around = picture[max(y - reach, 0) : y + reach, max(x - reach, 0) : min(x + reach, 885)]
    return int((np.abs(around.astype(int) - STATE_COLOURS[state]).max(axis=2) < 40).sum())


def until_shown(page: Page, look: Callable[[NDArray[np.uint8]], bool], what: str) -> NDArray[np.uint8]:
    """Return the first screenshot for which `look` is true."""
    pictures: list[NDArray[np.uint8]] = []

    def found() -> bool:
        # The browser's own events are processed meanwhile.
        page.wait_for_timeout(300)
        pictures[:] = [shot(page, what)]
        return look(pictures[0])

    until(found, what, SEEN_S)
    return pictures[0]


def row(page: Page, unit_id: object) -> Any:
    return page.locator(f'tr[data-unit="{unit_id}"]')


def test_it_opens_from_the_printed_link(cluster: TerminalCluster, page: Page) -> None:
    assert re.fullmatch(rf"{cluster.url}/viewer/(\?websocket=[^#]*)?", page.url)
    for unit in cluster.get("/units"):
        assert row(page, unit["id"]).get_attribute("data-state") == "live"
    expect(page.locator('[data-cellwatch="status"]')).to_contain_text("complete", timeout=SEEN_S * 1000)
    assert page.evaluate("document.cookie") == ""
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"], cookie["path"]) == (True, "Strict", "/viewer")
    token = Path(cluster.folder / "master" / "operator.token").read_text().strip()
    assert token not in cluster.log("master") + page.content() + json.dumps(page.context.cookies())


def test_obstacles_are_drawn_where_they_are(cluster: TerminalCluster, page: Page) -> None:
    centres = np.array(cluster.get("/voxels?form=centres")["voxels"])
    places = on_screen(page, centres)

    def shown(picture: NDArray[np.uint8]) -> bool:
        marked = is_obstacle(picture)
        return float(marked[places[:, 1], places[:, 0]].mean()) > 0.6

    picture = until_shown(page, shown, "obstacles")
    marked = is_obstacle(picture)
    low, high = places.min(axis=0) - 25, places.max(axis=0) + 25
    inside = marked[low[1] : high[1], low[0] : high[0]].sum()
    assert inside > 200
    assert marked[:, :800].sum() - inside < 0.1 * inside


def is_unit_2(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels in the hue of voxels of unit 2 alone, which nothing else has."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    return (green - red > 50) & (blue - red > 45)


def choose(page: Page, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def test_colours_show_the_unit_on_demand(cluster: TerminalCluster, page: Page) -> None:
    legend = page.locator('[data-cellwatch="legend"]')
    expect(legend).to_contain_text("2 units")
    places = on_screen(page, np.array(cluster.get("/voxels?form=centres")["voxels"]))

    def share(picture: NDArray[np.uint8]) -> float:
        return float(is_unit_2(picture)[places[:, 1], places[:, 0]].mean())

    assert share(shot(page, "by-number")) == 0.0
    choose(page, "voxels by", "unit")
    expect(legend).to_contain_text("several units", timeout=SEEN_S * 1000)
    picture = until_shown(page, lambda picture: share(picture) > 0.2, "by-unit")
    assert is_obstacle(picture)[places[:, 1], places[:, 0]].mean() > 0.2
    choose(page, "voxels by", "number of units")
    until_shown(page, lambda picture: share(picture) == 0.0, "by-number-again")


def range_lines(page: Page, row: dict[str, Any], intrinsics: dict[str, Any]) -> NDArray[np.int64]:
    """Return the pixels (N, 2) along the edges of a unit camera's view with these intrinsics."""
    edges = view_edges(Intrinsics(**intrinsics), row["range_m"]).astype(np.float64)
    steps = np.linspace(0.5, 1.0, 60)[:, None, None]
    points = (edges[:4, 0] * (1.0 - steps) + edges[:4, 1] * steps).reshape(-1, 3)
    places = on_screen(page, apply(np.array(row["T_world_camera"]), points))
    return places[(places[:, 0] > 5) & (places[:, 0] < 800) & (places[:, 1] > 5) & (places[:, 1] < 795)]


def share_lined(picture: NDArray[np.uint8], places: NDArray[np.int64]) -> float:
    """Return the share of the places that have, or adjoin, the light green of a live camera's range."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    is_green = (green - red > 18) & (green - blue > 12)
    near = [is_green[places[:, 1] + y, places[:, 0] + x] for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2)]
    return float(np.any(near, axis=0).mean())


def test_each_camera_shows_its_own_view(cluster: TerminalCluster, page: Page) -> None:
    wide, narrow = sorted(cluster.get("/units"), key=lambda unit: str(unit["ip"]))
    assert (wide["intrinsics"]["fx"], narrow["intrinsics"]["fx"]) == (FOCALS_PX[1], FOCALS_PX[2])
    for unit, other in ((wide, narrow), (narrow, wide)):
        # From a metre before the box to its far side, less half a block.
        assert unit["range_m"] == 2.95
        own, others = (range_lines(page, unit, one["intrinsics"]) for one in (unit, other))
        assert len(own) > 60
        picture = until_shown(page, lambda picture, own=own: share_lined(picture, own) > 0.8, "ranges")  # type: ignore[misc]  # a default binds `own`
        assert share_lined(picture, others) < 0.4
    page.get_by_role("checkbox", name="how far cameras see").uncheck(force=True)
    places = range_lines(page, wide, wide["intrinsics"])
    until_shown(page, lambda picture: share_lined(picture, places) < 0.1, "ranges-off")
    page.get_by_role("checkbox", name="how far cameras see").check(force=True)


def test_the_last_minutes_are_there_at_once(cluster: TerminalCluster, page: Page) -> None:
    history = cluster.get("/history")
    assert len(history["at_ns"]) > 5
    plot = page.locator(".uplot").first
    plot.scroll_into_view_if_needed()

    def is_drawn() -> bool:
        page.wait_for_timeout(300)
        picture = np.asarray(Image.open(io.BytesIO(plot.screenshot())).convert("RGB")).astype(int)
        return int(((picture[..., 2] - picture[..., 0]) > 60).sum()) > 100

    until(is_drawn, "the plot", SEEN_S)
    shot(page, "plots")


def test_a_setting_reaches_the_units(cluster: TerminalCluster, page: Page) -> None:
    versions = [unit["versions"]["lattice"] for unit in cluster.get("/units")]
    page.get_by_label("voxel size [m]").fill("0.08")
    page.get_by_label("voxel size [m]").press("Tab")
    page.get_by_role("button", name="Apply").click()
    until(lambda: cluster.get("/settings")["voxel_size_m"] == 0.08, "the setting at the master", SEEN_S)
    until(
        lambda: all(
            unit["state"] == "live" and unit["versions"]["lattice"] > before
            for unit, before in zip(cluster.get("/units"), versions, strict=True)
        ),
        "the setting at the units",
        SEEN_S,
    )
    settings = cluster.get("/settings")
    assert (settings["stale_after_s"], settings["occupancy_threshold"]) == (0.5, 0.6)


def test_pictures_are_shown_on_request(cluster: TerminalCluster, page: Page) -> None:
    before = page.locator("img").count()
    page.get_by_role("button", name="What it sees").click()
    until(lambda: page.wait_for_timeout(300) or page.locator("img").count() > before, "the picture", SEEN_S)
    shot(page, "pictures")
    expect(page.get_by_text("measured, expected; below: what remains")).to_be_visible()


def test_unseen_blocks_are_drawn_on_demand(page: Page) -> None:
    page.get_by_role("checkbox", name="space that nobody sees").check(force=True)

    def is_violet(picture: NDArray[np.uint8]) -> bool:
        red, green, blue = (picture[:, :800, i].astype(int) for i in range(3))
        return int(((blue - green > 12) & (red - green > 4) & (blue > red)).sum()) > 3000

    until_shown(page, is_violet, "unseen")
    page.get_by_role("checkbox", name="space that nobody sees").uncheck(force=True)
    until_shown(page, lambda picture: not is_violet(picture), "unseen-off")


def test_a_refusal_is_shown_as_its_sentence(page: Page) -> None:
    page.get_by_role("button", name="Ring the bell").click()
    expect(page.get_by_text("http://127.0.0.1:9/127.0.0.")).to_be_visible(timeout=SEEN_S * 1000)
    shot(page, "refusal")


def test_a_unit_that_dies_turns_its_frustum_and_its_row(cluster: TerminalCluster, page: Page) -> None:
    victim, other = sorted(cluster.get("/units"), key=lambda unit: unit["ip"] != "127.0.0.3")
    cameras = np.array([victim["T_world_camera"], other["T_world_camera"]])
    place, others = on_screen(page, cameras[:, :3, 3])
    live = until_shown(page, lambda picture: count_of(picture, "live", place) > 60, "live")
    assert count_of(live, "stale", place) < 10
    stop(cluster.processes[-1], signal.SIGKILL)
    expect(row(page, victim["id"])).to_have_attribute("data-state", "stale", timeout=SEEN_S * 1000)
    expect(page.locator('[data-cellwatch="status"]')).to_contain_text(f"unit {victim['id']} (127.0.0.3) is stale")
    killed = until_shown(page, lambda picture: count_of(picture, "stale", place) > 60, "unit-killed")
    assert count_of(killed, "live", others) > 60


def test_a_unit_is_deleted_only_after_confirmation(cluster: TerminalCluster, page: Page) -> None:
    (victim,) = [unit for unit in cluster.get("/units") if unit["state"] == "stale"]
    choose(page, "unit", f"{victim['id']} · {victim['ip']}")
    page.get_by_role("button", name="Forget this unit").click()
    asked = page.locator('[data-cellwatch="confirm"]')
    expect(asked).to_contain_text(f"unit {victim['id']} · {victim['ip']}", timeout=SEEN_S * 1000)
    shot(page, "confirm")
    page.get_by_role("button", name="Keep it").click()
    expect(asked).to_have_count(0, timeout=SEEN_S * 1000)
    assert victim["id"] in [unit["id"] for unit in cluster.get("/units")]
    page.get_by_role("button", name="Forget this unit").click()
    page.get_by_role("button", name="Forget it").click()
    expect(row(page, victim["id"])).to_have_count(0, timeout=SEEN_S * 1000)
    assert victim["id"] not in [unit["id"] for unit in cluster.get("/units")]
    expect(asked).to_have_count(0, timeout=SEEN_S * 1000)


def test_without_the_right_token_there_is_nothing_to_see(
    cluster: TerminalCluster, browser: Browser, witness: Witness
) -> None:
    context = browser.new_context()
    try:
        page = context.new_page()
        page.goto(f"{cluster.url}/viewer/")
        page.get_by_label("token").fill("wrong" * 8)
        page.get_by_role("button", name="Enter").click()
        expect(page.locator("output")).to_contain_text("unknown token")
        shot(page, "wrong-token")
        assert (page.locator("canvas").count(), context.cookies()) == (0, [])
        code = page.evaluate(
            """() => new Promise(resolve => {
                const socket = new WebSocket(location.href.replace('http', 'ws'), ['viser-v1.1.1']);
                socket.onopen = () => resolve('open'); socket.onclose = () => resolve('closed');
            })"""
        )
        assert code == "closed"
    finally:
        context.close()


def test_the_units_token_lets_look_but_not_touch(cluster: TerminalCluster, browser: Browser, witness: Witness) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    witness.watch(context)
    try:
        page = context.new_page()
        page.set_default_timeout(LOAD_MS)
        page.goto(f"{cluster.url}/viewer/login")
        page.get_by_label("token").fill(Path(cluster.unit_token_file).read_text().strip())
        page.get_by_role("button", name="Enter").click()
        expect(page.get_by_text("You entered as a reader")).to_be_visible(timeout=SEEN_S * 2000)
        assert page.get_by_role("button", name="Apply").count() == 0
        shot(page, "reader")
    finally:
        context.close()


def headers(cluster: Cluster) -> dict[str, str]:
    return {"Authorization": cluster.operator.headers["Authorization"]}


def socket(cluster: Cluster, **more: Any) -> ClientConnection:
    url = f"{cluster.url.replace('http', 'ws', 1)}/viewer/"
    return connect(url, subprotocols=[VISER], max_size=None, proxy=None, **more)


def test_no_tunnel_is_opened_to_anywhere(cluster: TerminalCluster) -> None:
    with socket(cluster, additional_headers=headers(cluster)) as talker:
        assert talker.subprotocol == VISER
        talker.recv(timeout=SEEN_S)
        viewer = viewer_process(cluster)
        for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
            talker.send(msgpack.packb({"type": kind}))
        talker.send(
            msgpack.packb(
                {
                    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 3.0],
                    "fov": 1.0, "image_height": 100, "image_width": 100, "near": 0.1, "far": 100.0,
                    "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0],
                }
            )
        )  # fmt: skip
        # The message after it is answered: the camera message makes the client a viewer.
        said = b""
        while b"Settings" not in said:
            said = unpacked(talker.recv(timeout=SEEN_S))
            assert b"ShareUrl" not in said
        assert {found.raddr.ip for found in viewer.net_connections() if found.raddr} <= {"127.0.0.1"}
        assert {found.laddr.ip for found in viewer.net_connections() if found.status == "LISTEN"} == {"127.0.0.1"}


def unpacked(data: bytes | str) -> bytes:
    """Return the part of viser's message that is no array."""
    import zstandard

    assert isinstance(data, bytes)
    size, length = (int.from_bytes(data[at : at + 8], "little") for at in (0, 8))
    return zstandard.ZstdDecompressor().decompress(data[16 : 16 + length], max_output_size=size)


def viewer_process(cluster: Cluster) -> psutil.Process:
    (found,) = psutil.Process(cluster.processes[0].pid).children()
    return found


def test_another_pages_socket_is_refused(cluster: TerminalCluster) -> None:
    for more, status in (
        ({"additional_headers": {}}, 401),
        ({"additional_headers": {"Authorization": "Bearer " + "x" * 40}}, 401),
        ({"additional_headers": headers(cluster), "origin": "http://evil.example"}, 403),
    ):
        with pytest.raises(InvalidStatus) as refused, socket(cluster, **more):
            pass
        assert refused.value.response.status_code == status


def test_its_own_port_reveals_nothing(cluster: TerminalCluster) -> None:
    with socket(cluster, additional_headers=headers(cluster)) as talker:
        talker.recv(timeout=SEEN_S)
        (port,) = {found.laddr.port for found in viewer_process(cluster).net_connections() if found.status == "LISTEN"}
        with (
            connect(f"ws://127.0.0.1:{port}/", subprotocols=[VISER], proxy=None) as direct,
            pytest.raises(ConnectionClosedError, match="1008"),
        ):
            direct.recv(timeout=SEEN_S)


def test_nothing_went_wrong_in_the_browser(cluster: TerminalCluster, page: Page, witness: Witness) -> None:
    foreign = witness.foreign(cluster.url)
    errors = [error for error in witness.errors if "401 (Unauthorized)" not in error]
    if OUT:
        (Path(OUT) / "browser.json").write_text(json.dumps({"foreign": foreign, "errors": errors}))
    assert witness.asked
    assert (foreign, errors) == ([], [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_it_ends_with_the_master(tmp_path: Path, number: signal.Signals) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        master = cluster.start_master()
        assert "#" not in cluster.log("master")
        assert httpx.get(f"{cluster.url}/viewer/", trust_env=False).status_code == 401
        assert psutil.Process(master.pid).children() == []
        with socket(cluster, additional_headers=headers(cluster)) as talker:
            talker.recv(timeout=SEEN_S)
            viewer = viewer_process(cluster)
            took_s = stop(master, number)
        viewer.wait(3.0)
        if number is signal.SIGTERM:
            assert (master.returncode, took_s < 2.5) == (0, True)
        assert "Traceback" not in cluster.log("master")


def link_of(cluster: Cluster) -> str:
    answer = cluster.operator.post("/viewer/links").raise_for_status().json()
    return f"{cluster.url}{answer['path']}"


def test_a_recording_is_played_in_the_same_window(tmp_path: Path, browser: Browser) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        master = cluster.start_master("--record", str(tmp_path / "recordings"))
        source = {"kind": "recorded", "folder": str(write_recording(tmp_path / "images")), "fps": 15.0, "loop": True}
        cluster.start_unit(1, source, T_world_camera=LOOKING_ALONG_Y)
        cluster.until_live(1, 2 * START_S)
        until(lambda: cluster.get("/recording")["moments"] >= 40, "a few seconds", SEEN_S)
        file = cluster.get("/recording")["file"]
        stop(master, signal.SIGTERM)
        start_replay(cluster, file, "--loop")
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        try:
            page = opened(context, link_of(cluster))
            assert page.get_by_role("button", name="Apply").count() == 0
            page.get_by_role("checkbox", name="play").uncheck(force=True)
            until(lambda: not cluster.get("/replay")["playing"], "the pause", SEEN_S)
            expect(page.locator('[data-cellwatch="status"]')).to_contain_text("paused", timeout=SEEN_S * 1000)
            page.get_by_role("slider").first.press("Home")
            until(lambda: cluster.get("/replay")["position_s"] == 0.0, "the beginning", SEEN_S)
            page.get_by_role("slider").first.press("End")
            until(lambda: cluster.get("/replay")["position_s"] > 1.0, "the end", SEEN_S)
            page.get_by_label("speed").click()
            page.get_by_role("option", name="2", exact=True).click()
            until(lambda: cluster.get("/replay")["speed"] == 2.0, "the speed", SEEN_S)
            shot(page, "replay")
            page.get_by_role("checkbox", name="play").check(force=True)
            until(lambda: cluster.get("/replay")["playing"], "to go on", SEEN_S)
        finally:
            context.close()


def test_the_demo_shows_itself_and_a_unit_without_power(browser: Browser) -> None:
    # A browser without a graphics card needs a core for itself: few frames of few cameras leave it one.
    with running("--units", "2", "--fps", "5") as demo:
        link = demo.until_said("watch it in a browser: ").split("browser: ")[1].split(" ")[0]
        demo.until_said("2 of 2 units live")
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        try:
            page = opened(context, link)
            until_shown(page, lambda picture: is_obstacle(picture[:, :800]).sum() > 200, "demo")
            victim = page.locator("tr[data-unit]").first.get_attribute("data-unit")
            page.get_by_role("button", name="Cut this unit's power").click()
            expect(row(page, victim)).to_have_attribute("data-state", "stale", timeout=SEEN_S * 1000)
            page.get_by_role("button", name="Cut this unit's power").click()
            expect(page.get_by_text("has no power already")).to_be_visible(timeout=SEEN_S * 1000)
            shot(page, "demo-power-cut")
            page.get_by_role("button", name="Give it power again").click()
            expect(row(page, victim)).to_have_attribute("data-state", "live", timeout=2 * SEEN_S * 1000)
        finally:
            context.close()
        code, _ = demo.end(signal.SIGINT)
        assert (code, demo.left()) == (0, [])
