# SPDX-License-Identifier: Apache-2.0
"""The viewer's process. The master starts it with one end of a socket pair; it ends with the master."""

from __future__ import annotations

import hmac
import json
import os
import socket
import sys
import threading
from typing import Any

import numpy as np
import viser

from master_server.viewer.channel import MasterChannel
from master_server.viewer.messages import (
    ApiAnswer,
    ApiRequest,
    BeginAnswer,
    BeginRequest,
    MapBits,
    ReadyAnswer,
    ReadyRequest,
    StateRequest,
    ViewerState,
)
from master_server.viewer.panel import ClientPanel, Panel
from master_server.viewer.scene import Scene, Voxels
from master_server.viewer.sessions import Viewer
from shared.cell import Cell
from shared.clock import NS_PER_S, monotonic_ns, wall_ns
from shared.errors import CellwatchError, Refusal

PERIOD_S = 0.1
"""Period of a refresh; a user notices no faster one, and each takes a little of the master's time."""

TABLE_EVERY = 5
"""Refreshes between two updates of the table; figures can still be read twice a second."""

IDLE_S = 60.0
"""Time without a browser before the process ends; a page that is reloaded finds its plots as they were."""

NICE = 5
"""Niceness of this process: updates have priority on a busy machine."""


class Window:
    """The scene that all browsers share, and the panel of each."""

    def __init__(self, channel: MasterChannel, configuration: BeginAnswer) -> None:
        self._channel = channel
        self._key = f"Bearer {configuration.key}"
        self._actions = configuration.actions
        self._is_replay = configuration.is_replay
        self._panels: dict[int, ClientPanel] = {}
        self._may: dict[int, Viewer] = {}
        self._lock = threading.Lock()
        self._has_client = threading.Event()
        self._cell: Cell | None = None
        self._cell_sha256 = ""
        self._drawn: MapBits | None = None
        self._voxels: Voxels | None = None
        self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        # Disable tunnels to viser's makers; the master does not forward such requests, either.
        self.server.request_share_url = _refuse_to_share  # type: ignore[method-assign]  # viser has no switch for it
        # viser has no authentication, so this check runs before anything else.
        self.server._websock_server._client_connect_cb.insert(0, self._admit)
        self.server.on_client_connect(self._on_connect)
        self.server.on_client_disconnect(self._on_disconnect)
        self._scene = Scene(self.server)
        self._panel = Panel(self.server)

    def run(self) -> None:
        """Draw while a browser is connected."""
        count = 0
        while True:
            began_ns = monotonic_ns()
            with self._lock:
                panels = list(self._panels.values())
            if not panels:
                self._has_client.clear()
                if not self._has_client.wait(IDLE_S):
                    return
                count = 0
                continue
            try:
                self._draw(panels, count % TABLE_EVERY == 0)
            except CellwatchError as error:
                self._panel.say(str(error))
            count += 1
            self._wait(PERIOD_S - (monotonic_ns() - began_ns) / NS_PER_S)

    # ------------------------------------------------------------------ inside

    async def _admit(self, connection: Any) -> None:
        """Close a connection that did not come through the master, before anything is sent."""
        socket_of_client = self.server._websock_server._live_connections[connection.client_id]
        request = socket_of_client.request
        assert request is not None
        shown = request.headers.get("Authorization", "")
        if not hmac.compare_digest(shown.encode(), self._key.encode()):
            await socket_of_client.close(1008)
            return
        self._may[connection.client_id] = Viewer(request.headers["Cellwatch-Viewer"])

    def _on_connect(self, client: viser.ClientHandle) -> None:
        viewer = self._may.get(client.client_id)
        if viewer is None:
            return
        panel = ClientPanel(client, viewer, self._channel, self._actions, self._is_replay)
        with self._lock:
            self._panels[client.client_id] = panel
        self._has_client.set()

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._panels.pop(client.client_id, None)
        self._may.pop(client.client_id, None)

    def _draw(self, panels: list[ClientPanel], with_units: bool) -> None:
        for panel in panels:
            panel.go()
        request = StateRequest(
            units=with_units,
            unseen=with_units and any(panel.wants_unseen for panel in panels),
            reports=any(panel.wants_by_unit for panel in panels),
            since_ns=self._panel.known_ns,
        )
        state = self._channel.request(request, ViewerState)
        if state.cell != self._cell_sha256:
            self._load_cell(state.cell)
        self._scene.set_joints(state.joints)
        if state.map != self._drawn:
            self._drawn, self._voxels = state.map, voxels_of(state.map)
        assert self._voxels is not None
        for panel in panels:
            panel.draw(self._voxels)
        if state.units is not None:
            self._scene.set_units(state.units)
            self._panel.show(state, wall_ns() / NS_PER_S)
            for panel in panels:
                panel.show(state)

    def _load_cell(self, sha256: str) -> None:
        document = json.loads(self._get("/cell"))
        known = {} if self._cell is None else self._cell.meshes
        meshes = {
            sha256: self._get(f"/cell/meshes/{sha256}") for sha256 in sorted(_named_meshes(document) - known.keys())
        }
        cell = Cell.from_document(document, meshes, self._cell)
        self._scene.set_cell(cell)
        self._cell, self._cell_sha256, self._drawn = cell, sha256, None

    def _get(self, path: str) -> bytes:
        answer = self._channel.request(ApiRequest(method="GET", path=path, viewer=Viewer.READER), ApiAnswer)
        if answer.status != 200:
            raise Refusal(answer.status, f"{path}: the master answers {answer.status}")
        return answer.body

    def _wait(self, seconds: float) -> None:
        threading.Event().wait(max(seconds, 0.0))


def voxels_of(state: MapBits) -> Voxels:
    """Return the obstacles of a map."""
    reports = {unit_id: np.frombuffer(keys, np.uint32) for unit_id, keys in (state.reports or {}).items()}
    keys, witnesses = np.frombuffer(state.keys, np.uint32), np.frombuffer(state.witnesses, np.uint8)
    return Voxels.of(state.lattice.lattice(), keys, witnesses, reports)


def _named_meshes(document: dict[str, Any]) -> set[str]:
    """Return the sha256 of all meshes that a cell's document names."""
    robot = document["robot"]
    bodies = [*document["static"], *document["objects"], *(robot["frames"] if robot else ())]
    return {body["mesh"] for body in bodies if body["mesh"] is not None}


def _refuse_to_share(*_: object, **__: object) -> None:
    return None


def main(arguments: list[str]) -> None:
    """Serve until the master ends or the last browser has been gone for `IDLE_S`."""
    os.nice(NICE)
    channel = MasterChannel(socket.socket(fileno=int(arguments[0])))

    def listen() -> None:
        channel.listen()
        # End even during a refresh: without the master, the display would be out of date.
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    window = Window(channel, channel.request(BeginRequest(), BeginAnswer))
    channel.request(ReadyRequest(port=window.server.get_port()), ReadyAnswer)
    window.run()
    # Its server's threads would wait for clients that are gone.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
