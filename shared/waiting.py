# SPDX-License-Identifier: Apache-2.0
"""Waiting with a limit, without losing a cancellation.

`asyncio.wait_for` of Python 3.11 and older swallows a cancellation that arrives together with what is waited for; a
task that is woken thirty times a second then goes on for ever although it was told to end.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any


async def within(timeout_s: float, work: Coroutine[Any, Any, object]) -> bool:
    """Whether `work` was done within `timeout_s`; what is not is cancelled. Its exceptions are raised."""
    task = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait((task,), timeout=timeout_s)
    finally:
        task.cancel()
    if done:
        task.result()
    return bool(done)
