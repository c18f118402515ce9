# SPDX-License-Identifier: Apache-2.0
"""What people do to a simulated camera while it runs: they knock it, cover it, or plug in another one.

A file says what holds now. It is no configuration: it stands for hands.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from shared.configuration import sentence
from shared.errors import SourceError
from shared.files import write_whole


class Handling(BaseModel):
    """What is done to one camera; left alone it hangs in its place of the rig.

    `xyz` m and `rpy_deg` (fixed axes) are where it hangs, in the frame of a camera in its place. `serial` is that of
    the camera that is plugged in, None: its own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covered: bool = False
    serial: str | None = None

    def write(self, path: Path) -> None:
        """From now on this is done to the camera that looks at `path`."""
        write_whole(path, self.model_dump_json().encode(), synced=False)


LEFT_ALONE = Handling()


class Hands:
    """The file of one camera, which need not be there."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._written_ns = 0
        self._now = LEFT_ALONE

    def now(self) -> Handling:
        """What is done at this moment.

        Raises:
            SourceError: the file is no `Handling`.
        """
        if self._path is None:
            return LEFT_ALONE
        try:
            # A new file each time, so that its time and content belong together.
            written_ns = self._path.stat().st_mtime_ns
            if written_ns != self._written_ns:
                self._now = Handling.model_validate_json(self._path.read_bytes())
                self._written_ns = written_ns
        except FileNotFoundError:
            return LEFT_ALONE
        except ValidationError as error:
            raise SourceError(f"simulated camera: {self._path}: {sentence(error)}") from error
        except OSError as error:
            raise SourceError(f"simulated camera: {self._path}: {error.strerror}") from error
        return self._now
