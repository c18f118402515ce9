# SPDX-License-Identifier: Apache-2.0
"""The tree of errors that the project raises.

    CellwatchError
      InputError            an argument of a public call is wrong (also a ValueError)
      ConfigError           a configuration file or value is wrong
        CellError           ... in cell.yaml
        MeshError           ... in a mesh file
        KinematicsError     ... in a robot description
      SourceError           a camera or a recording does not deliver frames
        SourceEnded         ... because the recording has ended
      BoardError            the camera's pose cannot be computed from the view of the board
      WireError             bytes from the network are not a valid message
        NewerContract       ... but one of a newer master that this unit does not support
      UplinkError           the exchange between unit and master failed
        MasterUnreachable   ... no answer came
        MasterRefused       ... the master answered with a refusal
      Refusal               the master refuses a request: an HTTP status and one sentence
      JitCacheError         the directory for compiled kernels cannot be used

Calls of libraries map their errors onto this tree. `__main__` prints a CellwatchError as one line; any other
exception is a bug and shows its traceback.
"""

from __future__ import annotations


class CellwatchError(Exception):
    """Base of all expected errors; the text is one sentence for a person."""


class InputError(CellwatchError, ValueError):
    """An argument of a public call has the wrong type, shape or value."""


class ConfigError(CellwatchError):
    """A configuration file or value is missing, unreadable or out of range."""


class CellError(ConfigError):
    """`cell.yaml`, or a file that it names, is missing or invalid."""


class MeshError(ConfigError):
    """A mesh file is missing, unreadable or empty."""


class KinematicsError(ConfigError):
    """A robot description is contradictory or uses a feature that is not supported."""


class SourceError(CellwatchError):
    """A camera or a recording does not deliver frames."""


class SourceEnded(SourceError):
    """A recording has ended."""


class BoardError(CellwatchError):
    """The view of the calibration board does not give the camera's pose; the text says what to do."""


class WireError(CellwatchError):
    """Bytes from the network are malformed, too long, or of another contract version."""


class NewerContract(WireError):
    """A master of a newer minor answered a registration with content that this unit does not support."""

    def __init__(self, message: str, answer: bytes) -> None:
        """Keep `answer`, the body received; a unit of any minor can read a part of it (`SlotAnswer`)."""
        super().__init__(message)
        self.answer = answer


class UplinkError(CellwatchError):
    """An exchange between a unit and the master failed."""


class MasterUnreachable(UplinkError):
    """No answer came from the master's address in time."""


class MasterRefused(UplinkError):
    """The master answered with a refusal."""

    def __init__(self, message: str, status: int, detail: str = "") -> None:
        """Keep the HTTP `status`, and as `detail` only the master's own sentence."""
        super().__init__(message)
        self.status = status
        self.detail = detail


class Refusal(CellwatchError):
    """The master refuses a request; `status` is the HTTP status."""

    def __init__(self, status: int, message: str, retry_after_s: int | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.retry_after_s = retry_after_s


class JitCacheError(CellwatchError):
    """The directory for compiled kernels cannot be created or written."""
