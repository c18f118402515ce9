# SPDX-License-Identifier: Apache-2.0
"""Whether the master lives; for service managers and balancers, so without a token."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """Answers while the event loop runs."""
    return {"status": "ok"}
