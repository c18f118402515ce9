# SPDX-License-Identifier: Apache-2.0
"""What units, master, robot and operators say to each other.

Times are integers of nanoseconds: `_at_ns` of a unit by its CLOCK_MONOTONIC, of the master and of
joints by the master's. Every text, list and array is bounded, since anyone on the network may send one.

The contract has a major and a minor number. Within a major, a unit works with any master whose minor is at least its
own, so a master is updated before its units. What that asks of whoever changes this file:

    requests        get new names with defaults; a unit sends them to no master that is older, for none takes it in
    answers         `Answer`: the names beside settings, lattice, cell, pose, joints and commands are status, and a
                    unit ignores those that it does not know; nothing that a unit must obey is put there
    what is obeyed  settings, lattice, cell, pose, joints, commands: a unit refuses names that it does not know, since
                    it would filter where it must not, and tells so as its trouble `contract`. So a master leaves new
                    names out where nothing uses them, and asks a unit for no verb that its minor does not have
    rows            of values without names are longer at their end: a unit ignores what is beyond those it knows, a
                    master takes a shorter row as one whose last values are at their defaults
    defaults        never change, since what is at its default may not travel

What each minor said is recorded in `tests/shared/golden`, and stays as it is.
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
    TypeAdapter,
    field_validator,
    model_validator,
)

from shared.camera import Intrinsics
from shared.errors import InputError
from shared.lattice import MAX_AXIS, Lattice
from shared.settings import Settings
from shared.timebase import Exchange
from shared.transforms import Transform, validated

CONTRACT_VERSION = 5
"""The major number: rises when a unit of the old contract and a master of the new one can no longer work together."""

CONTRACT_MINOR = 1
"""Rises with each addition, at most once a release. 5.0 had no outcome codes, no trouble codes and no progress."""

MAX_TEXT = 200
"""Enough for a serial, a version or one sentence; keeps tables and logs readable."""

MAX_JOINTS = 32
"""More than two arms on a track with grippers have."""

MAX_JOINT_VALUE = 1e4
"""Of a position in rad or m, or a velocity: 1600 turns. No robot is there, and on the wire it must fit a float32."""

MAX_VOXELS = 2**18
"""In one update: a wall that is in no CAD, 5 m by 5 m at 10 mm, still fits; 1 MiB on the wire."""

MAX_SEEN_BYTES = 4096
"""Of one seen report, compressed; coarser blocks are reported when it would be more."""

MAX_COMMANDS = 16
"""Pending for one unit; an operator who clicks on is told to wait."""

MAX_JOINT_SAMPLES = 32
"""In one answer: a slow unit at 5 fps gets all that it needs at one sample in 8 ms."""


PICTURE_RANGE_M = (0.3, 6.0)
"""What the colours of all units' pictures span: from what is nearest to a camera to the far wall of its cell."""

MAX_IMAGE_BYTES = 2**22
"""Of one picture: 1280 x 720 in three colours has 2.8 MB even when nothing of it can be compressed."""


def is_newer(contract: object, minor: object) -> bool:
    """Return True if this is the contract, by its two numbers, of a program that is newer than this one."""
    if not isinstance(contract, int) or not isinstance(minor, int):
        return False
    return (contract, minor) > (CONTRACT_VERSION, CONTRACT_MINOR)


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("expected printable characters only, since it is written into logs")
    return text


