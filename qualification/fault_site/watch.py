# SPDX-License-Identifier: Apache-2.0
"""Whoever drives a robot by the map: asks for it all the time, and what it was told is held against the truth."""

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
"""The default."""

SLACK_S = 0.1
"""For processes that share two cores with all others: when a signal takes effect, and when we are run."""

NOTICED_S_MAX = STALE_AFTER_S + 1.0 / FPS + POLL_S + SLACK_S

RECOVERED_S_MAX = 1.0

SETTLED_S = 0.5
"""Once good, answers must stay so for this long to count as recovered."""

SILENT_S = 1.0
"""The stream has a heartbeat twice as often."""

TIMEOUT_S = 0.25
"""Who waits longer for an answer has none."""


@dataclass(frozen=True)
class Answer:
    """One answer to GET /voxels?unseen=true, or that there was none (`now_ns` is None then)."""

    got_ns: int
    now_ns: int | None = None
    complete: bool = False
    reasons: tuple[str, ...] = ()
    units_live: int = 0
    age_s: float | None = None
    held: frozenset[str] = frozenset()
    """Things whose blocks are all reported as occupied."""
    free: frozenset[str] = frozenset()
    """Things of whose blocks one at least is neither occupied nor unseen."""


@dataclass(frozen=True)
class Present:
    """A thing, and since when it is there."""

    thing: Thing
    since_ns: int


class Observer(threading.Thread):
    """Notes what the map says, until told to stop."""

    def __init__(self, port: int, things: Sequence[Thing]) -> None:
        super().__init__(name="observer", daemon=True)
        self._port = port
        self._things = things
        self._stopped = threading.Event()
        self.answers: list[Answer] = []

    def stop(self) -> None:
        """Stop asking."""
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


class Asker(Observer):
    """Asks GET /voxels every POLL_S."""

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


class Listener(Observer):
    """Follows WS /stream; a message counts from its arrival, and silence for SILENT_S as no answer."""

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
    """What the answers were worth. Times in s, None where there is none."""

    noticed_s: float | None
    recovered_s: float | None
    told: str
    false_free: str
    """The first answer that called free what was not, in words; empty when there is none."""
    complete_share: float
    """Of the answers between the cause and its end; where there is nothing to notice, of all behind the cause."""


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
    """Hold the answers against what was there, with a cause from `cause_ns` until `gone_ns`.

    `names` is what a reason must name from `noticeable_ns` on; empty: that nobody answers tells; None: there is nothing
    to tell. When `blind`, no answer may be complete while the cause lasts, once it can be known. `units` is how many a
    complete map needs.
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
            wrong = f"{at} free although there is the {', '.join(sorted(due & answer.free))}"
        elif answer.complete and not due <= answer.held:
            wrong = f"{at} complete without the {', '.join(sorted(due - answer.held))}"
        elif answer.complete and answer.units_live < units and now_ns > cause_ns + grace_ns:
            wrong = f"{at} complete with {answer.units_live} of {units} units"
        elif answer.complete and blind and cause_ns + grace_ns < now_ns < gone_ns:
            wrong = f"{at} complete while nobody could know"
        if wrong:
            break
    # What nobody has to notice may be over at once, and its consequences come later.
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
    """Of a stream: each message when it came, and once more when the next one did, until when it was what counted."""
    lasting = []
    for message, following in pairwise(messages):
        lasting.append(message)
        if message.now_ns is not None:
            lasting.append(replace(message, now_ns=following.got_ns))
    return [*lasting, *messages[-1:]]


def good(answer: Answer, names: set[str], units: int) -> bool:
    """Whether an answer is complete and tells of all that is there."""
    return answer.complete and names <= answer.held and answer.units_live == units


def _tells(answer: Answer, names: str | None) -> bool:
    if answer.now_ns is None:
        return names == ""
    return bool(names) and not answer.complete and any(str(names) in reason for reason in answer.reasons)


def _recovered_s(answers: Sequence[Answer], names: set[str], gone_ns: int, units: int) -> float | None:
    """From `gone_ns` to the first good answer after the last bad one."""
    back_ns: int | None = None
    for answer in answers:
        if answer.got_ns < gone_ns:
            continue
        if not good(answer, names, units):
            back_ns = None
        elif back_ns is None:
            back_ns = answer.got_ns
    return None if back_ns is None else (back_ns - gone_ns) / NS_PER_S
