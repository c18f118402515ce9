# SPDX-License-Identifier: Apache-2.0
"""Memory, threads and handles of processes over their lifetimes, and what counts as growth."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import psutil

from shared.clock import NS_PER_S, monotonic_ns

SAMPLE_S = 1.0

CALM_LOOKS = 3
"""At each calm moment; who asks meanwhile has a connection open now and then."""

MIB = 2**20

GROWTH_SHARE_MAX, GROWTH_MIB_MAX = 1.05, 2.0
"""A lifetime's last quarter may take so much more memory than its second: the first fills caches and pools."""

LIFETIME_MIN_S = 60.0
"""Of a process that is judged; below, it is still filling them."""

SPARE = 4
"""Threads and handles that come and go: of pools that were never full at once, and connections that a unit keeps."""


@dataclass(frozen=True)
class Sample:
    """One look at a process; `calm` when nothing was being done to it nor to anyone."""

    at_s: float
    rss_mib: float
    threads: int
    handles: int
    calm: bool = False


@dataclass
class Lifetime:
    """One process from when it was seen first."""

    name: str
    pid: int
    samples: list[Sample] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """How long it was seen."""
        return self.samples[-1].at_s - self.samples[0].at_s

    def quarters_mib(self) -> tuple[float, ...]:
        """Median memory in each quarter of its lifetime."""
        at_s = np.array([sample.at_s for sample in self.samples])
        rss_mib = np.array([sample.rss_mib for sample in self.samples])
        quarter = np.minimum(4.0 * (at_s - at_s[0]) / max(self.seconds, 1e-9), 3.0).astype(int)
        return tuple(float(np.median(rss_mib[quarter == n])) if (quarter == n).any() else np.nan for n in range(4))

    @property
    def memory_grew(self) -> bool:
        """Whether it takes more than a process may whose caches are full."""
        _, second, _, last = self.quarters_mib()
        return last > GROWTH_SHARE_MAX * second + GROWTH_MIB_MAX

    def grown(self, count: Callable[[Sample], int]) -> int:
        """How many more threads or handles it has at the last calm moment than at any of the first half of these."""
        counts = [count(sample) for sample in self.samples if sample.calm]
        last, before = counts[-CALM_LOOKS:], counts[:-CALM_LOOKS]
        if not before:
            return 0
        return max(min(last) - max(before[: max(len(before) // 2, CALM_LOOKS)]), 0)

    @property
    def threads_grown(self) -> int:
        """See `grown`."""
        return self.grown(lambda sample: sample.threads)

    @property
    def handles_grown(self) -> int:
        """See `grown`."""
        return self.grown(lambda sample: sample.handles)


class Usage:
    """Looks at processes and all that they started."""

    def __init__(self, processes: Callable[[], Iterable[tuple[str, int]]]) -> None:
        """`processes` tells names and ids of those that run now."""
        self._processes = processes
        self._began_ns = monotonic_ns()
        self._found: dict[tuple[int, float], Lifetime] = {}

    async def run(self) -> None:
        """Look every SAMPLE_S until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(SAMPLE_S)

    def look(self, calm: bool = False) -> None:
        """Look at all of them once."""
        for name, pid in self._processes():
            try:
                root = psutil.Process(pid)
                self._add(name, root, calm)
                for number, child in enumerate(root.children(recursive=True), 1):
                    self._add(f"{name}, child {number}", child, calm)
            except psutil.NoSuchProcess:
                continue

    @property
    def lifetimes(self) -> Sequence[Lifetime]:
        """All processes that were seen."""
        return list(self._found.values())

    def _add(self, name: str, process: psutil.Process, calm: bool) -> None:
        with process.oneshot():
            key = process.pid, process.create_time()
            sample = Sample(
                (monotonic_ns() - self._began_ns) / NS_PER_S,
                process.memory_info().rss / MIB,
                process.num_threads(),
                process.num_fds(),
                calm,
            )
        self._found.setdefault(key, Lifetime(name, process.pid)).samples.append(sample)