Text = Annotated[str, Field(max_length=MAX_TEXT)]
Label = Annotated[Text, AfterValidator(_printable)]
Nanoseconds = Annotated[int, Field(ge=0, lt=2**63)]
Counter = Annotated[int, Field(ge=0, lt=2**63)]
Minor = Annotated[int, Field(ge=0, lt=2**31)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
JointValues = Annotated[tuple[float, ...], Field(max_length=MAX_JOINTS)]
# Strict, for true is no angle.
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
ToldOrigin = Literal["configured", "source"]
TroubleCode = Literal["camera", "board", "background", "joints", "frame", "contract"]
"""
camera      it delivers no frames
board       the camera's pose is not known, and the board is looked for
background  it is being learned
joints      where the robot is, is not known, and no frame can do without
frame       cannot be processed with this cell, pose and settings
contract    the master asks what this unit's minor does not know; update the unit
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
"""Why a unit is in its state, or the map not complete: what units tell as their trouble (`trouble`: one of contract
5.0, which has no codes), then by the states uncalibrated, stale, blind and moved, live with a warning; then the map."""
OutcomeCode = Literal["done", "refused", "failed", "superseded", "unanswered"]
"""
done        carried out
refused     cannot be done as things are; nothing was tried
failed      tried, and nothing is changed
superseded  void, by what was asked or came about later
unanswered  the unit did not answer in its time
"""


class Message(BaseModel):
    """Frozen; unknown names, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Answer(Message):
    """A message that one who is older may read: unknown names are ignored, those of what it holds are not."""

    model_config = ConfigDict(extra="ignore")


class Versions(Answer):
    """Counters of the master that rise with each change; a unit tells which ones it works with."""

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
        """Describe a lattice."""
        return cls(origin_m=lattice.origin_m, voxel_size_m=lattice.voxel_size_m, shape=lattice.shape)

    def lattice(self) -> Lattice:
        """The lattice described.

        Raises:
            InputError: there can be no such lattice.
        """
        return Lattice(self.origin_m, self.voxel_size_m, self.shape)


class CellReference(Message):
    """Which cell the master watches; `sha256` of its document, by which a unit keeps it on disk."""

    name: Text
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class CellAnswer(Message):
    """What a change of the cell led to: the cell that is watched now, and the versions that units must work with."""

    cell: CellReference
    versions: Versions


class ObjectPoseRequest(Message):
    """Where a known object stands now: `T_world_object` (4, 4), its mesh's frame in the world."""

    T_world_object: Matrix

    @field_validator("T_world_object")
    @classmethod
    def _rigid(cls, value: Matrix) -> Matrix:
        validated(value, "T_world_object")
        return value


class JointSample(NamedTuple):
    """The robot's joints at one time by the master's clock: positions (n,) rad (m if prismatic), velocities per s."""

    at_ns: Nanoseconds
    positions: JointValues
    velocities: JointValues | None


class Command(Message):
    """Something that a unit is asked to do; it tells the outcome under the same `id` in a later update."""

    id: Counter
    verb: Verb
    image: ImageKind | None = Field(default=None, description="With the verb `image`: which one.")
    raw: bool = Field(default=False, description="With the verb `image`: 16 bits in units of depth_scale, no colours.")


class Outcome(NamedTuple):
    """What became of a command: a code for programs, and for people what it gained, or why it was not carried out."""

    code: OutcomeCode
    detail: Text = ""

    @property
    def sentence(self) -> str:
        """`done`, whatever it gained, or why not."""
        return self.code if self.code == "done" else self.detail


DONE = Outcome("done")


class Ended(NamedTuple):
    """A command that came to an end, as it travels: units of contract 5.0 have no code, and say `done` in the text."""

    id: Counter
    text: Text
    code: OutcomeCode | None = None

    @classmethod
    def of(cls, command_id: int, outcome: Outcome) -> Ended:
        """The command of this id with its outcome; a detail that is too long is cut."""
        return cls(command_id, outcome.detail[:MAX_TEXT], outcome.code)

    @property
    def outcome(self) -> Outcome:
        """What became of it, whichever contract the unit speaks."""
        if self.code is not None:
            return Outcome(self.code, self.text)
        head, _, gained = self.text.partition(": ")
        return Outcome("done", gained) if head == "done" else Outcome("failed", self.text)


class InitializeRequest(Message):
    """A unit with its camera asks for its slot (Algorithm 8)."""

    contract: int = Field(ge=0, lt=2**31)
    contract_minor: Minor = Field(default=0, description="Units of 5.0 have none.")
    serial: Label = Field(min_length=1, description="Serial number of the camera.")
    model: Label = ""
    intrinsics: Intrinsics
    software: Label = ""
    boot_id: Label = Field(default="", description="Changes when the unit's monotonic clock starts anew.")
    T_world_camera: Matrix | None = Field(
        default=None, description="Where the unit was told that its camera is; the master may know better."
    )
    pose_origin: ToldOrigin = "configured"
    sent_at_ns: Nanoseconds

    @model_validator(mode="before")
    @classmethod
    def _known_part(cls, fields: Any) -> Any:
        """Of a newer unit only the names known here, so that it is refused for its contract and not for a name."""
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
    """The slot, and all that a unit needs to begin."""

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
    contract_minor: Minor = Field(default=0, description="The master's; a unit of 5.0 is not told.")


class SlotAnswer(Answer):
    """The part of `InitializeAnswer` that a unit of any minor can read."""

    id: Counter
    session: Counter
    versions: Versions
    received_at_ns: Nanoseconds
    answered_at_ns: Nanoseconds
    contract_minor: Minor = 0


class SeenReport(Message):
    """Which blocks of the cell a frame looks through.

    One bit each in C order `(ix*ny + iy)*nz + iz`, from the lattice's origin, little-endian bits, zlib.
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
    """Why something is as it is: a code and named numbers for programs, a sentence for people.

    Numbers are in the units that end their names; `unit` is the id of the unit that it is about.
    """

    # Readers pass over what a later master tells besides, also within a message that forbids it.
    __pydantic_config__ = ConfigDict(extra="ignore")

    code: ReasonCode
    sentence: str
    numbers: dict[str, float] = field(default_factory=dict)


_REASON = TypeAdapter(Reason)

ReadReason = Annotated[Reason, BeforeValidator(_REASON.validate_python)]
"""A reason that is read strictly, too, where only an instance would count as one."""


class Progress(Message):
    """How far a task has come: `done` of `total` frames."""

    task: Literal["background"]
    done: Counter
    total: Counter


class Health(Message):
    """How far a unit's view can be trusted, with the frame that it tells of."""

    valid_share: Share = Field(default=0.0, description="Share of the pixels that measured anything.")
    agreeing_share: Share = Field(
        default=0.0, description="Share of the measured pixels before a known static surface that fit it."
    )
    residual_share: float = Field(
        default=0.0, ge=-1.0, le=1.0, description="Median of measured less expected depth, in parts of the margin."
    )
    static_share: Share = Field(default=0.0, description="Share of the pixels before a known static surface.")
    process_ms: float = Field(default=0.0, ge=0.0, description="Time from a frame to its voxels.")
    frame: Counter = Field(default=0, description="Number of the frame.")
    trouble: Text | None = Field(default=None, description="What is wrong at the unit, in one sentence.")
    warning: Text | None = Field(default=None, description="What is worse than it need be, though it works.")
    moved: Text | None = Field(default=None, description="Why the camera seems to stand elsewhere than its pose says.")
    blind: Text | None = Field(default=None, description="Why the camera seems covered or dazzled.")
    trouble_code: TroubleCode | None = Field(default=None, description="What is wrong, for programs; since 5.1.")
    progress: Progress | None = Field(default=None, description="Of what is to be waited for; since 5.1.")


class UpdateRequest(Message):
    """What a unit reports of its newest frame (Algorithm 8)."""

    id: Counter
    session: Counter
    sequence: Counter
    captured_at_ns: Nanoseconds | None = Field(default=None, description="Absent: there is no frame yet.")
    sent_at_ns: Nanoseconds
    exchange: Exchange | None = Field(default=None, description="The four times of the exchange before.")
    versions: Versions = Field(description="What the voxels were made with.")
    keys: bytes = Field(default=b"", max_length=4 * MAX_VOXELS, description="Ascending little-endian uint32.")
    seen: SeenReport | None = Field(default=None, description="Absent: as it was in the update before.")
    health: Health = Health()
    joints_until_ns: Nanoseconds = Field(default=0, description="The newest joints that the unit has.")
    done: tuple[Ended, ...] = Field(default=(), max_length=MAX_COMMANDS, description="Commands that came to an end.")
    phase: Phase = Field(default="live", description="How far the unit has come since it started.")


class UpdateAnswer(Answer):
    """What a unit needs next. Settings, lattice, cell and pose only where the unit's version is another."""

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
    """How well a camera's pose is known by what it was found by; what was not measured is absent."""

    uncertainty_mm: float | None = Field(default=None, ge=0.0, description="Standard error of its position.")
    uncertainty_deg: float | None = Field(default=None, ge=0.0, description="Standard error of its rotation.")
    reprojection_px: float | None = Field(default=None, ge=0.0, description="RMS, where it was found by the board.")


class PoseRequest(Message):
    """Where a unit's camera is: `T_world_camera` (4, 4), optical frame."""

    T_world_camera: Matrix
    origin: PoseOrigin = "operator"
    quality: PoseQuality = PoseQuality()

    @field_validator("T_world_camera")
    @classmethod
    def _rigid(cls, value: Matrix) -> Matrix:
        validated(value, "T_world_camera")
        return value


class PoseAnswer(Message):
    """The version that the pose has now."""

    pose: Counter


class JointsRequest(Message):
    """`PUT /robot/joints`: positions in rad (m if prismatic); without a time they count from their arrival."""

    positions: JointNumbers
    velocities: JointNumbers | None = None
    at_ns: Nanoseconds | None = Field(default=None, description="By the master's clock, see `GET /robot`.")


class RobotAnswer(Message):
    """`GET /robot`: `fresh`, `stale` (silent for too long), `silent` (never reported), or `none` in this cell."""

    state: Literal["fresh", "stale", "silent", "none"]
    reason: Text = ""
    joint_names: tuple[str, ...]
    age_s: float | None = None
    now_ns: Nanoseconds
    joints: tuple[JointSample, ...]


class CommandRow(Answer):
    """The last thing that an operator asked of a unit."""

    id: Counter
    verb: Verb
    outcome: Text | None = Field(description="`done`, or why not; absent while the unit is at it.")
    code: OutcomeCode | None = Field(default=None, description="The same for programs.")
    detail: Text = Field(default="", description="What it gained, or why it was not carried out.")

    def ended(self, outcome: Outcome) -> CommandRow:
        """The same, come to its end."""
        told = {"outcome": outcome.sentence, "code": outcome.code, "detail": outcome.detail}
        return self.model_copy(update=told)


class UnitRow(Answer):
    """One unit in `GET /units`."""

    id: Counter
    ip: str
    serial: str
    model: str
    software: str
    state: State
    reason: str
    cause: ReadReason | None = Field(default=None, description="The reason for programs; absent where there is none.")
    phase: Phase = Field(default="live", description="How far it has come: registering, fetching, localising, live.")
    age_s: float | None = Field(description="Since the capture of its last frame.")
    arrival_age_s: float | None = Field(description="Since its last update arrived.")
    clock_uncertainty_ms: float | None
    fps: float
    voxels: int
    process_ms: float
    frame_number: int
    health: Health
    T_world_camera: Matrix | None
    pose_origin: PoseOrigin | None = Field(default=None, description="Who said where the camera is.")
    pose_quality: PoseQuality = PoseQuality()
    intrinsics: Intrinsics | None = Field(
        default=None, description="Of its camera, as it told them when it registered; absent until it did."
    )
    range_m: float | None = Field(
        default=None, description="How far before its camera the farthest block of the cell lies that it looks through."
    )
    versions: Versions
    contract_minor: int | None = Field(
        default=None, description="Of the contract that the unit speaks; absent until it registered with this master."
    )
    last_command: CommandRow | None = None


class VoxelsAnswer(Answer):
    """`GET /voxels`: the merged map. `voxels` are indices (N, 3), centres (N, 3) in m or keys (N,), as asked for."""

    lattice: LatticeDescription
    lattice_version: Counter
    voxels: list[Any]
    witnesses: list[int] = Field(description="How many live units report each voxel.")
    complete: bool = Field(description="False whenever a voxel's absence proves nothing.")
    reasons: list[str] = Field(description="Why it is not complete.")
    causes: list[Reason] = Field(default=[], description="The same for programs, in the same order.")
    oldest_view_age_s: float | None
    units_live: int
    now_ns: Nanoseconds
    unseen: dict[str, Any] | None = None


def matrix_of(transform: Transform) -> Matrix:
    """A (4, 4) transform as nested tuples of numbers.

    Raises:
        InputError: it is not (4, 4).
    """
    if transform.shape != (4, 4):
        raise InputError(f"transform: expected shape (4, 4), got {transform.shape}")
    a, b, c, d = ((float(x), float(y), float(z), float(w)) for x, y, z, w in transform)
    return a, b, c, d
