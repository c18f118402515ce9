# SPDX-License-Identifier: Apache-2.0
"""Trust in a master: by a certificate of the configured CA, or by one pinned certificate.

Both are checked during the handshake, before any request, and its token, is sent.
"""

from __future__ import annotations

import hashlib
import hmac
import ssl
from pathlib import Path

from shared.errors import ConfigError

FINGERPRINT_HEX = 64
"""Digits of a sha256."""


def normalised(fingerprint: str) -> str:
    """Return a certificate's sha256 as 64 small hexadecimal digits; openssl writes it in capitals with colons.

    Raises:
        ValueError: it is not a sha256.
    """
    digits = fingerprint.replace(":", "").strip().lower()
    if len(digits) != FINGERPRINT_HEX or not set(digits) <= set("0123456789abcdef"):
        raise ValueError(f"expected the {FINGERPRINT_HEX} hexadecimal digits of a sha256, got {fingerprint!r}")
    return digits


def tls_context(ca: Path | None = None, fingerprint: str | None = None) -> ssl.SSLContext:
    """Return the TLS context that checks the master's certificate.

    With `ca`, a file of PEM certificates, one of these must have signed it, for the host of `master_url`. With
    `fingerprint` (normalised) it must be exactly that certificate, with any signer and host. With both, both checks
    apply; with neither, the CAs of the system decide.

    Raises:
        ConfigError: `ca` cannot be read or holds no certificate.
    """
    try:
        context = ssl.create_default_context(cafile=ca)
    except ssl.SSLError as error:
        raise ConfigError(f"master_ca {ca}: expected certificates in PEM: {error.reason or error}") from error
    except OSError as error:
        raise ConfigError(f"master_ca {ca}: cannot be read: {error.strerror}") from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if fingerprint is not None:
        if ca is None:
            context.check_hostname = False
            context.verify_mode = ssl.CERT_NONE
        context.sslobject_class = _pinned(fingerprint)
    return context


def _pinned(fingerprint: str) -> type[ssl.SSLObject]:
    class PinnedObject(ssl.SSLObject):
        """An SSL object whose handshake fails unless the certificate is the expected one."""

        def do_handshake(self) -> None:
            super().do_handshake()
            certificate = self.getpeercert(binary_form=True) or b""
            came = hashlib.sha256(certificate).hexdigest()
            if not hmac.compare_digest(came, fingerprint):
                raise ssl.SSLCertVerificationError(
                    1, f"the certificate's sha256 is {came}, expected {fingerprint} (master_fingerprint)"
                )

    return PinnedObject
