# SPDX-License-Identifier: Apache-2.0
"""The files of one recording as one timeline; only one of them is unpacked at a time."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any

from master_server.recording.recording_reader import Frame, Progress, Recording
from shared.clock import NS_PER_S
from shared.errors import SourceError

FILES_MAX = 1024
"""Limit of files in one timeline: a week in files of ten minutes. Each file is held open."""

GAP_MAX_S = 10.0
"""Largest gap between two files of one recording; allows for a lost chunk and a step of the wall clock."""


class Timeline:
    """Rotated files of one recording, in any order, with the interface of `Recording`. A context manager closes them.

    Attributes:
        begin_ns, end_ns: of the first and the last moment, since 1970.
        files: the recordings, the oldest first.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        """Open all `paths`. `progress` receives the bytes read and the total.

        Raises:
            SourceError: a file cannot be read or holds no moment, or the files are not of one recording.
        """
        if not 1 <= len(paths) <= FILES_MAX:
            raise SourceError(f"replay: expected 1 to {FILES_MAX} files, got {len(paths)}")
        with ExitStack() as stack:
            found = [stack.enter_context(recording) for recording in _opened(paths, progress)]
            self.files = tuple(sorted(found, key=_begin_of))
            for before, after in pairwise(self.files):
                _check_follows(before, after)
            self._stack = stack.pop_all()
        self.begin_ns, self.end_ns = self.files[0].begin_ns, max(file.end_ns for file in self.files)
        self._current = self.files[0]
        # Each file holds every mesh that it needs, so any file that has it will do.
        self._cells = {sha256: file for file in self.files for sha256 in file.cell_names}
        self._meshes = {sha256: file for file in self.files for sha256 in file.meshes}

    def __enter__(self) -> Timeline:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def path(self) -> Path:
        """The file that was used last."""
        return self._current.path

    @property
    def trouble(self) -> str:
        """Reason why moments may be missing; empty when nothing is missing."""
        return "; ".join(f"{file.path.name}: {file.trouble}" for file in self.files if file.trouble)

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by topic."""
        total: Counter[str] = Counter()
        for file in self.files:
            total.update(file.counts)
        return dict(total)

    @property
    def size_bytes(self) -> int:
        """Size of all files, bytes."""
        return sum(file.size_bytes for file in self.files)

    @property
    def cells(self) -> list[dict[str, Any]]:
        """Documents of all cells that were watched, each once."""
        return [file.cell(sha256) for sha256, file in self._cells.items()]

    @property
    def meshes(self) -> list[str]:
        """sha256 of all meshes."""
        return list(self._meshes)

    def at(self, log_ns: int) -> Frame:
        """Return the last moment at or before `log_ns`, or the first moment if `log_ns` is earlier."""
        return self._file(log_ns).at(log_ns)

    def after(self, log_ns: int) -> int | None:
        """Return the time of the first moment after `log_ns`."""
        for file in self.files[self._number(log_ns) :]:
            if (found := file.after(log_ns)) is not None:
                return found
        return None

    def cell(self, sha256: str) -> dict[str, Any]:
        """Return the document of a cell.

        Raises:
            SourceError: the document is missing or damaged.
        """
        return self._cells.get(sha256, self._current).cell(sha256)

    def mesh(self, sha256: str) -> bytes | None:
        """Return a mesh in its canonical bytes; None if it is missing."""
        holder = self._meshes.get(sha256)
        return None if holder is None else holder.mesh(sha256)

    def _number(self, log_ns: int) -> int:
        return max(bisect_right(self.files, log_ns, key=_begin_of) - 1, 0)

    def _file(self, log_ns: int) -> Recording:
        file = self.files[self._number(log_ns)]
        if file is not self._current:
            self._current.forget()
            self._current = file
        return file


def _opened(paths: Sequence[Path], progress: Progress | None) -> Iterator[Recording]:
    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    for number, path in enumerate(paths):
        before, total = sum(sizes[:number]), sum(sizes)

        def tell(read: int, _: int, before: int = before, total: int = total) -> None:
            if progress is not None:
                progress(before + read, total)

        yield Recording(path, tell)


def _check_follows(before: Recording, after: Recording) -> None:
    gap_s = (after.begin_ns - before.end_ns) / NS_PER_S
    if after.begin_ns == before.begin_ns:
        raise SourceError(f"{after.path}: it begins when {before.path.name} does; expected each file once")
    if gap_s < -GAP_MAX_S:
        raise SourceError(f"{after.path}: it overlaps {before.path.name} by {-gap_s:.0f} s; expected one recording")
    if gap_s > GAP_MAX_S:
        raise SourceError(
            f"{after.path}: {gap_s:.0f} s are missing after {before.path.name}; expected files that follow one another"
        )


def _begin_of(file: Recording) -> int:
    return file.begin_ns


def duration_s(timeline: Timeline) -> float:
    """Return the seconds from the first moment to the last."""
    return (timeline.end_ns - timeline.begin_ns) / NS_PER_S


def summary(timeline: Timeline) -> list[str]:
    """Describe the contents of a recording in lines for a person."""
    first, last = timeline.at(timeline.begin_ns), timeline.at(timeline.end_ns)
    lines = [
        f"{', '.join(str(file.path) for file in timeline.files)}: {timeline.size_bytes / 1e6:.1f} MB",
        f"  from      {_utc(timeline.begin_ns)}",
        f"  to        {_utc(timeline.end_ns)} ({duration_s(timeline):.1f} s)",
        f"  trouble   {timeline.trouble or 'none'}",
    ]
    for cell in timeline.cells:
        low, high = (" ".join(f"{value:g}" for value in cell[key]) for key in ("box_min_m", "box_max_m"))
        lines.append(f"  cell      {cell['name']}: {low} to {high} m")
    for name, frame in (("begins", first), ("ends", last)):
        units = ", ".join(f"{row.id} {row.state}" for row in frame.state.units) or "none"
        lines.append(
            f"  {name:9s} voxels of {frame.view.lattice.voxel_size_m:g} m: {len(frame.view.keys)}, "
            f"{'complete' if frame.view.complete else 'not complete'}; units: {units}"
        )
    return lines + [f"  {topic:21s} {count}" for topic, count in sorted(timeline.counts.items())]


def _utc(log_ns: int) -> str:
    return datetime.fromtimestamp(log_ns / NS_PER_S, timezone.utc).isoformat(sep=" ", timespec="milliseconds")
