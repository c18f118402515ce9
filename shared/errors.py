# SPDX-License-Identifier: Apache-2.0
"""The one tree of errors that the project raises.

    CellwatchError
      InputError            an argument of a public call is wrong (also a ValueError)
      ConfigError           a configuration file or value is wrong
        CellError           ... in cell.yaml
        MeshError           ... in a mesh file
        KinematicsError     ... in a robot description
      SourceError           a camera or a recording does not deliver
        SourceEnded         ... because it has come to its end
      BoardError            the calibration board, as it is seen, does not tell the camera's pose
      WireError             bytes from the network are no message of ours
        NewerContract       ... but one of a newer master, which this unit does not understand
      UplinkError           the exchange between unit and master failed
        MasterUnreachable   ... nobody answered
        MasterRefused       ... the master answered, and said no
      Refusal               the master says no to a request: an HTTP status and one sentence
      JitCacheError         the directory for compiled kernels cannot be used

Errors of libraries are mapped onto this tree where the library is called. `__main__` prints a
CellwatchError as one line; anything else is a bug and shows its traceback.
"""

from __future__ import annotations


class CellwatchError(Exception):
    """Anything that we expected could go wrong; its text is one sentence for a person."""


class InputError(CellwatchError, ValueError):
    """An argument of a public call has the wrong type, shape or value."""


class ConfigError(CellwatchError):
    """A configuration file or value is missing, unreadable or out of range."""


class CellError(ConfigError):
    """`cell.yaml`, or what it names, does not describe a cell."""


class MeshError(ConfigError):
    """A mesh file is missing, unreadable or empty."""


class KinematicsError(ConfigError):
    """A robot description is contradictory or uses what is not supported."""


class SourceError(CellwatchError):
    """A camera or a recording does not deliver frames."""


class SourceEnded(SourceError):
    """A recording has come to its end."""


class BoardError(CellwatchError):
    """The calibration board is not seen, or not well enough to tell the camera's pose; says what to do."""


class WireError(CellwatchError):
    """Bytes from the network are malformed, too long, or of another contract version."""


class NewerContract(WireError):
    """A master of a newer minor answered a registration with what this unit does not know."""

    def __init__(self, message: str, answer: bytes) -> None:
        """`answer` is what it said; a part of it every minor can read."""
        super().__init__(message)
        self.answer = answer


class UplinkError(CellwatchError):
    """An exchange between a unit and the master failed."""


class MasterUnreachable(UplinkError):
    """Nobody answered at the master's address in time."""


class MasterRefused(UplinkError):
    """The master answered with a refusal."""

    def __init__(self, message: str, status: int, detail: str = "") -> None:
        """`detail` is the sentence of the master alone."""
        super().__init__(message)
        self.status = status
        self.detail = detail


class Refusal(CellwatchError):
    """The master says no to a request."""

    def __init__(self, status: int, message: str, retry_after_s: int | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.retry_after_s = retry_after_s


class JitCacheError(CellwatchError):
    """The directory for compiled kernels cannot be created or written."""
