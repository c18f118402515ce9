# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive their parent, each with a log of its own."""

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
"""From the request to stop until the kill; whoever stops all of them counts on two seconds."""

TAIL_LINES = 20
"""The end of a log that is shown when its process failed."""

TAIL_BYTES = 8192
"""So many are read for it."""

LOOK_S = 0.005
"""Between looks for a file."""

PR_SET_PDEATHSIG = 1
"""See prctl(2)."""

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""By which people and service managers ask for an end."""

_LIBC = ctypes.CDLL(None)


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """From now on the kernel sends this process `number` when its parent is gone, however that came to pass."""
    _LIBC.prctl(PR_SET_PDEATHSIG, int(number), 0, 0, 0)


def raise_when_stopped() -> None:
    """From now on a request to end raises KeyboardInterrupt, even where a shell had it ignored."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    for number in STOP_SIGNALS:
        signal.signal(number, stop)


class ChildNotReady(CellwatchError):
    """A process that was started ended, or was not ready in time."""


@dataclass(eq=False)
class Child:
    """A process that was started here; `may_end` is set when its end is no failure (any more)."""

    name: str
    log: Path
    process: asyncio.subprocess.Process
    may_end: bool = False

    @property
    def pid(self) -> int:
        """Of the process."""
        return self.process.pid

    @property
    def ended(self) -> str | None:
        """How it came to its end, in words; None while it runs."""
        code = self.process.returncode
        if code is None:
            return None
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    @property
    def failed(self) -> bool:
        """Whether it ended though nobody told it to."""
        return self.ended is not None and not self.may_end

    def log_tail(self) -> str:
        """The last lines of its log, introduced."""
        with self.log.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL_BYTES, 0))
            lines = file.read().decode("utf-8", "replace").splitlines()
        return "\n".join(("the end of its log:", *lines[-TAIL_LINES:])) if lines else "its log is empty"


class Processes:
    """Starts processes and, when left, stops all of them.

    They die with this process even when it is killed. Start them from the main thread, for the kernel means the
    thread that started them.
    """

    def __init__(self, folder: Path, without: Sequence[str] = ()) -> None:
        """Logs go to `folder`; variables whose names start with one of `without` are not handed on."""
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
        """Run `python -m module arguments` in a session of its own, so that a Ctrl-C reaches only this process.

        `under` is a command that runs another, as nsenter does; `variables` are added to the environment.
        """
        log = self._folder / f"{name}.log"
        parent = os.getpid()

        def in_child() -> None:
            die_with_parent()
            if os.getppid() != parent:
                # It died before the kernel knew.
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
        """Tell them to stop, all at once, and kill who does not within `STOP_S`."""
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
    """What `child` leaves in a file, as soon as it is there; it must appear whole.

    Raises:
        ChildNotReady: it ended instead, or took longer than `timeout_s`.
    """
    deadline_ns = monotonic_ns() + round(timeout_s * NS_PER_S)
    while not path.exists():
        if child.ended or monotonic_ns() > deadline_ns:
            # It is told now; not once more, as one that failed later.
            child.may_end = True
            raise ChildNotReady(
                f"{child.name}: {child.ended or f'not ready within {timeout_s:g} s'}; {child.log_tail()}"
            )
        await asyncio.sleep(LOOK_S)
    return path.read_bytes()
