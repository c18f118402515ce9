# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive their parent. Each has its own log."""

from __future__ import annotations

import asyncio
import ctypes
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType

from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError

STOP_S = 1.2
"""Time from SIGTERM to SIGKILL. Callers that stop all children count on two seconds."""

TAIL_LINES = 20
"""Number of lines of a log that an error message shows."""

TAIL_BYTES = 8192
"""Number of bytes at the end of a log that are read for it."""

POLL_S = 0.005
"""Time between two checks for a file."""

PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal that a process receives when its parent dies."""

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals by which people and service managers stop a process."""

_LIBC = ctypes.CDLL(None)


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """Let the kernel send signal `number` to this process when its parent dies for any reason."""
    _LIBC.prctl(PR_SET_PDEATHSIG, int(number), 0, 0, 0)


def raise_when_stopped() -> None:
    """Raise KeyboardInterrupt on each of `STOP_SIGNALS`, even if a shell had the signal ignored."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    for number in STOP_SIGNALS:
        signal.signal(number, stop)


class ChildNotReady(CellwatchError):
    """A child process ended early, or was not ready in time."""


@dataclass(eq=False)
class Child:
    """A child process. `may_end` is true while the end of the process is no failure."""

    name: str
    log: Path
    process: asyncio.subprocess.Process
    may_end: bool = False

    @property
    def pid(self) -> int:
        """Process id."""
        return self.process.pid

    @property
    def ended(self) -> str | None:
        """Cause of the end as text; None while the process runs."""
        code = self.process.returncode
        if code is None:
            return None
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    @property
    def failed(self) -> bool:
        """True if the process ended and was not stopped from here."""
        return self.ended is not None and not self.may_end

    def log_tail(self) -> str:
        """Return the last lines of the log below a heading."""
        with self.log.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL_BYTES, 0))
            lines = file.read().decode("utf-8", "replace").splitlines()
        return "\n".join(("the end of its log:", *lines[-TAIL_LINES:])) if lines else "its log is empty"


class Processes:
    """Starts processes, and stops all of them at the end of its context.

    They die with this process even if it is killed. Start them from the main thread: the kernel sends the signal when
    the thread that started them ends.
    """

    def __init__(self, folder: Path, without: Sequence[str] = ()) -> None:
        """Write logs to `folder`. Do not pass on environment variables whose names start with one of `without`."""
        self._folder = folder
        self._environment = {name: value for name, value in os.environ.items() if not name.startswith(tuple(without))}
        self._children: list[Child] = []

    def __iter__(self) -> Iterator[Child]:
        return iter(self._children)

    async def __aenter__(self) -> Processes:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop(*self._children)

    async def start(
        self,
        name: str,
        module: str,
        *arguments: str,
        may_end: bool = False,
        under: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> Child:
        """Run `python -m module arguments` in its own session, so that a Ctrl-C reaches only this process.

        `under` is a command that runs another, as nsenter does. `variables` are added to the environment.
        """
        log = self._folder / f"{name}.log"
        parent = os.getpid()

        def in_child() -> None:
            die_with_parent()
            if os.getppid() != parent:
                # The parent died before prctl took effect.
                os.kill(os.getpid(), signal.SIGKILL)

        with log.open("wb") as output:
            process = await asyncio.create_subprocess_exec(
                *under,
                sys.executable,
                "-m",
                module,
                *arguments,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**self._environment, **(variables or {})},
                start_new_session=True,
                preexec_fn=in_child,
            )
        child = Child(name, log, process, may_end)
        self._children.append(child)
        return child

    async def stop(self, *children: Child) -> None:
        """Stop the children, all at once. Kill those that still run after `STOP_S`."""
        running = [child for child in children if child.process.returncode is None]
        for child in running:
            child.may_end = True
            child.process.terminate()
        if not running:
            return
        waits = [asyncio.ensure_future(child.process.wait()) for child in running]
        await asyncio.wait(waits, timeout=STOP_S)
        for child in running:
            if child.process.returncode is None:
                child.process.kill()
        await asyncio.wait(waits)


async def until_written(child: Child, path: Path, timeout_s: float) -> bytes:
    """Return the content of a file that `child` writes, as soon as it exists. The file must appear whole.

    Raises:
        ChildNotReady: the child ended, or took longer than `timeout_s`.
    """
    deadline_ns = monotonic_ns() + round(timeout_s * NS_PER_S)
    while not path.exists():
        if child.ended or monotonic_ns() > deadline_ns:
            # The exception reports this end; it must not count as a failure once more.
            child.may_end = True
            raise ChildNotReady(
                f"{child.name}: {child.ended or f'not ready within {timeout_s:g} s'}; {child.log_tail()}"
            )
        await asyncio.sleep(POLL_S)
    return path.read_bytes()
