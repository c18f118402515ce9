# SPDX-License-Identifier: Apache-2.0
"""Digest of the kernels' source, which changes with any kernel.

numba detects a changed kernel by the time and size of its own file. Both can be equal in two releases, since an image
sets one time for all files, and numba ignores constants in other files. So the folder of compiled kernels is named by
this digest.

`python3 kernel_state.py` prints it. It needs only Python, so the build of an image can ask a release for its digest on
any computer.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

PLACE = Path(__file__).resolve().parents[2]
"""The folder that contains the packages."""

FOLDERS = ("geometry/kernels", "simulation/cameras")
"""All folders below `PLACE` with functions that numba compiles and caches."""

DIGITS = 12
"""Length of the digest: enough for the few states that a computer ever has."""


def state_of_kernels(place: Path = PLACE) -> str:
    """Return the digest of all kernels below `place`, as hexadecimal digits.

    Raises:
        FileNotFoundError: a folder has no kernel; a digest without kernels would never change.
    """
    digest = hashlib.sha256()
    for folder in FOLDERS:
        files = sorted((place / folder).glob("*.py"))
        if not files:
            raise FileNotFoundError(f"{place / folder}: expected the kernels' source, found no Python file")
        for file in files:
            digest.update(f"{folder}/{file.name}\0".encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:DIGITS]


def main() -> int:
    """Print the digest; exit code 1 with a message if there are no kernels."""
    try:
        print(state_of_kernels())
    except OSError as error:
        print(f"kernel_state: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
