# SPDX-License-Identifier: Apache-2.0
"""Messages between units, master, robot and operators.

Times are integers of nanoseconds. `_at_ns` of a unit is on its CLOCK_MONOTONIC, of the master and of joints on the
master's. Every text, list and array is bounded, since anyone on the network can send one.

The contract has a major and a minor number. Within a major, a unit works with any master whose minor is at least its
own, so a master is updated before its units. Rules for changes of this file:

    requests   New names have defaults. A unit does not send them to an older master, which would reject them.
    answers    `Answer`: the names beside settings, lattice, cell, pose, joints and commands are status. A unit ignores
               unknown status names, so nothing that changes a unit's behaviour may be status.
    behaviour  Settings, lattice, cell, pose, joints, commands: a unit refuses unknown names, since it would filter
               pixels that it must not, and reports the trouble `contract`. So a master omits new names that nothing
               uses, and sends a unit no verb that its minor does not have.
    rows       Rows are values without names. They grow at their end: a unit ignores values beyond those it knows, and
               a master reads a shorter row as one whose last values are at their defaults.
    defaults   Defaults never change, since a value at its default may be omitted.
    codes      Codes of a status (states, reasons, outcomes, tasks, troubles) may be added. This version writes only
               those that its types list. A reader takes any (`OPEN`): an unknown code stays a string and means nothing
               good. Codes in requests, and in settings, cell, pose, joints and commands, are closed.

`tests/shared/golden` records the messages of each minor; these records never change.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from shared.camera import Intrinsics
from shared.errors import InputError
from shared.lattice import MAX_AXIS, Lattice
from shared.settings import Settings
from shared.timebase import Exchange
from shared.transforms import Transform, validated

CONTRACT_VERSION = 5
"""Major number: rises when units of the old contract and masters of the new one can no longer work together."""

CONTRACT_MINOR = 1
"""Minor number: rises with additions, at most once a release. 5.0 had no outcome codes, trouble codes and progress."""

MAX_TEXT = 200
"""Limit of a text: enough for a serial, a version or one sentence; keeps tables and logs readable."""

MAX_JOINTS = 32
"""Limit of joints: more than two arms on a track with grippers."""

MAX_JOINT_VALUE = 1e4
"""Limit of a position in rad or m, or a velocity. 1600 turns are beyond any robot, and the value fits a float32."""

MAX_VOXELS = 2**18
"""Limit of voxels in one update, 1 MiB on the wire: a wall of 5 m by 5 m outside the CAD at 10 mm still fits."""

MAX_SEEN_BYTES = 4096
"""Limit of one seen report, compressed; units report coarser blocks when it would be larger."""

MAX_COMMANDS = 16
"""Limit of pending commands for one unit; the master refuses more until some have ended."""

MAX_JOINT_SAMPLES = 32
"""Limit of joint samples in one answer: a slow unit at 5 fps gets all it needs at one sample in 8 ms."""


PICTURE_RANGE_M = (0.3, 6.0)
"""Depth range of the colours in all units' images: from the least range of a camera to the far wall of its cell."""

MAX_IMAGE_BYTES = 2**22
"""Limit of one image: 1280 x 720 in three colours has 2.8 MB even when nothing can be compressed."""


def is_newer(contract: object, minor: object) -> bool:
    """Return True if these numbers are of a newer contract than this program's."""
    if not isinstance(contract, int) or not isinstance(minor, int):
        return False
    return (contract, minor) > (CONTRACT_VERSION, CONTRACT_MINOR)


