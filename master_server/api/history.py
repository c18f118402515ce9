# SPDX-License-Identifier: Apache-2.0
"""A few figures of a master over the last minutes, available at once to a new viewer."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from itertools import takewhile
from typing import NamedTuple

from pydantic import BaseModel, Field

from master_server.core import Readable
from shared.clock import monotonic_ns
from shared.errors import Refusal

logger = logging.getLogger(__name__)

PERIOD_S = 1.0

SAMPLES_MAX = 300
"""Five minutes: long enough to see the effect of a touched camera, about 30 kB."""


class Sample(NamedTuple):
    """The figures at `at_ns` of the master's clock."""

    at_ns: int
    oldest_view_age_s: float | None
    voxels: int
    units_live: int
    complete: bool


class HistoryAnswer(BaseModel):
    """`GET /history`: one value per sample in each list, the oldest first."""

    now_ns: int = Field(description="Present time of the clock of `at_ns`.")
    period_s: float = Field(description="Time between two samples.")
    at_ns: list[int]
    oldest_view_age_s: list[float | None] = Field(
        description="The scene refresh time: age of the oldest view in the map since its capture; null if none is live."
    )
    voxels: list[int]
    units_live: list[int]
    complete: list[bool]


class History:
    """Samples of a master, or of a recording that plays; the newest `SAMPLES_MAX`."""

    def __init__(self, master: Readable) -> None:
        self._master = master
        self._samples: deque[Sample] = deque(maxlen=SAMPLES_MAX)

    async def follow(self) -> None:
        """Take samples until cancelled."""
        while True:
            try:
                self.take(monotonic_ns())
            except Refusal as refusal:
                # A recording may be damaged in its middle; requests for the map report that.
                logger.debug("history: %s", refusal)
            await asyncio.sleep(PERIOD_S)

    def take(self, now_ns: int) -> None:
        """Take one sample.

        Raises:
            Refusal: 500, a recording is damaged here.
        """
        view = self._master.view(now_ns)
        age_s = None if view.oldest_view_age_s is None else round(view.oldest_view_age_s, 4)
        self._samples.append(Sample(now_ns, age_s, len(view.keys), view.units_live, view.complete))

    def since(self, at_ns: int) -> list[Sample]:
        """Return all samples after `at_ns`, the oldest first."""
        return list(takewhile(lambda sample: sample.at_ns > at_ns, reversed(self._samples)))[::-1]

    def answer(self, now_ns: int) -> HistoryAnswer:
        """Return all samples."""
        samples = self.since(-1)
        columns = {name: [getattr(sample, name) for sample in samples] for name in Sample._fields}
        return HistoryAnswer(now_ns=now_ns, period_s=PERIOD_S, **columns)
