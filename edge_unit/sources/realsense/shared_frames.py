# SPDX-License-Identifier: Apache-2.0
"""Frames passed between two processes without a copy: a few slots in shared memory.

The memory has no name: it is an anonymous file that vanishes when the last process that has it open ends, in whatever
way. One writer, one reader. The writer never touches the reader's slot nor the newest one, and never waits. The reader
takes the newest, so a slow one skips frames and never lags.
"""

from __future__ import annotations

import mmap
import os
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SLOTS = 4
"""One held by the reader, one newest, one being written, and a spare one, so that the two seldom meet."""

PAGE_BYTES = mmap.PAGESIZE

NO_SLOT = -1

LATEST, HELD, FIRST_SLOT = 0, 1, 8
"""Words of the header; each slot has `WORDS` words from `FIRST_SLOT` on."""

SEQUENCE, NUMBER, CAMERA_NUMBER, CAPTURED_AT, POSITION = 0, 1, 2, 3, 4
WORDS = 8


@dataclass(frozen=True)
class SharedFrame:
    """A frame in shared memory, valid until the reader takes another one.

    `pixels` are (H, W) uint16, (H, W) uint8 or (H, W, 3) uint8. `number` rises over all frames ever delivered;
    `camera_number` is the camera's own count, `position_ns` the position in a recording.
    """

    pixels: NDArray[Any]
    number: int
    camera_number: int
    captured_at_ns: int
    position_ns: int
    slot: int
    sequence: int


class SharedFrames:
    """The shared memory, for either side."""

    def __init__(self, descriptor: int, shape: tuple[int, ...], dtype: type[np.uint16] | type[np.uint8]) -> None:
        """Map the memory behind `descriptor`; the caller closes the descriptor."""
        image_bytes = _pages(int(np.prod(shape)) * np.dtype(dtype).itemsize)
        memory = mmap.mmap(descriptor, PAGE_BYTES + SLOTS * image_bytes)
        self._head = np.frombuffer(memory, np.int64, FIRST_SLOT + SLOTS * WORDS)
        self._images = [
            np.frombuffer(memory, dtype, int(np.prod(shape)), PAGE_BYTES + slot * image_bytes).reshape(shape)
            for slot in range(SLOTS)
        ]
        self._fence = threading.Lock()

    @staticmethod
    def create(shape: tuple[int, ...], dtype: type[np.uint16] | type[np.uint8]) -> int:
        """Allocate memory for images of this kind; returns its descriptor."""
        descriptor = os.memfd_create("cellwatch-frames", os.MFD_CLOEXEC)
        size = PAGE_BYTES + SLOTS * _pages(int(np.prod(shape)) * np.dtype(dtype).itemsize)
        os.ftruncate(descriptor, size)
        os.pwrite(descriptor, np.array([NO_SLOT, NO_SLOT], np.int64).tobytes(), 0)
        return descriptor

    # ------------------------------------------------------------------ the writer

    def write(
        self, pixels: NDArray[Any], number: int, camera_number: int, captured_at_ns: int, position_ns: int = 0
    ) -> None:
        """Store this as the newest frame: the only copy on its way."""
        slot, head = self._free_slot(), self._head
        words = _words(slot)
        np.copyto(self._images[slot], pixels)
        head[words + NUMBER] = number
        head[words + CAMERA_NUMBER] = camera_number
        head[words + CAPTURED_AT] = captured_at_ns
        head[words + POSITION] = position_ns
        self._order()
        head[words + SEQUENCE] += 1
        head[LATEST] = slot

    def _free_slot(self) -> int:
        """Return a slot that is neither newest nor held, marked as being written (its sequence is odd)."""
        head = self._head
        latest = int(head[LATEST])
        for step in range(1, 2 * SLOTS):
            slot = (latest + step) % SLOTS
            if slot in (latest, int(head[HELD])):
                continue
            sequence = _words(slot) + SEQUENCE
            head[sequence] |= 1
            self._order()
            if int(head[HELD]) != slot:
                return slot
            # The reader was about to hold this slot: it sees the odd sequence, or the writer sees its hold, or both.
            head[sequence] += 1
        raise AssertionError("a reader holds one slot, so there is always a free one")

    # ------------------------------------------------------------------ the reader

    @property
    def newest_number(self) -> int:
        """The number of the newest frame; 0 if there is none yet."""
        slot = int(self._head[LATEST])
        return 0 if slot == NO_SLOT else int(self._head[_words(slot) + NUMBER])

    def take(self, after: int) -> SharedFrame | None:
        """Hold the newest frame, if its number is greater than `after`; this releases the one held before."""
        head = self._head
        while True:
            slot = int(head[LATEST])
            if slot == NO_SLOT:
                return None
            words = _words(slot)
            sequence = int(head[words + SEQUENCE])
            if sequence & 1:
                continue
            if int(head[words + NUMBER]) <= after:
                return None
            head[HELD] = slot
            self._order()
            if int(head[words + SEQUENCE]) != sequence:
                continue
            return SharedFrame(
                self._images[slot],
                int(head[words + NUMBER]),
                int(head[words + CAMERA_NUMBER]),
                int(head[words + CAPTURED_AT]),
                int(head[words + POSITION]),
                slot,
                sequence,
            )

    def intact(self, frame: SharedFrame) -> bool:
        """Return True if a frame was not overwritten since it was taken."""
        return int(self._head[_words(frame.slot) + SEQUENCE]) == frame.sequence

    def _order(self) -> None:
        """Memory barrier: the other process sees all earlier stores before any later load here."""
        with self._fence:
            pass


def _words(slot: int) -> int:
    return FIRST_SLOT + slot * WORDS


def _pages(size: int) -> int:
    return -(-size // PAGE_BYTES) * PAGE_BYTES
