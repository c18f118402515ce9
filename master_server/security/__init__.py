# SPDX-License-Identifier: Apache-2.0
"""Who may do what, and how often.

In the order of the flow:

    tokens       the files of the two tokens
    auth         who may do what: two tokens
    rate_limits  how much one address may ask for
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
