# SPDX-License-Identifier: Apache-2.0
"""Access control and rate limits.

In the order of the flow:

    tokens       the files of the two tokens
    auth         checks requests against the two tokens
    rate_limits  bounds the requests of each address
"""

from master_server.security.auth import Access, load_access
from master_server.security.rate_limits import Limits, plain_ip
from master_server.security.tokens import Role, token_file, write_token

__all__ = [
    "Access",
    "Limits",
    "Role",
    "load_access",
    "plain_ip",
    "token_file",
    "write_token",
]
