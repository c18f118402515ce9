# SPDX-License-Identifier: Apache-2.0
"""The state of the kernels' source: it changes whenever any kernel does.

numba notices a changed kernel by the time and size of its own file. Both may be equal in two releases, since an image
gives every source one time, and a constant in another file is not looked at. So compiled kernels lie in a folder that
is named by this state.

`python3 kernel_state.py` prints it. That takes nothing but Python itself, so whoever builds an image asks the release
for the state of its kernels, on whatever computer.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

PLACE = Path(__file__).resolve().parents[2]
"""The folder that the packages lie in."""

FOLDERS = ("geometry/kernels", "simulation/cameras")
"""Every folder, below `PLACE`, with functions that numba compiles and keeps."""

DIGITS = 12
"""Of the digest: enough for the few states that a computer ever meets."""


def state_of_kernels(place: Path = PLACE) -> str:
    """Return the state of all kernels below `place`, as hexadecimal digits.

    Raises:
        FileNotFoundError: a folder holds no kernel; a state without them would never change.
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
    """Print the state; exit code 1, with a sentence, where there are no kernels."""
    try:
        print(state_of_kernels())
    except OSError as error:
        print(f"kernel_state: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
