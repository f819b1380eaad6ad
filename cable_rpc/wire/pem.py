"""Certificates and keys in PEM files, checked before anything connects or listens."""

from __future__ import annotations

import base64
import re
import ssl
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.der import DerError, expiry_of_certificate

CERTIFICATE = re.compile(rb"-----BEGIN CERTIFICATE-----(.+?)-----END CERTIFICATE-----", re.DOTALL)
SOON_S = 14 * 86_400.0
"""A certificate that ends within this time deserves a warning."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate chain with the key of its first certificate."""

    chain: bytes
    """PEM, own certificate first."""
    key: bytes
    """PEM, not encrypted."""
    expires_s: float
    """When the first certificate of the chain to end ends, seconds since 1970."""

    @property
    def warning(self) -> str | None:
        """What is to be said of its age; None = nothing."""
        return expiry_warning("the certificate", self.expires_s)


def load_key_pair(certificate: Path, key: Path, flags: tuple[str, str]) -> KeyPair:
    """Reads a chain and its key.

    Args:
        certificate: PEM file, own certificate first, then the intermediate ones.
        key: PEM file of the private key, without a password.
        flags: how the user names both files, for errors.

    Raises:
        ConfigurationError: a file is missing, unreadable, of another kind, or has ended; or they do not belong
            together.
    """
    chain = read_file(certificate, flags[0])
    ends = [check_certificate(der, certificate, flags[0]) for der in certificates_in(chain, certificate, flags[0])]
    key_bytes = read_file(key, flags[1])
    if b"PRIVATE KEY-----" not in key_bytes:
        raise ConfigurationError(f"{flags[1]} {key} holds no private key in PEM form (-----BEGIN PRIVATE KEY-----)")
    check_pair(certificate, key, flags)
    return KeyPair(chain, key_bytes, min(ends))


def load_authorities(path: Path, flag: str) -> bytes:
    """Reads the certificates that the other end's must descend from; PEM, one or more.

    Raises:
        ConfigurationError: the file is missing, unreadable or holds no certificate, or one that has ended.
    """
    authorities = read_file(path, flag)
    for der in certificates_in(authorities, path, flag):
        check_certificate(der, path, flag)
    return authorities


def read_file(path: Path, flag: str) -> bytes:
    """The bytes of a small file that a flag names.

    Raises:
        ConfigurationError: if it can't be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{flag} {path} can't be read: {error.strerror}") from error


def certificates_in(pem: bytes, path: Path, flag: str) -> list[bytes]:
    """The certificates of a PEM file in DER form.

    Raises:
        ConfigurationError: if there is none.
    """
    try:
        found = [base64.b64decode(body) for body in CERTIFICATE.findall(pem)]
    except ValueError as error:
        raise ConfigurationError(f"{flag} {path} is damaged: {error}") from error
    if not found:
        raise ConfigurationError(f"{flag} {path} holds no certificate in PEM form (-----BEGIN CERTIFICATE-----)")
    return found


def check_certificate(der: bytes, path: Path, flag: str) -> float:
    """When a certificate ends, seconds since 1970.

    Raises:
        ConfigurationError: it has ended, or is damaged.
    """
    try:
        expires_s = expiry_of_certificate(der)
    except DerError as error:
        raise ConfigurationError(f"{flag} {path} holds a damaged certificate: {error}") from error
    if expires_s <= time.time():
        raise ConfigurationError(f"{flag} {path} expired on {day(expires_s)}; renew it")
    return expires_s


def check_pair(certificate: Path, key: Path, flags: tuple[str, str]) -> None:
    """Checks that a key belongs to a certificate.

    Raises:
        ConfigurationError: it does not, or needs a password.
    """

    def refuse_password() -> bytes:
        raise ConfigurationError(f"{flags[1]} {key} is encrypted; give a key without a password")

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, refuse_password)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise ConfigurationError(
                f"{flags[1]} {key} is not the key of {flags[0]} {certificate}; give the pair that was made together"
            ) from error
        raise ConfigurationError(
            f"{flags[0]} {certificate} and {flags[1]} {key} can't be used: {error.reason or error}"
        ) from error


def expiry_warning(what: str, expires_s: float) -> str | None:
    """A sentence where something ends soon."""
    left_s = expires_s - time.time()
    if left_s > SOON_S:
        return None
    return f"{what} ends in {max(left_s, 0) / 86_400:.1f} days, on {day(expires_s)}; renew it"


def day(seconds: float) -> str:
    """A date for people, UTC."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M UTC")
