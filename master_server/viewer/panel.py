# SPDX-License-Identifier: Apache-2.0
"""The table, plots and controls beside the picture; what units say of themselves is text and never markup."""

from __future__ import annotations

import html
import io
import json
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any
from urllib.parse import quote

import httpx
import imageio.v3 as iio
import numpy as np
import viser
from numpy.typing import NDArray

from master_server.viewer.channel import Asker
from master_server.viewer.scene import STATE_COLOURS, UnseenLayer
from master_server.viewer.sessions import Viewer
from shared.errors import CellwatchError, Refusal
from shared.lattice import Lattice

HISTORY = 600
"""Points of the plots: five minutes at two a second."""

ACTION_S = 5.0
"""For what an operator's own action posts to."""

SENTENCE_CHARS = 300

SHOWN_S = 12.0
"""A refusal stays to be read."""

STYLE = """<style>
.cw{font:12px/1.45 system-ui,sans-serif;padding:0 .6em}.cw table{width:100%;border-collapse:collapse}
.cw th{font-weight:600;text-align:right;opacity:.65}.cw td{text-align:right;padding:.1em .2em}
.cw th:first-child,.cw td:first-child,.cw th:nth-child(2),.cw td:nth-child(2){text-align:left}
.cw td{white-space:nowrap}.cw td.why{white-space:normal;text-align:left;opacity:.8;padding-bottom:.4em}
.cw b{font-weight:600}
</style>"""

PICTURES = ("depth", "expected", "foreground")

SETTINGS = (
    ("voxel_size_m", "voxel size [m]", 0.01, 0.10, 0.005),
    ("occupancy_threshold", "threshold", 0.05, 2.0, 0.05),
    ("stale_after_s", "stale after [s]", 0.05, 60.0, 0.05),
)
"""Name, label, least, most and step; the other settings are for `PUT /settings`."""

COMMANDS = (
    ("Find by the board", "POST", "/calibrate"),
    ("Refine the pose", "POST", "/refine"),
    ("Learn the background", "POST", "/background"),
    ("Drop the background", "DELETE", "/background"),
    ("Forget this unit", "DELETE", ""),
)
"""What a button says, and what it asks of `/units/ID`."""


def status_html(told: dict[str, Any]) -> str:
    """Whether the map is all there is, and why not."""
    replayed = told.get("replay")
    lines = []
    if replayed:
        state = "playing" if replayed["playing"] else "paused"
        lines.append(
            f"<b>recording</b> {html.escape(replayed['file'])}, {replayed['position_s']:.1f} of "
            f"{replayed['duration_s']:.1f} s, {state}"
        )
    voxels = len(told["keys"]) // 4
    age_s = told["oldest_view_age_s"]
    age = "" if age_s is None else f", oldest view {age_s * 1000:.0f} ms"
    lines.append(f"<b>{voxels}</b> obstacle voxels, {told['units_live']} units live{age}")
    if told["reasons"]:
        colour = _css("blind")
        lines.append(f'<b style="color:{colour}">The map is not complete:</b>')
        lines += [html.escape(reason) for reason in told["reasons"]]
        more = told["reason_count"] - len(told["reasons"])
        lines += [f"and {more} more"] * (more > 0)
    else:
        lines.append(f'<b style="color:{_css("live")}">The map is complete.</b>')
    if told["robot"]["state"] not in ("fresh", "none"):
        lines.append(f"robot: {html.escape(told['robot']['reason'])}")
    return f'{STYLE}<div class="cw" data-cellwatch="status">{"<br>".join(lines)}</div>'