@dataclass(frozen=True)
class OpenCode:
    """Mark a code in a status as open: a reader keeps a code of a later minor as a string of at most `MAX_TEXT`.

    The static type stays the `Literal` of the codes that this version writes. A program that reads must treat each
    code that it does not know as not live and not complete. The JSON schema lists the known codes.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.union_schema([handler(source), core_schema.str_schema(max_length=MAX_TEXT)])


OPEN = OpenCode()


def known_names(model: type[BaseModel]) -> BeforeValidator:
    """Make a validator that drops the names that `model` does not have; for parts of a status that else refuse them."""

    def known(fields: Any) -> Any:
        return (
            {name: fields[name] for name in fields if name in model.model_fields}
            if isinstance(fields, dict)
            else fields
        )

    return BeforeValidator(known)


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("expected only printable characters, since logs show the text")
    return text


Text = Annotated[str, Field(max_length=MAX_TEXT)]
Label = Annotated[Text, AfterValidator(_printable)]
Nanoseconds = Annotated[int, Field(ge=0, lt=2**63)]
Counter = Annotated[int, Field(ge=0, lt=2**63)]
Minor = Annotated[int, Field(ge=0, lt=2**31)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
JointValues = Annotated[tuple[float, ...], Field(max_length=MAX_JOINTS)]
# Strict, since a boolean is not an angle.
JointNumber = Annotated[float, Field(strict=True, ge=-MAX_JOINT_VALUE, le=MAX_JOINT_VALUE)]
JointNumbers = Annotated[tuple[JointNumber, ...], Field(max_length=MAX_JOINTS)]
Matrix = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]
Phase = Literal["searching", "registering", "fetching", "localising", "live"]
State = Literal["uncalibrated", "live", "stale", "blind", "moved"]
Verb = Literal["learn_background", "drop_background", "calibrate", "refine", "image"]
ImageKind = Literal["depth", "expected", "foreground"]
PoseOrigin = Literal["configured", "board", "refined", "operator", "source"]
ReportedOrigin = Literal["configured", "source"]
RobotState = Literal["fresh", "stale", "silent", "none"]
Task = Literal["background", "refinement", "calibration"]
"""Tasks that report their progress: learning the background model, refining the pose, finding it by the board."""
TroubleCode = Literal["camera", "board", "background", "joints", "frame", "contract"]
"""Trouble of a unit:

camera      the camera delivers no frames
board       the camera's pose is not known; the unit searches for the board
background  the unit learns the background
joints      the robot's position is not known, and no frame can be processed without it
frame       the unit cannot process frames with this cell, pose and settings
contract    the master requires what this unit's minor does not support; update the unit
"""
ReasonCode = Literal[
    TroubleCode,
    "trouble", "no_pose", "pose_void",
    "no_update", "late_update", "no_frame", "clock_unknown", "clock_uncertain", "late_frame", "clock_jumped",
    "old_lattice", "old_cell", "old_pose",
    "covered", "few_pixels", "moved", "few_surfaces",
    "pose_differs", "warning",
    "not_seen", "no_unit", "robot_silent", "robot_stale",
]  # fmt: skip
"""Reason for a unit's state, or for an incomplete map.

In order: troubles of units (`trouble`: a trouble of contract 5.0, which has no codes); the states uncalibrated, stale,
blind and moved; live with a warning; the map.
"""
OutcomeCode = Literal["done", "refused", "failed", "superseded", "unanswered"]
"""Outcome of a command:

done        carried out
refused     not possible in the present state; nothing was tried
failed      tried without success; nothing changed
superseded  made void by a later command or event
unanswered  the unit did not answer in time
"""


class Message(BaseModel):
    """Base of messages: frozen; unknown names, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Answer(Message):
    """A message that an older receiver may read: its own unknown names are ignored, those of its parts refused."""

    model_config = ConfigDict(extra="ignore")


class Versions(Answer):
    """Counters of the master that rise with each change; a unit reports the versions that it works with."""

    settings: Counter = 0
    lattice: Counter = 0
    cell: Counter = 0
    pose: Counter = 0


class LatticeDescription(Message):
    """A `shared.lattice.Lattice` as plain numbers."""

    origin_m: tuple[float, float, float]
    voxel_size_m: float = Field(gt=0.0)
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, lattice: Lattice) -> LatticeDescription:
        """Describe `lattice`."""
        return cls(origin_m=lattice.origin_m, voxel_size_m=lattice.voxel_size_m, shape=lattice.shape)

    def lattice(self) -> Lattice:
        """Return the lattice described.

        Raises:
            InputError: the numbers do not describe a valid lattice.
        """
        return Lattice(self.origin_m, self.voxel_size_m, self.shape)


class CellReference(Message):
    """The cell that the master watches. `sha256` is of its document; a unit caches the cell on disk by it."""

    name: Text
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class CellAnswer(Message):
    """Answer to a change of the cell: the cell watched now, and the versions that units must work with."""

    cell: CellReference
    versions: Versions


class ObjectPoseRequest(Message):
    """Pose of a known object: `T_world_object` (4, 4), its mesh's frame in the world."""

    T_world_object: Matrix

    @field_validator("T_world_object")
    @classmethod
    def _rigid(cls, value: Matrix) -> Matrix:
        validated(value, "T_world_object")
        return value


class JointSample(NamedTuple):
    """The robot's joints at one time of the master's clock: positions (n,), rad or m, and velocities, per second."""

    at_ns: Nanoseconds
    positions: JointValues
    velocities: JointValues | None


