# SPDX-License-Identifier: Apache-2.0
"""Memory, threads and handles of processes over their lifetimes, and the limits of their growth."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import psutil

from shared.clock import NS_PER_S, monotonic_ns

SAMPLE_S = 1.0

CALM_LOOKS = 3
"""Samples at each calm moment; a client that polls meanwhile has a connection open now and then."""

MIB = 2**20

GROWTH_SHARE_MAX, GROWTH_MIB_MAX = 1.05, 2.0
"""Limits of a lifetime's last quarter against its second: a factor plus an offset. The first fills caches and pools."""

LIFETIME_MIN_S = 60.0
"""Shortest lifetime that is judged; a younger process still fills its caches and pools."""

SPARE = 4
"""Threads and handles that come and go: pools that were never full at once, connections that a unit keeps."""


@dataclass(frozen=True)
class Sample:
    """One sample of a process; `calm` if no fault was active anywhere."""

    at_s: float
    rss_mib: float
    threads: int
    handles: int
    calm: bool = False


@dataclass
class Lifetime:
    """One process from its first sample on."""

    name: str
    pid: int
    samples: list[Sample] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time from the first sample to the last, s."""
        return self.samples[-1].at_s - self.samples[0].at_s

    def quarters_mib(self) -> tuple[float, ...]:
        """Return the median memory in each quarter of the lifetime, MiB; NaN for a quarter without samples."""
        at_s = np.array([sample.at_s for sample in self.samples])
        rss_mib = np.array([sample.rss_mib for sample in self.samples])
        quarter = np.minimum(4.0 * (at_s - at_s[0]) / max(self.seconds, 1e-9), 3.0).astype(int)
        return tuple(float(np.median(rss_mib[quarter == n])) if (quarter == n).any() else np.nan for n in range(4))

    @property
    def memory_grew(self) -> bool:
        """True if the process takes more memory than the limits allow with full caches."""
        _, second, _, last = self.quarters_mib()
        return last > GROWTH_SHARE_MAX * second + GROWTH_MIB_MAX

    def grown(self, count: Callable[[Sample], int]) -> int:
        """Return by how much `count` at the last calm moment exceeds the maximum of the first half of these moments."""
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
    """Samples processes and all their descendants."""

    def __init__(self, processes: Callable[[], Iterable[tuple[str, int]]]) -> None:
        """`processes` returns the names and ids of all processes that run now."""
        self._processes = processes
        self._began_ns = monotonic_ns()
        self._found: dict[tuple[int, float], Lifetime] = {}

    async def run(self) -> None:
        """Take a sample every `SAMPLE_S` until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(SAMPLE_S)

    def look(self, calm: bool = False) -> None:
        """Take one sample of each process."""
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
        """Lifetimes of all processes with a sample."""
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
