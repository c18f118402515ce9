# SPDX-License-Identifier: Apache-2.0
"""Basis of all tests: recorded data, and guards against running leftovers."""

from __future__ import annotations

import multiprocessing.resource_tracker as resource_tracker
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from blockbuster import BlockBuster
from hypothesis import settings

from qualification.machines.containers import why_not
from tests.missing import missing

CHECKOUT = Path(__file__).resolve().parent.parent
SLOW_TIMEOUT_S = 600
# A stopping process may need a moment; a forgotten one outlives any moment.
GRACE_S = 3.0
# Real processes, whose times suffer from other load, but for tests that are marked `patient`.
ALONE = CHECKOUT / "tests" / "system"
# A blocking call delays every other unit's updates, so async code of the daemons may not make one.
EVENT_LOOP_TESTS = tuple(CHECKOUT / "tests" / package for package in ("edge_unit", "master_server"))
EVENT_LOOP_CODE = ("shared", "edge_unit", "master_server")
# Except for the rare change that must be on the disk before anything else happens; its docstring gives the reason.
STORE_BLOCKS = {"in_memory", "load", "_transaction", "_put", "_put_cell", "_drop_meshes", "save_units"}

# A busy machine is no fault of an example. With CI set, hypothesis draws the same examples each time by itself.
settings.register_profile("patient", settings(), deadline=None)
settings.load_profile("patient")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if ALONE in item.path.parents and not item.get_closest_marker("patient"):
            item.add_marker(pytest.mark.alone)
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))


@pytest.fixture(scope="session")
def data_dir() -> Iterator[Path]:
    """Yield the folder of the recorded data sets. `$CELLWATCH_DATA` names it during the session.

    Without the data a test is skipped; with CI set it fails.
    """
    folder = Path(os.environ.get("CELLWATCH_DATA") or CHECKOUT.parent / "shared" / "data").resolve()
    if not folder.is_dir():
        missing(f"no recorded data: {folder} is not a folder (CELLWATCH_DATA names another)")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CELLWATCH_DATA", str(folder))
        yield folder


@pytest.fixture(scope="session")
def roots() -> Path:
    """Return the root file systems of a unit and a master. `.ci/run` makes them before the tests, because tests fetch
    nothing.
    """
    if (reason := why_not()) is not None:
        pytest.skip(f"no machines can be run here: {reason}")
    folder = Path(os.environ.get("CELLWATCH_ROOTS", CHECKOUT / "out" / "rehearsal"))
    if not (folder / "master" / "opt").exists():
        pytest.skip("there are no root file systems: `deploy/image/rehearsal-roots out/rehearsal` makes them")
    return folder


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if not thread.daemon}


def _children() -> set[psutil.Process]:
    """Return all child processes, except the one that Python keeps for shared memory."""
    tracker = getattr(resource_tracker._resource_tracker, "_pid", None)
    return {child for child in psutil.Process().children(recursive=True) if child.pid != tracker}


def _name(process: psutil.Process) -> str:
    try:
        return f"process {process.pid} ({' '.join(process.cmdline()) or process.name()})"
    except psutil.Error:
        return f"process {process.pid}"


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Fail a test that leaves a non-daemon thread or a child process behind (and end the process)."""
    threads, children = _threads(), _children()
    yield
    new_threads = _threads() - threads
    for thread in new_threads:
        thread.join(GRACE_S)
    _, alive = psutil.wait_procs(_children() - children, timeout=GRACE_S)
    left = [f"thread {thread.name}" for thread in new_threads if thread.is_alive()]
    left += [_name(process) for process in alive]
    for process in alive:
        process.kill()
    psutil.wait_procs(alive, timeout=GRACE_S)
    if left:
        pytest.fail(f"left running: {', '.join(left)}", pytrace=False)


@pytest.fixture(autouse=True)
def no_blocking_call(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail an async test of a daemon when the daemon's code blocks its event loop."""
    is_async = request.node.get_closest_marker("asyncio") is not None
    if not (is_async and any(folder in request.path.parents for folder in EVENT_LOOP_TESTS)):
        yield
        return
    guard = BlockBuster(scanned_modules=[name for name in EVENT_LOOP_CODE if (CHECKOUT / name).is_dir()])
    for name, function in guard.functions.items():
        if name.startswith(("sqlite3.", "threading.Lock")):
            function.can_block_in("master_server/persistence/store.py", STORE_BLOCKS)
    guard.activate()
    yield
    guard.deactivate()
