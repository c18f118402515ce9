# SPDX-License-Identifier: Apache-2.0
"""The table, plots and controls beside the scene. Texts of units are escaped, and never markup."""

from __future__ import annotations

import html
import io
import json
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from urllib.parse import quote

import httpx
import imageio.v3 as iio
import numpy as np
import viser
from numpy.typing import NDArray

from master_server.api.history import SAMPLES_MAX, Sample
from master_server.recording.replay import ReplayAnswer
from master_server.viewer.channel import MasterChannel
from master_server.viewer.messages import ApiAnswer, ApiRequest, ViewerState
from master_server.viewer.scene import (
    SHARED_COLOUR,
    WITNESS_COLOURS,
    Colour,
    RangeLayer,
    UnseenLayer,
    VoxelLayer,
    Voxels,
    state_colour,
    unit_colour,
)
from master_server.viewer.sessions import Viewer
from shared.clock import NS_PER_S
from shared.errors import CellwatchError, Refusal
from shared.messages import Progress, UnitRow
from shared.settings import Settings

ACTION_S = 5.0
"""Timeout of an operator's own action."""

PLOT_PADDING_PX = (12, 16, 0, 8)
"""Padding above, right of, below and left of a plot."""

SENTENCE_CHARS = 300

SHOWN_S = 12.0
"""Time for which a refusal is shown."""

STYLE = """<style>
.cw{font:12px/1.45 system-ui,sans-serif;padding:0 .6em}.cw table{width:100%;border-collapse:collapse}
.cw th{font-weight:600;text-align:right;opacity:.65}.cw td{text-align:right;padding:.1em .2em}
.cw th:first-child,.cw td:first-child,.cw th:nth-child(2),.cw td:nth-child(2){text-align:left}
.cw td{white-space:nowrap}.cw td.why{white-space:normal;text-align:left;opacity:.8;padding-bottom:.4em}
.cw b{font-weight:600}.cw i{display:inline-block;width:.8em;height:.8em;border-radius:2px;margin:0 .3em 0 .8em}
.cw i:first-child{margin-left:0}.cw progress{width:100%;height:.6em;accent-color:#2f6fd0}
</style>"""

PICTURES = ("depth", "expected", "foreground")

SETTINGS = (
    ("voxel_size_m", "voxel size [m]", 0.01, 0.10, 0.005),
    ("occupancy_threshold", "threshold", 0.05, 2.0, 0.05),
    ("stale_after_s", "stale after [s]", 0.05, 60.0, 0.05),
)
"""Name, label, minimum, maximum and step; other settings are changed by `PUT /settings`."""

COMMANDS = (
    ("Find by the board", "POST", "/calibrate", ""),
    ("Refine the pose", "POST", "/refine", ""),
    ("Learn the background", "POST", "/background", ""),
    (
        "Drop the background",
        "DELETE",
        "/background",
        "What it learned of the empty cell is lost; to learn it again, the cell must be empty.",
    ),
    (
        "Forget this unit",
        "DELETE",
        "",
        "Its slot and its camera's pose are deleted, and the map no longer waits for it. If it still runs it comes "
        "back as a new unit without a pose.",
    ),
)
"""Label, method, path after `/units/ID`, and what is lost; a command that loses something asks for confirmation."""

COLOURINGS = BY_WITNESSES, BY_UNIT = "number of units", "unit"
"""Meanings of the voxels' colours."""


def status_html(state: ViewerState) -> str:
    """Return the status: whether the map is complete, and the reasons if not."""
    replayed = state.replay
    lines = []
    if replayed:
        playing = "playing" if replayed.playing else "paused"
        lines.append(
            f"<b>recording</b> {html.escape(replayed.file)}, {replayed.position_s:.1f} of "
            f"{replayed.duration_s:.1f} s{_of_files(replayed.files)}, {playing}"
        )
    voxels = state.map.count
    age_s = state.oldest_view_age_s
    age = "" if age_s is None else f", oldest view {age_s * 1000:.0f} ms"
    units = f"{state.units_live} unit{'' if state.units_live == 1 else 's'} live"
    lines.append(f"<b>{voxels}</b> obstacle voxels, {units}{age}")
    if state.reasons:
        colour = _css("blind")
        lines.append(f'<b style="color:{colour}">The map is not complete:</b>')
        lines += [html.escape(reason) for reason in state.reasons]
        more = state.reason_count - len(state.reasons)
        lines += [f"and {more} more"] * (more > 0)
    else:
        lines.append(f'<b style="color:{_css("live")}">The map is complete.</b>')
    if state.robot.state not in ("fresh", "none"):
        lines.append(f"robot: {html.escape(state.robot.reason)}")
    return f'{STYLE}<div class="cw" data-cellwatch="status">{"<br>".join(lines)}</div>'


