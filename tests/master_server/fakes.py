# SPDX-License-Identifier: Apache-2.0
"""Small cells, and fake units that only send messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from master_server.core import Master
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.kinematics import DHJoint, Robot
from shared.meshes import box_mesh
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    Health,
    InitializeAnswer,
    InitializeRequest,
    Matrix,
    SeenReport,
    UpdateAnswer,
    UpdateRequest,
    Versions,
)
from shared.settings import Settings
from shared.timebase import Exchange
from shared.wire import keys_to_bytes, pack_seen
from tests.set_clock import MS as MS
from tests.set_clock import START_NS as START_NS
from tests.set_clock import S as S

AT_ORIGIN: Matrix = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)
GOOD = Health(valid_share=0.9, agreeing_share=0.95, static_share=0.6, process_ms=5.0, frame=1)


def cell(with_robot: bool = False) -> Cell:
    """A box of 1 m, 2 m, 0.5 m; 20 x 40 x 10 voxels of 50 mm, 10 x 20 x 5 blocks of 100 mm."""
    robot = None
    if with_robot:
        joints = [DHJoint("shoulder", 0.2, 0.0, np.pi / 2.0), DHJoint("elbow", 0.0, 0.3, 0.0)]
        robot = Robot.from_dh(joints, [None, box_mesh("arm", (0.1, 0.1, 0.1)), None])
    return Cell("test", np.zeros(3), np.array([1.0, 2.0, 0.5]), robot=robot)


def master(with_robot: bool = False, **settings: Any) -> Master:
    """Return a master of that cell."""
    return Master(cell(with_robot), Settings(**settings))


@dataclass
class FakeUnit:
    """Registers and updates at a master without a network; its clock is the master's less `offset_ns`."""

    master: Master
    ip: str = "10.0.0.1"
    serial: str = "A"
    boot_id: str = "boot"
    offset_ns: int = 0
    delay_ns: int = MS
    sequence: int = 0
    exchange: Exchange | None = None
    joints_until_ns: int = 0
    initialized: InitializeAnswer = field(init=False)
    versions: Versions = field(init=False)

    def introduction(self, sent_ns: int, contract: int = CONTRACT_VERSION) -> InitializeRequest:
        """Return its registration request."""
        return InitializeRequest(
            contract=contract,
            contract_minor=CONTRACT_MINOR,
            serial=self.serial,
            model="fake",
            intrinsics=Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0),
            boot_id=self.boot_id,
            sent_at_ns=sent_ns,
        )

    def initialize(self, now_ns: int = START_NS, pose: Matrix | None = AT_ORIGIN) -> InitializeAnswer:
        """Register; set the pose if the unit knows it and the master does not."""
        sent_ns = now_ns - self.delay_ns - self.offset_ns
        request = self.introduction(sent_ns)
        answer = self.master.initialize(request, self.ip, now_ns)
        self.initialized, self.versions, self.sequence = answer, answer.versions, 0
        self.exchange = Exchange(sent_ns, now_ns, now_ns, now_ns + self.delay_ns - self.offset_ns)
        if answer.T_world_camera is None and pose is not None:
            version = self.master.set_pose(answer.id, pose, "configured", self.ip)
            self.versions = answer.versions.model_copy(update={"pose": version})
        return answer

    def request(
        self,
        now_ns: int,
        keys: Iterable[int] = (),
        seen: SeenReport | None = None,
        age_ns: int = 30 * MS,
        **changes: Any,
    ) -> UpdateRequest:
        """Return the next update, which arrives at `now_ns` with a frame captured `age_ns` before."""
        self.sequence += 1
        fields: dict[str, Any] = {
            "id": self.initialized.id,
            "session": self.initialized.session,
            "sequence": self.sequence,
            "captured_at_ns": now_ns - age_ns - self.offset_ns,
            "sent_at_ns": now_ns - self.delay_ns - self.offset_ns,
            "exchange": self.exchange,
            "versions": self.versions,
            "keys": keys_to_bytes(np.array(sorted(keys), dtype=np.uint32)),
            "seen": seen,
            "health": GOOD,
            "joints_until_ns": self.joints_until_ns,
        }
        return UpdateRequest(**{**fields, **changes})

    def update(self, now_ns: int, keys: Iterable[int] = (), **changes: Any) -> UpdateAnswer:
        """Send the next update, and adopt the versions of the answer."""
        request = self.request(now_ns, keys, **changes)
        answer = self.master.update(request, self.ip, now_ns)
        self.exchange = Exchange(request.sent_at_ns, now_ns, now_ns, now_ns + self.delay_ns - self.offset_ns)
        self.versions = answer.versions
        if answer.joints:
            self.joints_until_ns = answer.joints[-1].at_ns
        return answer


def joined(master: Master, number: int = 1, now_ns: int = START_NS) -> FakeUnit:
    """Return unit `number`, registered with its pose."""
    unit = FakeUnit(master, ip=f"10.0.0.{number}", serial=f"S{number}")
    unit.initialize(now_ns)
    return unit


def sees_all(master: Master) -> SeenReport:
    """Return the report of a unit that sees every block."""
    blocks = master.coverage.blocks
    report = pack_seen(np.ones(blocks.shape, dtype=bool), blocks.voxel_size_m)
    assert report is not None
    return report
