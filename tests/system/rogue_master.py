# SPDX-License-Identifier: Apache-2.0
"""`python -m tests.system.rogue_master CELL CONTRACT FINGERPRINT` announces itself as a master, and prints all
requests.
"""

from __future__ import annotations

import asyncio
import ssl
import sys

import trustme

from shared.discovery import Announcement, Announcer

PORT = 8420


async def serve(says: Announcement) -> None:
    """Accept all requests."""

    async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        print("was told", await reader.read(65536), flush=True)
        writer.close()

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    trustme.CA().issue_cert("10.78.0.66").configure_cert(context)
    async with await asyncio.start_server(take, "0.0.0.0", PORT, ssl=context if says.tls else None):
        await Announcer(lambda: says, "0.0.0.0", PORT).run()


if __name__ == "__main__":
    cell, contract, fingerprint = sys.argv[1:]
    asyncio.run(serve(Announcement(cell, "00" * 32, int(contract), bool(fingerprint), fingerprint)))
