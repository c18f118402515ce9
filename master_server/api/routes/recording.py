# SPDX-License-Identifier: Apache-2.0
"""Start and stop a recording at run time."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends

from master_server.api.routes.common import OPERATOR_ONLY, READERS, Negotiated, ServicesDependency
from master_server.recording.recorder import Recorder, RecordingStatus
from shared.errors import Refusal

router = APIRouter(tags=["recording"], route_class=Negotiated)


async def recorder_of(services: ServicesDependency) -> Recorder:
    """Return the recorder of this application.

    Raises:
        Refusal: 409, it has none.
    """
    if services.recorder is None:
        raise Refusal(409, "recording: this master has no folder to write to")
    return services.recorder


RecorderDependency = Annotated[Recorder, Depends(recorder_of)]


@router.get("/recording", dependencies=READERS)
async def status(recorder: RecorderDependency) -> RecordingStatus:
    """Return the state of the recording, its file, and the number of dropped moments."""
    return recorder.status()


@router.post("/recording", dependencies=OPERATOR_ONLY)
async def start(recorder: RecorderDependency) -> RecordingStatus:
    """Start to record; refused (507) with the reason if the disk is full."""
    return await recorder.start()


@router.delete("/recording", dependencies=OPERATOR_ONLY)
async def stop(recorder: RecorderDependency) -> RecordingStatus:
    """Finish the recording; its files stay."""
    return await recorder.stop()
