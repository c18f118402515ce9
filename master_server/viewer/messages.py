# SPDX-License-Identifier: Apache-2.0
"""What the viewer's process asks of the master, and what it is answered, as models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from master_server.api.history import Sample
from master_server.recording.replay import ReplayAnswer
from master_server.viewer.sessions import Viewer
from shared.messages import OPEN, LatticeDescription, RobotState, UnitRow

NOT_RECORDED: dict[int, bytes] = {}
"""Of `reports`, where a recording does not tell which unit reports which voxels."""


class ViewerMessage(BaseModel):
    """Frozen; unknown names are refused: both ends are of one version."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class BeginRequest(ViewerMessage):
    """How the window is to be; answered by `BeginAnswer`."""

    verb: Literal["begin"] = "begin"


class ReadyRequest(ViewerMessage):
    """The window is served at this port of loopback; answered by `ReadyAnswer`."""

    verb: Literal["ready"] = "ready"
    port: int


class LookRequest(ViewerMessage):
    """What is wanted besides the map and the robot: it costs the master time or changes rarely. Answered by `Look`.

    Attributes:
        units: their rows, and how things stood after `since_ns`.
        unseen: what nobody sees.
        reports: which unit reports which voxels.
        since_ns: the newest sample of the history that is known.
    """

    verb: Literal["look"] = "look"
    units: bool = False
    unseen: bool = False
    reports: bool = False
    since_ns: int = -1


class ApiRequest(ViewerMessage):
    """A request of the master's API, by somebody who looks; answered by `ApiAnswer`. `body` is JSON."""

    verb: Literal["ask"] = "ask"
    method: str
    path: str
    body: Any = None
    viewer: Viewer


Request = Annotated[BeginRequest | ReadyRequest | LookRequest | ApiRequest, Field(discriminator="verb")]


class BeginAnswer(ViewerMessage):
    """The key that the master shows, and the actions of an operator on a unit: what a button says, and its address."""

    key: str
    actions: dict[str, str]
    is_replay: bool


class ReadyAnswer(ViewerMessage):
    """The master knows."""


class ApiAnswer(ViewerMessage):
    """What the API answers: its status and its body."""

    status: int
    body: bytes


class RefusedAnswer(ViewerMessage):
    """Instead of any other answer: why there is none, in a sentence."""

    refused: str


class RobotStanding(ViewerMessage):
    """Whether units can filter the robot, and why not in words."""

    state: Annotated[RobotState, OPEN]
    reason: str


class SeenBits(ViewerMessage):
    """What anybody looks through: one bit a block, in C order, packed."""

    bits: bytes
    blocks: LatticeDescription


class MapBits(ViewerMessage):
    """The merged map: all that the picture of the obstacles is made of.

    Attributes:
        keys: little-endian uint32 (N,), ascending.
        witnesses: uint8 (N,).
        reports: keys of each live unit as in `keys`, by its id; None where nobody asked for them.
    """

    lattice: LatticeDescription
    keys: bytes
    witnesses: bytes
    reports: dict[int, bytes] | None = None

    @property
    def count(self) -> int:
        """How many voxels there are."""
        return len(self.witnesses)

    @property
    def tells_who(self) -> bool:
        """Whether it is known which unit reports a voxel, if there is any."""
        return not self.keys or self.reports != NOT_RECORDED


class Look(ViewerMessage):
    """The map and the robot at one time, and what else was wanted: None where it was not.

    Attributes:
        cell: the sha256 of the watched cell's document.
        reasons: the first few, why the map is not complete; `reason_count` are all.
    """

    now_ns: int
    cell: str
    map: MapBits
    reasons: tuple[str, ...]
    reason_count: int
    oldest_view_age_s: float | None
    units_live: int
    robot: RobotStanding
    joints: tuple[float, ...] | None
    units: tuple[UnitRow, ...] | None = None
    history: tuple[Sample, ...] = ()
    seen: SeenBits | None = None
    replay: ReplayAnswer | None = None