def table_html(rows: Sequence[UnitRow]) -> str:
    """Return a table with a row for each unit, and below it the reason why it is not live."""
    heads = ("unit", "state", "age ms", "fps", "ms", "voxels", "valid", "fits")
    parts = [f"<tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>"]
    for row in rows:
        health = row.health
        state = html.escape(row.state)
        cells = (
            f"{row.id} · {html.escape(row.ip)}",
            f'<span style="color:{_css(row.state)}">⬤</span> <b>{state}</b>',
            "" if row.age_s is None else f"{row.age_s * 1000:.0f}",
            f"{row.fps:.1f}",
            f"{row.process_ms:.1f}",
            str(row.voxels),
            f"{health.valid_share:.0%}",
            f"{health.agreeing_share:.0%}" if health.static_share > 0.0 else "",
        )
        data = f'data-unit="{row.id}" data-state="{state}"'
        parts.append(f"<tr {data}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
        notes = [row.reason] if row.reason else []
        if command := row.last_command:
            detail = f": {command.detail}" if command.code == "done" and command.detail else ""
            is_over = command.outcome is not None or command.code is not None
            outcome = command.outcome or command.code if is_over else "under way"
            notes.append(f"{command.verb}: {outcome}{detail}")
        if notes:
            bar = _progress_html(row.health.progress)
            parts.append(f'<tr><td class="why" colspan="8">{html.escape("; ".join(notes))}{bar}</td></tr>')
    if not rows:
        parts.append('<tr><td class="why" colspan="8">No unit has registered yet.</td></tr>')
    return f'{STYLE}<div class="cw" data-cellwatch="units"><table>{"".join(parts)}</table></div>'


def legend_html(by_unit: bool, unit_ids: Sequence[int], has_reports: bool) -> str:
    """Return the legend of the voxels' colours; without `has_reports` the reporting units are not known."""
    entries: list[tuple[Colour, str]]
    if not by_unit:
        counts = ("1 unit", "2 units", f"{len(WITNESS_COLOURS)} or more")
        entries = list(zip(WITNESS_COLOURS, counts, strict=True))
    elif has_reports:
        entries = [(unit_colour(unit_id), f"unit {unit_id}") for unit_id in unit_ids]
        entries.append((SHARED_COLOUR, "several units"))
    else:
        entries = [(SHARED_COLOUR, "not recorded: only the number of units that report a voxel is known")]
    chips = "".join(
        f'<span style="white-space:nowrap"><i style="background:rgb{colour}"></i>{text}</span> '
        for colour, text in entries
    )
    return f'{STYLE}<div class="cw" data-cellwatch="legend">{chips}</div>'


def confirm_html(row: UnitRow, loss: str) -> str:
    """Return the question before a command that loses something: the unit, and the loss."""
    unit = html.escape(f"unit {row.id} · {row.ip}, camera {row.serial}")
    return f'{STYLE}<div class="cw" data-cellwatch="confirm" style="padding-bottom:.8em"><b>{unit}</b><br>{loss}</div>'


def _of_files(count: int) -> str:
    return f" in {count} files" if count > 1 else ""


def _progress_html(progress: Progress | None) -> str:
    """Return a bar for the progress of a unit's task; empty without a task."""
    if progress is None:
        return ""
    return f'<progress value="{progress.done}" max="{progress.total}"></progress>'


def _css(state: str) -> str:
    return "rgb({}, {}, {})".format(*state_colour(state))


def _curve(points: list[tuple[int, float]], offset_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times (N,) in seconds, `offset_s` later than the given nanoseconds, and values (N,) for a plot."""
    at_ns, values = np.array(points or [(0, 0.0)], np.float64).T
    return at_ns / NS_PER_S + offset_s, values


class Panel:
    """The part of the panel that is the same for all viewers."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._history: deque[Sample] = deque(maxlen=SAMPLES_MAX)
        gui = server.gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, control_layout="collapsible", control_width="large"
        )
        gui.set_panel_label("Cellwatch")
        self._status = gui.add_html("", order=0.0)
        with gui.add_folder("Units", order=1.0):
            self._table = gui.add_html("")
        with gui.add_folder("The last minutes", order=2.6):
            self._age = self._plot(gui, "scene refresh: age of the oldest view [ms]", "#2f6fd0")
            self._voxels = self._plot(gui, "obstacle voxels", "#e65a1e")

    @property
    def known_ns(self) -> int:
        """Time of the newest history sample that is shown."""
        return self._history[-1].at_ns if self._history else -1

    def show(self, state: ViewerState, wall_s: float) -> None:
        """Show the newest state, with its units."""
        self._status.content = status_html(state)
        self._table.content = table_html(state.units or ())
        if not state.history:
            return
        self._history.extend(state.history)
        offset_s = wall_s - state.now_ns / NS_PER_S
        self._voxels.data = _curve([(sample.at_ns, float(sample.voxels)) for sample in self._history], offset_s)
        # The plot draws nothing at all of a curve with a NaN, so a gap is left out.
        ages_s = [(sample.at_ns, sample.oldest_view_age_s) for sample in self._history]
        self._age.data = _curve([(at_ns, 1000.0 * age_s) for at_ns, age_s in ages_s if age_s is not None], offset_s)

    def say(self, text: str) -> None:
        """Show a text in place of the status."""
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
            aspect=2.4,
            # Without it the uppermost number of an axis is cut in half.
            padding=PLOT_PADDING_PX,
        )


