# SPDX-License-Identifier: Apache-2.0
"""Handling of a simulated camera while it runs: people knock it, cover it, or plug in another one.

A file describes the present state. It is not a configuration: it replaces hands.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from shared.configuration import sentence
from shared.errors import SourceError
from shared.files import write_whole


class Handling(BaseModel):
    """The handling of one camera; by default it is in its place of the rig.

    `xyz` (m) and `rpy_deg` (fixed axes) are its pose in the frame of a camera in its place. `serial` is the serial of
    the plugged-in camera; None: its own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covered: bool = False
    serial: str | None = None

    def write(self, path: Path) -> None:
        """Apply this handling to the camera that reads `path`, from now on."""
        write_whole(path, self.model_dump_json().encode(), synced=False)


LEFT_ALONE = Handling()


class Hands:
    """The file of one camera; it need not exist."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._written_ns = 0
        self._now = LEFT_ALONE

    def now(self) -> Handling:
        """Return the present handling.

        Raises:
            SourceError: the file is not a valid `Handling`.
        """
        if self._path is None:
            return LEFT_ALONE
        try:
            # The file is replaced each time, so that its time and content belong together.
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