class Command(Message):
    """A command to a unit; the unit reports the outcome under the same `id` in a later update."""

    id: Counter
    verb: Verb
    image: ImageKind | None = Field(default=None, description="Kind of the image, for the verb `image`.")
    raw: bool = Field(default=False, description="For the verb `image`: 16 bits in units of depth_scale, not colours.")


class Outcome(NamedTuple):
    """Outcome of a command: a code for programs, and for people the result, or the reason why it failed."""

    code: OutcomeCode
    detail: Text = ""

    @property
    def sentence(self) -> str:
        """`done` for a command carried out, else the reason."""
        return self.code if self.code == "done" else self.detail


DONE = Outcome("done")


class Ended(NamedTuple):
    """A command's outcome as it travels. Units of contract 5.0 have no code; their text starts with `done`."""

    id: Counter
    text: Text
    code: OutcomeCode | None = None

    @classmethod
    def of(cls, command_id: int, outcome: Outcome) -> Ended:
        """Combine a command's id with its outcome; cut a detail that is too long."""
        return cls(command_id, outcome.detail[:MAX_TEXT], outcome.code)

    @property
    def outcome(self) -> Outcome:
        """The outcome, for any minor of the unit."""
        if self.code is not None:
            return Outcome(self.code, self.text)
        head, _, result = self.text.partition(": ")
        return Outcome("done", result) if head == "done" else Outcome("failed", self.text)


class InitializeRequest(Message):
    """Registration of a unit with its camera for a slot (Algorithm 8)."""

    contract: int = Field(ge=0, lt=2**31)
    contract_minor: Minor = Field(default=0, description="Units of 5.0 send none.")
    serial: Label = Field(min_length=1, description="Serial number of the camera.")
    model: Label = ""
    intrinsics: Intrinsics
    software: Label = ""
    boot_id: Label = Field(default="", description="Changes when the unit's monotonic clock restarts.")
    T_world_camera: Matrix | None = Field(
        default=None, description="The camera's pose as the unit knows it; the master's own pose takes precedence."
    )
    pose_origin: ReportedOrigin = "configured"
    sent_at_ns: Nanoseconds

    @model_validator(mode="before")
    @classmethod
    def _known_part(cls, fields: Any) -> Any:
        """Keep only known names of a newer unit's request, so that it is refused for its contract, not for a name."""
        if isinstance(fields, dict) and is_newer(fields.get("contract"), fields.get("contract_minor", 0)):
            return {name: value for name, value in fields.items() if name in cls.model_fields}
        return fields

    @field_validator("T_world_camera")
    @classmethod
    def _rigid(cls, value: Matrix | None) -> Matrix | None:
        if value is not None:
            validated(value, "T_world_camera")
        return value


class InitializeAnswer(Answer):
    """The slot, and everything that a unit needs to start."""

    id: Counter
    session: Counter
    versions: Versions
    settings: Settings
    lattice: LatticeDescription
    cell: CellReference
    T_world_camera: Matrix | None = None
    board: dict[str, Any] | None = None
    joints: tuple[JointSample, ...] = Field(default=(), max_length=MAX_JOINT_SAMPLES)
    received_at_ns: Nanoseconds
    answered_at_ns: Nanoseconds
    contract_minor: Minor = Field(default=0, description="The master's minor; not sent to units of 5.0.")


class SlotAnswer(Answer):
    """The part of `InitializeAnswer` that a unit of any minor can read."""

    id: Counter
    session: Counter
    versions: Versions
    received_at_ns: Nanoseconds
    answered_at_ns: Nanoseconds
    contract_minor: Minor = 0


class SeenReport(Message):
    """The blocks of the cell that a frame looks through.

    One bit for each block in C order `(ix*ny + iy)*nz + iz` from the lattice's origin; little-endian bits, zlib.
    """

    block_size_m: float = Field(gt=0.0, le=1000.0)
    shape: tuple[
        Annotated[int, Field(ge=1, le=MAX_AXIS)],
        Annotated[int, Field(ge=1, le=MAX_AXIS)],
        Annotated[int, Field(ge=1, le=MAX_AXIS)],
    ]
    bits: bytes = Field(max_length=MAX_SEEN_BYTES)


@dataclass(frozen=True)
class Reason:
    """Reason for a state: a code and named numbers for programs, and a sentence for people.

    The name of a number ends with its unit of measure; `unit` is the id of the unit concerned.
    """

    # Readers ignore additional names of a later master, also inside a message that forbids unknown names.
    __pydantic_config__ = ConfigDict(extra="ignore")

    code: Annotated[ReasonCode, OPEN]
    sentence: str
    numbers: dict[str, float] = field(default_factory=dict)