class Player:
    """The controls of a recording, and the last position of the slider."""

    def __init__(self, gui: viser.GuiApi, change: Callable[[dict[str, object]], None]) -> None:
        """Call `change` with each request of the user for the replay."""
        self._change = change
        self._wanted_s: float | None = None
        with gui.add_folder("Recording", order=0.5):
            self._playing: Any = gui.add_checkbox("play", True)
            self._speed = gui.add_dropdown("speed", ("0.1", "0.25", "0.5", "1", "2", "5", "10"), initial_value="1")
            self._position: Any = gui.add_slider("time [s]", min=0.0, max=1.0, step=0.01, initial_value=0.0)
        self._playing.on_update(lambda event: self._if_by_user(event, self._play))
        self._speed.on_update(lambda event: self._if_by_user(event, self._set_speed))
        self._position.on_update(lambda event: self._if_by_user(event, self._move))

    def show(self, replayed: ReplayAnswer) -> None:
        """Show the state of the replay, except while the slider is being moved."""
        if self._wanted_s is None:
            self._position.max = max(replayed.duration_s, 0.1)
            self._position.value = min(replayed.position_s, self._position.max)
            self._playing.value = replayed.playing

    def go(self) -> None:
        """Move the replay to the last position of the slider."""
        wanted_s, self._wanted_s = self._wanted_s, None
        if wanted_s is not None:
            self._change({"position_s": wanted_s})

    @staticmethod
    def _if_by_user(event: Any, do: Callable[[], None]) -> None:
        # A value that the program itself set has no client.
        if event.client is not None:
            do()

    def _play(self) -> None:
        self._change({"playing": bool(self._playing.value)})

    def _set_speed(self) -> None:
        self._change({"speed": float(self._speed.value)})

    def _move(self) -> None:
        # A moving slider reports a hundred positions a second; only the last one counts.
        self._wanted_s = float(self._position.value)


