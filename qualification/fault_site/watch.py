# SPDX-License-Identifier: Apache-2.0
"""Observers that poll the map all the time, as a robot does, and comparison of its answers with the truth."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from qualification.fault_site.scene import FPS, Thing
from shared.clock import NS_PER_S, monotonic_ns

POLL_S = 0.01

STALE_AFTER_S = 0.5
"""The default of the master."""

SLACK_S = 0.1
"""Allowance for processes that share two cores: a signal takes effect late, and an observer runs late."""

NOTICED_S_MAX = STALE_AFTER_S + 1.0 / FPS + POLL_S + SLACK_S

RECOVERED_S_MAX = 1.0

SETTLED_S = 0.5
"""Time for which answers must stay good to count as recovered."""

SILENT_S = 1.0
"""Silence of the stream that counts as no answer. The heartbeat is twice as frequent."""

TIMEOUT_S = 0.25
"""Timeout of one answer."""


@dataclass(frozen=True)
class Answer:
    """One answer to GET /voxels?unseen=true, or the lack of one (`now_ns` is None)."""

    got_ns: int
    now_ns: int | None = None
    complete: bool = False
    reasons: tuple[str, ...] = ()
    units_live: int = 0
    age_s: float | None = None
    held: frozenset[str] = frozenset()
    """Things whose blocks are all reported as occupied."""
    free: frozenset[str] = frozenset()
    """Things with at least one block that is neither occupied nor unseen."""


@dataclass(frozen=True)
class Present:
    """A thing, and the time since which it stands there."""

    thing: Thing
    since_ns: int


class Observer(threading.Thread):
    """Records the answers of the master until stopped."""

    def __init__(self, port: int, things: Sequence[Thing]) -> None:
        super().__init__(name="observer", daemon=True)
        self._port = port
        self._things = things
        self._stopped = threading.Event()
        self.answers: list[Answer] = []

    def stop(self) -> None:
        """Stop polling."""
        self._stopped.set()
        self.join()

    def _look(self, view: dict[str, Any], got_ns: int) -> Answer:
        blocks = view["unseen"]
        origin_m, size_m = np.array(blocks["origin_m"]), blocks["voxel_size_m"]
        unseen = _grid(blocks["shape"], np.array(blocks["blocks"], dtype=np.int64).reshape(-1, 3))
        lattice = view["lattice"]
        voxels = np.array(view["voxels"], dtype=np.float64).reshape(-1, 3)
        centres_m = np.array(lattice["origin_m"]) + (voxels + 0.5) * lattice["voxel_size_m"]
        occupied = _grid(blocks["shape"], ((centres_m - origin_m) // size_m).astype(np.int64))
        held, free = set(), set()
        for thing in self._things:
            of_thing = tuple(thing.blocks(origin_m, size_m).T)
            if occupied[of_thing].all():
                held.add(thing.name)
            if not (occupied | unseen)[of_thing].all():
                free.add(thing.name)
        return Answer(
            got_ns,
            view["now_ns"],
            view["complete"],
            tuple(view["reasons"]),
            view["units_live"],
            view["oldest_view_age_s"],
            frozenset(held),
            frozenset(free),
        )


class Poller(Observer):
    """Polls GET /voxels every POLL_S."""

    def run(self) -> None:
        """See `threading.Thread`."""
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=TIMEOUT_S)
        while not self._stopped.wait(POLL_S):
            try:
                connection.request("GET", "/voxels?unseen=true")
                body = connection.getresponse().read()
                self.answers.append(self._look(json.loads(body), monotonic_ns()))
            except (OSError, http.client.HTTPException):
                connection.close()
                self.answers.append(Answer(monotonic_ns()))
        connection.close()


class Subscriber(Observer):
    """Subscribes to WS /stream. A message counts from its arrival; silence for SILENT_S counts as no answer."""

    def run(self) -> None:
        """See `threading.Thread`."""
        url = f"ws://127.0.0.1:{self._port}/stream?encoding=json&unseen=true"
        while not self._stopped.wait(POLL_S):
            try:
                with connect(url, proxy=None, compression=None, open_timeout=SILENT_S, close_timeout=POLL_S) as stream:
                    while not self._stopped.is_set():
                        self.answers.append(self._look(json.loads(stream.recv(SILENT_S)), monotonic_ns()))
            except (OSError, TimeoutError, WebSocketException):
                self.answers.append(Answer(monotonic_ns()))


def _grid(shape: Sequence[int], indices: NDArray[np.int64]) -> NDArray[np.bool_]:
    grid = np.zeros(tuple(shape), dtype=np.bool_)
    grid[tuple(indices.T)] = True
    return grid


@dataclass(frozen=True)
class Verdict:
    """Judgement of the answers. Times in s, None if there is none."""

    noticed_s: float | None
    recovered_s: float | None
    told: str
    false_free: str
    """The first answer that called an occupied place free, in words; empty if there is none."""
    complete_share: float
    """Share of complete answers between the cause and its end; without anything to notice, of all after the cause."""


def judge(
    answers: Sequence[Answer],
    things: Sequence[Present],
    cause_ns: int,
    noticeable_ns: int,
    gone_ns: int,
    names: str | None,
    blind: bool,
    units: int,
) -> Verdict:
    """Compare the answers with the truth, for a cause from `cause_ns` until `gone_ns`.

    `names` must stand in a reason from `noticeable_ns` on. Empty: the lack of an answer suffices; None: there is
    nothing to notice. With `blind`, no answer may be complete while the cause lasts, once it can be known. `units` is
    the number of units of a complete map.
    """
    grace_ns = round((STALE_AFTER_S + 1.0 / FPS + SLACK_S) * NS_PER_S)
    noticed = next((a for a in answers if a.got_ns >= noticeable_ns and _tells(a, names)), None)
    wrong = ""
    for answer in answers:
        now_ns = answer.now_ns
        if now_ns is None:
            continue
        due = {present.thing.name for present in things if now_ns > present.since_ns + grace_ns}
        at = f"{(now_ns - cause_ns) / NS_PER_S:+.3f} s:"
        if due & answer.free:
            wrong = f"{at} free although it holds the {', '.join(sorted(due & answer.free))}"
        elif answer.complete and not due <= answer.held:
            wrong = f"{at} complete without the {', '.join(sorted(due - answer.held))}"
        elif answer.complete and answer.units_live < units and now_ns > cause_ns + grace_ns:
            wrong = f"{at} complete with {answer.units_live} of {units} units"
        elif answer.complete and blind and cause_ns + grace_ns < now_ns < gone_ns:
            wrong = f"{at} complete although the fault hid the state"
        if wrong:
            break
    # A cause that nobody has to notice may end at once, and its consequences come later.
    end_ns = gone_ns if names is not None else answers[-1].got_ns + 1
    during = [answer.complete for answer in answers if cause_ns <= answer.got_ns < end_ns]
    return Verdict(
        None if noticed is None else (noticed.got_ns - noticeable_ns) / NS_PER_S,
        _recovered_s(answers, {present.thing.name for present in things}, gone_ns, units),
        "" if noticed is None else "; ".join(noticed.reasons) or "no answer",
        wrong,
        sum(during) / max(len(during), 1),
    )


def in_force(messages: Sequence[Answer]) -> list[Answer]:
    """Return each message of a stream at its arrival, and again at the arrival of the next one, until which it was
    valid.
    """
    lasting = []
    for message, following in pairwise(messages):
        lasting.append(message)
        if message.now_ns is not None:
            lasting.append(replace(message, now_ns=following.got_ns))
    return [*lasting, *messages[-1:]]


def good(answer: Answer, names: set[str], units: int) -> bool:
    """Return True if an answer is complete and holds all things."""
    return answer.complete and names <= answer.held and answer.units_live == units


def _tells(answer: Answer, names: str | None) -> bool:
    if answer.now_ns is None:
        return names == ""
    return bool(names) and not answer.complete and any(str(names) in reason for reason in answer.reasons)


def _recovered_s(answers: Sequence[Answer], names: set[str], gone_ns: int, units: int) -> float | None:
    """Return the seconds from `gone_ns` to the first good answer after the last bad one."""
    back_ns: int | None = None
    for answer in answers:
        if answer.got_ns < gone_ns:
            continue
        if not good(answer, names, units):
            back_ns = None
        elif back_ns is None:
            back_ns = answer.got_ns
    return None if back_ns is None else (back_ns - gone_ns) / NS_PER_S
