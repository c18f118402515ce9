# SPDX-License-Identifier: Apache-2.0
"""Read a new cell outside of the event loop, one at a time, so that no unit waits for it."""

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
"""Limit of an upload. CAD of a whole cell at the precision that a depth camera resolves takes a tenth of it."""

LOAD_TIMEOUT_S = 60.0
"""Ten times the duration of the largest cell. A longer one means that something is wrong with the files."""

PLACE = Path(unpacking.__file__).resolve().parents[unpacking.__name__.count(".")]
"""Folder of our packages: the unpacking process runs in another folder, where nothing is installed."""


class CellLoader:
    """Reads cells that an operator sends."""

    def __init__(self) -> None:
        self._is_busy = False

    @contextlib.asynccontextmanager
    async def folder(self) -> AsyncIterator[Path]:
        """Make a folder for one cell and remove it afterwards.

        Raises:
            Refusal: 409, another cell is being read.
        """
        if self._is_busy:
            raise Refusal(409, "cell: another cell is being read; try again when it is done")
        self._is_busy = True
        try:
            made = await asyncio.to_thread(tempfile.TemporaryDirectory, prefix="cellwatch-cell-")
            try:
                yield Path(made.name)
            finally:
                await asyncio.to_thread(made.cleanup)
        finally:
            self._is_busy = False

    async def load_zip(self, archive: Path, folder: Path) -> PublishedCell:
        """Read the cell from the zip of its folder; `folder` comes from `folder()`.

        Raises:
            Refusal: 422, reading takes longer than LOAD_TIMEOUT_S.
            CellError: the zip holds no valid cell; one sentence.
        """
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            unpacking.__name__,
            str(archive),
            str(folder),
            stdout=asyncio.subprocess.PIPE,
            # An empty working directory: no module in it can shadow an installed one.
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
            raise Refusal(422, reason or f"cell: the reader ended with code {process.returncode}; see the master's log")
        return await asyncio.to_thread(_read, folder)

    async def load_document(self, document: Any, current: PublishedCell) -> PublishedCell:
        """Read the cell of a document whose meshes are in the `current` cell.

        Raises:
            CellError: the document is no valid cell; one sentence.
        """

        def read() -> PublishedCell:
            return PublishedCell.of(Cell.from_document(document, {}, current.cell))

        return await asyncio.to_thread(read)


def _read(folder: Path) -> PublishedCell:
    """Read the result of the other process."""
    document = json.loads((folder / unpacking.DOCUMENT).read_text(encoding="utf-8"))
    meshes = {file.name: file.read_bytes() for file in (folder / unpacking.MESHES).iterdir()}
    return PublishedCell.of(Cell.from_document(document, meshes))