class ClientPanel:
    """The part of the panel that belongs to one browser: its choices, and the commands that its role may use."""

    def __init__(
        self,
        client: viser.ClientHandle,
        viewer: Viewer,
        channel: MasterChannel,
        actions: dict[str, str],
        is_replay: bool,
    ) -> None:
        self.client = client
        self.viewer = viewer
        self._channel = channel
        self._units: dict[str, UnitRow] = {}
        self._unseen = UnseenLayer(client)
        self._ranges = RangeLayer(client)
        self._voxels = VoxelLayer(client)
        self._player: Player | None = None
        gui = client.gui
        with gui.add_folder("Look", order=2.0):
            self._colouring = gui.add_dropdown("voxels by", COLOURINGS)
            self._legend = gui.add_html("")
            self._wants_ranges = gui.add_checkbox("how far cameras see", True)
            self._wants_unseen = gui.add_checkbox("space that nobody sees", False)
            self._unit = gui.add_dropdown("unit", ("none",))
            if not is_replay:
                self._on_click(gui.add_button("What it sees"), self._show_pictures)
            self._pictures: Any = None
        if viewer is Viewer.OPERATOR and is_replay:
            self._player = Player(gui, lambda change: self._do(partial(self._fetch, "PUT", "/replay", change)))
        elif viewer is Viewer.OPERATOR:
            self._do(partial(self._add_controls, gui, actions))
        elif not is_replay:
            gui.add_markdown("You entered as a reader: to change something, enter as the operator.", order=3.0)

    @property
    def wants_unseen(self) -> bool:
        """True if the unseen blocks are shown."""
        return bool(self._wants_unseen.value)

    @property
    def wants_by_unit(self) -> bool:
        """True if colours show the reporting unit."""
        return bool(self._colouring.value == BY_UNIT)

    def draw(self, voxels: Voxels) -> None:
        """Draw the obstacle voxels in the chosen colours."""
        self._voxels.show(voxels, self.wants_by_unit)

    def show(self, state: ViewerState) -> None:
        """Show the newest state, with its units."""
        rows = state.units or ()
        units = {f"{row.id} · {row.ip}": row for row in rows}
        if units.keys() != self._units.keys():
            self._unit.options = tuple(units) or ("none",)
        self._units = units
        self._legend.content = legend_html(self.wants_by_unit, [row.id for row in rows], state.map.has_reports)
        if self._wants_ranges.value:
            self._ranges.show(rows)
        else:
            self._ranges.hide()
        if self.wants_unseen and state.seen is not None:
            self._unseen.show(state.seen.bits, state.seen.blocks.lattice())
        elif not self.wants_unseen:
            self._unseen.hide()
        if state.replay is not None and self._player is not None:
            self._player.show(state.replay)

    def go(self) -> None:
        """Move the replay to the last position of the slider."""
        if self._player is not None:
            self._player.go()

    # ------------------------------------------------------------------ inside

    def _add_controls(self, gui: viser.GuiApi, actions: dict[str, str]) -> None:
        with gui.add_folder("This unit", order=3.0):
            for label, url in actions.items():
                self._on_click(gui.add_button(label, color="orange"), partial(self._act, url))
            for label, method, path, loss in COMMANDS:
                colour: Any = "red" if loss else "gray"
                do = partial(self._confirm, label, loss, method, path) if loss else partial(self._command, method, path)
                self._on_click(gui.add_button(label, color=colour), do)
        settings = Settings.model_validate_json(self._fetch("GET", "/settings"))
        with gui.add_folder("Settings", order=4.0):
            numbers: dict[str, Any] = {
                name: gui.add_number(label, float(getattr(settings, name)), min=least, max=most, step=step)
                for name, label, least, most, step in SETTINGS
            }

            def apply() -> None:
                wanted = {name: number.value for name, number in numbers.items()}
                changed = Settings.model_validate_json(self._fetch("PUT", "/settings", wanted))
                for name, number in numbers.items():
                    number.value = float(getattr(changed, name))

            self._on_click(gui.add_button("Apply"), apply)

    def _on_click(self, button: Any, do: Callable[[], Any]) -> None:
        button.on_click(lambda _: self._do(do))

    def _command(self, method: str, path: str) -> None:
        self._fetch(method, f"/units/{self._chosen().id}{path}")

    def _confirm(self, label: str, loss: str, method: str, path: str) -> None:
        """Ask for confirmation, for the unit that is chosen now."""
        row = self._chosen()
        gui = self.client.gui
        modal = gui.add_modal(f"{label}?")
        with modal:
            gui.add_html(confirm_html(row, loss))
            sure = gui.add_button(f"{label.split()[0]} it", color="red")
            back = gui.add_button("Keep it", color="gray")

        def act() -> None:
            modal.close()
            self._fetch(method, f"/units/{row.id}{path}")

        self._on_click(sure, act)
        self._on_click(back, modal.close)

    def _do(self, do: Callable[[], Any]) -> None:
        try:
            do()
        except CellwatchError as error:
            self.client.add_notification(
                "Not done", str(error)[:SENTENCE_CHARS], color="red", auto_close_seconds=SHOWN_S
            )

    def _chosen(self) -> UnitRow:
        row = self._units.get(self._unit.value)
        if row is None:
            raise Refusal(404, "no unit is chosen")
        return row

    def _fetch(self, method: str, path: str, body: object = None) -> bytes:
        request = ApiRequest(method=method, path=path, body=body, viewer=self.viewer)
        answer = self._channel.request(request, ApiAnswer)
        if answer.status >= 400:
            raise Refusal(answer.status, _detail(answer.body))
        return answer.body

    def _act(self, url: str) -> None:
        row = self._chosen()
        address = url.format(id=row.id, ip=quote(row.ip), serial=quote(row.serial))
        try:
            response = httpx.post(address, timeout=ACTION_S, trust_env=False)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Refusal(502, f"{address}: {str(error) or type(error).__name__}") from error
        if response.is_error:
            raise Refusal(response.status_code, _detail(response.content))

    def _show_pictures(self) -> None:
        row = self._chosen()
        images = [
            np.asarray(iio.imread(io.BytesIO(self._fetch("GET", f"/units/{row.id}/images/{kind}"))))[..., :3]
            for kind in PICTURES
        ]
        sheet = contact_sheet(images)
        label = f"unit {row.id}: measured, expected; below: what remains"
        if self._pictures is not None:
            self._pictures.remove()
        self._pictures = self.client.gui.add_image(sheet, label=label, order=2.5)


def contact_sheet(images: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Join three images (H, W, 3): two beside each other and the third below."""
    first, second, third = images
    height, width, _ = first.shape
    sheet = np.zeros((2 * height, 2 * width, 3), np.uint8)
    sheet[:height, :width], sheet[:height, width:] = first, second
    sheet[height:, :width] = third
    return sheet


def _detail(body: bytes) -> str:
    """Return the sentence of a refusal."""
    try:
        return str(json.loads(body)["detail"])
    except (ValueError, KeyError, TypeError):
        return body[:SENTENCE_CHARS].decode("utf-8", "replace")