def table_html(rows: list[dict[str, Any]]) -> str:
    """A row a unit, and below it why it is not live."""
    heads = ("unit", "state", "age ms", "fps", "ms", "voxels", "valid", "fits")
    parts = [f"<tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>"]
    for row in rows:
        health = row["health"]
        state = row["state"]
        cells = (
            f"{row['id']} · {html.escape(row['ip'])}",
            f'<span style="color:{_css(state)}">⬤</span> <b>{state}</b>',
            "" if row["age_s"] is None else f"{row['age_s'] * 1000:.0f}",
            f"{row['fps']:.1f}",
            f"{row['process_ms']:.1f}",
            str(row["voxels"]),
            f"{health['valid_share']:.0%}",
            f"{health['agreeing_share']:.0%}" if health["static_share"] > 0.0 else "",
        )
        data = f'data-unit="{row["id"]}" data-state="{state}"'
        parts.append(f"<tr {data}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
        notes = [row["reason"]] if row["reason"] else []
        if command := row["last_command"]:
            notes.append(f"{command['verb']}: {command['outcome'] or 'under way'}")
        if notes:
            parts.append(f'<tr><td class="why" colspan="8">{html.escape("; ".join(notes))}</td></tr>')
    if not rows:
        parts.append('<tr><td class="why" colspan="8">No unit has registered yet.</td></tr>')
    return f'{STYLE}<div class="cw" data-cellwatch="units"><table>{"".join(parts)}</table></div>'


def _css(state: str) -> str:
    return "rgb({}, {}, {})".format(*STATE_COLOURS[state])


class Panel:
    """What all who look see alike beside the picture."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._history: deque[tuple[float, float, float]] = deque(maxlen=HISTORY)
        gui = server.gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, control_layout="collapsible", control_width="large"
        )
        gui.set_panel_label("Cellwatch")
        self._status = gui.add_html("", order=0.0)
        with gui.add_folder("Units", order=1.0):
            self._table = gui.add_html("")
        with gui.add_folder("The last minutes", order=5.0):
            self._age = self._plot(gui, "age of the oldest view [ms]", "#2f6fd0")
            self._voxels = self._plot(gui, "obstacle voxels", "#e65a1e")

    def show(self, told: dict[str, Any], at_s: float) -> None:
        """The newest, with units."""
        age_s = told["oldest_view_age_s"]
        self._history.append((at_s, np.nan if age_s is None else age_s * 1000.0, len(told["keys"]) / 4.0))
        self._status.content = status_html(told)
        self._table.content = table_html(told["units"])
        times_s, ages_ms, voxels = np.array(self._history, np.float64).T
        self._age.data = (times_s, ages_ms)
        self._voxels.data = (times_s, voxels)

    def say(self, text: str) -> None:
        """Something stands in place of the status."""
        self._status.content = f'{STYLE}<div class="cw" data-cellwatch="status">{html.escape(text)}</div>'

    @staticmethod
    def _plot(gui: viser.GuiApi, title: str, colour: str) -> Any:
        nothing = np.zeros(1)
        return gui.add_uplot(
            (nothing, nothing),
            series=({}, {"label": title, "stroke": colour, "width": 1.5}),
            title=title,
            scales={"x": {"time": True}, "y": {"auto": True}},
            legend={"show": False},
            aspect=3.0,
        )


class Person:
    """One who looks: what is theirs alone, and what they may do."""

    def __init__(
        self,
        client: viser.ClientHandle,
        viewer: Viewer,
        asker: Asker,
        actions: dict[str, str],
        is_replay: bool,
    ) -> None:
        self.client = client
        self.viewer = viewer
        self._asker = asker
        self._units: dict[str, dict[str, Any]] = {}
        self._unseen = UnseenLayer(client)
        self._position: Any = None
        self._playing: Any = None
        self.wanted_position_s: float | None = None
        gui = client.gui
        with gui.add_folder("Look", order=2.0):
            self._wants_unseen = gui.add_checkbox("space that nobody sees", False)
            self._unit = gui.add_dropdown("unit", ("none",))
            if not is_replay:
                self._on_click(gui.add_button("What it sees"), self._show_pictures)
            self._pictures: Any = None
        if viewer is Viewer.OPERATOR and is_replay:
            self._add_player(gui)
        elif viewer is Viewer.OPERATOR:
            self._add_controls(gui, actions)
        elif not is_replay:
            gui.add_markdown("You entered as a reader: to change something, enter as the operator.", order=3.0)

    @property
    def wants_unseen(self) -> bool:
        """Whether they want to see what nobody sees."""
        return bool(self._wants_unseen.value)

    def show(self, told: dict[str, Any]) -> None:
        """The newest, with units."""
        units = {f"{row['id']} · {row['ip']}": row for row in told["units"]}
        if units.keys() != self._units.keys():
            self._unit.options = tuple(units) or ("none",)
        self._units = units
        if self.wants_unseen and "seen" in told:
            self._unseen.show(told["seen"], lattice_of(told["blocks"]))
        elif not self.wants_unseen:
            self._unseen.hide()
        replayed = told.get("replay")
        if replayed and self._position is not None and self.wanted_position_s is None:
            self._position.max = max(replayed["duration_s"], 0.1)
            self._position.value = min(replayed["position_s"], self._position.max)
            self._playing.value = replayed["playing"]

    def go(self) -> None:
        """Go where the slider was last moved to."""
        wanted_s, self.wanted_position_s = self.wanted_position_s, None
        if wanted_s is not None:
            self._do(lambda: self._ask("PUT", "/replay", {"position_s": wanted_s}))

    # ------------------------------------------------------------------ inside

    def _add_controls(self, gui: viser.GuiApi, actions: dict[str, str]) -> None:
        with gui.add_folder("This unit", order=3.0):
            for label, url in actions.items():
                self._on_click(gui.add_button(label, color="orange"), partial(self._act, url))
            for label, method, path in COMMANDS:
                colour: Any = "red" if label.startswith("Forget") else "gray"
                self._on_click(gui.add_button(label, color=colour), partial(self._command, method, path))
        settings = self._ask("GET", "/settings")
        with gui.add_folder("Settings", order=4.0):
            numbers: dict[str, Any] = {
                name: gui.add_number(label, float(settings[name]), min=least, max=most, step=step)
                for name, label, least, most, step in SETTINGS
            }

            def apply() -> None:
                changed = self._ask("PUT", "/settings", {name: number.value for name, number in numbers.items()})
                for name, number in numbers.items():
                    number.value = float(changed[name])

            self._on_click(gui.add_button("Apply"), apply)

    def _add_player(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Recording", order=0.5):
            self._playing = gui.add_checkbox("play", True)
            speed = gui.add_dropdown("speed", ("0.1", "0.25", "0.5", "1", "2", "5", "10"), initial_value="1")
            self._position = gui.add_slider("time [s]", min=0.0, max=1.0, step=0.01, initial_value=0.0)

        def play(event: Any) -> None:
            # What the program itself set comes from nobody.
            if event.client is not None:
                self._do(lambda: self._ask("PUT", "/replay", {"playing": bool(self._playing.value)}))

        def hurry(event: Any) -> None:
            if event.client is not None:
                self._do(lambda: self._ask("PUT", "/replay", {"speed": float(speed.value)}))

        def go(event: Any) -> None:
            if event.client is not None:
                # A hand that moves it says a hundred places a second; the last one is where it goes.
                self.wanted_position_s = float(self._position.value)

        self._playing.on_update(play)
        speed.on_update(hurry)
        self._position.on_update(go)

    def _on_click(self, button: Any, do: Callable[[], Any]) -> None:
        button.on_click(lambda _: self._do(do))

    def _command(self, method: str, path: str) -> None:
        self._ask(method, f"/units/{self._chosen()['id']}{path}")

    def _do(self, do: Callable[[], Any]) -> None:
        try:
            do()
        except CellwatchError as error:
            self.client.add_notification(
                "Not done", str(error)[:SENTENCE_CHARS], color="red", auto_close_seconds=SHOWN_S
            )

    def _chosen(self) -> dict[str, Any]:
        row = self._units.get(self._unit.value)
        if row is None:
            raise Refusal(404, "no unit is chosen")
        return row

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        data = self._fetch(method, path, body)
        return json.loads(data) if data else None

    def _fetch(self, method: str, path: str, body: Any = None) -> bytes:
        answer = self._asker.ask(verb="ask", method=method, path=path, body=body, viewer=self.viewer.value)
        data = bytes(answer["body"])
        if answer["status"] >= 400:
            raise Refusal(answer["status"], _detail(data))
        return data

    def _act(self, url: str) -> None:
        row = self._chosen()
        address = url.format(id=row["id"], ip=quote(row["ip"]), serial=quote(row["serial"]))
        try:
            response = httpx.post(address, timeout=ACTION_S, trust_env=False)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Refusal(502, f"{address}: {str(error) or type(error).__name__}") from error
        if response.is_error:
            raise Refusal(response.status_code, _detail(response.content))

    def _show_pictures(self) -> None:
        row = self._chosen()
        images = [
            np.asarray(iio.imread(io.BytesIO(self._fetch("GET", f"/units/{row['id']}/images/{kind}"))))[..., :3]
            for kind in PICTURES
        ]
        sheet = contact_sheet(images)
        label = f"unit {row['id']}: measured, expected; below: what remains"
        if self._pictures is not None:
            self._pictures.remove()
        self._pictures = self.client.gui.add_image(sheet, label=label, order=2.5)


def contact_sheet(images: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Three pictures (H, W, 3) as one: two beside each other and the third below."""
    first, second, third = images
    height, width, _ = first.shape
    sheet = np.zeros((2 * height, 2 * width, 3), np.uint8)
    sheet[:height, :width], sheet[:height, width:] = first, second
    sheet[height:, :width] = third
    return sheet


def lattice_of(described: dict[str, Any]) -> Lattice:
    """A lattice as a look tells it."""
    return Lattice(tuple(described["origin_m"]), described["voxel_size_m"], tuple(described["shape"]))


def _detail(body: bytes) -> str:
    """The sentence of a refusal."""
    try:
        return str(json.loads(body)["detail"])
    except (ValueError, KeyError, TypeError):
        return body[:SENTENCE_CHARS].decode("utf-8", "replace")