_REASON = TypeAdapter(Reason)

ReadReason = Annotated[Reason, BeforeValidator(_REASON.validate_python)]
"""A reason validated from its fields even in strict mode, which would accept only an instance."""


class Progress(Message):
    """Progress of a task: `done` of `total` frames."""

    task: Task
    done: Counter
    total: Counter


class Health(Message):
    """Quality of a unit's view, with the number of the frame that it refers to."""

    valid_share: Share = Field(default=0.0, description="Share of the pixels with a measurement.")
    agreeing_share: Share = Field(
        default=0.0, description="Share of the measured pixels on a known static surface that agree with it."
    )
    residual_share: float = Field(
        default=0.0, ge=-1.0, le=1.0, description="Median of measured less expected depth, as a share of the margin."
    )
    static_share: Share = Field(default=0.0, description="Share of the pixels with a known static surface.")
    process_ms: float = Field(default=0.0, ge=0.0, description="Time from a frame to its voxels.")
    frame: Counter = Field(default=0, description="Number of the frame.")
    trouble: Text | None = Field(default=None, description="The unit's trouble, in one sentence.")
    warning: Text | None = Field(default=None, description="A degradation of a unit that still works, in one sentence.")
    moved: Text | None = Field(default=None, description="Reason to believe that the camera moved from its pose.")
    blind: Text | None = Field(default=None, description="Reason to believe that the camera is covered or dazzled.")
    trouble_code: TroubleCode | None = Field(default=None, description="The trouble, for programs; since 5.1.")
    progress: Progress | None = Field(default=None, description="Progress of the running task; since 5.1.")


class StatusProgress(Progress):
    """Progress in a status: unknown names are ignored, unknown tasks kept."""

    model_config = ConfigDict(extra="ignore")

    task: Annotated[Task, OPEN]


class StatusHealth(Health):
    """Health in a status: unknown names are ignored, unknown codes kept."""

    model_config = ConfigDict(extra="ignore")

    trouble_code: Annotated[TroubleCode, OPEN] | None = None
    progress: StatusProgress | None = None


def _status_health(health: object) -> object:
    """Read a health that this version knows as `Health`, so that equal ones are equal; others as `StatusHealth`."""
    if not isinstance(health, dict):
        return health
    try:
        return Health.model_validate(health)
    except ValidationError:
        return StatusHealth.model_validate(health)


class UpdateRequest(Message):
    """Report of a unit's newest frame (Algorithm 8)."""

    id: Counter
    session: Counter
    sequence: Counter
    captured_at_ns: Nanoseconds | None = Field(default=None, description="Absent: there is no frame yet.")
    sent_at_ns: Nanoseconds
    exchange: Exchange | None = Field(default=None, description="The four times of the previous exchange.")
    versions: Versions = Field(description="Versions with which the voxels were made.")
    keys: bytes = Field(default=b"", max_length=4 * MAX_VOXELS, description="Ascending little-endian uint32.")
    seen: SeenReport | None = Field(default=None, description="Absent: unchanged since the previous update.")
    health: Health = Health()
    joints_until_ns: Nanoseconds = Field(default=0, description="Time of the newest joints that the unit has.")
    done: tuple[Ended, ...] = Field(default=(), max_length=MAX_COMMANDS, description="Commands that ended.")
    phase: Phase = Field(default="live", description="Phase of the unit's start.")


class UpdateAnswer(Answer):
    """All that a unit needs next; settings, lattice, cell and pose only when the unit's version differs."""

    versions: Versions
    received_at_ns: Nanoseconds
    answered_at_ns: Nanoseconds
    joints: tuple[JointSample, ...] = Field(default=(), max_length=MAX_JOINT_SAMPLES)
    commands: tuple[Command, ...] = Field(default=(), max_length=MAX_COMMANDS)
    settings: Settings | None = None
    lattice: LatticeDescription | None = None
    cell: CellReference | None = None
    T_world_camera: Matrix | None = None


class PoseQuality(Message):
    """Accuracy of a camera's pose by the method that found it; values not measured are absent."""

    uncertainty_mm: float | None = Field(default=None, ge=0.0, description="Standard error of its position.")
    uncertainty_deg: float | None = Field(default=None, ge=0.0, description="Standard error of its rotation.")
    reprojection_px: float | None = Field(default=None, ge=0.0, description="RMS, for a pose from the board.")


