# SPDX-License-Identifier: Apache-2.0
"""Models of the viewer's requests to the master, and of the answers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from master_server.api.history import Sample
from master_server.recording.replay import ReplayAnswer
from master_server.viewer.sessions import Viewer
from shared.messages import OPEN, LatticeDescription, RobotState, UnitRow

NOT_RECORDED: dict[int, bytes] = {}
"""Id for `reports`, if a recording does not name the unit of each voxel."""


class ViewerMessage(BaseModel):
    """Frozen; unknown names are refused, since both ends have the same version."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class BeginRequest(ViewerMessage):
    """Request for the configuration of the viewer; answered by `BeginAnswer`."""

    verb: Literal["begin"] = "begin"


class ReadyRequest(ViewerMessage):
    """The viewer listens at this port of loopback; answered by `ReadyAnswer`."""

    verb: Literal["ready"] = "ready"
    port: int


class StateRequest(ViewerMessage):
    """Request for the state, with the parts that are costly or change rarely. Answered by `ViewerState`.

    Attributes:
        units: include the rows of the units, and the history after `since_ns`.
        unseen: include the unseen blocks.
        reports: include the voxels of each unit.
        since_ns: the newest known sample of the history.
    """

    verb: Literal["look"] = "look"
    units: bool = False
    unseen: bool = False
    reports: bool = False
    since_ns: int = -1


class ApiRequest(ViewerMessage):
    """A request to the master's API on behalf of a browser; answered by `ApiAnswer`. `body` is JSON."""

    verb: Literal["ask"] = "ask"
    method: str
    path: str
    body: Any = None
    viewer: Viewer


Request = Annotated[BeginRequest | ReadyRequest | StateRequest | ApiRequest, Field(discriminator="verb")]


class BeginAnswer(ViewerMessage):
    """The key that the master sends, and an operator's actions on a unit: the text of each button and its address."""

    key: str
    actions: dict[str, str]
    is_replay: bool


class ReadyAnswer(ViewerMessage):
    """Acknowledgement of `ReadyRequest`."""


class ApiAnswer(ViewerMessage):
    """The status and the body of the API's answer."""

    status: int
    body: bytes


class RefusedAnswer(ViewerMessage):
    """A refusal in place of any other answer, with its reason in a sentence."""

    refused: str


class RobotStatus(ViewerMessage):
    """The robot's state, and the reason in words if units cannot filter the robot."""

    state: Annotated[RobotState, OPEN]
    reason: str


class SeenBits(ViewerMessage):
    """The blocks that any unit sees: one bit per block, in C order, packed."""

    bits: bytes
    blocks: LatticeDescription


class MapBits(ViewerMessage):
    """The merged map: all data for drawing the obstacles.

    Attributes:
        keys: little-endian uint32 (N,), ascending.
        witnesses: uint8 (N,).
        reports: keys of each live unit as in `keys`, by its id; None if not requested.
    """

    lattice: LatticeDescription
    keys: bytes
    witnesses: bytes
    reports: dict[int, bytes] | None = None

    @property
    def count(self) -> int:
        """Number of voxels."""
        return len(self.witnesses)

    @property
    def has_reports(self) -> bool:
        """True if the unit of each voxel is known, or there are no voxels."""
        return not self.keys or self.reports != NOT_RECORDED


class ViewerState(ViewerMessage):
    """The map and the robot at one time, and the requested parts: None if not requested.

    Attributes:
        cell: the sha256 of the watched cell's document.
        reasons: the first few reasons why the map is incomplete; `reason_count` counts all.
    """

    now_ns: int
    cell: str
    map: MapBits
    reasons: tuple[str, ...]
    reason_count: int
    oldest_view_age_s: float | None
    units_live: int
    robot: RobotStatus
    joints: tuple[float, ...] | None
    units: tuple[UnitRow, ...] | None = None
    history: tuple[Sample, ...] = ()
    seen: SeenBits | None = None
    replay: ReplayAnswer | None = None
