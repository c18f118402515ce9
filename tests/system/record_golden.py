# SPDX-License-Identifier: Apache-2.0
"""Record the golden bytes of this version's contract: `python -m tests.system.record_golden 5.1 --after 5.0`.

Run it once, when the minor of the contract has been raised, with the conversation of the version before: a unit of now
says the same, with the names and codes that are new (`said_by_now`), and a master of now answers. The tests read every
folder of `tests/shared/golden` and need no change. A recording is never made again: units of that version say the same
for as long as they run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import shutil
import sqlite3
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from master_server.persistence import Store
from master_server.recording.moment import StateRecord, moment_of
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    Ended,
    Health,
    InitializeRequest,
    Progress,
)
from shared.wire import decode_update, encode, encode_update, unpack
from tests.system.conversation import GOLDEN, Step, Table, keep, recorded

TROUBLES: dict[str, dict[str, Any]] = {
    "looks for the board": {"trouble_code": "board", "progress": Progress(task="calibration", done=3, total=20)},
    "learns the background": {"trouble_code": "background", "progress": Progress(task="background", done=3, total=60)},
    "gets joints": {"progress": Progress(task="refinement", done=9, total=30)},
}
"""Fields of the health that a unit of 5.1 adds in some steps."""

PRAGMAS = ("application_id", "user_version")

MOMENTS = ("readers ask for the units that learn", "works with it")
"""Steps after which the recorder's state is kept."""


def said_by_now(step: Step) -> Step:
    """Return a step as a unit of this version says it; what operators, robots and readers say stays."""
    if not step.is_units or not step.body:
        return step
    if step.path == "/initialize":
        fields = unpack(step.body, 2**20)
        if step.name != "a newer major is refused":
            fields["contract_minor"] = CONTRACT_MINOR + (step.name == "a newer minor is refused")
        return replace(step, body=encode(InitializeRequest.model_validate(fields)))
    if step.path != "/update":
        return step
    update = decode_update(step.body)
    health = Health.model_validate(update.health.model_dump() | TROUBLES.get(step.name, {}))
    done = tuple(Ended.of(ended.id, ended.outcome) for ended in update.done)
    return replace(step, body=encode_update(update.model_copy(update={"health": health, "done": done})))


async def record(version: str, after: str) -> None:
    """Record `version` from the conversation of the version `after` which it comes."""
    folder = GOLDEN / version
    folder.mkdir()
    shutil.copy(GOLDEN / after / "cell.json", folder / "cell.json")
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as place:
        path = Path(place) / "master.db"
        store = Store.open(path)
        table = Table(version, patch, store)
        said, states = [], []
        for step in recorded(after):
            now = said_by_now(step)
            said.append(await table.say(now.name, now.method, now.path, now.token, now.body))
            if step.name in MOMENTS:
                moment = moment_of(table.master, table.now_ns)
                states.append(StateRecord.of(moment).model_dump(mode="json"))
        keep(version, said)
        (folder / "states.json").write_text(json.dumps(states, indent=1, ensure_ascii=False) + "\n")
        store.close()
        with sqlite3.connect(path) as kept:
            # A dump leaves them out, and they say that it is a store of ours.
            pragmas = [f"PRAGMA {name}={kept.execute(f'PRAGMA {name}').fetchone()[0]};" for name in PRAGMAS]
            (folder / "master.sql").write_text("\n".join((*kept.iterdump(), *pragmas)) + "\n")
        kept.close()


def main() -> None:
    """Record the version that is named; it must be that of this source."""
    parser = argparse.ArgumentParser(prog="python -m tests.system.record_golden", description=__doc__.split("\n")[0])
    parser.add_argument("version", help="major and minor of the contract, as 5.1")
    parser.add_argument("--after", required=True, help="the version before, whose conversation is said again")
    chosen = parser.parse_args()
    if chosen.version != f"{CONTRACT_VERSION}.{CONTRACT_MINOR}":
        sys.exit(f"expected the contract of this source, {CONTRACT_VERSION}.{CONTRACT_MINOR}, got {chosen.version}")
    asyncio.run(record(chosen.version, chosen.after))


if __name__ == "__main__":
    main()
