# SPDX-License-Identifier: Apache-2.0
"""Compare the registry with a slow model, in any history of units that come, go, change addresses and restart."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from master_server.core import Registry
from master_server.core import units as registry_module
from master_server.persistence import Store
from shared.camera import Intrinsics
from shared.errors import Refusal
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION, InitializeRequest
from tests.master_server.fakes import AT_ORIGIN, START_NS, S

MAX_UNITS = 4
"""Instead of 64, so that tests reach it."""

STALE_AFTER_S = 1.0
IPS = [f"10.0.0.{number}" for number in range(1, 8)]
SERIALS = "ABCDEFG"


@dataclass
class Known:
    """The model's state of the slot of one IP."""

    id: int
    serial: str
    updated_at_ns: int | None = None
    has_pose: bool = False

    def reports(self, now_ns: int) -> bool:
        return self.updated_at_ns is not None and now_ns - self.updated_at_ns <= STALE_AFTER_S * S


class RegistryMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(registry_module, "MAX_UNITS", MAX_UNITS)
        self.store = Store.in_memory()
        self.registry = Registry(self.store)
        self.twin: dict[str, Known] = {}
        self.given: set[int] = set()
        self.now_ns = START_NS

    def teardown(self) -> None:
        self.store.close()
        self.patch.undo()

    @rule(ip=st.sampled_from(IPS), serial=st.sampled_from(SERIALS), boot=st.sampled_from("xy"))
    def initialize(self, ip: str, serial: str, boot: str) -> None:
        request = InitializeRequest(
            contract=CONTRACT_VERSION, contract_minor=CONTRACT_MINOR,
            serial=serial, intrinsics=Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0),
            boot_id=boot, sent_at_ns=self.now_ns,
        )  # fmt: skip
        here = self.twin.get(ip)
        elsewhere = [there for there, known in self.twin.items() if known.serial == serial and there != ip]
        expected = 0
        if any(self.twin[there].reports(self.now_ns) for there in elsewhere) or (
            here is not None and here.serial != serial and here.reports(self.now_ns)
        ):
            expected = 409
        elif here is None and len(self.twin) - len(elsewhere) >= MAX_UNITS:
            expected = 503
        if expected:
            with pytest.raises(Refusal) as caught:
                self.registry.initialize(request, ip, self.now_ns, STALE_AFTER_S)
            assert caught.value.status == expected
            return
        slot, retired = self.registry.initialize(request, ip, self.now_ns, STALE_AFTER_S)
        assert sorted(old.ip for old in retired) == sorted(elsewhere)
        assert len(elsewhere) <= 1
        for there in elsewhere:
            if here is None or here.serial == serial:
                del self.twin[there]
            else:
                # The earlier camera is expected in the slot that the new one left.
                self.twin[there] = Known(self.twin[there].id, here.serial)
        if here is None:
            # An id is never reused: a deleted unit would otherwise report into another's slot.
            assert slot.id > max(self.given, default=0)
            self.given.add(slot.id)
            self.twin[ip] = Known(slot.id, serial, has_pose=slot.T_world_camera is not None)
        else:
            assert slot.id == here.id
            if here.serial != serial:
                assert slot.T_world_camera is None
            here.has_pose = slot.T_world_camera is not None
            here.serial, here.updated_at_ns = serial, None

    @precondition(lambda self: self.twin)
    @rule(data=st.data())
    def update(self, data: st.DataObject) -> None:
        ip = data.draw(st.sampled_from(sorted(self.twin)))
        slot = self.registry.own(self.twin[ip].id, ip)
        slot.session.arrived_at_ns = self.twin[ip].updated_at_ns = self.now_ns

    @precondition(lambda self: self.twin)
    @rule(data=st.data())
    def find_its_pose(self, data: st.DataObject) -> None:
        ip = data.draw(st.sampled_from(sorted(self.twin)))
        slot = self.registry.get(self.twin[ip].id)
        before = slot.pose_version
        self.registry.set_pose(slot, AT_ORIGIN, "board")
        assert slot.pose_version > before
        self.twin[ip].has_pose = True

    @precondition(lambda self: self.twin)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        ip = data.draw(st.sampled_from(sorted(self.twin)))
        self.registry.remove(self.twin.pop(ip).id)

    @rule(seconds=st.sampled_from((0.1, 0.9, 1.1)))
    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)

    @rule()
    def restart(self) -> None:
        saved = self.store.load()
        self.registry = Registry(self.store, saved.units, saved.last_id)
        for known in self.twin.values():
            known.updated_at_ns = None

    @invariant()
    def equals_the_model(self) -> None:
        assert {slot.ip: (slot.id, slot.serial) for slot in self.registry} == {
            ip: (known.id, known.serial) for ip, known in self.twin.items()
        }
        assert {slot.ip: slot.T_world_camera is not None for slot in self.registry} == {
            ip: known.has_pose for ip, known in self.twin.items()
        }
        assert len(self.registry) <= MAX_UNITS
        assert len({slot.serial for slot in self.registry}) == len(self.registry)
        for slot in self.registry:
            with pytest.raises(Refusal, match="another IP") as caught:
                self.registry.own(slot.id, "10.0.9.9")
            assert caught.value.status == 403
        for gone in self.given - {known.id for known in self.twin.values()}:
            with pytest.raises(Refusal, match="initialize first") as caught:
                self.registry.get(gone)
            assert caught.value.status == 404

    @invariant()
    def everything_is_stored(self) -> None:
        assert {unit.id: unit for unit in self.store.load().units} == {slot.id: slot.record for slot in self.registry}


TestRegistryMachine = RegistryMachine.TestCase
TestRegistryMachine.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)
