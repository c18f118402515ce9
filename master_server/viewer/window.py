# SPDX-License-Identifier: Apache-2.0
"""The viewer's process, started by the master with one end of a socket pair; it ends with the master."""

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

from master_server.viewer.channel import Asker
from master_server.viewer.messages import (
    ApiAnswer,
    ApiRequest,
    BeginAnswer,
    BeginRequest,
    Look,
    LookRequest,
    MapBits,
    ReadyAnswer,
    ReadyRequest,
)
from master_server.viewer.panel import Panel, Person
from master_server.viewer.scene import Scene, Voxels
from master_server.viewer.sessions import Viewer
from shared.cell import Cell
from shared.clock import NS_PER_S, monotonic_ns, wall_ns
from shared.errors import CellwatchError, Refusal

PERIOD_S = 0.1
"""Between two looks; a person sees no more, and each takes a little of the master's time."""

TABLE_EVERY = 5
"""Looks; twice a second one can still read figures."""

IDLE_S = 60.0
"""Without anyone who looks; a page that is loaded anew finds its plots as they were."""

NICE = 5
"""Updates first, where there is not time enough for all."""


class Window:
    """What is drawn for all who look."""

    def __init__(self, asker: Asker, beginning: BeginAnswer) -> None:
        self._asker = asker
        self._key = f"Bearer {beginning.key}"
        self._actions = beginning.actions
        self._is_replay = beginning.is_replay
        self._people: dict[int, Person] = {}
        self._may: dict[int, Viewer] = {}
        self._lock = threading.Lock()
        self._somebody_came = threading.Event()
        self._cell: Cell | None = None
        self._cell_sha256 = ""
        self._drawn: MapBits | None = None
        self._voxels: Voxels | None = None
        self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        # Nobody opens a tunnel to the world from here; the master does not pass such requests on, either.
        self.server.request_share_url = _refuse_to_share  # type: ignore[method-assign]  # viser has no switch for it
        # viser asks nobody who they are; so before all else, this does.
        self.server._websock_server._client_connect_cb.insert(0, self._admit)
        self.server.on_client_connect(self._come)
        self.server.on_client_disconnect(self._leave)
        self._scene = Scene(self.server)
        self._panel = Panel(self.server)

    def run(self) -> None:
        """Draw for as long as somebody looks."""
        count = 0
        while True:
            began_ns = monotonic_ns()
            with self._lock:
                people = list(self._people.values())
            if not people:
                self._somebody_came.clear()
                if not self._somebody_came.wait(IDLE_S):
                    return
                count = 0
                continue
            try:
                self._draw(people, count % TABLE_EVERY == 0)
            except CellwatchError as error:
                self._panel.say(str(error))
            count += 1
            self._rest(PERIOD_S - (monotonic_ns() - began_ns) / NS_PER_S)

    # ------------------------------------------------------------------ inside

    async def _admit(self, connection: Any) -> None:
        """Close what did not come by way of the master, before anything is told."""
        socket_of_client = self.server._websock_server._live_connections[connection.client_id]
        request = socket_of_client.request
        assert request is not None
        shown = request.headers.get("Authorization", "")
        if not hmac.compare_digest(shown.encode(), self._key.encode()):
            await socket_of_client.close(1008)
            return
        self._may[connection.client_id] = Viewer(request.headers["Cellwatch-Viewer"])

    def _come(self, client: viser.ClientHandle) -> None:
        viewer = self._may.get(client.client_id)
        if viewer is None:
            return
        person = Person(client, viewer, self._asker, self._actions, self._is_replay)
        with self._lock:
            self._people[client.client_id] = person
        self._somebody_came.set()

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._people.pop(client.client_id, None)
        self._may.pop(client.client_id, None)

    def _draw(self, people: list[Person], with_units: bool) -> None:
        for person in people:
            person.go()
        request = LookRequest(
            units=with_units,
            unseen=with_units and any(person.wants_unseen for person in people),
            reports=any(person.wants_by_unit for person in people),
            since_ns=self._panel.known_ns,
        )
        told = self._asker.ask(request, Look)
        if told.cell != self._cell_sha256:
            self._load_cell(told.cell)
        self._scene.set_joints(told.joints)
        if told.map != self._drawn:
            self._drawn, self._voxels = told.map, voxels_of(told.map)
        assert self._voxels is not None
        for person in people:
            person.draw(self._voxels)
        if told.units is not None:
            self._scene.set_units(told.units)
            self._panel.show(told, wall_ns() / NS_PER_S)
            for person in people:
                person.show(told)

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
        answer = self._asker.ask(ApiRequest(method="GET", path=path, viewer=Viewer.READER), ApiAnswer)
        if answer.status != 200:
            raise Refusal(answer.status, f"{path}: the master answers {answer.status}")
        return answer.body

    def _rest(self, seconds: float) -> None:
        threading.Event().wait(max(seconds, 0.0))


def voxels_of(told: MapBits) -> Voxels:
    """The obstacles of a map."""
    reports = {unit_id: np.frombuffer(keys, np.uint32) for unit_id, keys in (told.reports or {}).items()}
    keys, witnesses = np.frombuffer(told.keys, np.uint32), np.frombuffer(told.witnesses, np.uint8)
    return Voxels.of(told.lattice.lattice(), keys, witnesses, reports)


def _named_meshes(document: dict[str, Any]) -> set[str]:
    """The sha256 of all meshes that a cell's document names."""
    robot = document["robot"]
    bodies = [*document["static"], *document["objects"], *(robot["frames"] if robot else ())]
    return {body["mesh"] for body in bodies if body["mesh"] is not None}


def _refuse_to_share(*_: object, **__: object) -> None:
    return None


def main(arguments: list[str]) -> None:
    """Serve until the master is gone or nobody looks any more."""
    os.nice(NICE)
    asker = Asker(socket.socket(fileno=int(arguments[0])))

    def listen() -> None:
        asker.listen()
        # Whatever else goes on: what it shows would not be true any more.
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    window = Window(asker, asker.ask(BeginRequest(), BeginAnswer))
    asker.ask(ReadyRequest(port=window.server.get_port()), ReadyAnswer)
    window.run()
    # Its server's threads have nobody left to wait for.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
