# SPDX-License-Identifier: Apache-2.0
"""The file with the truth of each frame of one simulated camera: written beside the unit, read by the evaluation.

The file is a sequence of msgpack maps, one a frame: `captured_at_ns`, `frame_number`, `voxel_size_m`, `visible_keys`,
`visible_counts` and `surface_keys`. Keys and counts are little-endian uint32 as bytes (`simulation.cameras.truth`
defines them).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import msgpack
import numpy as np
from numpy.typing import NDArray

from shared.errors import CellwatchError, InputError, SourceError

if TYPE_CHECKING:
    from simulation.cameras.camera import SimulatedCamera, SimulatedFrame
    from simulation.cameras.truth import TruthFinder

KEYS = np.dtype("<u4")
"""Lattice keys and counts in a file."""


class TruthWriter:
    """Appends the truth of each frame to a file; a `FrameObserver` of the simulated source."""

    def __init__(self, path: Path, voxel_size_m: float) -> None:
        self._path = path
        self._voxel_size_m = voxel_size_m
        self._finder: TruthFinder | None = None
        self._file: BinaryIO | None = None

    def place(self, camera: SimulatedCamera) -> None:
        """See `FrameObserver`. The first search compiles its kernels before any frame is due.

        Raises:
            SourceError: the file cannot be opened, or the cell has no lattice with such voxels.
        """
        # Imported only here: a unit settles the folder of its kernels before it imports the first of them.
        from simulation.cameras.truth import TruthFinder

        if self._file is None:
            try:
                self._file = self._path.open("ab")
            except OSError as error:
                raise SourceError(
                    f"truth file {self._path}: expected a file that can be written, got {error.strerror}; "
                    "name a file in a folder that exists"
                ) from error
        try:
            lattice = camera.world.cell.lattice(self._voxel_size_m)
        except CellwatchError as error:
            raise SourceError(f"truth file {self._path}: {error}") from error
        self._finder = TruthFinder(camera.intrinsics, camera.T_world_camera, lattice, camera.noise)
        self._finder.find(camera.look(0.0))

    def observe(self, captured_at_ns: int, frame_number: int, frame: SimulatedFrame) -> None:
        """See `FrameObserver`. Append one record."""
        assert self._finder is not None
        assert self._file is not None
        truth = self._finder.find(frame.view)
        record = {
            "captured_at_ns": captured_at_ns,
            "frame_number": frame_number,
            "voxel_size_m": self._voxel_size_m,
            "visible_keys": truth.visible_keys.astype(KEYS).tobytes(),
            "visible_counts": truth.visible_counts.astype(KEYS).tobytes(),
            "surface_keys": truth.surface_keys.astype(KEYS).tobytes(),
        }
        self._file.write(msgpack.packb(record))
        self._file.flush()

    def close(self) -> None:
        """See `FrameObserver`. Records that follow are appended to the same file."""
        if self._file is not None:
            self._file.close()
        self._finder, self._file = None, None


@dataclass(frozen=True)
class TrueFrame:
    """One record of a truth file; keys (N,) uint32 of the lattice with voxels of `voxel_size_m`."""

    captured_at_ns: int
    voxel_size_m: float
    visible_keys: NDArray[np.uint32]
    surface_keys: NDArray[np.uint32]


def read_truth(path: Path) -> Iterator[TrueFrame]:
    """Yield the records of a truth file in the order in which they were written.

    Raises:
        InputError: the file cannot be read, or is no truth file.
    """
    try:
        with path.open("rb") as file:
            for record in msgpack.Unpacker(file):
                yield TrueFrame(
                    record["captured_at_ns"],
                    record["voxel_size_m"],
                    np.frombuffer(record["visible_keys"], KEYS),
                    np.frombuffer(record["surface_keys"], KEYS),
                )
    except (OSError, ValueError, KeyError, TypeError, msgpack.UnpackException) as error:
        raise InputError(f"{path}: expected a truth file, got: {error}") from error