class PoseRequest(Message):
    """Pose of a unit's camera: `T_world_camera` (4, 4), optical frame."""

    T_world_camera: Matrix
    origin: PoseOrigin = "operator"
    quality: PoseQuality = PoseQuality()

    @field_validator("T_world_camera")
    @classmethod
    def _rigid(cls, value: Matrix) -> Matrix:
        validated(value, "T_world_camera")
        return value


class PoseAnswer(Message):
    """The new version of the pose."""

    pose: Counter


class JointsRequest(Message):
    """`PUT /robot/joints`: positions in rad (m if prismatic); without a time, the time of arrival counts."""

    positions: JointNumbers
    velocities: JointNumbers | None = None
    at_ns: Nanoseconds | None = Field(default=None, description="On the master's clock, see `GET /robot`.")


class RobotAnswer(Message):
    """`GET /robot`: `fresh`, `stale` (no recent report), `silent` (never reported), or `none` (no robot)."""

    state: RobotState
    reason: Text = ""
    joint_names: tuple[str, ...]
    age_s: float | None = None
    now_ns: Nanoseconds
    joints: tuple[JointSample, ...]


class CommandRow(Answer):
    """The last command of an operator to a unit."""

    id: Counter
    verb: Annotated[Verb, OPEN]
    outcome: Text | None = Field(description="`done`, or the reason; absent while the command runs.")
    code: Annotated[OutcomeCode, OPEN] | None = Field(default=None, description="The outcome, for programs.")
    detail: Text = Field(default="", description="The result, or the reason why it failed.")

    def ended(self, outcome: Outcome) -> CommandRow:
        """Return a copy of the row with the command's outcome."""
        ending = {"outcome": outcome.sentence, "code": outcome.code, "detail": outcome.detail}
        return self.model_copy(update=ending)


class UnitRow(Answer):
    """One unit in `GET /units`: a status, of which a reader ignores unknown names and keeps unknown codes."""

    id: Counter
    ip: str
    serial: str
    model: str
    software: str
    state: Annotated[State, OPEN]
    reason: str
    cause: ReadReason | None = Field(default=None, description="The reason, for programs; absent when there is none.")
    phase: Annotated[Phase, OPEN] = Field(
        default="live", description="Phase of its start: registering, fetching, localising, live."
    )
    age_s: float | None = Field(description="Age of its last frame, since the capture.")
    arrival_age_s: float | None = Field(description="Age of its last update, since the arrival.")
    clock_uncertainty_ms: float | None
    fps: float
    voxels: int
    process_ms: float
    frame_number: int
    health: Annotated[Health, BeforeValidator(_status_health)]
    T_world_camera: Matrix | None
    pose_origin: Annotated[PoseOrigin, OPEN] | None = Field(default=None, description="Origin of the camera's pose.")
    pose_quality: Annotated[PoseQuality, known_names(PoseQuality)] = PoseQuality()
    intrinsics: Annotated[Intrinsics, known_names(Intrinsics)] | None = Field(
        default=None, description="Intrinsics of its camera from its registration; absent before."
    )
    range_m: float | None = Field(
        default=None, description="Distance from its camera to the farthest block of the cell that it looks through."
    )
    versions: Versions
    contract_minor: int | None = Field(
        default=None, description="Minor of the unit's contract; absent until it registers with this master."
    )
    last_command: CommandRow | None = None


class VoxelsAnswer(Answer):
    """`GET /voxels`: the merged map. `voxels` are indices (N, 3), centres (N, 3) in m or keys (N,), as requested."""

    lattice: LatticeDescription
    lattice_version: Counter
    voxels: list[Any]
    witnesses: list[int] = Field(description="Number of live units that report each voxel.")
    complete: bool = Field(description="False when the absence of a voxel does not prove free space.")
    reasons: list[str] = Field(description="Reasons why the map is not complete.")
    causes: list[Reason] = Field(default=[], description="The reasons for programs, in the same order.")
    oldest_view_age_s: float | None
    units_live: int
    now_ns: Nanoseconds
    unseen: dict[str, Any] | None = None


def matrix_of(transform: Transform) -> Matrix:
    """Return a (4, 4) transform as nested tuples of numbers.

    Raises:
        InputError: the shape is not (4, 4).
    """
    if transform.shape != (4, 4):
        raise InputError(f"transform: expected shape (4, 4), got {transform.shape}")
    a, b, c, d = ((float(x), float(y), float(z), float(w)) for x, y, z, w in transform)
    return a, b, c, d
