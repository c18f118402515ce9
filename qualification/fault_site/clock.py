# SPDX-License-Identifier: Apache-2.0
"""Separate clocks for one process: a wall clock that jumps while it runs, and a monotonic clock with another origin."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

from shared.errors import ConfigError

OFFSET_FILE = "CELLWATCH_WALL_CLOCK_FILE"

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t none, *offset_s = &none;

__attribute__((constructor)) static void open_offset(void) {
    const char *path = getenv("CELLWATCH_WALL_CLOCK_FILE");
    int file = path ? open(path, O_RDONLY) : -1;
    if (file < 0) return;
    void *page = mmap(NULL, sizeof *offset_s, PROT_READ, MAP_SHARED, file, 0);
    if (page != MAP_FAILED) offset_s = page;
    close(file);
}

int clock_gettime(clockid_t clock, struct timespec *at) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(clock, at);
    if (!result && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) at->tv_sec += *offset_s;
    return result;
}

int gettimeofday(struct timeval *at, void *zone) {
    struct timespec now;
    (void)zone;
    int result = clock_gettime(CLOCK_REALTIME, &now);
    at->tv_sec = now.tv_sec;
    at->tv_usec = now.tv_nsec / 1000;
    return result;
}

time_t time(time_t *at) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (at) *at = now.tv_sec;
    return now.tv_sec;
}
"""


class WallClock:
    """Wall clock of the processes that are started with `environment`. It can jump."""

    def __init__(self, folder: Path) -> None:
        """Compile the library. Raises ConfigError if there is no C compiler."""
        compiler = shutil.which("cc")
        if compiler is None:
            raise ConfigError("wall clock: expected a C compiler named cc, found none; install one (package gcc)")
        folder.mkdir()
        library, self._file = folder / "wall_clock.so", folder / "offset"
        source = folder / "wall_clock.c"
        source.write_text(SOURCE)
        command = (compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl")
        compiled = subprocess.run(command, capture_output=True, text=True, check=False)
        if compiled.returncode:
            raise ConfigError(f"wall clock: {compiler} failed: {compiled.stderr.strip()}")
        self._file.write_bytes(struct.pack("=q", 0))
        self.environment = {"LD_PRELOAD": str(library), OFFSET_FILE: str(self._file)}

    def jump(self, by_s: int) -> None:
        """Set the offset of the clock in seconds."""
        with self._file.open("r+b", buffering=0) as file:
            file.write(struct.pack("=q", by_s))


def monotonic_elsewhere(by_s: int) -> tuple[str, ...]:
    """Return the start of a command whose CLOCK_MONOTONIC is this far ahead."""
    return ("unshare", "--time", f"--monotonic={by_s}", "--fork", "--kill-child=KILL", "--")
