# SPDX-License-Identifier: Apache-2.0
"""Frames in shared memory: nothing torn, nothing twice, nothing held is overwritten."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge_unit.sources.realsense.shared_frames import SLOTS, SharedFrames

SHAPE = (6, 8)


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = SharedFrames.create(SHAPE, np.uint16)
    yield descriptor
    os.close(descriptor)


def picture(number: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
    return np.full(SHAPE, number, np.uint16)


def test_the_newest_is_taken_once(memory: int) -> None:
    writer, reader = SharedFrames(memory, SHAPE, np.uint16), SharedFrames(memory, SHAPE, np.uint16)
    assert reader.take(0) is None
    assert reader.newest_number == 0
    for number in (1, 2, 5):
        writer.write(picture(number), number, number + 100, number + 1000, number + 10)
    frame = reader.take(0)
    assert frame is not None
    assert (frame.number, frame.camera_number, frame.captured_at_ns, frame.position_ns) == (5, 105, 1005, 15)
    np.testing.assert_array_equal(frame.pixels, picture(5))
    assert reader.newest_number == 5
    assert reader.take(frame.number) is None


def test_a_held_frame_stays_until_another_is_taken(memory: int) -> None:
    writer, reader = SharedFrames(memory, SHAPE, np.uint16), SharedFrames(memory, SHAPE, np.uint16)
    writer.write(picture(1), 1, 1, 0)
    first = reader.take(0)
    assert first is not None
    for number in range(2, 10 * SLOTS):
        writer.write(picture(number), number, number, 0)
        assert reader.intact(first)
        np.testing.assert_array_equal(first.pixels, picture(1))
    second = reader.take(first.number)
    assert second is not None
    assert second.number == 10 * SLOTS - 1
    for number in range(10 * SLOTS, 20 * SLOTS):
        writer.write(picture(number), number, number, 0)
    assert not reader.intact(first)
    assert reader.intact(second)


def test_a_view_outlives_the_memorys_owner() -> None:
    descriptor = SharedFrames.create(SHAPE, np.uint16)
    reader = SharedFrames(descriptor, SHAPE, np.uint16)
    SharedFrames(descriptor, SHAPE, np.uint16).write(picture(3), 3, 3, 0)
    os.close(descriptor)
    frame = reader.take(0)
    del reader
    assert frame is not None
    np.testing.assert_array_equal(frame.pixels, picture(3))


def test_colour_has_three_channels() -> None:
    descriptor = SharedFrames.create((4, 5, 3), np.uint8)
    frames = SharedFrames(descriptor, (4, 5, 3), np.uint8)
    os.close(descriptor)
    frames.write(np.full((4, 5, 3), 9, np.uint8), 1, 1, 0)
    frame = frames.take(0)
    assert frame is not None
    assert frame.pixels.shape == (4, 5, 3)
    assert frame.pixels.dtype == np.uint8


WRITER = """
import sys
import numpy as np
from edge_unit.sources.realsense.shared_frames import SharedFrames
shape = (200, 320)
frames = SharedFrames(int(sys.argv[1]), shape, np.uint16)
for number in range(1, 20001):
    frames.write(np.full(shape, number, np.uint16), number, number, number)
"""


def test_nothing_is_torn_between_two_processes() -> None:
    shape = (200, 320)
    descriptor = SharedFrames.create(shape, np.uint16)
    reader = SharedFrames(descriptor, shape, np.uint16)
    with subprocess.Popen((sys.executable, "-c", WRITER, str(descriptor)), pass_fds=(descriptor,)) as writer:
        os.close(descriptor)
        last, seen = 0, 0
        while (last < 20000 and writer.poll() is None) or reader.newest_number > last:
            frame = reader.take(last)
            if frame is None:
                continue
            assert frame.number > last
            last, seen = frame.number, seen + 1
            assert frame.captured_at_ns == frame.number
            assert (frame.pixels == frame.number % 65536).all()
            assert reader.intact(frame)
    assert last == 20000
    assert seen > 5


def test_the_memory_has_no_name(memory: int) -> None:
    assert Path(f"/proc/self/fd/{memory}").readlink().name.endswith("(deleted)")
