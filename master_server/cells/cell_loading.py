# SPDX-License-Identifier: Apache-2.0
"""A new cell is read outside of the event loop, so that no unit waits for it; one at a time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from master_server.cells import unpacking
from master_server.cells.published import PublishedCell
from shared.cell import Cell
from shared.errors import Refusal
from shared.waiting import within

logger = logging.getLogger(__name__)

MAX_ZIP_BYTES = 128 * 2**20
"""CAD of a whole cell at a precision that a depth camera can tell has a tenth of it."""

LOAD_TIMEOUT_S = 60.0
"""Ten times what the largest cell takes; then something is wrong with its files."""

PLACE = Path(unpacking.__file__).resolve().parents[unpacking.__name__.count(".")]
"""The folder of our packages: the process that unpacks a cell stands elsewhere, where nothing is installed."""


class CellLoader:
    """Reads cells that an operator sends."""

    def __init__(self) -> None:
        self._is_busy = False

    @contextlib.asynccontextmanager
    async def folder(self) -> AsyncIterator[Path]:
        """A folder of its own for one cell, removed afterwards.

        Raises:
            Refusal: 409, another cell is being read.
        """
        if self._is_busy:
            raise Refusal(409, "cell: another one is being read at this moment")
        self._is_busy = True
        try:
            made = await asyncio.to_thread(tempfile.TemporaryDirectory, prefix="cellwatch-cell-")
            try:
                yield Path(made.name)
            finally:
                await asyncio.to_thread(made.cleanup)
        finally:
            self._is_busy = False

    async def of_zip(self, archive: Path, folder: Path) -> PublishedCell:
        """The cell in a zip of its folder; `folder` is one of `folder()`.

        Raises:
            Refusal: 422, it takes too long.
            CellError: it is no cell; one sentence.
        """
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            unpacking.__name__,
            str(archive),
            str(folder),
            stdout=asyncio.subprocess.PIPE,
            # Where nothing lies that could be imported in place of what is meant.
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(PLACE), "OPENBLAS_NUM_THREADS": "1"},
        )
        said = bytearray()

        async def finished() -> None:
            assert process.stdout is not None
            said.extend(await process.stdout.read(4 * unpacking.REASON_CHARS))
            await process.wait()

        try:
            if not await within(LOAD_TIMEOUT_S, finished()):
                raise Refusal(422, f"cell: expected files that can be read within {LOAD_TIMEOUT_S:g} s")
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode != 0:
            reason = said.decode("utf-8", "replace").strip()
            raise Refusal(422, reason or f"cell: reading it ended with code {process.returncode}, see the master's log")
        return await asyncio.to_thread(_read, folder)

    async def of_document(self, document: Any, current: PublishedCell) -> PublishedCell:
        """The cell of a document whose meshes the `current` one has.

        Raises:
            CellError: it is no cell; one sentence.
        """

        def read() -> PublishedCell:
            return PublishedCell.of(Cell.from_document(document, {}, current.cell))

        return await asyncio.to_thread(read)


def _read(folder: Path) -> PublishedCell:
    """What the other process left."""
    document = json.loads((folder / unpacking.DOCUMENT).read_text(encoding="utf-8"))
    meshes = {file.name: file.read_bytes() for file in (folder / unpacking.MESHES).iterdir()}
    return PublishedCell.of(Cell.from_document(document, meshes))
