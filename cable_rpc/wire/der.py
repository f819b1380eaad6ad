"""The one date that we need out of an X.509 certificate (RFC 5280, section 4.1), which the standard library hides."""

from __future__ import annotations

from datetime import UTC, datetime

SEQUENCE, INTEGER, UTC_TIME, GENERALIZED_TIME, VERSION = 0x30, 0x02, 0x17, 0x18, 0xA0


class DerError(ValueError):
    """The bytes are no certificate."""


def expiry_of_certificate(der: bytes) -> float:
    """The notAfter of a certificate, seconds since 1970.

    Raises:
        DerError: if the bytes are no certificate.
    """
    certificate, _ = element(der, SEQUENCE)
    rest, _ = element(certificate, SEQUENCE)
    if rest[:1] == bytes([VERSION]):
        _, rest = element(rest, VERSION)
    # Serial number, signature algorithm and issuer stand before the validity.
    for kind in (INTEGER, SEQUENCE, SEQUENCE):
        _, rest = element(rest, kind)
    validity, _ = element(rest, SEQUENCE)
    _, not_after = element(validity, validity[0] if validity else UTC_TIME)
    kind = not_after[0] if not_after else 0
    text, _ = element(not_after, kind)
    try:
        moment = datetime.strptime(text.decode("ascii"), "%y%m%d%H%M%SZ" if kind == UTC_TIME else "%Y%m%d%H%M%SZ")
    except ValueError as error:
        raise DerError(f"its end date is unreadable: {error}") from error
    # RFC 5280, 4.1.2.5.1: two-digit years from 50 on are of the last century.
    if kind == UTC_TIME and moment.year >= 2050:
        moment = moment.replace(year=moment.year - 100)
    return moment.replace(tzinfo=UTC).timestamp()


def element(data: bytes, kind: int) -> tuple[bytes, bytes]:
    """The contents of the first element, and what follows it.

    Raises:
        DerError: if it is of another kind, or cut.
    """
    if len(data) < 2 or data[0] != kind:
        raise DerError(f"an element of kind {kind:#x} was expected")
    length, start = data[1], 2
    if length & 0x80:
        start += length & 0x7F
        length = int.from_bytes(data[2:start], "big")
    if start + length > len(data):
        raise DerError("it is cut short")
    return data[start : start + length], data[start + length :]
